"""`turgor bench`: the benchmarks, which have their options from `turgor.bench`."""

from __future__ import annotations

import argparse

from turgor.cli.command import Command, Parser


def _bench_options(parser: Parser) -> None:
    from turgor import bench

    bench.add_arguments(parser)


def _bench(options: argparse.Namespace) -> int:
    from turgor import bench

    return bench.run(options)


BENCH = Command(
    "Measure how fast the engine is on this machine.",
    "examples:\n  turgor bench --quick\n  turgor bench --csv results.csv\n  turgor bench --compare results.csv\n"
    "  turgor bench --page docs\n  turgor bench --only peer --evogym ../evogym/bin/python",
    _bench_options,
    _bench,
)
