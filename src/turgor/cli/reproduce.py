"""`turgor reproduce`: a campaign, from the questions asked to its verdicts."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

from turgor.cli.command import Command, Interrupted, Parser, add_cluster, connected, count
from turgor.cli.progress import CampaignDisplay
from turgor.cli.words import say


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
    add_cluster(parser, "does the runs")
    add("--no-videos", action="store_true", help="leave the champions' videos out of the report")
    add("--out", type=Path, metavar="FOLDER", help="of the campaign, new or to go on with (default: runs/paper)")


def _reproduce(options: argparse.Namespace) -> None:
    from turgor.experiments.reproduce import reproduce
    from turgor.experiments.rows import Claim, read_rows

    size = QUICK if options.quick else WHOLE
    bodies, out = options.body or size.bodies, options.out or size.out
    seeds, evaluations = options.seeds or size.seeds, options.evaluations or size.evaluations
    began = time.perf_counter()
    what = f"{' '.join(options.only)}: {', '.join(bodies)}; {seeds} seeds, {evaluations:,} evaluations"
    say(f"reproducing {what} -> {out}")
    try:
        with connected(options.cluster) as executor, CampaignDisplay() as display:
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
                executor=executor,
            )
    except KeyboardInterrupt:
        raise Interrupted(f"every run is kept in {out}; the same command goes on") from None
    for claim in read_rows(out / "tables" / "claims.csv", Claim):
        say(f"{claim.question:<9} {claim.claim} -> {claim.verdict}")
    say(f"time      {time.perf_counter() - began:.1f} s")
    say(f"report    {report}")


REPRODUCE = Command(
    "Run the paper's experiments, and write a report.",
    "examples:\n"
    "  turgor reproduce --quick\n"
    "  turgor reproduce\n"
    "  turgor reproduce --only rq2 --body small --seeds 20\n"
    "  turgor reproduce --only rq0 rq1 rq2 studies\n"
    "  turgor reproduce --cluster tcp://host:8786\n\n"
    "Interrupted, the same command goes on where it stopped.",
    _reproduce_options,
    _reproduce,
)
