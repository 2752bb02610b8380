"""MLflow in the run folder's `mlruns/`, a file store, unless MLFLOW_TRACKING_URI says otherwise."""

from __future__ import annotations

import os
import time

# read when mlflow is imported or a store is opened; what the user has set stays
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
# a server that does not answer ends the tracking within seconds, not minutes
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")

from mlflow.entities import Metric, Param
from mlflow.tracking import MlflowClient

from esp_cli.files.documents import flat
from esp_cli.files.opening import own_folder
from esp_cli.files.writing import replace_file
from esp_cli.training.trackers.sink import Row, TrackedRun, scalars

_MOST_PARAMS = 100
"""Parameters that one request of MLflow takes."""
_LONGEST_VALUE = 500


class MlFlow:
    """Logs one run of the experiment "esp"; `mlflow ui --backend-store-uri RUN/mlruns` shows it."""

    def __init__(self, run: TrackedRun) -> None:
        folder = run.folder.absolute()
        self._seeds = run.seeds
        store = own_folder(folder / "mlruns")
        self._client = MlflowClient(os.environ.get("MLFLOW_TRACKING_URI") or store.as_uri())
        found = self._client.get_experiment_by_name("esp")
        experiment = found.experiment_id if found is not None else self._client.create_experiment("esp")
        file = store / "run-id"
        if file.is_file():
            self._run_id = file.read_text(encoding="utf-8").strip()
            self._client.update_run(self._run_id, status="RUNNING")
            return
        self._run_id = self._client.create_run(experiment, run_name=folder.name).info.run_id
        params = [Param(name, str(value)[:_LONGEST_VALUE]) for name, value in flat(run.config)]
        for begin in range(0, len(params), _MOST_PARAMS):
            self._client.log_batch(self._run_id, params=params[begin : begin + _MOST_PARAMS])
        store.mkdir(exist_ok=True)
        replace_file(file, self._run_id.encode())

    def write(self, step: int, values: Row) -> None:
        """Log the means under their names, and each seed's number under seed-k/NAME."""
        now_ms = int(time.time() * 1000)
        metrics = [
            Metric(name if seed is None else f"seed-{seed}/{name}", value, now_ms, step)
            for name, seed, value in scalars(values, self._seeds)
        ]
        for begin in range(0, len(metrics), 1000):
            self._client.log_batch(self._run_id, metrics=metrics[begin : begin + 1000])

    def close(self) -> None:
        """Mark the run as ended."""
        self._client.set_terminated(self._run_id)
