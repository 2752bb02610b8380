"""The one exception for what a user can get wrong."""

from __future__ import annotations


class UserError(ValueError):
    """A mistake that whoever uses this package can correct; its message says what is wrong, where, and what to do.

    The application shows the message alone and ends with exit code 2. Any other `ValueError` is a fault of the code
    that raised it, and keeps its traceback.

    Example:
        >>> raise UserError("task.num_agents is 0; write at least 1")
        Traceback (most recent call last):
        ...
        esp_envs.errors.UserError: task.num_agents is 0; write at least 1
    """
