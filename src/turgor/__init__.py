"""turgor: simulate and evolve pressure-based soft agents.

task = turgor.make_task("hilly", body="small", condition="pressure", seed=0)
out = turgor.Simulator(task).rollout(theta)          # theta [agent, parameter] -> out.fitness [agent]
run = turgor.evolve(task, evaluations=10_000, out="runs/first")
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from turgor.body import LARGE, MEDIUM, SMALL, Body, ring
    from turgor.control import Sensing
    from turgor.errors import InvalidInput
    from turgor.evolve.loop import evolve
    from turgor.evolve.strategy import CMAES, Strategy
    from turgor.recording import Recording
    from turgor.runs import Run
    from turgor.scene import Scene, cage, flat, hills
    from turgor.simulate import Rollout, Simulator, Step, perturbed, replay
    from turgor.task import Leave, Physics, Task, make_task, resting

# One canonical path per name; a module is imported when its first name is asked for, so that
# `import turgor` and the command line answer at once.
_HOME = {
    "turgor.body": ("Body", "LARGE", "MEDIUM", "SMALL", "ring"),
    "turgor.control": ("Sensing",),
    "turgor.errors": ("InvalidInput",),
    "turgor.evolve.loop": ("evolve",),
    "turgor.evolve.strategy": ("CMAES", "Strategy"),
    "turgor.recording": ("Recording",),
    "turgor.runs": ("Run",),
    "turgor.scene": ("Scene", "cage", "flat", "hills"),
    "turgor.simulate": ("Rollout", "Simulator", "Step", "perturbed", "replay"),
    "turgor.task": ("Leave", "Physics", "Task", "make_task", "resting"),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}
__all__ = sorted(_MODULE)


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        raise AttributeError(f"module 'turgor' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
