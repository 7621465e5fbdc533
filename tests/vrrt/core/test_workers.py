"""Many items, in processes and on a cluster whose workers come and go."""

import collections
import os
import signal
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from nrp_jax.learning.data import write_dataset
from nrp_jax.learning.shards import DatasetSettings
from vrrt_jax.core.workers import in_workers

ITEMS = range(12)
KILLED = 5  # an item whose first worker never comes to an end


def _work(log: str, item: int) -> int:
    """Tell who works on what, then do it."""
    with open(log, "a") as file:
        file.write(f"{item} {os.getpid()}\n")
    time.sleep(0.3)
    if item == 99:
        raise ValueError("item 99 makes no sense")
    return item * item


def _work_to_be_killed(log: str, item: int) -> int:
    """As :func:`_work`, but whoever begins with one of the items waits to be killed."""
    if item == KILLED and all(begun != item for begun, _ in _begun(Path(log))):
        _work(log, item)
        time.sleep(60)
    return _work(log, item)


def _begun(log: Path) -> list[tuple[int, int]]:
    """Items and processes."""
    lines = log.read_text().splitlines() if log.exists() else []
    return [(int(item), int(pid)) for item, pid in map(str.split, lines)]


@pytest.fixture(scope="module")
def cluster():
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    # Ray gives way to everything else on a machine, so that a busy one would do nothing.
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # of the workers
    here = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    for _ in range(2):
        here.add_node(num_cpus=1)
    yield here
    here.shutdown()


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_failure_is_told_after_what_was_under_way(tmp_path, jobs):
    done = []
    with pytest.raises(ValueError, match="item 99 makes no sense"):
        for result in in_workers(partial(_work, str(tmp_path / "log")), [1, 99, *ITEMS], jobs):
            done.append(result)
    assert done[0] == 1 and len(done) < len(ITEMS)


def test_workers_of_a_cluster_come_and_go(cluster, tmp_path):
    """A worker that is killed, and a machine that goes, cost what they were at; one joins late."""
    log, results, killed = tmp_path / "log", [], None
    work = partial(_work_to_be_killed, str(log))
    for result in in_workers(work, ITEMS, 1, cluster.address):
        results.append(result)
        begun = dict(_begun(log))
        if killed is None and KILLED in begun:
            killed = begun[KILLED]
            os.kill(killed, signal.SIGKILL)
            cluster.add_node(num_cpus=1)
            cluster.remove_node(min(cluster.worker_nodes, key=id), allow_graceful=False)
    assert sorted(results) == [item * item for item in ITEMS]
    times = collections.Counter(item for item, _ in _begun(log))
    assert sum(times.values()) <= len(ITEMS) + 2 and times[KILLED] >= 2


def test_what_a_cluster_has_under_way_at_a_failure_is_kept(cluster, tmp_path):
    log, done = tmp_path / "log", []
    with pytest.raises(ValueError, match="^item 99 makes no sense$"):
        work = partial(_work, str(log))
        for result in in_workers(work, [1, 99, *range(20, 60)], 1, cluster.address):
            done.append(result)
    begun = {item for item, _ in _begun(log)}
    assert sorted(done) == sorted(item * item for item in begun - {99})
    assert 99 in begun and len(done) < 20


def test_what_goes_wrong_on_a_cluster_is_told_as_here(cluster, tmp_path):
    with pytest.raises(ValueError, match="^item 99 makes no sense$"):
        list(in_workers(partial(_work, str(tmp_path / "log")), [99], 1, cluster.address))
    for address in ("127.0.0.1:1", "nowhere"):
        with pytest.raises(ConnectionError, match=f"no Ray cluster at '{address}'.*ray start"):
            list(in_workers(partial(_work, str(tmp_path / "log")), [1], 1, address))


def test_a_cluster_writes_the_data_set_that_one_process_writes(cluster, tmp_path):
    settings = DatasetSettings(task="snake", queries=4, waypoints=2, nodes=500, seed=5)
    homes = {"homes": 1, "test_homes": 1}
    write_dataset(tmp_path / "here", settings, **homes)
    write_dataset(tmp_path / "there", settings, **homes, cluster=cluster.address)
    here = {file.name: file.read_bytes() for file in (tmp_path / "here").iterdir()}
    there = {file.name: file.read_bytes() for file in (tmp_path / "there").iterdir()}
    assert len(here) == 3 and here == there
