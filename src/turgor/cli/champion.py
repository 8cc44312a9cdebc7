"""`turgor evaluate` and `turgor video`: a run's champion is run again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from turgor.cli.command import Command, Parser, add_threads, count, number
from turgor.cli.words import name_of, say, spread, unit_of
from turgor.errors import InvalidInput

if TYPE_CHECKING:
    import numpy as np

    from turgor.runs import Run
    from turgor.simulate import Simulator

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
    from turgor.evolution.worlds import judge_generation
    from turgor.files import write_whole
    from turgor.recording import tangled
    from turgor.runs import Run
    from turgor.simulate import Simulator

    run = Run.open(options.run)
    champion, unit, robust = run.checked_champion(), unit_of(run.task), run.settings.robust
    simulator, theta = Simulator(run.task, threads=options.threads), champion.theta
    again = float(judge_generation(simulator, theta[None], robust, run.settings.seed, champion.generation).fitness[0])
    out = evaluate(simulator, theta, options.repeats)
    low, median, high = np.percentile(out.fitness, [25, 50, 75]).tolist()
    least, most = float(out.fitness.min()), float(out.fitness.max())
    solved = int(out.solved.sum()) if run.task.end is not None else None
    around = int(tangled(out.position, run.task.body, run.task.scene).sum())
    changed = _in_other_worlds(run, simulator, options.repeats) if robust else None
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
        if robust and changed is not None:
            result |= {"judged": robust.told, "nominal": changed[0], "worlds": changed[1].tolist()}
        data = msgspec.json.format(msgspec.json.encode(result)) + b"\n"
        if str(options.json) == "-":
            say(data.decode().rstrip())
            return
        write_whole(options.json, data)
    judged = f" {robust.told}," if robust else ""
    say(f"champion   {champion.fitness:.3f}{unit},{judged} generation {champion.generation} of {options.run}")
    same = "the same bits" if again == champion.fitness else "not the same: another version or machine made the run"
    say(f"again      {again:.3f}{unit}, {same}" + (", the worlds of its generation drawn again" if robust else ""))
    if changed is not None:
        say(f"changed    {spread(changed[1], unit)}, of {len(changed[1])} worlds of no generation")
        say(f"nominal    {changed[0]:.3f}{unit}, in the task's own world; so are all below")
    say(f"robust     {spread(out.fitness, unit)}, of {options.repeats} starts moved by 1e-6 m")
    say(f"range      {least:.3f} to {most:.3f}{unit}")
    if solved is not None:
        steps = simulator.record(theta).tangled
        say(f"solved     {solved} of {options.repeats}")
        say(f"tangled    {around} of {options.repeats} at the end (a wall through a spring); the champion itself")
        say(f"           in {steps.sum()} of its {len(steps) - 1} steps")


def _in_other_worlds(run: Run, simulator: Simulator, count: int) -> tuple[float, np.ndarray]:
    """The champion's fitness in the task's own world, and in `count` changed ones (as many as there may be) that it was
    not chosen by, shape [world]."""
    import msgspec
    import numpy as np

    from turgor.evolution.worlds import draw_worlds
    from turgor.variants import MOST_WORLDS

    assert run.settings.robust is not None
    theta = run.checked_champion().theta[None]
    robust = msgspec.structs.replace(run.settings.robust, worlds=min(count, MOST_WORLDS))
    worlds = draw_worlds(run.task, robust, run.settings.seed, generation=0)
    nominal, *others = (float(out.fitness[0]) for out in simulator.rollout_in([run.task, *worlds], theta))
    return nominal, np.array(others)


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

    champion, robust = run.checked_champion(), run.settings.robust
    recording = Simulator(run.task, threads=1).record(champion.theta)
    fitness = recording.fitness if robust else champion.fitness  # what is seen is the task's own world
    title = f"{name_of(run.task, run.settings.recipe, robust)}: {fitness:.2f}{unit_of(run.task)}"
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
