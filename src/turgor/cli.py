"""The command line: a function a command. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import turgor
from turgor.errors import InvalidInput
from turgor.terminal import Parser, ProgressDisplay, add_variants, count, did_you_mean, number, say, whole

if TYPE_CHECKING:
    from turgor.runs import Run
    from turgor.task import Task

INTERRUPTED = 130  # exit status, as shells have it for Ctrl-C


class Command(NamedTuple):
    """What a command is called with, and what it does."""

    summary: str
    examples: str
    options: Callable[[Parser], None]
    run: Callable[[argparse.Namespace], int | None]  # exit status; None: 0


def main(argv: list[str] | None = None) -> int:
    """Runs the command in `argv`, by default the process's; returns the exit status: 0, 2 for an error that is told
    in one line, 130 for Ctrl-C."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        return _run(argv)
    except InvalidInput as error:
        return _fail(str(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        print("turgor: interrupted", file=sys.stderr)
        return INTERRUPTED
    except SystemExit as end:  # of --help
        return end.code if isinstance(end.code, int) else 0


def _run(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        say(_help())
        return 0
    name, rest = argv[0], argv[1:]
    if name == "--version":
        say(f"turgor {turgor.__version__}")
        return 0
    if name not in COMMANDS:
        if name.startswith("-"):
            raise InvalidInput("expected a command first, as in turgor evolve", name)
        raise InvalidInput(f"there is no command {name!r}{did_you_mean(name, COMMANDS)}")
    command = COMMANDS[name]
    parser = Parser(f"turgor {name}", command.summary, command.examples)
    command.options(parser)
    try:
        return command.run(parser.parse(rest)) or 0
    except _Interrupted as end:
        print(f"turgor: interrupted; {end}", file=sys.stderr)
        return INTERRUPTED


def _fail(message: str) -> int:
    print(f"turgor: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


class _Interrupted(Exception):
    """Ctrl-C, with what became of the work."""


def _help() -> str:
    lines = "\n".join(f"  {name:<10}{command.summary}" for name, command in COMMANDS.items())
    return f"""usage: turgor COMMAND [options]

Simulates and evolves pressure-based soft agents: bodies of gas inside a ring of masses and springs.

commands:
{lines}

'turgor COMMAND --help' lists a command's options and their defaults; --version tells the version.

examples:
  turgor evolve                                     a small body on hilly ground, 10,000 evaluations
  turgor evolve --task escape --body large --seed 3
  turgor evaluate runs/hilly-small-pressure-s0
  turgor video runs/hilly-small-pressure-s0 --out champion.webm"""


# --- evolve, resume -----------------------------------------------------------------------------------------------


def _evolve_options(parser: Parser) -> None:
    add = parser.add_argument
    add("--task", default="hilly", metavar="NAME", help="hilly, flat, escape or escape-authors (default: hilly)")
    add("--body", default="small", metavar="NAME", help="small, medium or large (default: small)")
    add(
        "--condition",
        metavar="NAME",
        help="what is controlled: pressure (springs and pressure) or springs (default: pressure)",
    )
    add(
        "--controller",
        default="linear",
        metavar="NAME",
        help="linear (the paper's), mlp (a hidden layer), sinusoid (open loop) or distributed (the same small "
        "network in every mass) (default: linear)",
    )
    add("--hidden", type=whole, metavar="N", help="units of the hidden layer (default: mlp 16, distributed 8)")
    add("--messages", type=whole, metavar="N", help="numbers sent each way along a spring (default: distributed 1)")
    add("--seed", type=whole, default=0, metavar="N", help="draws the terrain and drives the evolution (default: 0)")
    _evolution_options(parser, "evaluations, at least; whole generations (default: 10000)", 10_000)
    _strategy_options(parser)
    add(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="new folder of the run (default: runs/TASK-BODY-CONDITION-sSEED, with the controller's name before the "
        "seed if it is not linear, with -2, -3 ... if that exists)",
    )
    add_variants(parser)


def _strategy_options(parser: Parser) -> None:
    from turgor.evolution import STRATEGIES

    add, names = parser.add_argument, ", ".join(STRATEGIES)
    add("--strategy", default="cma-es", metavar="NAME", help=f"the optimizer: {names} (default: cma-es)")
    add("--population", type=count, metavar="N", help="agents in a generation (default: 4 + floor(3 ln parameters))")
    add("--sigma", type=number, metavar="X", help="its first step size [1] (default: 0.5; openai-es: 0.3)")


def _resume_options(parser: Parser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of the run")
    _evolution_options(parser, "evaluations in all (default: those that the run was started with)", None)


def _evolution_options(parser: Parser, text: str, default: int | None) -> None:
    parser.add_argument("--evaluations", type=count, default=default, metavar="N", help=text)
    _threads_option(parser)
    parser.add_argument("--no-video", action="store_true", help="do not draw champion.mp4 at the end")


def _threads_option(parser: Parser) -> None:
    parser.add_argument("--threads", type=count, metavar="N", help="of the simulator (default: all cores)")


def _evolve(options: argparse.Namespace) -> None:
    from turgor.control import Linear, make_controller
    from turgor.task import make_task, variant_names

    chosen = {name: getattr(options, name) for name in variant_names()}
    variants = {name: value for name, value in chosen.items() if value is not None}
    controller = make_controller(options.controller, hidden=options.hidden, messages=options.messages)
    if controller != Linear():
        variants["controller"] = controller
    task = make_task(options.task, body=options.body, condition=options.condition, seed=options.seed, **variants)
    from turgor.evolution.loop import evolve
    from turgor.evolution.strategy import built_in
    from turgor.runs import check_new, free_folder

    given = {name: getattr(options, name) for name in ("population", "sigma") if getattr(options, name) is not None}
    strategy = partial(built_in(options.strategy), **given)
    out = options.out or free_folder("-".join([task.name, options.body, *_controlled(task), f"s{options.seed}"]))
    check_new(out)
    recipe = {"name": task.name, "body": options.body, "condition": task.condition, "seed": options.seed, **variants}
    say(
        f"evolving {_name(task, recipe)}: {task.parameter_count:,} parameters, {options.evaluations:,} evaluations "
        f"-> {out}"
    )
    run = _watched(
        out,
        lambda display: evolve(
            task,
            options.evaluations,
            options.seed,
            out,
            strategy=strategy,
            threads=options.threads,
            progress=display,
            recipe=recipe,
        ),
    )
    _finish(run, options)


def _resume(options: argparse.Namespace) -> None:
    from turgor.evolution.loop import resume
    from turgor.runs import Run, current_versions

    run = Run.open(options.run)
    now = current_versions()
    changed = [f"{name} {was} -> {now[name]}" for name, was in run.versions.items() if now.get(name, was) != was]
    if changed:
        say(f"note: {', '.join(changed)}: results may differ from those of a run without a pause")
    say(f"resuming {_name(run.task, run.settings.recipe)} after {run.evaluations:,} evaluations -> {run.path}")
    run = _watched(
        options.run, lambda display: resume(run, options.evaluations, threads=options.threads, progress=display)
    )
    _finish(run, options)


def _watched(out: Path, work: Callable[[ProgressDisplay], Run]) -> Run:
    """What `work` returns, with its progress shown; Ctrl-C becomes a line that tells what is kept."""
    try:
        with ProgressDisplay() as display:
            return work(display)
    except KeyboardInterrupt:
        kept = (out / "run.json").exists()
        raise _Interrupted(f"kept in {out}; turgor resume {out} goes on" if kept else "nothing to keep yet") from None


def _finish(run: Run, options: argparse.Namespace) -> None:
    """Draws the run and sums it up."""
    import time

    from turgor.view.figures import fitness_figure

    assert run.path is not None
    started = time.perf_counter()
    name, unit, champion = _name(run.task, run.settings.recipe), _unit(run.task), run.checked_champion()
    fitness_figure(run.history, run.path / "fitness.png", unit=unit.strip(), title=name)
    (run.path / "champion.mp4").unlink(missing_ok=True)  # of a run resumed: an earlier champion's
    if not options.no_video:
        say("drawing champion.mp4 ...")
        try:
            _draw_video(run, run.path / "champion.mp4", (1280, 720))
        except KeyboardInterrupt:
            raise _Interrupted(f"kept in {run.path}, whole; turgor video {run.path} draws it") from None
    drawing = time.perf_counter() - started

    if run.note:
        say(f"note     {run.note}")
    say(f"best     {champion.fitness:.3f}{unit}, generation {champion.generation} of {run.generation}")
    say(f"robust   {_spread(champion.robust, unit)}, of {len(champion.robust)} starts moved by 1e-6 m")
    if run.task.end is not None:
        solver = "none" if run.solver is None else f"{run.solver.fitness:.3f}{unit} after {_duration(run, run.solver)}"
        say(f"solved   best: {'yes' if champion.solved else 'no'}; best that solves the task: {solver}")
    s = run.seconds
    say(
        f"time     {s['total']:.1f} s: simulation {s['simulation']:.1f}, {run.settings.strategy} {s['strategy']:.1f}, "
        f"start {s['start']:.1f}, rest {s['rest']:.1f}; drawing {drawing:.1f} s"
    )
    say(f"folder   {run.path}: {' '.join(sorted(file.name for file in run.path.iterdir()))}")
    say(f"next     turgor evaluate {run.path}")
    say(f"         turgor resume {run.path} --evaluations {2 * run.settings.evaluations}")


# --- evaluate, video, bench ---------------------------------------------------------------------------------------


def _evaluate_options(parser: Parser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of the run")
    parser.add_argument("--repeats", type=count, default=30, metavar="N", help="starts (default: 30)")
    _threads_option(parser)
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write the result to FILE as well; - for the terminal"
    )


def _evaluate(options: argparse.Namespace) -> None:
    import numpy as np

    from turgor.evolution.loop import evaluate
    from turgor.recording import tangled
    from turgor.runs import Run, write_whole
    from turgor.simulate import Simulator

    run = Run.open(options.run)
    champion, unit = run.checked_champion(), _unit(run.task)
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
    say(f"robust     {_spread(out.fitness, unit)}, of {options.repeats} starts moved by 1e-6 m")
    say(f"range      {least:.3f} to {most:.3f}{unit}")
    if solved is not None:
        steps = simulator.record(champion.theta).tangled
        say(f"solved     {solved} of {options.repeats}")
        say(f"tangled    {around} of {options.repeats} at the end (a wall through a spring); the champion itself")
        say(f"           in {steps.sum()} of its {len(steps) - 1} steps")


def _video_options(parser: Parser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of the run")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help=".mp4 or .webm (default: champion.mp4 in the run's folder)"
    )
    parser.add_argument("--size", type=_size, default=(1280, 720), metavar="WxH", help="pixels (default: 1280x720)")


def _size(text: str) -> tuple[int, int]:
    width, x, height = text.partition("x")
    if not (x and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, as in 1280x720; got {text!r}")
    return int(width), int(height)


def _video(options: argparse.Namespace) -> None:
    from turgor.runs import Run

    run = Run.open(options.run)
    path = _draw_video(run, options.out or options.run / "champion.mp4", options.size)
    say(str(path))


def _draw_video(run: Run, path: Path, size: tuple[int, int]) -> Path:
    from turgor.simulate import Simulator
    from turgor.view.video import write_video

    champion = run.checked_champion()
    recording = Simulator(run.task, threads=1).record(champion.theta)
    title = f"{_name(run.task, run.settings.recipe)}: {champion.fitness:.2f}{_unit(run.task)}"
    return write_video(recording, path, size=size, title=title)


# --- reproduce ----------------------------------------------------------------------------------------------------


class Size(NamedTuple):
    """How large a campaign is, where nothing else is asked for."""

    bodies: list[str]
    seeds: int
    evaluations: int
    out: Path


WHOLE = Size(["small", "medium", "large"], 5, 10_000, Path("runs/paper"))
QUICK = Size(["small", "medium"], 2, 1_000, Path("runs/quick"))


def _reproduce_options(parser: Parser) -> None:
    add = parser.add_argument
    add(
        "--only",
        nargs="+",
        default=["rq0", "rq1", "rq2"],
        metavar="QUESTION",
        help="rq0 (inflation), rq1 (hilly ground), rq2 (escape), studies (one thing changed at a time) "
        "(default: rq0 rq1 rq2)",
    )
    add("--body", nargs="+", metavar="NAME", help="small, medium, large (default: all three)")
    add("--seeds", type=count, metavar="N", help="evolutions of each kind (default: 5)")
    add("--evaluations", type=count, metavar="N", help="of each evolution, at least (default: 10000)")
    add(
        "--quick",
        action="store_true",
        help="a look in under a minute: 2 seeds, 1000 evaluations, small and medium, in runs/quick",
    )
    add("--threads", type=count, metavar="N", help="cores to use (default: all)")
    add("--no-videos", action="store_true", help="leave the champions' videos out of the report")
    add("--out", type=Path, metavar="FOLDER", help="of the campaign, new or to go on with (default: runs/paper)")


def _reproduce(options: argparse.Namespace) -> None:
    import time

    from turgor.experiments.reproduce import reproduce
    from turgor.experiments.rows import Claim, read_rows
    from turgor.terminal import CampaignDisplay

    size = QUICK if options.quick else WHOLE
    bodies, out = options.body or size.bodies, options.out or size.out
    seeds, evaluations = options.seeds or size.seeds, options.evaluations or size.evaluations
    began = time.perf_counter()
    what = f"{' '.join(options.only)}: {', '.join(bodies)}; {seeds} seeds, {evaluations:,} evaluations"
    say(f"reproducing {what} -> {out}")
    try:
        with CampaignDisplay() as display:
            report = reproduce(
                out,
                questions=options.only,
                bodies=bodies,
                seeds=seeds,
                evaluations=evaluations,
                threads=options.threads,
                videos=not options.no_videos,
                progress=display,
                say=say,
            )
    except KeyboardInterrupt:
        raise _Interrupted(f"every run is kept in {out}; the same command goes on") from None
    for claim in read_rows(out / "tables" / "claims.csv", Claim):
        say(f"{claim.question:<9} {claim.claim} -> {claim.verdict}")
    say(f"time      {time.perf_counter() - began:.1f} s")
    say(f"report    {report}")


def _bench_options(parser: Parser) -> None:
    from turgor import bench

    bench.add_arguments(parser)


def _bench(options: argparse.Namespace) -> int:
    from turgor import bench

    return bench.run(options)


# --- words --------------------------------------------------------------------------------------------------------


def _name(task: Task, recipe: dict[str, Any] | None) -> str:
    parts = [task.name, str(recipe["body"])] if recipe else [task.name]
    return ", ".join([*parts, *_controlled(task), *([f"seed {recipe['seed']}"] if recipe else [])])


def _controlled(task: Task) -> list[str]:
    """The condition, and the controller's name where it is not the paper's."""
    from turgor.control import CONTROLLERS

    name = next(name for name, kind in CONTROLLERS.items() if kind is type(task.controller))
    return [task.condition] if name == "linear" else [task.condition, name]


def _unit(task: Task) -> str:
    """The fitness's unit, with a space before it."""
    return " m/s" if task.fitness in ("progress", "distance", "elapsed") else ""


def _spread(fitness: Any, unit: str) -> str:
    import numpy as np

    low, median, high = np.percentile(fitness, [25, 50, 75])
    return f"{median:.3f}{unit} median, quartiles {low:.3f} and {high:.3f}"


def _duration(run: Run, champion: Any) -> str:
    return f"{champion.steps * run.task.physics.dt:.1f} s"


COMMANDS = {
    "evolve": Command(
        "Evolve a controller, and leave a run: champion, history, curve, video.",
        "examples:\n"
        "  turgor evolve\n"
        "  turgor evolve --task escape --body large --condition springs --seed 3\n"
        "  turgor evolve --body large --strategy sep-cma-es --population 50\n"
        "  turgor evolve --gravity 9.81 --window 15 --observation unit --out runs/variant",
        _evolve_options,
        _evolve,
    ),
    "resume": Command(
        "Go on with a run that was interrupted, or evolve a finished one further.",
        "examples:\n"
        "  turgor resume runs/hilly-small-pressure-s0\n"
        "  turgor resume runs/hilly-small-pressure-s0 --evaluations 20000",
        _resume_options,
        _resume,
    ),
    "evaluate": Command(
        "Run a champion again, from starts moved by 1e-6 m: how much of it was luck.",
        "examples:\n"
        "  turgor evaluate runs/hilly-small-pressure-s0\n"
        "  turgor evaluate runs/hilly-small-pressure-s0 --repeats 1000 --json robust.json",
        _evaluate_options,
        _evaluate,
    ),
    "video": Command(
        "Draw a run's champion as a video, at 60 frames/s, without any display.",
        "examples:\n"
        "  turgor video runs/hilly-small-pressure-s0\n"
        "  turgor video runs/hilly-small-pressure-s0 --out champion.webm --size 1920x1080",
        _video_options,
        _video,
    ),
    "reproduce": Command(
        "Run the paper's experiments, and write a report.",
        "examples:\n"
        "  turgor reproduce --quick\n"
        "  turgor reproduce\n"
        "  turgor reproduce --only rq2 --body small --seeds 20\n"
        "  turgor reproduce --only rq0 rq1 rq2 studies\n\n"
        "Interrupted, the same command goes on where it stopped.",
        _reproduce_options,
        _reproduce,
    ),
    "bench": Command(
        "Measure how fast the engine is on this machine.",
        "examples:\n  turgor bench --quick\n  turgor bench --csv results.csv",
        _bench_options,
        _bench,
    ),
}
