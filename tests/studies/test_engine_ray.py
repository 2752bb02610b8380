"""Studies on a real Ray cluster of two nodes on this machine: nodes, workers and drivers come and go."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("ray", reason="needs Ray, of the extra cluster")

import ray
from ray.cluster_utils import Cluster

from esp_cli.run import Run
from esp_cli.studies import engine_ray, versions
from esp_cli.studies.engine import Engine
from esp_cli.studies.engine_local import LocalEngine
from esp_cli.studies.engine_ray import RayEngine
from esp_cli.studies.mirror import Mirror
from esp_cli.studies.ray_cluster import ClusterError, refuse_what_no_node_has
from esp_cli.studies.scheduler import Scheduler, Snapshot
from esp_cli.studies.study import Cell, Study, StudyFolder
from esp_cli.studies.tuning import TuningFolder
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder
from tests.cli.running import TINY_OPTIONS
from tests.studies.small_studies import small_study
from tests.studies.test_tuning import tuning
from tests.studies.test_worker import wait_for
from tests.training.runs import TINY

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
STORE = 80 * 2**20
STEPS = 6000
"""120 iterations: time enough to lose something in the middle."""


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A head that runs nothing, and two nodes of one core each."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    head = {"num_cpus": 0, "object_store_memory": STORE, "include_dashboard": False}
    head["_system_config"] = {"health_check_period_ms": 1000, "health_check_initial_delay_ms": 0}
    made = Cluster(initialize_head=True, head_node_args=head)
    made.nodes_of_work = [made.add_node(num_cpus=1, object_store_memory=STORE) for _ in range(2)]
    yield made
    made.shutdown()


def study() -> Study:
    return small_study(steps=((None, STEPS),), seeds=(0, 1), overrides=TINY)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StudyFolder:
    monkeypatch.setenv("ESP_CHECKPOINT_SECONDS", "0")
    return StudyFolder.create(tmp_path / "s", study())


@pytest.fixture
def engine(cluster: Cluster, folder: StudyFolder) -> Iterator[RayEngine]:
    with RayEngine(folder.path, cluster.address, silence_s=2.0) as made:
        yield made


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same runs, trained in this process."""
    found = {}
    for cell in study().cells:
        path = tmp_path_factory.mktemp("alone") / cell.name
        run = RunFolder.create(path, cell.config.model_dump(mode="json"))
        Run(run.path).train()
        found[cell.name] = path
    return found


def scheduled(folder: StudyFolder, engine: RayEngine, listener: Callable[[Snapshot], bool], **choice) -> Scheduler:
    scheduler = Scheduler(folder, choice.get("cells", folder.study.cells), 2, engine)
    scheduler.complete = scheduler.run(listener, 0.05)
    return scheduler


def checkpointed(folder: StudyFolder, cell: Cell) -> bool:
    path = folder.run_path(cell) / "checkpoints"
    return path.is_dir() and any(path.glob("step-*.safetensors"))


def log(folder: StudyFolder, cell: Cell) -> str:
    return folder.log_path(cell).read_text() if folder.log_path(cell).exists() else ""


def same(folder: StudyFolder, cell: Cell, alone: Path) -> bool:
    """Return whether a run is the one trained alone, bit for bit, and its metrics have no row twice."""
    run = folder.run_path(cell)
    rows = [
        [{name: x for name, x in row.items() if not name.startswith("time/")} for row in read_metrics(path)]
        for path in (run / "metrics.jsonl", alone / "metrics.jsonl")
    ]
    policies = [(path / "policy.safetensors").read_bytes() for path in (run, alone)]
    return rows[0] == rows[1] and policies[0] == policies[1]


def workers() -> list[str]:
    return [actor["name"] for actor in ray.util.list_named_actors(all_namespaces=True)]


def test_a_lost_node_and_a_lost_worker_cost_a_checkpoint_and_change_no_result(
    cluster: Cluster, folder: StudyFolder, engine: RayEngine, alone: dict[str, Path]
) -> None:
    cell = folder.study.cells[1]
    lost: list[str] = []

    def lose(snapshot: Snapshot) -> bool:
        if not lost and checkpointed(folder, cell):
            for node in list(cluster.nodes_of_work):
                cluster.remove_node(node, allow_graceful=False)
            cluster.nodes_of_work = [cluster.add_node(num_cpus=1, object_store_memory=STORE) for _ in range(2)]
            lost.append("nodes")
        elif lost == ["nodes"] and "resuming at" in log(folder, cell):
            ray.kill(ray.get_actor(*workers(), namespace="esp"))
            lost.append("worker")
        return True

    scheduler = scheduled(folder, engine, lose, cells=[cell])
    assert lost == ["nodes", "worker"], log(folder, cell)
    assert log(folder, cell).count("lost the worker on ") == 2
    assert scheduler.runs[0].status == "finished", scheduler.runs[0].message
    assert same(folder, cell, alone[cell.name])
    here = Run(alone[cell.name]).evaluate(folder.study.episodes).model_dump(mode="json")
    there = json.loads(folder.evaluation_path(cell).read_text())
    assert here | {"source": str(folder.run_path(cell))} == there
    assert workers() == []


def steps_here(folder: StudyFolder) -> list[int]:
    return [Mirror(folder.run_path(cell)).newest_step for cell in folder.study.cells]


def command(out: Path, cluster: Cluster) -> list[str]:
    words = ["reproduce", "table1", "--tasks", "navigation", "--algos", "mappo", "--seeds", "2", "--episodes", "4"]
    words += ["--steps", STEPS, *TINY_OPTIONS, "--out", out, "--engine", "ray", "--address", cluster.address]
    return [sys.executable, "-c", "from esp_cli.app import main; main()", *map(str, words)]


def test_a_killed_driver_goes_on_with_its_workers_and_an_interrupted_one_leaves_none(
    cluster: Cluster, tmp_path: Path, alone: dict[str, Path]
) -> None:
    out = tmp_path / "s"
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "environments")]),
        "ESP_CHECKPOINT_SECONDS": "0",
    }

    def started() -> subprocess.Popen[str]:
        return subprocess.Popen(
            command(out, cluster), env=environment, cwd=tmp_path, stderr=subprocess.PIPE, text=True, bufsize=0
        )

    def begun() -> bool:
        return StudyFolder.is_one(out) and all(checkpointed(folder(), cell) for cell in folder().study.cells)

    def folder() -> StudyFolder:
        return StudyFolder.open(out)

    with started() as process:
        wait_for(begun)
        process.kill()
    before = steps_here(folder())
    with started() as process:
        wait_for(lambda: all(new > old for new, old in zip(steps_here(folder()), before, strict=True)))
        process.send_signal(signal.SIGINT)
        told = process.communicate()[1]
    assert process.returncode == 130, told
    assert f"--engine ray --address {cluster.address}" in told
    for cell in folder().study.cells:
        assert log(folder(), cell).count("$ esp train") == 1, "a second worker trained it"
    with RayEngine(out, cluster.address):
        assert workers() == []
    with started() as process:
        told = process.communicate()[1]
    assert process.returncode == 0, told
    for cell in folder().study.cells:
        assert same(folder(), cell, alone[cell.name])


def test_a_full_disk_of_the_driver_fails_a_run_that_the_same_command_finishes(
    folder: StudyFolder, engine: RayEngine, alone: dict[str, Path]
) -> None:
    plain = folder.study.cells[0]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, limits[1]))
    try:
        scheduler = scheduled(folder, engine, lambda _: True, cells=[plain])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert scheduler.runs[0].status == "failed"
    assert "file too large" in scheduler.runs[0].message
    assert workers() == []
    assert scheduled(folder, engine, lambda _: True, cells=[plain]).runs[0].status == "finished"
    assert same(folder, plain, alone[plain.name])


def test_a_run_that_no_node_has_room_for_fails_at_once(
    folder: StudyFolder, engine: RayEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_ray, "process_bytes", lambda config, spec: 10**15)
    runs = scheduled(folder, engine, lambda _: True).runs
    assert [run.status for run in runs] == ["failed"] * 2
    sentence = f"no node of the cluster offers what {runs[0].cell.name} needs (a core, 1000000.0 GB of memory)"
    assert runs[0].message.startswith(sentence)


@pytest.mark.parametrize(
    ("node", "advice"),
    [
        ({"CPU": 4, "GPU": 1, "memory": 1e9}, "add one, or use fewer seeds"),
        ({"CPU": 4, "memory": 9e9}, "add one"),
        ({"CPU": 4, "memory": 1e9}, "add one"),
    ],
)
def test_fewer_seeds_are_advised_only_where_memory_is_what_is_missing(node: dict[str, float], advice: str) -> None:
    needed = {"CPU": 1, "GPU": 1, "memory": 2e9}
    with pytest.raises(ClusterError) as told:
        refuse_what_no_node_has(needed, "esp", [node])
    assert str(told.value) == (
        f"no node of the cluster offers what esp needs (a core, a GPU, 2.0 GB of memory); {advice}"
    )
    refuse_what_no_node_has(needed, "esp", [node, {"CPU": 1, "GPU": 1, "memory": 2e9}])


def test_a_cluster_of_another_version_or_none_is_refused_in_one_sentence(
    cluster: Cluster, folder: StudyFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(versions, "versions", lambda: {"torch": "0.1"})
    with pytest.raises(ValueError, match=r"the node .* has torch .*, but this machine has 0.1; install"):
        RayEngine(folder.path, cluster.address)
    assert not ray.is_initialized()
    for address, reason in (("127.0.0.1:1", "refused"), ("ray://127.0.0.1:1", "client is not supported")):
        with pytest.raises(
            ClusterError, match=rf"cannot use the Ray cluster at {address} \(.*{reason}\); check --address"
        ):
            RayEngine(folder.path, address)


def test_a_search_on_a_cluster_goes_on_after_a_stop_and_scores_as_on_this_machine(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna", reason="needs Optuna, of the extra tune")
    from esp_cli.studies.tuner import Outcome, Trials, Tuner

    monkeypatch.setenv("ESP_CHECKPOINT_SECONDS", "0")
    asked = tuning(priors=("esp",), budget=3, steps=STEPS // 2)

    def searched(folder: TuningFolder, engine: Engine) -> Outcome:
        """Search; stop at the first checkpoint, and go on."""
        first = folder.run_path(folder.cell("esp", 0, {}))
        for until in (lambda _: not any(first.glob("checkpoints/step-*.safetensors")), lambda _: True):
            assert not (first / "policy.safetensors").exists()
            trials = Trials(TuningFolder.begin(folder.path, asked))
            Tuner(trials, 1, engine).run(until, 0.05)
        return trials.outcome("esp")

    here = searched(TuningFolder(tmp_path / "here", asked), LocalEngine())
    with RayEngine(tmp_path / "there", cluster.address, silence_s=2.0) as engine:
        there = searched(TuningFolder(tmp_path / "there", asked), engine)
        assert workers() == []
    assert there.trials == 3
    # a trial that is pruned ends some steps after it was judged
    assert replace(there, seconds=0.0, env_steps=0) == replace(here, seconds=0.0, env_steps=0)
