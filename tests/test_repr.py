"""What a notebook shows of an object fits on a line or two and has no arrays in it."""

import numpy as np
import pytest

import turgor


def objects() -> dict[str, object]:
    task = turgor.make_task("escape", steps=30)
    simulator = turgor.Simulator(task, threads=1)
    theta = np.zeros((3, task.parameter_count))
    run = turgor.evolve(task, 21, seed=1, threads=1)
    undecided = turgor.Rollout(
        fitness=np.full(2, np.nan), steps=np.ones(2), solved=np.zeros(2, bool), com=None, start=None, position=None
    )
    return {
        "Body(10 masses, 10 springs, 1 chamber, radius 5 m": task.body,
        "Body(1 masses, 0 springs, 0 chambers": turgor.Body([[0.0, 0.0]]),
        "Scene(9 segments, x -100 to 100 m": task.scene,
        "Scene(empty)": turgor.Scene([]),
        "Task('escape', body of 10 masses": task,
        "Simulator(Task('escape'": simulator,
        "Rollout(3 agents, fitness ": simulator.rollout(theta),
        "Rollout(2 agents, none with a fitness)": undecided,
        "Rollout(0 agents, none": simulator.rollout(theta[:0]),
        "Recording(30 steps, 0.5 s, 10 masses": simulator.record(theta[0]),
        "Step(2 agents of 10 masses, 0 solved)": simulator.reset(2),
        "Run(escape, done, 21 evaluations, Champion(fitness ": run,
        "Champion(fitness ": run.champion,
    }


@pytest.mark.parametrize(("start", "value"), objects().items(), ids=lambda value: str(value)[:20])
def test_a_repr_is_short(start: str, value: object) -> None:
    text = repr(value)
    assert text.startswith(start)
    assert len(text) < 160
    assert "\n" not in text
    assert "array" not in text
