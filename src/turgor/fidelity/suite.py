"""The fidelity suite: everything that can be compared with Box2D, as tables, figures and a page.

FOLDER/fidelity.md
FOLDER/fidelity/*.csv          what was measured
FOLDER/images/fidelity-*.png
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec

import turgor
from turgor.errors import InvalidInput
from turgor.experiments.rows import read_rows, write_rows
from turgor.fidelity.compare import HERE
from turgor.fidelity.contacts import Contact, contact_rows
from turgor.fidelity.engines import ENGINES, Crew, installed, version_of
from turgor.fidelity.golden import FOLDER as GOLDEN
from turgor.fidelity.golden import Growth, Inflation, Square, growth_rows, inflation_rows, square_rows
from turgor.fidelity.populations import BOX2D, Crossed, Ranked, champions, crossed_rows, ranked_rows
from turgor.files import writing

Progress = Callable[[int, int], object]


class Version(msgspec.Struct, frozen=True, kw_only=True):
    """What an engine was."""

    engine: str
    says: str
    version: str


class Suite(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that was measured; each field is a table of its name."""

    versions: list[Version] = []
    growth: list[Growth] = []
    squares: list[Square] = []
    inflation: list[Inflation] = []
    contacts: list[Contact] = []
    random: list[Ranked] = []
    champions: list[Crossed] = []


TABLES: dict[str, Any] = {name: get_args(hint)[0] for name, hint in get_type_hints(Suite).items()}


def write_suite(
    out: Path,
    *,
    campaign: Path,
    golden: Path | None = None,
    processes: int | None = None,
    say: Callable[[str], object] = lambda text: None,
    progress: Progress | None = None,
) -> Path:
    """Path of the page FOLDER/fidelity.md, after everything that it tells has been measured.

    `campaign`: the folder of `turgor reproduce`, for its champions; `golden`: the repository's tests/golden. Every
    engine that is installed takes part; Box2D 2.3 must. `say` is called with a line for every part, `progress` with
    agents done and all. Processes are spawned: call it under `if __name__ == "__main__"`. Raises `InvalidInput`.
    """
    suite = measure(campaign, golden or GOLDEN, processes, say, progress)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        write_suite_tables(out / "fidelity", suite)
    say("figures and page ...")
    from turgor.fidelity.suite_page import write_page

    return write_page(out, suite)


def measure(
    campaign: Path,
    golden: Path,
    processes: int | None,
    say: Callable[[str], object],
    progress: Progress | None,
) -> Suite:
    """The `Suite` of all engines that are installed."""
    engines = installed()
    if BOX2D not in engines:
        raise InvalidInput("--suite: expected Box2D 2.3; pip install 'turgor[box2d]'", "none")
    if not campaign.is_dir() or next(champions(campaign), None) is None:
        raise InvalidInput(f"{campaign}: expected a campaign; turgor reproduce makes one", "no champions")
    everyone = [HERE, *engines]
    with Crew(processes) as crew:
        say(f"golden data, contact cases: {', '.join(everyone)} ...")

        def each(rows: Callable[..., list[Any]], *given: Any) -> list[Any]:
            return [row for engine in everyone for row in rows(engine, *given)]

        found = {
            "growth": each(growth_rows, golden),
            "squares": each(square_rows, golden),
            "inflation": each(inflation_rows, golden),
            "contacts": each(contact_rows),
        }
        say("random controllers ...")
        ranked = ranked_rows(engines, crew, progress)
        say(f"champions of {campaign} ...")
        crossed = crossed_rows(campaign, engines, crew, progress)
    return Suite(versions=_versions(engines), random=ranked, champions=crossed, **found)


def _versions(engines: Sequence[str]) -> list[Version]:
    here = Version(engine=HERE, says="turgor", version=turgor.__version__)
    return [here, *(Version(engine=e, says=ENGINES[e].says, version=version_of(e)) for e in engines)]


def write_suite_tables(folder: Path, suite: Suite) -> None:
    """Writes every table as FOLDER/NAME.csv."""
    folder.mkdir(exist_ok=True)
    for name, kind in TABLES.items():
        write_rows(folder / f"{name}.csv", kind, getattr(suite, name))


def read_suite(folder: Path) -> Suite:
    """What `write_suite_tables` wrote. Raises `InvalidInput` that names the file."""
    tables: dict[str, Any] = {name: read_rows(folder / f"{name}.csv", kind) for name, kind in TABLES.items()}
    return Suite(**tables)
