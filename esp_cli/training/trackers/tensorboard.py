"""TensorBoard event files in the run folder's `tensorboard/`: the mean over seeds, and a sub-folder for each seed."""

from __future__ import annotations

from typing import Any

from torch.utils.tensorboard import SummaryWriter

from esp_cli.files.opening import own_folder
from esp_cli.training.trackers.sink import Row, TrackedRun, scalars


class TensorBoard:
    """Writes event files; TensorBoard lays the curves of `seed-k` over the mean under the same name."""

    def __init__(self, run: TrackedRun) -> None:
        self._run = run
        self._boards: dict[int | None, Any] = {}  # SummaryWriter has no types
        self._board(None)

    def write(self, step: int, values: Row) -> None:
        """Add a scalar per metric and seed."""
        for name, seed, value in scalars(values, self._run.seeds):
            self._board(seed).add_scalar(name, value, step)

    def close(self) -> None:
        """Close the event files."""
        for board in self._boards.values():
            board.close()

    def _board(self, seed: int | None) -> Any:
        if seed not in self._boards:
            folder = own_folder(self._run.folder / "tensorboard")
            place = folder if seed is None else own_folder(folder / f"seed-{seed}")
            # what a resumed run writes again is hidden, also where it begins anew without a checkpoint
            purge = self._run.first_step + 1 if self._run.first_step else 0
            self._boards[seed] = SummaryWriter(str(place), purge_step=purge, flush_secs=10)
        return self._boards[seed]
