"""`turgor view` as a visitor meets it: the server, its policy, the player and the playground in one browser."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from browser import until, watched_page

from turgor.evolution.loop import evolve
from turgor.task import make_task

# a number that changes with any pixel of the canvas
PIXELS = """() => { const c = document.querySelector("canvas"), g = c.getContext("2d");
    const pixels = new Uint32Array(g.getImageData(0, 0, c.width, c.height).data.buffer);
    return pixels.reduce((a, b) => (31 * a + b) | 0, 7) }"""


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Of a server of two runs."""
    folder = tmp_path_factory.mktemp("together")
    for name, seed in (("a", 0), ("b", 1)):
        recipe = {"name": "hilly", "body": "small", "condition": "pressure", "seed": seed}
        evolve(make_task("hilly", seed=seed, steps=300), 42, seed, folder / name, robust_repeats=3, recipe=recipe)
    command = [sys.executable, "-m", "turgor", "view", str(folder), "--no-browser", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        yield server.stdout.readline().split()[-1]
        server.send_signal(signal.SIGINT)
        assert server.wait(20) == 0


@pytest.mark.parametrize("width", [1200, 360])
def test_a_champion_plays(browser: Any, address: str, width: int) -> None:
    with watched_page(browser, viewport={"width": width, "height": 800}) as page:
        page.goto(f"{address}#/run/a")
        page.wait_for_selector("canvas")
        first = page.evaluate(PIXELS)
        page.get_by_role("button", name="Play", exact=True).click()
        page.wait_for_timeout(400)
        page.get_by_role("button", name="Pause", exact=True).click()
        assert page.evaluate(PIXELS) != first
        time = page.get_by_label("Time", exact=True)
        time.fill(time.get_attribute("min") or "0")
        page.wait_for_timeout(200)
        page.keyboard.press("End")
        page.wait_for_timeout(200)
        assert float(time.input_value()) == float(time.get_attribute("max"))
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_two_champions_side_by_side(browser: Any, address: str) -> None:
    with watched_page(browser, viewport={"width": 1200, "height": 800}) as page:
        page.goto(f"{address}#/compare/a/b")
        page.wait_for_selector("canvas")
        side = page.evaluate(PIXELS)
        page.get_by_role("button", name="Ghosts").click()
        page.wait_for_timeout(300)
        assert page.evaluate(PIXELS) != side


def test_the_playground_lets_the_gas_go(browser: Any, address: str) -> None:
    with watched_page(browser, viewport={"width": 1200, "height": 800}) as page:
        page.goto(f"{address}#/play")
        page.wait_for_selector("[data-play=read-area]")
        area = '+document.querySelector("[data-play=read-area]").innerText.replace("−", "-")'
        until(page, f"{area} > 0.7")
        page.get_by_label("Pressure", exact=True).fill("0")
        until(page, f"{area} < 0.6")
        page.goto(f"{address}#/")
        page.wait_for_selector("tbody tr")
