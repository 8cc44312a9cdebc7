"""Reproduce: the paper's experiments from nothing to the report.

FOLDER/hilly-small-pressure-s0/ ...    a run each
FOLDER/tables/*.csv                    what was found
FOLDER/figures/*.svg, .pdf, .png
FOLDER/videos/*.mp4                    the most reliable champion of each cell
FOLDER/report.html                     all of it
"""

from __future__ import annotations

import contextlib
import datetime
import multiprocessing
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import msgspec

from turgor.errors import InvalidInput, describe
from turgor.experiments.analysis import by_cell, compare, find_curves, find_effects
from turgor.experiments.campaign import Progress, follow_first_process, run_entries
from turgor.experiments.claims import check_claims
from turgor.experiments.figures import draw_figures
from turgor.experiments.inflation import author_protocol, quasi_static
from turgor.experiments.measure import STARTS, Measured
from turgor.experiments.plan import BODIES, make_plan
from turgor.experiments.report import Film, Method, write_report
from turgor.experiments.rows import Tables, write_tables
from turgor.files import FolderLock, is_left_over, write_whole, writing
from turgor.physics.batch import load_kernel
from turgor.recording import Recording
from turgor.runs import current_versions, machine
from turgor.simulate import Simulator, available_cores
from turgor.view.video import write_video

PAPER = ("rq0", "rq1", "rq2")
MARK = "campaign.json"  # tells a campaign's folder from others
FORMAT = 1
FILM: dict[str, Any] = {
    "size": (480, 270),
    "fps": 20.0,
    "crf": 34,
}  # half a megabyte each: the report holds all of them


def reproduce(
    out: str | Path = "runs/paper",
    *,
    questions: Sequence[str] = PAPER,
    bodies: Sequence[str] = BODIES,
    seeds: int = 5,
    evaluations: int = 10_000,
    threads: int | None = None,
    videos: bool = True,
    progress: Callable[[Progress], object] | None = None,
    say: Callable[[str], object] = lambda text: None,
    executor: Any = None,
) -> Path:
    """Path of the report on `questions` ("rq0", "rq1", "rq2", "studies"), after all runs that it needs.

    The campaign's folder is `out`. Started again it goes on where it stopped, and runs nothing twice; more seeds,
    bodies or questions add runs. The report tells of what this call asks for. Its numbers do not depend on `threads`
    (cores in use; None: all) or on interruptions. `progress` is called as runs go on, `say` with a line for every
    other part. `executor`: a Dask `Client`, whose workers then do the runs, with the same results (docs/cluster.md);
    tables, figures, videos and report are made here.

    Processes are spawned: call it under `if __name__ == "__main__"`. Raises `InvalidInput` for a folder that holds
    something else, or runs with other settings; `KeyboardInterrupt` once every run has kept what it has.
    """
    began, folder = time.perf_counter(), Path(out)
    entries = make_plan(questions, bodies, seeds, evaluations)
    with _claimed(folder):
        load_kernel()  # compiles it, if it has to be, before every process would
        measured = run_entries(folder, entries, threads, progress, executor)

        with _drawers(threads) as pool:
            films = [pool.submit(_film, m, folder / "videos") for m in _chosen(measured)] if videos else []
            say(f"inflation, statistics, tables, figures{f', {len(films)} videos' if films else ''} ...")
            tables = _find_tables(measured, [b for b in BODIES if b in bodies] if "rq0" in questions else [])
            write_tables(folder / "tables", tables)
            recordings = {m.entry.name: record(m) for m in measured if m.entry.question == "rq1"}
            figures = draw_figures(tables, recordings, folder / "figures")
        method = Method(
            settings={
                "questions": list(questions),
                "bodies": list(bodies),
                "seeds": seeds,
                "evaluations": evaluations,
                "starts": STARTS,
                "threads": threads or available_cores(),
            },
            versions=current_versions(),
            machine=machine(),
            seconds={m.entry.name: m.seconds["total"] for m in measured if m.seconds},
            wall=time.perf_counter() - began,
            made=datetime.date.today().isoformat(),
        )
        return write_report(folder / "report.html", tables, figures, [film.result() for film in films], method)


def record(measured: Measured) -> Recording:
    """The recording of a champion from its own start."""
    return Simulator(measured.entry.make_judge(), threads=1).record(measured.theta)


@contextlib.contextmanager
def _claimed(folder: Path) -> Generator[None]:
    """Makes `folder` a campaign's, and keeps other processes from it. Raises `InvalidInput` for one that is in use or
    holds something else."""
    _check_folder(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    lock = FolderLock(folder)
    try:
        if not (folder / MARK).exists():
            write_whole(folder / MARK, msgspec.json.encode({"format": FORMAT}) + b"\n")
        yield
    finally:
        lock.release()


def _check_folder(folder: Path) -> None:
    mark = folder / MARK
    if mark.exists():
        try:
            found = msgspec.json.decode(mark.read_bytes(), type=dict[str, Any]).get("format")
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise InvalidInput(f"{mark}: expected JSON", describe(error)) from None
        if found != FORMAT:
            raise InvalidInput(f"{mark}: expected a campaign of format {FORMAT}", f"format {describe(found)}")
        return
    if folder.exists() and not (folder.is_dir() and all(is_left_over(path) for path in folder.iterdir())):
        raise InvalidInput("out: expected a new or empty folder, or a campaign's", f"{folder}, which holds other files")


def _find_tables(measured: Sequence[Measured], inflated: Sequence[str]) -> Tables:
    champions = [m.champion for m in measured]
    comparisons = compare(champions)
    inflation = author_protocol(inflated) if inflated else []
    return Tables(
        inflation=inflation,
        quasistatic=quasi_static(inflated) if inflated else [],
        champions=champions,
        starts=[start for m in measured for start in m.starts],
        curves=find_curves(measured),
        comparisons=comparisons,
        effects=find_effects(champions),
        claims=check_claims(inflation, champions, comparisons),
    )


def _chosen(measured: Sequence[Measured]) -> list[Measured]:
    """The champion of each cell of rq1 and rq2 that escapes, or else moves, most reliably."""
    by_name = {m.entry.name: m for m in measured}
    cells = by_cell(m.champion for m in measured if m.entry.evaluations and not m.entry.change)
    best = [max(found, key=lambda c: (c.solved_starts or 0, bool(c.solved), c.robust)) for found in cells.values()]
    return [by_name[champion.run] for champion in best]


@contextlib.contextmanager
def _drawers(processes: int | None) -> Generator[ProcessPoolExecutor]:
    """Processes for what takes long to draw; whatever ends the block ends them."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes or available_cores(), context, follow_first_process) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _film(measured: Measured, folder: Path) -> Film:
    champion = measured.champion
    title = f"{champion.task}, {champion.body}, {champion.condition}, seed {champion.seed}: {champion.best:.2f} m/s"
    folder.mkdir(exist_ok=True)
    path = folder / f"{champion.run}.mp4"
    write_video(record(measured), path, title=title, **FILM)
    return Film(run=champion.run, title=title, path=path)
