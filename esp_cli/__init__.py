"""ESP: symmetry priors for multi-agent reinforcement learning."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from esp_cli.deploy.library import LoadedPolicy, load_policy

__all__ = ["LoadedPolicy", "__version__", "load_policy"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import what other programs use when they ask for it: torch takes a second, `esp --help` a sixth of one."""
    if name in ("LoadedPolicy", "load_policy"):
        from esp_cli.deploy import library  # noqa: PLC0415 - see above

        return getattr(library, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
