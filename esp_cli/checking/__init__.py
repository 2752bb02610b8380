"""Whether a task is as symmetric as it claims: from paired states where it can be set to one, else from transitions."""

from esp_cli.checking.candidates import candidates, named
from esp_cli.checking.paired import check_paired
from esp_cli.checking.policy import PolicyVerdict, check_policy
from esp_cli.checking.recorded import Transitions, collect
from esp_cli.checking.task import SymmetryReport, check_recorded, check_symmetry
from esp_cli.checking.transitions import check_transitions
from esp_cli.checking.verdicts import ElementVerdict, FieldVerdict

__all__ = [
    "ElementVerdict",
    "FieldVerdict",
    "PolicyVerdict",
    "SymmetryReport",
    "Transitions",
    "candidates",
    "check_paired",
    "check_policy",
    "check_recorded",
    "check_symmetry",
    "check_transitions",
    "collect",
    "named",
]
