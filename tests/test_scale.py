"""The plan for scale: its model against pen and paper, its measurements at tiny sizes, its page against its results."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import cluster_plan  # noqa: E402
import scale  # noqa: E402
import scale_page  # noqa: E402
from cluster_model import Cluster, Load, simulate  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results"
TINY = scale.Size(
    bodies=("small",),
    steps=20,
    seconds=0.0,
    million=60,
    chunk=25,
    growth=(50,),
    growth_steps=2,
    populations=(21, 1000),
    patience=0.0,
    cluster_workers=(2, 4),
    cluster_seconds=0.05,
)

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


# --- the plan's arithmetic ------------------------------------------------------------------------------------------


def way(**changes: float) -> cluster_plan.Way:
    given: dict[str, Any] = {
        "name": "a way",
        "evaluations": 100,
        "seconds": 1.0,
        "shards": 1,
        "bytes_there": 0,
        "bytes_back": 0,
    }
    return cluster_plan.Way(**given | changes)


FREE = {f"{who}_{what}": 0.0 for who in ("coordinator", "scheduler", "worker") for what in ("task", "byte")}


def test_cores_of_a_target() -> None:
    """9000 evaluations/s are 90 tasks/s of 1 s each; workers are planned for 90 % of their time."""
    found = cluster_plan.needs(way(), 9000, FREE)
    assert (found["tasks_a_second"], found["cores_needed"], found["schedulers"]) == (90, 100, 1)
    # 202 evolutions of 10 tasks each are 2020 tasks: 100 workers do them in 21 rounds of 1 s
    assert found["reached"] == pytest.approx(2020 * 100 / 21 / 9000)


@pytest.mark.parametrize(
    ("changes", "cost", "limit", "busy"),
    [
        ({}, {"scheduler_task": 0.02}, "scheduler", 90 * 0.02),
        ({"optimizer": 0.1, "shards": 4}, {}, "optimizer", 90 / 4 * 0.1),
        ({"bytes_there": 1e8}, {}, "network", 90 * 1e8 / 1.25e9),
        ({"bytes_there": 1e6}, {"coordinator_byte": 1e-7}, "coordinator", 90 * 0.1),
    ],
)
def test_schedulers_of_a_target(changes: dict[str, float], cost: dict[str, float], limit: str, busy: float) -> None:
    """As many as keep each busy for 80 % of its time at most."""
    found = cluster_plan.needs(way(**changes), 9000, FREE | cost)
    assert found["limit"] == limit
    assert found["schedulers"] == np.ceil(busy / 0.8)
    assert found["share"] == pytest.approx(busy / found["schedulers"])


def test_costs_are_found_again_from_rows_that_were_made_of_them() -> None:
    """Of a shard [s], of a byte [s], and the parts of a core that a process takes for itself and for each worker."""
    made = {"coordinator": (1e-3, 1e-9, 0, 0), "scheduler": (2e-3, 2e-9, 0.1, 0), "worker": (3e-3, 0, 0.2, 0.002)}
    rows: list[dict[str, Any]] = []
    for seconds, size, wall, workers in [(1, 0, 0.5, 4), (1, 1e5, 0.1, 4), (1, 1e6, 0.02, 64), (0, 0, 0.01, 4)]:
        row = {"seconds": seconds, "bytes_there": size, "bytes_back": 0, "wall": 5 * wall, "tasks": 5}
        for who, (task, byte, idle, worker) in made.items():
            row[who] = task + size * byte + wall * (idle + workers * worker)
        rows.append({**row, "workers": workers})
    for who, expected in made.items():
        assert cluster_plan.fit(rows, who) == pytest.approx(expected, abs=1e-12)
    alone, together = cluster_plan.costs(rows), cluster_plan.costs(rows, 64)
    assert alone["scheduler_task"] == together["scheduler_task"] == pytest.approx(2e-3 / 0.9)
    assert alone["scheduler_byte"] == pytest.approx(2e-9 / 0.9)
    assert alone["worker_task"] == pytest.approx(3e-3 / (1 - 0.202))
    assert together["worker_task"] == pytest.approx(3e-3 / (1 - 0.328))
    assert alone["latency"] == pytest.approx(0.01 - 0.006)


# --- measuring, and the page ----------------------------------------------------------------------------------------


def test_every_part_runs_and_fills_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of it at tiny sizes: a real scheduler with real workers, and fresh processes for the memory."""
    pytest.importorskip("distributed")
    for name in scale.PARTS:
        with monkeypatch.context() as patch:
            if name == "optimizer":  # many processes, whose start takes longer than all the rest
                patch.setattr(scale, "in_a_process", lambda function, *arguments: function(*arguments))
            rows = scale.measure(name, TINY, tmp_path)
        kept = scale_page.read_rows(tmp_path / f"scale-{name}.csv")
        assert len(rows) == len(kept) > 0
        assert scale_page.table(name, tmp_path).count("\n") == (len(rows) + 1 if name in scale_page.TABLES else 0)
        assert all(value >= 0 for row in rows for value in row.values() if not isinstance(value, str))
    million = scale_page.read_rows(tmp_path / "scale-million.csv")
    assert [(row["agents"], row["theta"]) for row in million] == [
        (50, 50 * 374 * 8),
        (50, 50 * 374 * 4),
        (50, 25 * 374 * 4),
        (60, 25 * 374 * 4),
    ]
    page = tmp_path / "scale.md"
    page.write_text(scale_page.PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    scale_page.make_page(tmp_path, page)
    scale_page.make_figure(tmp_path, tmp_path / "scale.png")
    for name in scale_page.TABLES:
        assert scale_page.table(name, tmp_path) in page.read_text(encoding="utf-8")


def test_a_part_whose_rows_are_missing_says_so(tmp_path: Path) -> None:
    with pytest.raises(scale_page.Missing, match="scheduler has to be measured first"):
        scale.measure("plan", TINY, tmp_path)


def test_a_page_without_a_mark_is_not_written_over(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected a mark <!-- table: million -->"):
        scale_page.filled("no marks", RESULTS)


def test_the_page_says_what_the_results_say() -> None:
    page = scale_page.PAGE.read_text(encoding="utf-8")
    assert scale_page.filled(page, RESULTS) == page
    assert scale_page.FIGURE.stat().st_size > 10_000


def test_the_plan_follows_from_the_measurements() -> None:
    expected = scale_page.read_rows(RESULTS / "scale-plan.csv")
    found = list(cluster_plan.plan(scale.Size(), RESULTS))
    assert len(found) == len(expected)
    for mine, kept in zip(found, expected, strict=True):
        for name, value in mine.items():
            assert kept[name] == (value if isinstance(value, str) else pytest.approx(value, rel=1e-5)), name


def test_sentences_of_the_page_have_no_figures_that_a_measurement_would_falsify() -> None:
    """What the script does not write has the numbers of the task and of the plan's assumptions alone."""
    page = re.sub(
        r"<!-- (table|text): .*?<!-- end -->", "", scale_page.PAGE.read_text(encoding="utf-8"), flags=re.DOTALL
    )
    text = re.sub(r"```.*?```|10\^9|[Ff]loat\d\d", "", page, flags=re.DOTALL)
    given = {"1000", "250", "21", "20", "1800", "30", "2017", "10", "90", "80", "1.6", "1", "2", "3", "4"}
    assert set(re.findall(r"\d+(?:[.,]\d+)?", text)) - given == set()
