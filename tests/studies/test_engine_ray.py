"""Studies on a real Ray cluster of two nodes on this machine: nodes, workers and drivers come and go."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("ray", reason="needs Ray, of the extra cluster")

import ray
from ray.cluster_utils import Cluster

from esp_cli.files.opening import is_held
from esp_cli.run import Run
from esp_cli.studies import engine_ray
from esp_cli.studies.engine_ray import (
    CLUSTER_FORMAT,
    RayEngine,
    refuse_difference,
    refuse_what_no_node_has,
    run_job,
    versions,
)
from esp_cli.studies.plan import Cell, Study
from esp_cli.studies.scheduler import Scheduler
from esp_cli.studies.study import StudyFolder
from esp_cli.training.folder_names import FINAL, LOG
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder, checkpoints_in, step_of
from esp_envs.errors import UserError
from tests.cli.running import TINY_OPTIONS
from tests.studies.small_studies import small_study
from tests.training.runs import TINY

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
STORE = 80 * 2**20
STEPS = 6000
"""120 iterations: time enough to lose something in the middle."""


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A head that runs nothing, and two nodes of one core each."""
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0123456789abcdef" * 4}
    ray._raylet.Config.initialize("")
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
    with RayEngine(folder.path, cluster.address) as made:
        yield made


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 240
    while not condition():
        assert time.monotonic() < deadline, "it did not come true"
        time.sleep(0.01)


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


def scheduled(folder: StudyFolder, engine: RayEngine, listener: Callable[[Scheduler], bool], **choice) -> Scheduler:
    scheduler = Scheduler(folder, choice.get("cells", folder.study.cells), 2, engine)
    scheduler.complete = scheduler.run(listener, 0.05)
    return scheduler


def checkpointed(folder: StudyFolder, cell: Cell) -> bool:
    path = folder.run_path(cell) / "checkpoints"
    return path.is_dir() and any(path.glob("step-*.safetensors"))


def log(folder: StudyFolder, cell: Cell) -> str:
    return (folder.run_path(cell) / LOG).read_text() if (folder.run_path(cell) / LOG).exists() else ""


def same(folder: StudyFolder, cell: Cell, alone: Path) -> bool:
    """Return whether a run is the one trained alone, bit for bit, and its metrics have no row twice."""
    run = folder.run_path(cell)
    rows = [
        [{name: x for name, x in row.items() if not name.startswith("time/")} for row in read_metrics(path)]
        for path in (run / "metrics.jsonl", alone / "metrics.jsonl")
    ]
    policies = [(path / "policy.safetensors").read_bytes() for path in (run, alone)]
    return rows[0] == rows[1] and policies[0] == policies[1]


def test_a_lost_node_and_a_lost_worker_cost_a_checkpoint_and_change_no_result(cluster, folder, engine, alone):
    cell = folder.study.cells[1]
    lost: list[str] = []

    def lose(_: Scheduler) -> bool:
        if not lost and checkpointed(folder, cell):
            for node in list(cluster.nodes_of_work):
                cluster.remove_node(node, allow_graceful=False)
            cluster.nodes_of_work = [cluster.add_node(num_cpus=1, object_store_memory=STORE) for _ in range(2)]
            lost.append("nodes")
        elif lost == ["nodes"] and "resuming at" in log(folder, cell):
            lock = json.loads((folder.run_path(cell) / "run.lock").read_text())
            os.kill(int(re.search(r"PPid:\t(\d+)", Path(f"/proc/{lock['pid']}/status").read_text())[1]), signal.SIGKILL)
            lost.append("worker")
        return True

    scheduler = scheduled(folder, engine, lose, cells=[cell])
    assert lost == ["nodes", "worker"], (scheduler.runs[0], log(folder, cell))
    assert log(folder, cell).count("$ esp train") == 3
    assert scheduler.runs[0].status == "finished", scheduler.runs[0].message
    assert same(folder, cell, alone[cell.name])
    here = Run(alone[cell.name]).evaluate(folder.study.episodes).model_dump(mode="json")
    there = json.loads((folder.run_path(cell) / FINAL).read_text())
    assert here | {"source": str(folder.run_path(cell))} == there


def steps_here(folder: StudyFolder) -> list[int]:
    paths = (folder.run_path(cell) for cell in folder.study.cells)
    return [max(map(step_of, checkpoints_in(path)), default=-1) for path in paths]


def command(out: Path, cluster: Cluster) -> list[str]:
    words = ["reproduce", "table1", "--tasks", "navigation", "--algos", "mappo", "--seeds", "2", "--episodes", "4"]
    words += ["--steps", STEPS, *TINY_OPTIONS, "--out", out, "--engine", "ray", "--address", cluster.address]
    return [sys.executable, "-c", "from esp_cli.app import main; main()", *map(str, words)]


def test_a_killed_or_interrupted_driver_leaves_no_job_and_the_same_command_goes_on(cluster, tmp_path, alone):
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

    def nothing_runs() -> bool:
        return not any(is_held(folder().run_path(cell) / "run.lock") for cell in folder().study.cells)

    def folder() -> StudyFolder:
        return StudyFolder.open(out)

    with started() as process:
        wait_for(begun)
        process.kill()
    # until then the runs of the first driver may still write, and would be taken for those of the second
    wait_for(nothing_runs)
    before = steps_here(folder())
    with started() as process:
        # any, not all: beside other work one run may end before the other has begun
        wait_for(lambda: any(new > old for new, old in zip(steps_here(folder()), before, strict=True)))
        process.send_signal(signal.SIGINT)
        told = process.communicate()[1]
    assert process.returncode == 130, told
    assert f"--engine ray --address {cluster.address}" in told
    assert nothing_runs()
    with started() as process:
        told = process.communicate()[1]
    assert process.returncode == 0, told
    for cell in folder().study.cells:
        assert same(folder(), cell, alone[cell.name])


def test_a_node_that_does_not_see_the_folder_of_the_driver_is_refused_before_it_trains(folder: StudyFolder) -> None:
    run, file = folder.prepare(folder.study.cells[0]).path, folder.path / "cluster.json"
    told = {"working_folder": str(folder.path), "versions": dict(versions()), "environment": {}}

    def job(*arguments: str) -> tuple[int, str]:
        return run_job(arguments, run / "log.txt", file, "mine")

    missing = job("train", "--resume", str(run))
    assert missing[0] == 2
    assert f"does not see {folder.path} of this machine; put the study on a file system that all" in missing[1]
    CLUSTER_FORMAT.write(file, told | {"identity": "theirs"})
    assert job("train", "--resume", str(run)) == missing
    CLUSTER_FORMAT.write(file, told | {"identity": "mine", "versions": {"torch": "0.1"}})
    assert "but the driver has 0.1; install the same versions on both" in job("train", "--resume", str(run))[1]
    assert not (run / "log.txt").exists()
    CLUSTER_FORMAT.write(file, told | {"identity": "mine"})
    assert job("train", "--no-such-option")[0] == 2
    assert "$ esp train --no-such-option" in (run / "log.txt").read_text()


def test_a_node_of_another_version_is_refused_in_one_sentence() -> None:
    refuse_difference("n1", versions(), versions())
    other = {**versions(), "torch": "1.0", "numpy": "1.0"}
    with pytest.raises(ValueError, match=r"the node n1 has torch 1.0, numpy 1.0, but the driver has .*; install"):
        refuse_difference("n1", other, versions())
    with pytest.raises(ValueError, match="has esp missing"):
        refuse_difference("n1", {name: text for name, text in versions().items() if name != "esp"}, versions())


def test_a_cluster_of_this_machine_alone_has_a_token_and_no_other_machine_reaches_it(tmp_path: Path) -> None:
    code = (
        "import os, pathlib, subprocess\n"
        "from esp_cli.studies.engine_ray import RayEngine\n"
        "with RayEngine(pathlib.Path('s')):\n"
        "    from ray._raylet import AuthenticationMode, get_authentication_mode\n"
        "    assert get_authentication_mode() == AuthenticationMode.TOKEN\n"
        "    table = ''.join(pathlib.Path(f'/proc/net/{name}').read_text() for name in ('tcp', 'tcp6'))\n"
        "    inodes = set()\n"
        "    for link in pathlib.Path('/proc').glob('[0-9]*/fd/*'):\n"
        "        try:\n"
        "            mine = b'RAY_AUTH_TOKEN=' + os.environ['RAY_AUTH_TOKEN'].encode()\n"
        "            if mine in (link.parents[1] / 'environ').read_bytes():\n"
        "                inodes.add(os.readlink(link))\n"
        "        except OSError:\n"
        "            pass\n"
        "    rows = [row.split() for row in table.splitlines()]\n"
        "    print(*(row[1].split(':')[0] for row in rows if row[3] == '0A' and f'socket:[{row[9]}]' in inodes))\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "environments")])}
    environment = {name: text for name, text in environment.items() if not name.startswith("RAY_")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    loopback = {"0100007F", "0000000000000000FFFF00000100007F"}
    assert len(done.stdout.split()) > 3
    assert set(done.stdout.split()) <= loopback


def test_a_run_that_no_node_has_room_for_fails_at_once(folder, engine, monkeypatch):
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
    with pytest.raises(UserError) as told:
        refuse_what_no_node_has(needed, "esp", [node])
    assert str(told.value) == (
        f"no node of the cluster offers what esp needs (a core, a GPU, 2.0 GB of memory); {advice}"
    )
    refuse_what_no_node_has(needed, "esp", [node, {"CPU": 1, "GPU": 1, "memory": 2e9}])


def test_a_cluster_that_does_not_answer_is_refused_in_one_sentence(folder: StudyFolder) -> None:
    for address, reason in (("127.0.0.1:1", "refused"), ("ray://127.0.0.1:1", "client is not supported")):
        with pytest.raises(
            UserError, match=rf"cannot use the Ray cluster at {address} \(.*{reason}\); check --address"
        ):
            RayEngine(folder.path, address)
