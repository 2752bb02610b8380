"""The finished run that the tests of the commands share, for the tests of trackers."""

from tests.cli.conftest import copied, finished

__all__ = ["copied", "finished"]
