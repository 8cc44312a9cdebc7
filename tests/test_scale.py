"""The plan for scale: its model against pen and paper, its measurements at tiny sizes, its page against its results."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from cluster_model import Cluster, Load, simulate  # noqa: E402

# --- the model ------------------------------------------------------------------------------------------------------


def test_one_worker_does_one_thing_after_the_other() -> None:
    """2 generations of 1 shard: ask 5, submit 1, schedule 2, send 10 / 5, worker 3 + 100, back 5 / 5, 2, 1; wait 8."""
    cluster = Cluster(workers=1, coordinator_task=2, scheduler_task=4, worker_task=3, network=5, latency=8)
    load = Load(evolutions=1, generations=2, shards=1, seconds=100, bytes_there=10, bytes_back=5, optimizer=5)
    out = simulate(cluster, load)
    assert out.seconds == 2 * (5 + 1 + 2 + 2 + 103 + 1 + 2 + 1 + 8)
    assert out.workers == pytest.approx(206 / 250)
    assert (out.coordinator, out.scheduler, out.network) == pytest.approx((14 / 250, 8 / 250, 4 / 250))
    assert out.bottleneck == "workers"


def test_bytes_cost_each_on_their_way() -> None:
    cluster = Cluster(workers=1, coordinator_byte=1, scheduler_byte=10, worker_byte=100)
    out = simulate(cluster, Load(evolutions=1, generations=1, shards=1, seconds=0, bytes_there=2, bytes_back=3))
    assert out.seconds == (2 + 3) * 111


def test_workers_share_the_shards_and_the_slowest_ends_the_generation() -> None:
    load = Load(evolutions=1, generations=3, shards=10, seconds=7)
    assert simulate(Cluster(workers=4), load).seconds == 3 * 3 * 7  # 4 + 4 + 2
    assert simulate(Cluster(workers=10), load).seconds == 3 * 7
    assert simulate(Cluster(workers=99), load).workers == pytest.approx(10 / 99)


def test_evolutions_fill_each_others_gaps() -> None:
    """While one waits for its only shard, the other's is simulated."""
    one = Load(evolutions=1, generations=10, shards=1, seconds=3, optimizer=3)
    assert simulate(Cluster(workers=1), one).seconds == 60
    two = simulate(Cluster(workers=1), Load(evolutions=2, generations=10, shards=1, seconds=3, optimizer=3))
    assert two.seconds == 63
    assert two.workers == two.coordinator == pytest.approx(60 / 63)


def test_a_scheduler_bounds_however_many_workers() -> None:
    """Each shard takes 2 of it; 1000 workers would take 100 / 1000 for each."""
    load = Load(evolutions=50, generations=20, shards=4, seconds=100)
    out = simulate(Cluster(workers=1000, scheduler_task=2), load)
    assert out.seconds == pytest.approx(load.tasks * 2, rel=0.03)
    assert out.seconds >= load.tasks * 2
    assert out.bottleneck == "scheduler"


def test_an_optimizer_bounds_however_many_workers() -> None:
    load = Load(evolutions=8, generations=20, shards=2, seconds=1, optimizer=5)
    out = simulate(Cluster(workers=100), load)
    assert out.seconds == 8 * 20 * 5 + 1
    assert out.bottleneck == "coordinator"


def test_a_network_bounds_however_many_workers() -> None:
    load = Load(evolutions=100, generations=5, shards=1, seconds=1, bytes_there=1000, bytes_back=300)
    out = simulate(Cluster(workers=100, network=100), load)
    assert out.seconds == pytest.approx(load.tasks * 10, rel=0.01)
    assert out.bottleneck == "network"


def test_on_one_machine_all_share_its_cores() -> None:
    """Each shard takes 1 of the coordinator, 1 of the scheduler and 2 of the workers' process: 4, on 1 core or on 2."""
    load = Load(evolutions=60, generations=10, shards=1, seconds=5)
    costs = {"workers": 60, "coordinator_task": 1, "scheduler_task": 1, "worker_task": 2}
    assert simulate(Cluster(**costs, one_machine=1), load).seconds == pytest.approx(600 * 4, rel=0.02)
    assert simulate(Cluster(**costs, one_machine=2), load).seconds == pytest.approx(600 * 2, rel=0.1)
    assert simulate(Cluster(**costs, one_machine=8), load).seconds == pytest.approx(600 * 2, rel=0.02)
    assert simulate(Cluster(**costs), load).seconds == pytest.approx(600, rel=0.03)
