"""Variants: every number of the `paper` preset that can be changed, with its unit and its default.

They are keyword arguments of `turgor.make_task` and options of the command line, whose help shows the text beside
each field: the only list there is. `Robust` is the same for a robust evolution, whose worlds vary by themselves. No
NumPy in here, so that help answers at once.
"""

from __future__ import annotations

from typing import Annotated, Literal, get_args

import msgspec

from turgor.errors import InvalidInput, describe, one_of

Condition = Literal["pressure", "springs", "passive"]
Fitness = Literal["progress", "distance", "elapsed", "area"]
Observation = Literal["signed", "unit"]
PressureLength = Literal["true", "commanded"]
Keep = Literal["median", "worst"]


LARGEST = 1e9  # what a number of the world or of sensing may be, in its unit
_RANGES = {
    "dt": (1e-6, 10.0),
    "temperature": (1e-9, LARGEST),
    "max_travel": (1e-9, LARGEST),
    "velocity_iterations": (0, 1000),
    "position_iterations": (0, 1000),
}


class General(msgspec.Struct, frozen=True):
    """Numbers of the task itself."""

    steps: Annotated[int, "length of an evaluation [step]"] = 1800
    fitness: Annotated[Fitness | None, "None: progress on flat and hilly, distance on escape, area on inflation"] = None
    pressure_unit: Annotated[float | None, "[Pa] per step and unit of the controller's output; None: p_max / 1000"] = (
        None
    )
    ground_friction: Annotated[float, "of ground, roof and walls [1]"] = 0.2


class Physics(msgspec.Struct, frozen=True):
    """The world's and the solver's numbers; the defaults are the `paper` preset (Box2D 2.3's solver)."""

    gravity: Annotated[float, "[m/s^2], downwards"] = 10.0
    dt: Annotated[float, "length of a step [s]"] = 1 / 60
    velocity_iterations: Annotated[int, "of the solver, per step"] = 8
    position_iterations: Annotated[int, "of the solver, per step, at most"] = 3
    slop: Annotated[float, "penetration that is left alone [m]"] = 0.005
    baumgarte: Annotated[float, "share of the penetration corrected by an iteration [1]"] = 0.2
    max_correction: Annotated[float, "by an iteration [m]"] = 0.2
    max_travel: Annotated[float, "by a step [m]"] = 2.0
    skin: Annotated[float, "around squares and segments [m]"] = 0.01
    temperature: Annotated[float, "of the gas [K]"] = 288.15
    pressure_max: Annotated[float, "p_max / (nRT / (pi r^2)) [1]"] = 1.25
    pressure_min: Annotated[float, "p_min / p_max [1]"] = 0.2
    area_min: Annotated[float, "smallest area for the gas law / (pi r^2) [1]"] = 0.01
    pressure_length: Annotated[
        PressureLength, "spring lengths that the gas acts on; commanded: the paper's program, momentum from nothing"
    ] = "true"

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if name == "pressure_length":
                if value not in get_args(PressureLength):
                    raise one_of(name, get_args(PressureLength), value)
            elif name in _RANGES:
                low, high = _RANGES[name]
                if not low <= value <= high:
                    raise InvalidInput(f"{name}: expected a number from {low:g} to {high:g}", describe(value))
            elif not 0 <= value <= LARGEST:
                raise InvalidInput(
                    f"{name}: expected a number that is not negative, up to {LARGEST:g}", describe(value)
                )


class Sensing(msgspec.Struct, frozen=True):
    """What is observed: touch of each mass; x, y of each mass relative to the centre of mass; velocity of
    the centre of mass; pressure of each chamber. 3 masses + 2 + chambers values."""

    window: Annotated[int, "averaged over [step]; fewer at the start"] = 25
    observation: Annotated[Observation, "unit: signed values v become (v + 1) / 2"] = "signed"
    position_scale: Annotated[float, "relative positions are divided by this many body radii [1]"] = 1.75
    velocity_scale: Annotated[float, "velocities are divided by this [m/s]"] = 20.0

    def __post_init__(self) -> None:
        if not isinstance(self.window, int) or not 1 <= self.window <= 10_000:
            raise InvalidInput("window: expected a whole number of steps, 1 to 10000", describe(self.window))
        if self.observation not in get_args(Observation):
            raise one_of("observation", get_args(Observation), self.observation)
        for name in ("position_scale", "velocity_scale"):
            value = getattr(self, name)
            if not 1e-9 <= value <= LARGEST:
                raise InvalidInput(f"{name}: expected a positive number, 1e-09 to {LARGEST:g}", describe(value))


class Elements(msgspec.Struct, frozen=True):
    """Numbers of the body's elements; the defaults are those of `Body`."""

    mass_count: Annotated[int | None, "None: 10, 15, 20 for small, medium, large"] = None
    radius: Annotated[float | None, "[m]; None: 5, 7.5, 10"] = None
    gas_amount: Annotated[float | None, "[mol]; None: 1400.67, 2101.005, 2801.34"] = None
    side: Annotated[float, "of a mass [m]"] = 1.0
    density: Annotated[float, "of a mass [kg/m^2]"] = 2500.0
    friction: Annotated[float, "of the masses [1]"] = 10.0
    frequency: Annotated[float, "of the springs [Hz]"] = 8.0
    damping_ratio: Annotated[float, "of the springs [1]"] = 0.3
    shortest: Annotated[float, "commanded spring length / rest length [1]"] = 0.75
    longest: Annotated[float, "commanded spring length / rest length [1]"] = 1.25


class Hills(msgspec.Struct, frozen=True):
    """Numbers of the hilly terrain."""

    hill_height: Annotated[
        float | None, "standard deviation [m]; None: 1, 2, 3 for small, medium, large, r / 5 for others"
    ] = None
    hill_step: Annotated[float, "mean distance of two vertices [m]"] = 10.0
    hill_step_spread: Annotated[float, "its standard deviation / mean [1]"] = 0.25
    hill_extent: Annotated[float, "where the terrain ends [m]"] = 400.0


class Cage(msgspec.Struct, frozen=True):
    """Numbers of the cage; the defaults are the paper's text."""

    cage_width: Annotated[float | None, "between the walls [m]; None: 3 r"] = None
    cage_roof: Annotated[float | None, "[m]; None: 2 r + 1, and 3 r for escape-authors"] = None
    cage_aperture: Annotated[float | None, "[m]; None: a third of the roof, and r for escape-authors"] = None
    cage_wall: Annotated[float, "thickness [m]"] = 1.0


class Inflation(msgspec.Struct, frozen=True):
    """Numbers of the validation by inflation: p(t) = clip((t - rest) / ramp, 0, 1) p_max in step t."""

    rest_steps: Annotated[int, "before the pressure rises [step]"] = 360
    ramp_steps: Annotated[int, "until it is p_max [step]"] = 100


MOST_WORLDS = 100  # that are simulated at once
# What a spread may be [1]; of the start [m]: the paper's cages have 1 m free beside each body, 0.015 m below.
_SPREADS = {"friction": 1.0, "gravity": 1.0, "gas": 1.0, "damping": 1.0, "shift": 1.0, "jitter": 1e-3}


class Robust(msgspec.Struct, frozen=True, kw_only=True):
    """How a robust evolution judges its candidates: each runs once in every one of a few worlds that differ a little
    from the task's. The worlds are drawn for each generation, and are the same for all of its candidates. A spread s
    changes a number by a share that is uniform in [-s, s]."""

    worlds: Annotated[int, "worlds of a generation, in each of which a candidate runs once"] = 5
    keep: Annotated[Keep, "which of its runs counts as the candidate's: the median (of an even number the lower) or "
                          "the worst"] = "median"  # fmt: skip
    friction: Annotated[float, "spread of the friction of ground, roof and walls [1]"] = 0.1
    gravity: Annotated[float, "spread of gravity [1]"] = 0.02
    gas: Annotated[float, "spread of the amount of gas, and of p_max with it [1]"] = 0.05
    damping: Annotated[float, "spread of the springs' damping ratio [1]"] = 0.2
    shift: Annotated[float, "the start moves sideways by up to this [m]"] = 0.05
    jitter: Annotated[float, "each mass starts up to this beside its place, in x and in y [m]"] = 1e-6

    def __post_init__(self) -> None:
        if not isinstance(self.worlds, int) or isinstance(self.worlds, bool) or not 1 <= self.worlds <= MOST_WORLDS:
            raise InvalidInput(f"robust worlds: expected a whole number, 1 to {MOST_WORLDS}", describe(self.worlds))
        if self.keep not in get_args(Keep):
            raise one_of("robust keep", get_args(Keep), self.keep)
        for name, largest in _SPREADS.items():
            value = getattr(self, name)
            if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value <= largest:
                raise InvalidInput(f"robust {name}: expected a number from 0 to {largest:g}", describe(value))

    @property
    def told(self) -> str:
        """What a candidate's fitness is, in words."""
        return f"{self.keep} of {self.worlds} changed worlds" if self.worlds > 1 else "in a changed world"


VARIANT_GROUPS: tuple[type[msgspec.Struct], ...] = (General, Physics, Sensing, Elements, Hills, Cage, Inflation)


def variant_names() -> dict[str, type[msgspec.Struct]]:
    """Every number that `make_task` takes as a keyword argument, with the group that holds its default."""
    return {name: group for group in VARIANT_GROUPS for name in group.__struct_fields__}
