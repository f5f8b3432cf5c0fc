"""Work shared by a cluster of Ray: three nodes on this machine, of one process each."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import ray

from drivesem.cli import main
from drivesem.config.errors import UsageError
from drivesem.config.options import WorkerOptions
from drivesem.run import workers as clusters
from drivesem.run.workers import run_jobs
from drivesem.store import local_copy
from scene_ir.errors import FormatError, SceneError
from tests.drivesem.commands.test_attack_command import contents
from tests.drivesem.invoke import refusal


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))  # where nodes find this module
    found = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    for _ in range(2):
        found.add_node(num_cpus=1)
    found.wait_for_nodes()
    yield found
    ray.shutdown()
    found.shutdown()


def square_and_node(job: int, folder: str) -> tuple[int, str]:
    """A job's square and the node that found it. FormatError for 3; job 5 ends its process once, job 7 always."""
    with Path(folder, str(job)).open("a") as tries:
        tries.write("x")
    if job == 3:
        raise FormatError("three", "another number", job)
    if job == 7 or (job == 5 and len(Path(folder, "5").read_text()) == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.2)
    return job * job, ray.get_runtime_context().get_node_id()


def make_worker(folder: str) -> Callable[[int], tuple[int, str]]:
    return partial(square_and_node, folder=folder)


def found_by(jobs: list[int], folder: Path, address: str) -> Iterator[tuple[int, Any]]:
    config = WorkerOptions(engine="ray", address=address)
    for job, outcome in run_jobs(square_and_node, partial(make_worker, str(folder)), jobs, config):
        try:
            yield job, outcome()
        except SceneError as error:
            yield job, str(error)


@pytest.mark.slow
def test_nodes_share_jobs_and_a_process_that_ends_costs_what_it_had_in_hand(tmp_path: Path, cluster: Any) -> None:
    found = dict(found_by(list(range(12)), tmp_path, cluster.address))
    assert found[3] == "three: expected another number, found 3"
    assert "expected a process that lasts" in found[7]
    rest = {job: value for job, value in found.items() if job not in (3, 7)}
    assert {job: value[0] for job, value in rest.items()} == {
        job: job * job for job in range(12) if job not in (3, 7)
    }
    assert len({node for _, node in rest.values()}) >= 2
    tries = {job: len((tmp_path / str(job)).read_text()) for job in range(12)}
    assert tries == dict.fromkeys(range(12), 1) | {5: 2, 7: 3}, "nothing is done twice"


@pytest.mark.slow
def test_a_node_that_is_gone_costs_what_it_had_in_hand(tmp_path: Path, cluster: Any) -> None:
    found: dict[int, Any] = {}
    jobs, gone = list(range(10, 60)), False
    for job, outcome in found_by(jobs, tmp_path, cluster.address):
        found[job] = outcome
        if not gone and len({node for _, node in found.values()}) == 3:
            # Not the one through which this process speaks to the others: all share this machine.
            here = ray.get_runtime_context().get_node_id()
            other = next(node for node in cluster.worker_nodes if node.node_id != here)
            cluster.remove_node(other, allow_graceful=False)
            gone = True
    assert gone
    assert {job: value[0] for job, value in found.items()} == {job: job * job for job in jobs}
    assert sum(len((tmp_path / str(job)).read_text()) for job in jobs) <= len(jobs) + 1


def test_processes_that_never_come_back_end_it_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the head takes the machine of the command for lost."""

    class Gone:
        exceptions = ray.exceptions

        def wait(
            self, references: list[object], num_returns: int, timeout: float | None
        ) -> tuple[list[object], list[object]]:
            return references[:1], references[1:]

        def get(self, reference: object) -> None:
            raise ray.exceptions.ActorDiedError

    class Actor:
        class ready:  # noqa: N801
            remote = object

    monkeypatch.setattr(clusters, "_PAUSE_S", 0.01)
    monkeypatch.setattr(clusters, "_LOST_S", 0.05)
    with pytest.raises(UsageError, match="--engine: expected a Ray cluster that lasts"):
        list(clusters._distribute_jobs(Gone(), [Actor(), Actor()], deque([(1, 0)])))  # type: ignore[arg-type]


def test_without_an_address_it_is_this_machine_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And not what RAY_ADDRESS or the last cluster's file speak of."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    ray.shutdown()
    config = WorkerOptions(engine="ray", workers=1)
    try:
        found = dict(run_jobs(square_and_node, partial(make_worker, str(tmp_path)), [1, 2], config))
        assert {job: outcome()[0] for job, outcome in found.items()} == {1: 1, 2: 4}
    finally:
        ray.shutdown()


def test_a_cluster_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    words = ["attack", "--limit", "1", "--engine", "ray", "--address", "127.0.0.1:1", "--out", str(tmp_path / "a")]
    assert "--address: expected a Ray cluster, found 127.0.0.1:1: " in refusal(*words)
    with pytest.raises(UsageError, match="--address"):
        WorkerOptions(address="auto").check()


Alike = Callable[..., None]


@pytest.fixture
def alike(tmp_path: Path, cluster: Any, monkeypatch: pytest.MonkeyPatch) -> Alike:
    """Runs a command here and on the cluster, and compares its two folders, but for the files that are named."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def run(words: list[str], out: str, *varying: str, program: str = "drivesem.cli") -> None:
        contents_by_run, others = [], (*varying, "config.yaml", ".lock")
        alone = [sys.executable, "-m", program, *words, "--workers", "1", "--out", str(tmp_path / out)]
        subprocess.run(alone, check=True, cwd=Path(__file__).parents[3])
        shared = ["--engine", "ray", "--address", cluster.address, "--out", str(tmp_path / f"{out}-ray"), "--json"]
        assert importlib.import_module(program).main([*words, *shared]) == 0
        for folder in (out, f"{out}-ray"):
            contents_by_run.append(
                {n: x for n, x in contents(tmp_path / folder).items() if not n.startswith(others)}
            )
        assert contents_by_run[0] == contents_by_run[1]
        assert contents_by_run[0]

    return run


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_frames_from_a_cluster_equal_local_ones(tmp_path: Path, cluster: Any, alike: Alike) -> None:
    alike(["synth", "--frames", "2", "--seed", "5"], "kitti")
    read = ["--dataset", "kitti", "--root", str(tmp_path / "kitti")]
    alike(["derender", "--no-fit", *read], "scenes")
    alike(["eval", "--detector", "squeezedet", *read], "figures")
    # Each machine brings what it made to the store; this one fetches it.
    url = f"file://{tmp_path}/elsewhere/kitti"
    words = ["synth", "--frames", "2", "--seed", "5", "--engine", "ray", "--address", cluster.address]
    assert main([*words, "--out", url]) == 0
    for made in (local_copy(url), tmp_path / "kitti"):
        (made / ".lock").unlink(missing_ok=True)
    assert contents(local_copy(url)) == contents(tmp_path / "kitti")
    assert not (tmp_path / "elsewhere" / "kitti" / ".lock").exists()


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_analyses_on_a_cluster_equal_local_ones(tmp_path: Path, alike: Alike) -> None:
    study = ["labels", "--quick", "--limit", "1", "--steps", "1", "--second-detector", "off", "--bootstrap", "0"]
    place_and_time = ("results/study.json", "results/frames.csv", "arms/translate/config.yaml")
    varying = ("study.", "largest", "label_sets", "arms/combo", *place_and_time)
    alike(study, "study", *varying, program="tools.experiments.__main__")
    run = str(tmp_path / "study" / "arms" / "translate")
    alike(["confirm", "--run", run], "confirm")
    alike(["holes", run, "--samples", "24", "--fresh", "8"], "holes")


@pytest.mark.slow
def test_an_attack_on_a_cluster_that_loses_a_machine_is_what_one_machine_makes(
    tmp_path: Path, cluster: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["attack", "--limit", "6", "--steps", "2", "--out"]
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    alone = [sys.executable, "-m", "drivesem.cli", *words, str(tmp_path / "local"), "--workers", "2"]
    subprocess.run(alone, check=True, cwd=Path(__file__).parents[3])
    shared = tmp_path / "shared"

    def lose_a_machine() -> None:
        while len(list(shared.glob("frames/*/result.json"))) < 2:
            time.sleep(0.1)
        here = ray.get_runtime_context().get_node_id()
        cluster.remove_node(next(n for n in cluster.worker_nodes if n.node_id != here), allow_graceful=False)

    loss = threading.Thread(target=lose_a_machine)
    loss.start()
    assert main([*words, str(shared), "--engine", "ray", "--address", cluster.address]) == 0
    loss.join()
    assert contents(shared / "frames") == contents(tmp_path / "local" / "frames")
