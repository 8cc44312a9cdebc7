"""turgor: simulate and evolve pressure-based soft agents.

task = turgor.make_task("hilly", body="small", condition="pressure", seed=0)
out = turgor.Simulator(task).rollout(theta)          # theta [agent, parameter] -> out.fitness [agent]
run = turgor.evolve(task, evaluations=10_000, out="runs/first")
"""

import importlib
from typing import TYPE_CHECKING, Any

from turgor.envs.registration import register_on_import

__version__ = "0.1.0"

if TYPE_CHECKING:
    from turgor.body import LARGE as LARGE
    from turgor.body import MEDIUM as MEDIUM
    from turgor.body import SMALL as SMALL
    from turgor.body import Body as Body
    from turgor.body import ring as ring
    from turgor.control import MLP as MLP
    from turgor.control import Distributed as Distributed
    from turgor.control import Linear as Linear
    from turgor.control import Sensing as Sensing
    from turgor.control import Sinusoid as Sinusoid
    from turgor.errors import InvalidInput as InvalidInput
    from turgor.evolution.cma_es import CMAES as CMAES
    from turgor.evolution.lm_ma_es import LMMAES as LMMAES
    from turgor.evolution.loop import evaluate as evaluate
    from turgor.evolution.loop import evolve as evolve
    from turgor.evolution.loop import resume as resume
    from turgor.evolution.openai_es import OpenAIES as OpenAIES
    from turgor.evolution.sep_cma_es import SepCMAES as SepCMAES
    from turgor.evolution.strategy import Degenerate as Degenerate
    from turgor.evolution.strategy import Strategy as Strategy
    from turgor.evolution.worlds import draw_worlds as draw_worlds
    from turgor.experiments.reproduce import reproduce as reproduce
    from turgor.fidelity.compare import crosscheck as crosscheck
    from turgor.recording import Recording as Recording
    from turgor.rollout import Rollout as Rollout
    from turgor.runs import Run as Run
    from turgor.scene import Scene as Scene
    from turgor.scene import cage as cage
    from turgor.scene import flat as flat
    from turgor.scene import hills as hills
    from turgor.simulate import Simulator as Simulator
    from turgor.simulate import Step as Step
    from turgor.simulate import perturbed as perturbed
    from turgor.simulate import replay as replay
    from turgor.task import Leave as Leave
    from turgor.task import Physics as Physics
    from turgor.task import Task as Task
    from turgor.task import make_task as make_task
    from turgor.task import resting as resting
    from turgor.variants import Robust as Robust

# One canonical path per name; a module is imported when its first name is asked for, so that
# `import turgor` and the command line answer at once.
_HOME = {
    "turgor.body": ("Body", "LARGE", "MEDIUM", "SMALL", "ring"),
    "turgor.control": ("Distributed", "Linear", "MLP", "Sensing", "Sinusoid"),
    "turgor.errors": ("InvalidInput",),
    "turgor.evolution.cma_es": ("CMAES",),
    "turgor.evolution.lm_ma_es": ("LMMAES",),
    "turgor.evolution.loop": ("evaluate", "evolve", "resume"),
    "turgor.evolution.openai_es": ("OpenAIES",),
    "turgor.evolution.sep_cma_es": ("SepCMAES",),
    "turgor.evolution.strategy": ("Degenerate", "Strategy"),
    "turgor.evolution.worlds": ("draw_worlds",),
    "turgor.experiments.reproduce": ("reproduce",),
    "turgor.fidelity.compare": ("crosscheck",),
    "turgor.recording": ("Recording",),
    "turgor.runs": ("Run",),
    "turgor.rollout": ("Rollout",),
    "turgor.scene": ("Scene", "cage", "flat", "hills"),
    "turgor.simulate": ("Simulator", "Step", "perturbed", "replay"),
    "turgor.task": ("Leave", "Physics", "Task", "make_task", "resting"),
    "turgor.variants": ("Robust",),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}
__all__ = sorted(_MODULE)

register_on_import()


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        raise AttributeError(f"module 'turgor' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
