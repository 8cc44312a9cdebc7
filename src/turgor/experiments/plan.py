"""The plan: which runs answer which question."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec

from turgor.errors import InvalidInput, describe, one_of
from turgor.evolution.strategy import default_population
from turgor.task import Task, make_task
from turgor.variants import Condition

QUESTIONS = {
    "rq0": "validation by inflation",
    "rq1": "locomotion on hilly ground",
    "rq2": "escape from a cage",
    "studies": "what the findings rest on",
}
BODIES = ("small", "medium", "large")
CONDITIONS: tuple[Condition, ...] = ("pressure", "springs", "passive")
STUDY_SEEDS = 3
STUDY_BODY = "medium"


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that a side study does otherwise than the paper preset."""

    says: str  # in words
    variants: dict[str, Any] = {}  # of `make_task`
    tasks: tuple[str, ...] = ("hilly", "escape")  # where it matters
    task: str | None = None  # evolved on in place of the paper's
    product_population: bool = False  # 4 floor(3 ln N) agents in a generation
    judged: bool = True  # champions are judged with the change too; False: by the paper preset


CHANGES = {
    "pressure_length=commanded": Change(
        says="pressure acts on commanded spring lengths, as in the published program: momentum out of nothing",
        variants={"pressure_length": "commanded"},
    ),
    "pressure_unit=1": Change(
        says="pressure moves by 1 Pa per unit of output, as printed, not by p_max/1000", variants={"pressure_unit": 1.0}
    ),
    "observation=unit": Change(
        says="all observations shifted into [0, 1], as printed, not centred", variants={"observation": "unit"}
    ),
    "window=15": Change(
        says="observations averaged over 15 steps, as in the published program, not 25", variants={"window": 15}
    ),
    "escape-authors": Change(
        says="the published program's cage: roof 3r, aperture r", tasks=("escape",), task="escape-authors"
    ),
    "fitness=elapsed": Change(
        says="evolved for distance over the time used, not over 30 s (judged by the latter)",
        variants={"fitness": "elapsed"},
        tasks=("escape",),
        judged=False,
    ),
    "population=product": Change(
        says="population 4 * floor(3 ln N) = 76, the text's formula read as a product, not 4 + floor(3 ln N) = 23",
        product_population=True,
    ),
}


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One evolution of a campaign, or (passive) the body that nothing moves."""

    task: str
    body: str
    condition: Condition
    seed: int
    evaluations: int  # 0: passive
    change: str = ""  # of CHANGES; empty: the paper preset

    @property
    def name(self) -> str:
        """Of the run's folder."""
        stem = f"{self.task}-{self.body}-{self.condition}-s{self.seed}"
        return f"{stem}-{self.change.replace('=', '-').replace('_', '-')}" if self.change else stem

    @property
    def question(self) -> str:
        if self.change:
            return "studies"
        return "rq1" if self.task == "hilly" else "rq2"

    @property
    def recipe(self) -> dict[str, Any]:
        """Arguments of `make_task` for what is evolved."""
        change = CHANGES.get(self.change, Change(says=""))
        where = {"name": change.task or self.task, "body": self.body, "condition": self.condition, "seed": self.seed}
        return {**where, **change.variants}

    def make_task(self) -> Task:
        """The task that is evolved on."""
        return make_task(**self.recipe)

    def make_judge(self) -> Task:
        """The task that the champion is judged by."""
        if not self.change or CHANGES[self.change].judged:
            return self.make_task()
        return make_task(self.task, body=self.body, condition=self.condition, seed=self.seed)

    @property
    def population(self) -> int:
        """Agents in a generation."""
        parameters = self.make_task().parameter_count
        if self.change and CHANGES[self.change].product_population:
            return 4 * math.floor(3 * math.log(parameters))
        return default_population(parameters)


def make_plan(
    questions: Sequence[str], bodies: Sequence[str] = BODIES, seeds: int = 5, evaluations: int = 10_000
) -> list[Entry]:
    """The entries behind `questions`, each once, in the order of the report. Raises `InvalidInput`."""
    for name, given, known in (("only", questions, tuple(QUESTIONS)), ("body", bodies, BODIES)):
        for value in given:
            if value not in known:
                raise one_of(name, known, value)
    for name, value in (("seeds", seeds), ("evaluations", evaluations)):
        if not isinstance(value, int) or value < 1:
            raise InvalidInput(f"{name}: expected a whole number, at least 1", describe(value))
    entries = []
    for question, task in (("rq1", "hilly"), ("rq2", "escape")):
        if question in questions:
            entries += _of_task(task, bodies, seeds, evaluations)
    if "studies" in questions:
        entries += _of_studies(evaluations)
    return list(dict.fromkeys(entries))


def _of_task(task: str, bodies: Sequence[str], seeds: int, evaluations: int) -> list[Entry]:
    entries = []
    for body in [b for b in BODIES if b in bodies]:
        for condition in CONDITIONS:
            # nothing in the cage depends on the seed but the evolution
            alike = condition == "passive" and task == "escape"
            for seed in range(1 if alike else seeds):
                budget = 0 if condition == "passive" else evaluations
                entries.append(Entry(task=task, body=body, condition=condition, seed=seed, evaluations=budget))
    return entries


def _of_studies(evaluations: int) -> list[Entry]:
    """The changed runs, and those of the paper preset that they are compared with."""
    entries = []
    for change in ("", *CHANGES):
        for task in CHANGES[change].tasks if change else ("hilly", "escape"):
            for seed in range(STUDY_SEEDS):
                entries.append(
                    Entry(
                        task=task,
                        body=STUDY_BODY,
                        condition="pressure",
                        seed=seed,
                        evaluations=evaluations,
                        change=change,
                    )
                )
    return entries
