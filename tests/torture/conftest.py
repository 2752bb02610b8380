"""The assault reads searches, too: without Optuna its tests are left out, and `.ci/run` installs it."""

from importlib.util import find_spec

collect_ignore = [] if find_spec("optuna") else ["test_torture.py"]
