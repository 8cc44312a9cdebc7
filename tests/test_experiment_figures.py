"""Figures of a campaign, from made-up rows and recordings: no simulator, no display."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest

from turgor import body as bodies
from turgor.experiments.figures import draw_figures, drawings
from turgor.experiments.plan import BODIES
from turgor.experiments.rows import Champion, Comparison, CurvePoint, Effect, Inflated, QuasiStatic, Start, Tables
from turgor.experiments.sheets import FORMATS, WIDTH, Drawing
from turgor.experiments.terrains import SLOW, find_hollows, find_trapping
from turgor.recording import Recording
from turgor.scene import Scene, flat, hills, polyline

NAMES = ["inflation", "hilly", "escape", "effects", "terrains"]
QUESTIONS = {"hilly": "rq1", "escape": "rq2"}


# --- made-up campaigns --------------------------------------------------------------------------------------------


def champion(
    task: str, body: str, condition: str, seed: int, robust: float, change: str = "", escapes: int = 0, tangled: int = 0
) -> Champion:
    cage = task == "escape"
    return Champion(
        run=f"{task}-{body}-{condition}-s{seed}{change}",
        question="studies" if change else QUESTIONS[task],
        task=task,
        body=body,
        condition=condition,
        change=change,
        seed=seed,
        evaluations=0 if condition == "passive" else 1000,
        generation=None if condition == "passive" else 40,
        best=robust + 0.25,
        robust=robust,
        robust_low=robust - 0.1,
        robust_high=robust + 0.1,
        starts=30,
        solved=escapes > 0 if cage else None,
        solved_starts=escapes if cage else None,
        escape_time=20.5 if escapes else None,
        tangled_starts=tangled,
        tangled_steps=0,
        steps=1800,
    )


def comparison(body: str, a: str, b: str, question: str = "rq1", p: float = 0.0123, effect: float = 0.76) -> Comparison:
    return Comparison(
        question=question,
        task="hilly" if question == "rq1" else "escape",
        body=body,
        measure="robust",
        a=a,
        b=b,
        count_a=5,
        count_b=5,
        median_a=1.0,
        median_b=2.0,
        difference=1.0,
        low=0.5,
        high=1.5,
        u=20.0,
        p=p / 3,
        p_holm=p,
        effect=effect,
    )


def campaign(sizes: Sequence[str] = BODIES[:2], seeds: int = 3) -> Tables:
    """Rows of every kind."""
    rng = np.random.default_rng(0)
    champions, starts, curves, comparisons = [], [], [], []
    for task, question in QUESTIONS.items():
        for body in sizes:
            for condition in ("pressure", "springs", "passive"):
                for seed in range(1 if (task, condition) == ("escape", "passive") else seeds):
                    robust = 0.0 if condition == "passive" else float(rng.uniform(0.2, 7))
                    escapes = 3 * seed if (task, condition) == ("escape", "pressure") else 0
                    tangled = 5 if (task, condition) == ("escape", "springs") else 0
                    one = champion(task, body, condition, seed, robust, escapes=escapes, tangled=tangled)
                    champions.append(one)
                    solved = [k < escapes for k in range(30)] if task == "escape" else [None] * 30
                    starts += [
                        Start(
                            run=one.run, start=k, fitness=robust, solved=s, time=20.0 + k if s else 30.0, tangled=False
                        )
                        for k, s in enumerate(solved)
                    ]
                if condition != "passive":
                    where = {"question": question, "task": task, "body": body, "condition": condition}
                    for k in range(1, 11):
                        spread = {"std": 0.5, "low": k / 2 - 1, "high": k / 2 + 1}
                        point = CurvePoint(**where, change="", evaluations=100 * k, seeds=seeds, median=k / 2, **spread)
                        curves += [
                            point,
                            msgspec.structs.replace(point, question="studies", change="window=15", median=99.0),
                        ]
            pairs = [("springs", "pressure"), ("passive", "pressure"), ("passive", "springs")]
            comparisons += [comparison(body, a, b, question) for a, b in pairs[: 3 if task == "hilly" else 1]]
    champions += [champion("hilly", "medium", "pressure", seed, 1.5, "window=15") for seed in range(seeds)]
    return Tables(
        inflation=[
            Inflated(body=body, gas=gas, time=t, pressure_ratio=t / 30, area_ratio=0.5 + t / 90, height=9.0)
            for body in sizes
            for gas in ("author", "text")
            for t in range(0, 31, 3)
        ],
        quasistatic=[
            QuasiStatic(
                body=body,
                pressure=1000.0 * p,
                lift_off=25_000.0,
                pressure_max=30_500.0,
                area_ratio=p / 60,
                analytic=None if p > 50 else 0.9,
            )
            for body in sizes
            for p in range(1, 61)
        ],
        champions=champions,
        starts=starts,
        curves=curves,
        comparisons=comparisons,
        effects=[effect("hilly", "window=15"), effect("escape", "window=15"), effect("escape", "escape-authors")],
    )


def effect(task: str, change: str) -> Effect:
    share = None if task == "hilly" else 0.25
    return Effect(
        task=task,
        change=change,
        says="observations averaged over fewer steps, as in some program, not over as many as in the text",
        count=3,
        count_paper=3,
        median=1.5,
        median_paper=1.0,
        difference=0.5,
        low=-0.25,
        high=1.25,
        effect=0.8,
        p=0.1,
        solved_starts=share,
        solved_starts_paper=share,
    )


def film(body: str = "medium", scene: Scene | None = None, speed: float = 3.0, stop: float = np.inf) -> Recording:
    """A rigid ring that moves at `speed` [m/s] until x = `stop` [m], for 30 s."""
    ring = getattr(bodies, body.upper())
    dt = 1 / 20
    steps = round(30 / dt)
    x = np.minimum(np.arange(steps + 1) * dt * speed, stop)
    centre = np.stack([x, np.full_like(x, ring.radius + 1)], axis=1)
    shape = (steps + 1, ring.mass_count, 2)
    return Recording(
        body=ring,
        scene=hills(1, height=2.0) if scene is None else scene,
        dt=dt,
        position=(ring.position + centre[:, None]).astype(np.float32),
        velocity=np.zeros(shape),
        pressure=np.zeros((steps + 1, 1)),
        rest_length=np.zeros((steps + 1, ring.spring_count)),
        touch=np.zeros(shape[:2], dtype=bool),
        fitness=float(x[-1] / 30),
    )


def films(tables: Tables) -> dict[str, Recording]:
    return {c.run: film(c.body, speed=c.robust) for c in tables.champions if c.run.startswith("hilly") and not c.change}


def made(tables: Tables, recordings: Mapping[str, Recording] | None = None) -> dict[str, Drawing]:
    return {drawing.name: drawing for drawing in drawings(tables, recordings or {})}


def lines(axes: Any, label: str) -> list[Any]:
    return [line for line in axes.get_lines() if line.get_label() == label]


def texts(drawing: Drawing) -> list[str]:
    from matplotlib.text import Text

    return [text.get_text() for text in drawing.figure.findobj(Text)]


def rows_of(tables: Tables, task: str, body: str, condition: str) -> list[Champion]:
    return [c for c in tables.champions if (c.task, c.body, c.condition, c.change) == (task, body, condition, "")]


# --- files --------------------------------------------------------------------------------------------------------


def test_every_figure_is_a_vector_twice_and_an_image_once(tmp_path: Path) -> None:
    tables = campaign(["medium"], 2)
    figures = draw_figures(tables, films(tables), tmp_path / "new" / "figures")
    assert [f.name for f in figures] == NAMES
    assert sorted(p.name for p in (tmp_path / "new" / "figures").iterdir()) == sorted(
        f"{name}.{suffix}"
        for name in NAMES
        for suffix in FORMATS  # and nothing unfinished
    )
    for figure in figures:
        assert [p.name for p in figure.files] == [f"{figure.name}.{suffix}" for suffix in FORMATS]
        assert figure.title
        assert ".csv" in figure.caption
        svg, pdf, png = (p.read_bytes() for p in figure.files)
        assert png[:8] == b"\x89PNG\r\n\x1a\n"
        width, height = struct.unpack(">II", png[16:24])
        assert width == WIDTH * 200
        assert 300 < height < 4000
        root = ElementTree.fromstring(svg)
        assert root.tag.endswith("svg")
        words = " ".join("".join(node.itertext()) for node in root.iter("{http://www.w3.org/2000/svg}text"))
        said = {"inflation": "quasi-static", "effects": "window=15", "terrains": "seed 1"}.get(
            figure.name, "evaluations"
        )
        assert said in words  # text, not outlines
        assert pdf.startswith(b"%PDF")
        assert pdf.rstrip().endswith(b"%%EOF")
        assert b"/Type3" not in pdf  # fonts go along as TrueType
        assert b"/FontFile2" in pdf
        assert b"CreationDate" not in pdf


def test_the_same_rows_give_the_same_bytes(tmp_path: Path) -> None:
    tables = Tables(effects=campaign().effects)
    first, second = (draw_figures(tables, {}, tmp_path / name)[0].files for name in "ab")
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]


def test_no_display_no_pyplot_and_the_settings_stay(tmp_path: Path) -> None:
    code = """
import struct, sys
from pathlib import Path
from turgor.experiments import figures
from turgor.experiments.rows import Inflated, Tables
assert "matplotlib" not in sys.modules
import matplotlib
mine = {"font.size": 31.0, "savefig.bbox": "tight", "pdf.fonttype": 3}
matplotlib.rcParams.update(mine)
backend = matplotlib.rcParams._get("backend")
row = Inflated(body="small", gas="author", time=1.0, pressure_ratio=1.0, area_ratio=1.0, height=9.0)
figure, = figures.draw_figures(Tables(inflation=[row]), {}, Path(sys.argv[1]))
assert struct.unpack(">I", figure.files[2].read_bytes()[16:20])[0] == 1400
assert "matplotlib.pyplot" not in sys.modules
assert matplotlib.rcParams._get("backend") == backend
assert mine == {name: matplotlib.rcParams[name] for name in mine}
"""
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment["MPLBACKEND"] = "tkagg"
    command = [sys.executable, "-W", "error", "-c", code, str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("sizes", "seeds"), [(BODIES, 12), (("large",), 1)])
def test_nothing_hangs_over_the_edge(sizes: Sequence[str], seeds: int) -> None:
    tables = campaign(sizes, seeds)
    for name, drawing in made(tables, films(tables)).items():
        drawing.figure.draw_without_rendering()
        box = drawing.figure.get_tightbbox()
        width, height = drawing.figure.get_size_inches()
        assert width == WIDTH
        assert box.x0 > -0.02, name
        assert box.y0 > -0.02, name
        assert box.x1 < width + 0.02, name
        assert box.y1 < height + 0.02, name
        for axes in drawing.figure.axes:
            if axes.get_legend() is not None:
                legend = axes.get_legend().get_window_extent()
                assert legend.x1 <= drawing.figure.bbox.x1 + 1, name
                assert legend.x0 >= -1, name


# --- what is drawn ------------------------------------------------------------------------------------------------


def test_inflation_shows_its_rows() -> None:
    tables = campaign()
    upper, lower, balance = made(tables)["inflation"].figure.axes
    author = [row for row in tables.inflation if (row.body, row.gas) == ("medium", "author")]
    (ratio,), (pressure,) = lines(upper, "medium"), lines(lower, "medium")
    assert ratio.get_xydata().tolist() == [[row.time, row.area_ratio] for row in author]
    assert pressure.get_xydata().tolist() == [[row.time, row.pressure_ratio] for row in author]
    assert len(lines(upper, "_small, text")) == 1
    slow = [row for row in tables.quasistatic if row.body == "small"]
    (line,), (analytic,), (mark,) = (lines(balance, name) for name in ("small", "_small, analytic", "_small, p_max"))
    np.testing.assert_allclose(line.get_xydata(), [[row.pressure / 1000, row.area_ratio] for row in slow])
    assert np.isnan(analytic.get_ydata()).sum() == 10  # None where there is no finite radius
    np.testing.assert_allclose(mark.get_xydata(), [[30.5, 30.5 / 60]])
    assert "lift-off 25 kPa" in texts(made(tables)["inflation"])


def test_inflation_draws_either_half() -> None:
    tables = campaign(["small"])
    assert len(made(Tables(inflation=tables.inflation))["inflation"].figure.axes) == 2
    assert len(made(Tables(quasistatic=tables.quasistatic))["inflation"].figure.axes) == 1


@pytest.mark.parametrize("task", ["hilly", "escape"])
def test_courses_show_their_rows(task: str) -> None:
    tables = campaign()
    drawing = made(tables)[task]
    axes = drawing.figure.axes
    for column, body in enumerate(("small", "medium")):
        curves, boxes = axes[column], axes[2 + column]
        for condition in ("pressure", "springs"):
            points = [
                p for p in tables.curves if (p.task, p.body, p.condition, p.change) == (task, body, condition, "")
            ]
            (line,) = lines(curves, condition)
            np.testing.assert_allclose(line.get_xydata(), [[p.evaluations / 1000, p.median] for p in points])
        (still,) = lines(curves, "passive")
        assert still.get_ydata()[0] == np.median([c.best for c in rows_of(tables, task, body, "passive")])
        for condition in ("pressure", "springs", "passive"):
            for measure in ("best", "robust"):
                (dots,) = lines(boxes, f"{measure}, {condition}")
                values = [getattr(c, measure) for c in rows_of(tables, task, body, condition)]
                np.testing.assert_allclose(dots.get_ydata(), values)
        assert len(boxes.patches) == (6 if task == "hilly" else 4)  # no box around one value
        assert len(lines(boxes, "_seed")) == 6  # two groups of three seeds
    assert "p = 0.012, A = 0.76" in texts(drawing)
    assert "n = 3" in drawing.caption


def test_brackets_join_what_they_compare() -> None:
    tables = campaign(["small"])
    boxes = made(tables)["hilly"].figure.axes[1]
    place = {c: float(np.mean(lines(boxes, f"robust, {c}")[0].get_xdata())) for c in ("pressure", "springs", "passive")}
    ends = [sorted({float(x) for x in line.get_xdata()}) for line in lines(boxes, "_test")]
    expected = [(place[c.b], place[c.a]) for c in reversed(tables.comparisons) if c.question == "rq1"]
    np.testing.assert_allclose(ends, expected)
    highest = max(c.best for c in tables.champions if c.task == "hilly")
    lowest = min(float(line.get_ydata().min()) for line in lines(boxes, "_test"))
    low, high = boxes.get_ylim()
    assert (highest - low) / (high - low) < lowest  # the brackets stand above the points


def test_a_comparison_the_other_way_round_says_the_same() -> None:
    tables = msgspec.structs.replace(campaign(["small"]), comparisons=[comparison("small", "pressure", "springs")])
    assert "p = 0.012, A = 0.24" in texts(made(tables)["hilly"])


def test_tiny_p_is_not_printed_in_full() -> None:
    tables = msgspec.structs.replace(
        campaign(["small"]), comparisons=[comparison("small", "springs", "pressure", p=1e-7)]
    )
    assert "p < 0.001, A = 0.76" in texts(made(tables)["hilly"])


def test_escape_counts_starts() -> None:
    tables = campaign()
    axes = made(tables)["escape"].figure.axes
    for column, body in enumerate(("small", "medium")):
        counts, times = axes[4 + column], axes[6 + column]
        for condition in ("pressure", "springs", "passive"):
            for c in rows_of(tables, "escape", body, condition):
                bars = [bar for bar in counts.containers if bar.get_label() == c.run]
                heights = [bar.patches[0].get_height() for bar in bars]
                assert heights == [c.solved_starts, -c.tangled_starts][: 1 + bool(c.tangled_starts)]
                assert len(lines(counts, c.run)) == bool(c.solved)
                medians = [line.get_ydata().tolist() for line in lines(times, c.run)]
                assert medians == ([[20.5, 20.5]] if c.escape_time else [])
        shown = sorted(y for line in times.get_lines() if line.get_marker() == "o" for y in line.get_ydata())
        runs = {c.run for c in rows_of(tables, "escape", body, "pressure")}
        assert shown == sorted(s.time for s in tables.starts if s.run in runs and s.solved)


def test_effects_show_their_rows() -> None:
    tables = campaign()
    drawing = made(tables)["effects"]
    hilly, escape = drawing.figure.axes
    (diamond,) = lines(hilly, "window=15")
    assert diamond.get_xdata().tolist() == [0.5]
    assert [line.get_xdata().tolist() for line in lines(escape, "_interval")] == [[-0.25, 1.25]] * 2
    without = {c.seed: c.robust for c in rows_of(tables, "hilly", "medium", "pressure")}
    (dots,) = lines(hilly, "seeds, window=15")
    np.testing.assert_allclose(dots.get_xdata(), [1.5 - without[seed] for seed in range(3)])
    assert texts(drawing).count("1.50 / 1.00") == 3
    assert texts(drawing).count("25 / 25 %") == 2
    assert lines(escape, "escape-authors")[0].get_ydata()[0] < lines(escape, "window=15")[0].get_ydata()[0]


def test_terrains_show_ground_path_and_outlines() -> None:
    tables = campaign(["small"], 2)
    recordings = films(tables)
    drawing = made(tables, recordings)["terrains"]
    strip = drawing.figure.axes[0]
    shown = recordings["hilly-small-pressure-s0"]
    (path,) = lines(strip, "path")
    np.testing.assert_allclose(path.get_xydata(), shown.com[::6])
    for moment in (0, 10, 20, 30):
        (outline,) = lines(strip, f"{moment} s")
        position = shown.position[moment * 20]
        np.testing.assert_allclose(outline.get_xydata(), [*position, position[0]])
    (ground,) = lines(strip, "ground")
    x, y = ground.get_xydata()[3]
    assert ((shown.scene.segments[:, :2] == (x, y)).all(axis=1)).any()
    # heights are not exaggerated
    box = strip.get_position()
    width, height = drawing.figure.get_size_inches()
    across = np.ptp(strip.get_xlim()) / (box.width * width)
    assert np.ptp(strip.get_ylim()) / (box.height * height) == pytest.approx(across)
    pressure, springs = (rows_of(tables, "hilly", "small", c)[0].robust for c in ("pressure", "springs"))
    assert f"pressure {pressure:.2f}, springs {springs:.2f}" in texts(drawing)


def test_slow_champions_are_enlarged_and_trapping_terrains_named() -> None:
    cast = {("pressure", 0): 5.0, ("pressure", 1): 1.0, ("springs", 1): 4.0, ("pressure", 2): 1.0, ("springs", 2): 1.5}
    champions = [champion("hilly", "medium", condition, seed, v) for (condition, seed), v in cast.items()]
    champions.append(champion("hilly", "medium", "passive", 2, 3.0))  # rolls: no merit of an agent
    assert find_trapping(champions) == [("medium", 2)]
    tables = Tables(champions=champions)
    drawing = made(tables, {c.run: film("medium", speed=c.robust) for c in champions})["terrains"]
    words = texts(drawing)
    assert words.count("trapped") == 1
    assert [word.split(" m/s")[0] for word in words if "in a hollow" in word] == [
        "medium, seed 1, pressure: 1.00",
        "medium, seed 2, pressure: 1.00",
        "medium, seed 2, springs: 1.50",
    ]
    assert f"below {SLOW:g} m/s" in drawing.caption


def test_a_missing_recording_is_said() -> None:
    tables = campaign(["small"], 2)
    recordings = films(tables)
    del recordings["hilly-small-pressure-s1"]
    assert texts(made(tables, recordings)["terrains"]).count("no recording") == 1


# --- hollows ------------------------------------------------------------------------------------------------------


def valley(*corners: tuple[float, float]) -> Scene:
    return polyline(np.array([(-20.0, 0.0), *corners, (400.0, 0.0)]))


def test_a_hollow_is_measured() -> None:
    # the body goes from the crest at x = 5 into a valley, and stays there at x = 30, before a crest of 5 m at x = 50
    stay = film("medium", valley((5, 4), (20, 0), (30, 0), (50, 5), (51, 3)), speed=6.0, stop=30.0)
    before, hollow = find_hollows(stay)
    assert before.right == pytest.approx(5, abs=0.2)
    assert (hollow.left, hollow.right) == pytest.approx((5, 50), abs=0.2)
    assert 20 <= hollow.bottom <= 30.1
    assert hollow.floor == pytest.approx(0, abs=0.05)
    assert hollow.depth == pytest.approx(5, abs=0.05)
    assert hollow.slope == pytest.approx(np.degrees(np.arctan(5 / 20)), abs=0.1)
    assert before.seconds == pytest.approx(5 / 6, abs=0.1)
    assert before.seconds + hollow.seconds == pytest.approx(30)
    assert hollow.area_ratio == pytest.approx(stay.area_ratio[0, 0], abs=1e-4)


def test_a_body_rolls_over_a_gap_that_is_too_narrow_for_it() -> None:
    gap = valley((5, 4), (30, 0), (31, -3), (32, 0), (60, 5), (61, 3))
    ends = [(hollow.left, hollow.right) for hollow in find_hollows(film("medium", gap, speed=1.0))]
    np.testing.assert_allclose(ends[1], (5, 60), atol=0.2)  # no hollow of its own


def test_no_hollows_without_ground_and_one_on_a_plane() -> None:
    assert find_hollows(film("medium", Scene([]))) == []
    (plane,) = find_hollows(film("medium", flat()))
    assert plane.depth == plane.slope == 0


# --- what may be missing ------------------------------------------------------------------------------------------


def test_empty_tables_give_no_figure(tmp_path: Path) -> None:
    assert draw_figures(Tables(), {}, tmp_path / "figures") == []


@pytest.mark.parametrize(
    ("kept", "names"),
    [
        (("champions",), ["hilly", "escape", "terrains"]),
        (("champions", "comparisons"), ["hilly", "escape", "terrains"]),
        (("curves", "comparisons", "starts"), []),
        (("effects",), ["effects"]),
        (("inflation",), ["inflation"]),
    ],
)
def test_what_has_no_rows_is_left_out(kept: Sequence[str], names: Sequence[str]) -> None:
    tables = campaign(["small"], 1)
    some = Tables(**{name: getattr(tables, name) for name in kept})
    found = made(some, films(tables))
    assert list(found) == list(names)
    for drawing in found.values():
        drawing.figure.draw_without_rendering()


@pytest.mark.parametrize("condition", ["pressure", "springs", "passive"])
def test_a_single_champion_will_do(condition: str) -> None:
    tables = Tables(
        champions=[champion("hilly", "large", condition, 7, 2.5), champion("escape", "large", condition, 7, 0.0)]
    )
    found = made(tables, {"hilly-large-pressure-s7": film("large")})
    assert list(found) == ["hilly", "escape", *(["terrains"] if condition == "pressure" else [])]
    for drawing in found.values():
        drawing.figure.draw_without_rendering()
        assert "n = 1" in drawing.caption or drawing.name == "terrains"


def test_side_studies_stay_out_of_the_questions() -> None:
    tables = Tables(champions=[champion("hilly", "medium", "pressure", 0, 2.5, "window=15")])
    assert made(tables, {}) == {}
