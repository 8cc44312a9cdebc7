"""`turgor evolve` and `turgor resume`: a run is made, drawn and summed up."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from turgor.cli.champion import draw_video
from turgor.cli.command import (
    Command,
    Interrupted,
    Parser,
    add_cluster,
    add_robust,
    add_threads,
    add_variants,
    connected,
    count,
    number,
    robust_of,
    whole,
)
from turgor.cli.progress import ProgressDisplay
from turgor.cli.words import controlled, name_of, say, spread, unit_of

if TYPE_CHECKING:
    from turgor.records import Champion
    from turgor.runs import Run

FIGURE, FILM = "fitness.png", "champion.mp4"


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
        "seed if it is not linear, with -robust for --robust, with -2, -3 ... if that exists)",
    )
    add_robust(parser)
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
    add_threads(parser)
    add_cluster(parser, "spreads generations of 256 agents and more")
    parser.add_argument("--no-video", action="store_true", help="do not draw champion.mp4 at the end")


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
    robust = robust_of(options)
    parts = [task.name, options.body, *controlled(task), f"s{options.seed}", *(["robust"] if robust else [])]
    out = options.out or free_folder("-".join(parts))
    check_new(out)
    recipe = {"name": task.name, "body": options.body, "condition": task.condition, "seed": options.seed, **variants}
    each = f", each {robust.told}" if robust else ""
    say(
        f"evolving {name_of(task, recipe, robust)}: {task.parameter_count:,} parameters, {options.evaluations:,} "
        f"evaluations{each} -> {out}"
    )
    with connected(options.cluster) as executor:
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
                executor=executor,
                robust=robust,
            ),
        )
    _finish(run, options)


def _resume(options: argparse.Namespace) -> None:
    from turgor.evolution.loop import resume
    from turgor.runs import Run, current_versions

    run = Run.open(options.run)
    if options.evaluations is None and run.status == "done":
        say(f"{run.path} is evolved")
        _finish(run, options)
        return
    now = current_versions()
    changed = [f"{name} {was} -> {now[name]}" for name, was in run.versions.items() if now.get(name, was) != was]
    if changed:
        say(f"note: {', '.join(changed)}: results may differ from those of a run without a pause")
    name = name_of(run.task, run.settings.recipe, run.settings.robust)
    say(f"resuming {name} after {run.evaluations:,} evaluations -> {run.path}")
    with connected(options.cluster) as executor:
        run = _watched(
            options.run,
            lambda display: resume(
                run, options.evaluations, threads=options.threads, progress=display, executor=executor
            ),
        )
    _finish(run, options)


def _watched(out: Path, work: Callable[[ProgressDisplay], Run]) -> Run:
    """What `work` returns, with its progress shown; Ctrl-C becomes a line that tells what is kept."""
    try:
        with ProgressDisplay() as display:
            return work(display)
    except KeyboardInterrupt:
        kept = (out / "run.json").exists()
        raise Interrupted(f"kept in {out}; turgor resume {out} goes on" if kept else "nothing to keep yet") from None


def _finish(run: Run, options: argparse.Namespace) -> None:
    """Sums the run up, and draws what is missing, because the run was ended before, or is an earlier champion's."""
    from turgor.records import CHAMPION
    from turgor.view.figures import fitness_figure

    assert run.path is not None
    robust, unit, champion = run.settings.robust, unit_of(run.task), run.checked_champion()
    if run.note:
        say(f"note     {run.note}")
    judged = f" {robust.told}," if robust else ""
    say(f"best     {champion.fitness:.3f}{unit},{judged} generation {champion.generation} of {run.generation}")
    say(f"robust   {spread(champion.robust, unit)}, of {len(champion.robust)} starts moved by 1e-6 m")
    if run.task.end is not None:
        solver = "none" if run.solver is None else f"{run.solver.fitness:.3f}{unit} after {_duration(run, run.solver)}"
        where = ", in the world that counts" if robust and (champion.solved or run.solver) else ""
        say(f"solved   best: {'yes' if champion.solved else 'no'}; best that solves the task: {solver}{where}")
    s = run.seconds
    say(
        f"time     {s['total']:.1f} s: simulation {s['simulation']:.1f}, {run.settings.strategy} {s['strategy']:.1f}, "
        f"start {s['start']:.1f}, rest {s['rest']:.1f}"
    )
    for path in (run.path / FIGURE, run.path / FILM):
        if path.exists() and path.stat().st_mtime < (run.path / CHAMPION).stat().st_mtime:
            path.unlink()
    if not (run.path / FIGURE).exists():
        title = name_of(run.task, run.settings.recipe, robust)
        fitness_figure(run.history, run.path / FIGURE, unit=unit.strip(), title=title)
    if not (options.no_video or (run.path / FILM).exists()):
        say(f"drawing  {FILM} ...")
        try:
            draw_video(run, run.path / FILM, (1280, 720))
        except KeyboardInterrupt:
            raise Interrupted(f"kept in {run.path}, whole; turgor video {run.path} draws it") from None
    say(f"folder   {run.path}: {' '.join(sorted(file.name for file in run.path.iterdir()))}")
    say(f"next     turgor evaluate {run.path}")
    say(f"         turgor resume {run.path} --evaluations {2 * run.settings.evaluations}")


def _duration(run: Run, champion: Champion) -> str:
    """Simulated time until the champion had solved the task."""
    return f"{champion.steps * run.task.physics.dt:.1f} s"


EVOLVE = Command(
    "Evolve a controller, and leave a run: champion, history, curve, video.",
    "examples:\n"
    "  turgor evolve\n"
    "  turgor evolve --task escape --body large --condition springs --seed 3\n"
    "  turgor evolve --body large --strategy sep-cma-es --population 50\n"
    "  turgor evolve --robust\n"
    "  turgor evolve --robust-worlds 9 --robust-keep worst --robust-friction 0.2\n"
    "  turgor evolve --strategy sep-cma-es --population 10000 --evaluations 1000000 --cluster tcp://host:8786\n"
    "  turgor evolve --gravity 9.81 --window 15 --observation unit --out runs/variant",
    _evolve_options,
    _evolve,
)

RESUME = Command(
    "Go on with a run that was interrupted, or evolve a finished one further.",
    "examples:\n"
    "  turgor resume runs/hilly-small-pressure-s0\n"
    "  turgor resume runs/hilly-small-pressure-s0 --evaluations 20000",
    _resume_options,
    _resume,
)
