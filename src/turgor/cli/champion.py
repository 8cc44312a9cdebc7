"""`turgor evaluate` and `turgor video`: a run's champion is run again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from turgor.cli.command import Command, Parser, add_threads, count, number
from turgor.cli.words import name_of, say, spread, unit_of
from turgor.errors import InvalidInput

if TYPE_CHECKING:
    from turgor.runs import Run

FORMATS = ("mp4", "webm", "gif")  # of a video


# --- evaluate -----------------------------------------------------------------------------------------------------


def _evaluate_options(parser: Parser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of the run")
    parser.add_argument("--repeats", type=count, default=30, metavar="N", help="starts (default: 30)")
    add_threads(parser)
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write the result to FILE as well; - for the terminal"
    )


def _evaluate(options: argparse.Namespace) -> None:
    import numpy as np

    from turgor.evolution.loop import evaluate
    from turgor.files import write_whole
    from turgor.recording import tangled
    from turgor.runs import Run
    from turgor.simulate import Simulator

    run = Run.open(options.run)
    champion, unit = run.checked_champion(), unit_of(run.task)
    simulator = Simulator(run.task, threads=options.threads)
    again = float(simulator.rollout(champion.theta[None]).fitness[0])
    out = evaluate(simulator, champion.theta, options.repeats)
    low, median, high = np.percentile(out.fitness, [25, 50, 75]).tolist()
    least, most = float(out.fitness.min()), float(out.fitness.max())
    solved = int(out.solved.sum()) if run.task.end is not None else None
    around = int(tangled(out.position, run.task.body, run.task.scene).sum())
    if options.json is not None:
        import msgspec

        result = {
            "run": str(options.run),
            "fitness": champion.fitness,
            "again": again,
            "repeats": options.repeats,
            "median": median,
            "quartiles": [low, high],
            "min": least,
            "max": most,
            "solved": solved,
            "tangled": around,
            "each": out.fitness.tolist(),
        }
        data = msgspec.json.format(msgspec.json.encode(result)) + b"\n"
        if str(options.json) == "-":
            say(data.decode().rstrip())
            return
        write_whole(options.json, data)
    say(f"champion   {champion.fitness:.3f}{unit}, generation {champion.generation} of {options.run}")
    same = "the same bits" if again == champion.fitness else "not the same: another version or machine made the run"
    say(f"again      {again:.3f}{unit}, {same}")
    say(f"robust     {spread(out.fitness, unit)}, of {options.repeats} starts moved by 1e-6 m")
    say(f"range      {least:.3f} to {most:.3f}{unit}")
    if solved is not None:
        steps = simulator.record(champion.theta).tangled
        say(f"solved     {solved} of {options.repeats}")
        say(f"tangled    {around} of {options.repeats} at the end (a wall through a spring); the champion itself")
        say(f"           in {steps.sum()} of its {len(steps) - 1} steps")


EVALUATE = Command(
    "Run a champion again, from starts moved by 1e-6 m: how much of it was luck.",
    "examples:\n"
    "  turgor evaluate runs/hilly-small-pressure-s0\n"
    "  turgor evaluate runs/hilly-small-pressure-s0 --repeats 1000 --json robust.json",
    _evaluate_options,
    _evaluate,
)


# --- video --------------------------------------------------------------------------------------------------------


def _video_options(parser: Parser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of the run")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help=".mp4, .webm or .gif (default: champion.mp4 in the run's folder)"
    )
    parser.add_argument("--format", choices=FORMATS, help="mp4, webm or gif (default: what FILE ends with)")
    parser.add_argument("--size", type=_size, metavar="WxH", help="pixels (default: 1280x720, of a GIF 640x360)")
    parser.add_argument("--from", type=number, default=0.0, dest="start", metavar="S", help="first second (default: 0)")
    parser.add_argument("--to", type=number, dest="stop", metavar="S", help="last second (default: the end)")


def _size(text: str) -> tuple[int, int]:
    width, x, height = text.partition("x")
    if not (x and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, as in 1280x720; got {text!r}")
    return int(width), int(height)


def _video(options: argparse.Namespace) -> None:
    from turgor.runs import Run

    run = Run.open(options.run)
    path = options.out or options.run / f"champion.{options.format or 'mp4'}"
    if options.format is not None and path.suffix.lower() != f".{options.format}":
        raise InvalidInput(f"--format: expected --out to end with .{options.format}", str(path))
    size = options.size or ((640, 360) if path.suffix.lower() == ".gif" else (1280, 720))
    say(str(draw_video(run, path, size, start=options.start, stop=options.stop)))


def draw_video(run: Run, path: Path, size: tuple[int, int], *, start: float = 0.0, stop: float | None = None) -> Path:
    from turgor.simulate import Simulator
    from turgor.view.video import write_video

    champion = run.checked_champion()
    recording = Simulator(run.task, threads=1).record(champion.theta)
    title = f"{name_of(run.task, run.settings.recipe)}: {champion.fitness:.2f}{unit_of(run.task)}"
    return write_video(recording, path, size=size, start=start, stop=stop, title=title)


VIDEO = Command(
    "Draw a run's champion as a video, at 60 frames/s, without any display.",
    "examples:\n"
    "  turgor video runs/hilly-small-pressure-s0\n"
    "  turgor video runs/hilly-small-pressure-s0 --out champion.webm --size 1920x1080\n"
    "  turgor video runs/hilly-small-pressure-s0 --format gif --from 5 --to 10",
    _video_options,
    _video,
)
