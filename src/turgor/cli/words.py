"""What commands say: a line, and the words for a run, its unit and its fitness."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from turgor.task import Task
    from turgor.variants import Robust


def say(text: str = "") -> None:
    """Prints a line. Where nobody reads any more, the rest is lost in silence and the work goes on."""
    try:
        try:
            print(text, flush=True)
        except UnicodeEncodeError:  # a name of a file, or a terminal, that is not UTF-8
            print(text.encode(sys.stdout.encoding, "backslashreplace").decode(sys.stdout.encoding), flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def name_of(task: Task, recipe: dict[str, Any] | None, robust: Robust | None = None) -> str:
    """What a run of `task` is called; with the recipe that it was made from, its body and seed as well."""
    parts = [task.name, str(recipe["body"])] if recipe else [task.name]
    parts += [*controlled(task), *(["robust"] if robust else [])]
    return ", ".join([*parts, *([f"seed {recipe['seed']}"] if recipe else [])])


def controlled(task: Task) -> list[str]:
    """The condition, and the controller's name where it is not the paper's."""
    from turgor.control import CONTROLLERS

    name = next(name for name, kind in CONTROLLERS.items() if kind is type(task.controller))
    return [task.condition] if name == "linear" else [task.condition, name]


def unit_of(task: Task) -> str:
    """The fitness's unit, with a space before it."""
    return " m/s" if task.fitness in ("progress", "distance", "elapsed") else ""


def spread(fitness: Any, unit: str) -> str:
    """Median and quartiles of `fitness`, shape [start]."""
    import numpy as np

    low, median, high = np.percentile(fitness, [25, 50, 75])
    return f"{median:.3f}{unit} median, quartiles {low:.3f} and {high:.3f}"
