"""Campaigns: the plan, many runs over processes, going on where it stopped, the whole command."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from turgor.errors import InvalidInput
from turgor.evolution.loop import evaluate
from turgor.experiments import rows
from turgor.experiments.analysis import by_cell, find_curves
from turgor.experiments.campaign import Progress, Schedule, open_run, run_entries, share_done
from turgor.experiments.measure import STARTS, measure
from turgor.experiments.plan import CHANGES, Entry, make_plan
from turgor.runs import Run
from turgor.simulate import Simulator

TINY = ("--only", "rq0", "rq1", "rq2", "--body", "small", "--seeds", "2", "--evaluations", "150", "--no-videos")


def small(**changes):
    entry = {"task": "hilly", "body": "small", "condition": "pressure", "seed": 0, "evaluations": 42}
    return Entry(**{**entry, **changes})


def turgor(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "turgor", *map(str, arguments)], capture_output=True, text=True, timeout=300, **options
    )


def tables_of(folder):
    return {path.name: path.read_bytes() for path in sorted((folder / "tables").iterdir())}


# --- the plan -----------------------------------------------------------------------------------------------------


def test_the_whole_campaign_is_sixty_evolutions_and_their_passive_controls():
    entries = make_plan(["rq0", "rq1", "rq2"])
    evolved = Counter((e.task, e.body, e.condition) for e in entries if e.evaluations)
    assert sum(evolved.values()) == 60
    assert set(evolved.values()) == {5}
    passive = Counter(e.task for e in entries if not e.evaluations)
    assert passive == {"hilly": 15, "escape": 3}  # the cage is the same for every seed
    assert len({e.name for e in entries}) == len(entries)


def test_side_studies_share_their_controls_with_the_main_questions():
    alone, together = make_plan(["studies"]), make_plan(["rq1", "rq2", "studies"])
    changes = {e.change for e in alone}
    assert changes == {"", *CHANGES}
    assert {e.seed for e in alone} == {0, 1, 2}
    assert {e.body for e in alone} == {"medium"}
    main = {e.name for e in make_plan(["rq1", "rq2"])}
    assert {e.name for e in alone if not e.change} <= main
    assert len({e.name for e in together}) == len(together)


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_changes_what_it_says(change):
    plain = small(body="medium", task=CHANGES[change].tasks[0])
    changed = small(body="medium", task=CHANGES[change].tasks[0], change=change)
    task_differs = changed.make_task().identity != plain.make_task().identity
    assert task_differs != (changed.population != plain.population)
    judge_differs = changed.make_judge().identity != plain.make_judge().identity
    assert judge_differs == (task_differs and CHANGES[change].judged)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"questions": ["rq3"]}, "only: expected one of rq0, rq1, rq2, studies; got 'rq3'"),
        ({"questions": ["rq1"], "bodies": ["huge"]}, "body: expected one of small, medium, large; got 'huge'"),
        ({"questions": ["rq1"], "seeds": 0}, "seeds: expected a whole number, at least 1; got 0"),
        ({"questions": ["rq1"], "evaluations": 0}, "evaluations: expected a whole number, at least 1; got 0"),
    ],
)
def test_an_impossible_plan_is_refused(asked, words):
    with pytest.raises(InvalidInput) as error:
        make_plan(**asked)
    assert str(error.value) == words


def test_the_schedule_pairs_long_with_short_and_ends_with_the_shortest():
    entries = [small(seed=k) for k in range(20)]
    schedule = Schedule({entry: float(entry.seed) for entry in entries}, 2)
    first, second = schedule.start(), schedule.start()
    assert (first.seed, second.seed) == (19, 6)  # six of the shortest are kept
    schedule.end(second)
    assert schedule.start().seed == 7
    schedule.end(first)
    assert schedule.start().seed == 18
    rest = []
    while (entry := schedule.start()) is not None:
        rest.append(entry.seed)
    assert sorted([*rest, 19, 6, 7, 18]) == list(range(20))
    assert rest[-6:] == [5, 4, 3, 2, 1, 0]


# --- many runs ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Four entries run over two processes: folder, entries, what was measured, what was told."""
    folder = tmp_path_factory.mktemp("ran")
    entries = [
        small(),
        small(seed=1, condition="springs"),
        small(task="escape"),
        small(condition="passive", evaluations=0),
    ]
    told: list[Progress] = []
    return folder, entries, run_entries(folder, entries, 2, told.append), told


def test_every_run_is_a_folder_of_its_own(ran):
    folder, entries, measured, _ = ran
    assert sorted(path.name for path in folder.iterdir()) == sorted(e.name for e in entries if e.evaluations)
    for entry, one in zip(entries, measured, strict=True):
        assert one.entry == entry
        assert one.champion.run == entry.name
        if entry.evaluations:
            run = Run.open(folder / entry.name)
            assert run.status == "done"
            assert run.champion.fitness == one.champion.best
            assert run.champion.robust_fitness == one.champion.robust


def test_progress_tells_every_run_and_ends(ran):
    _, entries, _, told = ran
    finished = [p.finished.entry for p in told if p.finished is not None]
    assert sorted(e.name for e in finished) == sorted(e.name for e in entries)
    assert told[-1].done == told[-1].total == len(entries)
    assert told[-1].seconds_left == 0.0
    assert [p.done for p in told] == sorted(p.done for p in told)


def test_measured_are_the_same_starts_as_evaluate_runs(ran):
    folder, entries, measured, _ = ran
    run = Run.open(folder / entries[2].name)
    out = evaluate(Simulator(run.task), run.champion.theta, STARTS)
    assert [s.fitness for s in measured[2].starts] == out.fitness.tolist()
    assert measured[2].champion.solved_starts == out.solved.sum()
    assert measured[0].champion.solved is None
    assert measured[0].champion.escape_time is None


def test_finished_runs_are_not_run_again(ran):
    folder, entries, measured, _ = ran
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.*")}
    again = run_entries(folder, entries, 1)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.*")} == before
    assert [m.champion for m in again] == [m.champion for m in measured]


def test_what_is_done_counts_for_the_time_left(ran):
    folder, entries, *_ = ran
    assert [share_done(folder, entry) for entry in entries] == [1.0, 1.0, 1.0, 0.0]
    assert share_done(folder, small(seed=9)) == 0.0


def test_a_passive_body_is_measured_without_a_run(ran):
    _, _, measured, _ = ran
    passive = measured[3]
    assert passive.champion.evaluations == 0
    assert passive.champion.generation is None
    assert not len(passive.best)
    assert measure(passive.entry, None).champion == passive.champion


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"evaluations": 63}, "expected a run of 63 evaluations"),
        ({"change": "population=product"}, None),  # another folder
    ],
)
def test_a_run_of_other_settings_is_refused(ran, change, words):
    folder, *_ = ran
    entry = small(**change)
    if words is None:
        assert open_run(folder, entry) is None
        return
    with pytest.raises(InvalidInput, match=words):
        run_entries(folder, [entry])


def test_a_run_of_another_task_is_refused(ran, tmp_path):
    folder, entries, *_ = ran
    (tmp_path / small(seed=2).name).symlink_to(folder / entries[0].name)
    with pytest.raises(InvalidInput, match="expected a run of 2 seed"):
        open_run(tmp_path, small(seed=2))
    (tmp_path / small(body="medium").name).symlink_to(folder / entries[0].name)
    with pytest.raises(InvalidInput, match="choose another folder"):
        open_run(tmp_path, small(body="medium"))


def test_an_error_in_a_process_ends_the_campaign_and_keeps_the_runs(tmp_path):
    (tmp_path / small(seed=1).name).mkdir()
    (tmp_path / small(seed=1).name / "run.json").write_text("{")
    with pytest.raises(InvalidInput, match=r"run\.json: expected JSON"):
        run_entries(tmp_path, [small(), small(seed=1)], 1)


def test_curves_are_medians_over_seeds_of_the_best_so_far(ran):
    _, _, measured, _ = ran
    points = [p for p in find_curves(measured[:1]) if p.evaluations == 42]
    assert [p.median for p in points] == [measured[0].best[-1]]
    assert points[0].std == 0.0
    assert list(by_cell(m.champion for m in measured)) == [
        ("rq1", "hilly", "small", "pressure", ""),
        ("rq1", "hilly", "small", "springs", ""),
        ("rq2", "escape", "small", "pressure", ""),
        ("rq1", "hilly", "small", "passive", ""),
    ]


# --- the command --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def in_one_go(tmp_path_factory):
    """A tiny campaign on two cores: its folder and what the command said."""
    folder = tmp_path_factory.mktemp("whole") / "campaign"
    done = turgor("reproduce", *TINY, "--threads", "2", "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder, done


def test_the_command_leaves_runs_tables_figures_and_a_report(in_one_go):
    folder, done = in_one_go
    assert f"report    {folder / 'report.html'}" in done.stdout
    assert (folder / "report.html").stat().st_size > 10_000
    assert sorted(path.stem for path in (folder / "tables").iterdir()) == sorted(rows.KINDS)
    tables = rows.read_tables(folder / "tables")
    assert Counter((c.task, c.condition) for c in tables.champions) == {
        ("hilly", "pressure"): 2,
        ("hilly", "springs"): 2,
        ("hilly", "passive"): 2,
        ("escape", "pressure"): 2,
        ("escape", "springs"): 2,
        ("escape", "passive"): 1,
    }
    assert len(tables.starts) == STARTS * len(tables.champions)
    for champion in tables.champions:
        fitness = [s.fitness for s in tables.starts if s.run == champion.run]
        assert champion.robust == np.median(fitness)
    assert [(c.question, c.a, c.b) for c in tables.comparisons if c.measure == "best"] == [
        ("rq1", "springs", "pressure"),
        ("rq1", "passive", "pressure"),
        ("rq1", "passive", "springs"),
        ("rq2", "springs", "pressure"),
    ]
    assert {path.suffix for path in (folder / "figures").iterdir()} == {".svg", ".pdf", ".png"}
    assert not done.stderr


def test_interrupted_and_continued_gives_the_same_bytes(in_one_go, tmp_path):
    folder, _ = in_one_go
    other = tmp_path / "campaign"
    command = [sys.executable, "-m", "turgor", "reproduce", *TINY, "--threads", "1", "--out", str(other)]
    group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP} if os.name == "nt" else {"start_new_session": True}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **group)
    wait_for_rows(other, process)
    interrupt(process)
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "the same command goes on" in error
    states = [Run.open(path.parent).status for path in other.glob("*/run.json")]
    assert "interrupted" in states
    assert not (other / "report.html").exists()
    done = turgor(*command[3:])
    assert done.returncode == 0, done.stderr
    assert tables_of(other) == tables_of(folder)


def test_killed_and_started_again_at_once_it_gives_the_same_bytes(in_one_go, tmp_path):
    folder, _ = in_one_go
    other = tmp_path / "campaign"
    command = [sys.executable, "-m", "turgor", "reproduce", *TINY, "--threads", "2", "--out", str(other)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    wait_for_rows(other, process)
    second = turgor(*command[3:])
    assert second.returncode == 2
    assert f"wait for that one, or end it; got process {process.pid} on" in second.stderr
    assert second.stderr.count("\n") == 1
    process.kill()
    process.wait()
    done = turgor(*command[3:])
    assert done.returncode == 0, done.stderr
    assert tables_of(other) == tables_of(folder)


@pytest.mark.skipif(sys.platform != "linux", reason="counts processes in /proc")
def test_when_the_first_process_is_killed_the_others_keep_their_runs_and_end(tmp_path):
    folder = tmp_path / "campaign"
    arguments = ("--only", "rq1", "--body", "small", "--seeds", "2", "--threads", "2", "--out", str(folder))
    command = [sys.executable, "-m", "turgor", "reproduce", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    wait_for_rows(folder, process)
    others = [pid for pid in group_of(process.pid) if pid != process.pid]
    assert len(others) >= 2
    process.kill()
    process.wait()
    until = time.monotonic() + 60
    while group_of(process.pid) and time.monotonic() < until:
        time.sleep(0.05)
    assert not group_of(process.pid)
    states = {Run.open(path.parent).status for path in folder.glob("*/run.json")}
    assert states == {"interrupted"}


def group_of(leader: int) -> list[int]:
    """Processes of the group of `leader` that are alive."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, group = stat.read_text().rpartition(")")[2].split()[:3]
        except OSError:  # gone meanwhile
            continue
        if int(group) == leader and state != "Z":
            found.append(int(stat.parent.name))
    return found


def wait_for_rows(folder: Path, process):
    """Until some run has a generation behind it."""
    until = time.monotonic() + 120
    while time.monotonic() < until and process.poll() is None:
        if any(path.read_bytes().count(b"\n") > 1 for path in folder.glob("*/history.csv")):
            return
        time.sleep(0.002)
    raise AssertionError("no generation")


def interrupt(process):
    """Ctrl-C, which reaches every process of a terminal."""
    if os.name == "nt":
        process.send_signal(signal.CTRL_BREAK_EVENT)
    else:
        os.killpg(process.pid, signal.SIGINT)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--evaluations", "151"), "expected a run of 151 evaluations; choose another folder"),
        (("--only", "rq9"), "only: expected one of rq0, rq1, rq2, studies; got 'rq9'"),
        (("--body", "tiny"), "body: expected one of small, medium, large; got 'tiny'"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(in_one_go, arguments, words):
    folder, _ = in_one_go
    done = turgor("reproduce", *TINY, *arguments, "--out", folder)
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    done = turgor("reproduce", *TINY, "--out", tmp_path)
    assert done.returncode == 2
    assert "expected a new or empty folder, or a campaign's" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
