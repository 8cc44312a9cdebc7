"""The viewer's page in a real browser: what it shows, follows and asks for. Skipped where there is no chromium."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from sealing import seal

from turgor.evolution.loop import evolve
from turgor.task import make_task
from turgor.variants import Robust

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SCRIPT = "<img src=x onerror=window.hurt=1>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign of four runs, one more run with scripts in its words, and a broken one."""
    out = tmp_path_factory.mktemp("pages") / "runs"
    for task, seed in (("escape", 0), ("escape", 1), ("hilly", 0), ("hilly", 1)):
        recipe = {"name": task, "body": "small", "seed": seed}
        path = out / "paper" / f"{task}-small-pressure-s{seed}"
        evolve(make_task(task, seed=seed, steps=20), 63, seed, path, robust_repeats=3, recipe=recipe)
    (out / "paper" / "campaign.json").write_text('{"format": 1}')
    name = 'a "b" & #%2f'
    recipe = {"name": "flat", "body": "medium", "seed": 7, "window": SCRIPT}
    evolve(make_task("flat", body="medium", steps=20), 46, 7, out / name, robust_repeats=2, recipe=recipe)
    record = json.loads((out / name / "run.json").read_text())
    (out / name / "run.json").write_text(json.dumps(record | {"note": SCRIPT}))
    seal(out / name)
    (out / "broken").mkdir()
    (out / "broken" / "run.json").write_text('{"format": 1, ')
    return out


@pytest.fixture(scope="module")
def serve() -> Iterator[Callable[..., str]]:
    """Starts `turgor view` and returns the address that it prints."""
    started: list[subprocess.Popen[str]] = []

    def start(*argv: str) -> str:
        command = [sys.executable, "-m", "turgor", "view", *argv, "--no-browser", "--port", "0"]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        assert started[-1].stdout is not None
        return started[-1].stdout.readline().split()[-1]

    yield start
    for process in started:
        with process:
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0


@pytest.fixture(scope="module")
def address(folder: Path, serve: Callable[..., str]) -> str:
    return serve(str(folder))


@pytest.fixture
def open_page(browser: Browser, address: str) -> Iterator[Callable[..., Page]]:
    """Opens a page, which must neither complain nor ask another host."""
    pages, wrong = [], []

    def note(message: Any) -> None:
        if message.type in ("error", "warning"):
            wrong.append(f"{message.text} {message.location.get('url')}")

    def start(route: str = "#/", **options: Any) -> Page:
        options = {"viewport": {"width": 1200, "height": 800}, **options}
        page = browser.new_page(**options)
        page.set_default_timeout(10_000)
        page.on("console", note)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda r: r.url.startswith((address, "data:", "blob:")) or wrong.append(f"asked {r.url}"))
        page.goto(address + route)
        pages.append(page)
        return page

    start.wrong = wrong  # ty: ignore[unresolved-attribute]
    yield start
    for page in pages:
        assert page.evaluate("window.hurt") is None
        page.close()
    assert wrong == []


def forgive(open_page: Any, pattern: str) -> None:
    """Takes back complaints that a test asks for; there must be one."""
    assert any(re.search(pattern, line) for line in open_page.wrong)
    open_page.wrong[:] = [line for line in open_page.wrong if not re.search(pattern, line)]


def texts(page: Page, css: str) -> list[str]:
    return [" ".join(text.split()) for text in page.locator(css).all_inner_texts()]


def until(page: Page, true: Callable[[], bool]) -> None:
    """Waits; the page's policy forbids Playwright's own way, which evaluates strings."""
    for _ in range(100):
        if true():
            return
        page.wait_for_timeout(100)
    raise AssertionError("it never came true")


# --- the list -----------------------------------------------------------------------------------------------------


def test_the_list_filters_and_sorts(open_page: Callable[..., Page]) -> None:
    page = open_page()
    page.wait_for_selector("tbody tr")
    assert texts(page, "h1") == ["runs"]
    assert "5 runs · 1 with a problem" in page.inner_text(".head")
    assert page.locator("tbody tr").count() == 6
    assert texts(page, "tr.problem") == ["problem broken run.json: expected JSON; got Input data was truncated"]
    assert SCRIPT in page.inner_text("tbody")  # as words

    page.get_by_label("Filter runs").fill("HILLY s1")
    assert texts(page, "tbody td.seed") == ["1"]
    page.get_by_label("Filter runs").fill("nothing like it")
    assert page.locator("tbody tr").count() == 0
    assert "Nothing matches" in page.inner_text(".rest")
    page.get_by_label("Filter runs").fill("")
    page.get_by_label("State", exact=True).select_option("problem")
    assert page.locator("tbody tr").count() == 1
    page.get_by_label("State", exact=True).select_option("done")

    head = page.locator("th", has_text="fitness")
    head.get_by_role("button").focus()
    for order, sign in (("descending", -1), ("ascending", 1)):
        page.keyboard.press("Enter")
        assert head.get_attribute("aria-sort") == order
        found = [float(text.replace("−", "-").replace("✓", "")) for text in texts(page, "tbody td.fitness")]
        assert found == sorted(found, key=lambda value: sign * value)
    assert page.locator("th[aria-sort]").count() == 1


def test_a_running_evolution_is_followed(open_page: Callable[..., Page], folder: Path) -> None:
    page = open_page()
    page.wait_for_selector("tbody tr")
    argv = ["--task", "flat", "--steps", "20", "--evaluations", "10000000", "--threads", "1", "--seed", "99"]
    command = [sys.executable, "-m", "turgor", "evolve", *argv, "--out", str(folder / "now")]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as evolution:
        try:
            page.wait_for_selector(".live .card path.best[d*=L]", timeout=60_000)  # compiling takes long, once
            assert page.locator("tbody .badge.running").count() == 1
            before = page.inner_text(".live .card .muted")
            until(page, lambda: page.inner_text(".live .card .muted") != before)
            asked: list[str] = []
            page.on("request", lambda request: asked.append(request.url))
            page.click(".live .card")
            curve = page.locator(".curves path.line.best")
            curve.wait_for()
            drawn, told = curve.get_attribute("d"), page.inner_text(".tiles")
            until(page, lambda: curve.get_attribute("d") != drawn and page.inner_text(".tiles") != told)
            assert page.inner_text(".head .badge") == "running"
            assert sum("/api/run/" in url for url in asked) <= 2  # rows are heard, not asked for
        finally:
            evolution.send_signal(signal.SIGINT)
            evolution.wait(30)
    page.wait_for_selector(".head .badge.interrupted")
    page.wait_for_selector(".stage canvas", timeout=60_000)  # its replay is made from the files
    shutil.rmtree(folder / "now")
    page.goto(page.url.partition("#")[0] + "#/")
    until(page, lambda: page.locator("tbody tr").count() == 6)


# --- a run, a campaign, two runs ----------------------------------------------------------------------------------


def test_a_run_has_numbers_and_curves(open_page: Callable[..., Page]) -> None:
    page = open_page()
    page.locator("tbody a", has_text="flat").click()
    page.wait_for_selector(".curves path.line.best")
    assert "flat · medium · pressure · seed 7" in page.inner_text("h1")
    assert SCRIPT in page.inner_text(".head")
    assert "46" in page.inner_text(".tiles")
    labels = page.locator(".curves text").all_text_contents()
    assert "fitness [m/s]" in labels
    assert "evaluations" in labels
    assert "best fitness" in str(page.locator(".curves svg").get_attribute("aria-label"))
    page.hover(".curves svg")
    assert re.search(r"generation \d\s*best .*\s*median .*\s*σ", page.inner_text(".curves .tip"))
    page.locator(".curves svg").focus()
    for key, generation in (("Home", 1), ("ArrowRight", 2), ("End", 2), ("ArrowLeft", 1)):
        page.keyboard.press(key)
        assert f"generation {generation}" in page.inner_text(".curves .tip")
    assert page.locator(".luck circle.value").count() == 2
    page.get_by_text("Settings").click()
    assert "population" in page.inner_text(".facts")


def test_a_robust_run_says_what_its_fitness_is(browser: Browser, serve: Callable[..., str], tmp_path: Path) -> None:
    for name, robust in (("one", Robust(worlds=3, gas=0.125)), ("two", None)):
        evolve(make_task("flat", steps=20), 42, out=tmp_path / name, robust_repeats=2, robust=robust)
    address, judged = serve(str(tmp_path)), "median of 3 changed worlds"
    page = browser.new_page()
    page.goto(f"{address}#/run/one")
    page.wait_for_selector(".curves path.line.best")
    assert "robust: median of 3 changed worlds" in page.inner_text("h1")
    assert re.search(
        rf"fitness\s+\S+ m/s\s+{judged}, found in generation [12]", page.inner_text(".tiles"), re.IGNORECASE
    )
    assert f"the diamond is what it was chosen for: {judged}." in page.inner_text(".luck")
    assert str(page.locator(".luck path.mark title").text_content()).startswith(f"{judged}: ")
    page.get_by_text("Settings").click()
    assert re.search(r"robust gas\s+0\.125", page.inner_text(".facts"))
    page.goto(f"{address}#/compare/one/two")
    page.wait_for_selector(".luck path.mark")
    marks = page.locator(".luck path.mark title").all_text_contents()
    assert [mark.partition(":")[0] for mark in marks] == [judged, "from its own start"]
    page.close()


def test_a_campaign_is_the_papers_grid(open_page: Callable[..., Page]) -> None:
    page = open_page()
    page.click("a.campaign")
    page.wait_for_selector("table.grid")
    assert texts(page, "table.grid caption h2") == ["hilly", "escape"]
    assert texts(page, "table.grid tbody th") == ["small", "small"]
    assert page.locator("table.grid svg.box rect").count() == 2
    assert page.locator("table.grid circle.value").count() == 4
    page.get_by_role("button", name="Best fitness").click()
    assert page.locator("button[aria-pressed=true]").inner_text() == "Best fitness"
    page.locator("table.grid svg a").last.focus()
    page.keyboard.press("Enter")
    page.wait_for_selector(".tiles b")
    assert "escape · small · pressure · seed" in page.inner_text("h1")


def test_two_runs_side_by_side(open_page: Callable[..., Page]) -> None:
    page = open_page()
    for seed in (0, 1):
        page.get_by_label(f"Compare hilly · small · pressure · seed {seed}").check()
    page.get_by_role("link", name="Compare").click()
    page.wait_for_selector(".curves path.line.best.run1")
    assert "seed 0" in page.inner_text("table.two")
    assert "seed 1" in page.inner_text("table.two")
    page.hover(".curves svg")
    assert page.inner_text(".curves .tip").count("generation") == 2


def test_the_champion_is_played(open_page: Callable[..., Page]) -> None:
    page = open_page("#/run/paper%2Fhilly-small-pressure-s0")
    page.wait_for_selector(".stage canvas", timeout=60_000)
    page = open_page("#/compare/paper%2Fhilly-small-pressure-s0/paper%2Fhilly-small-pressure-s1")
    page.wait_for_selector(".stage canvas", timeout=60_000)


# --- everywhere ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_needs_no_sideways_scrolling(open_page: Callable[..., Page], scheme: str) -> None:
    page = open_page(viewport={"width": 360, "height": 740}, color_scheme=scheme)
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (int(background[4:].split(",")[0]) < 80) == (scheme == "dark")
    a, b = ("paper%2Fhilly-small-pressure-s" + seed for seed in "01")
    for route, shown in (
        ("#/", "tbody tr"),
        (f"#/run/{a}", ".curves path.best"),
        ("#/campaign/paper", "svg.box"),
        (f"#/compare/{a}/{b}", ".curves path.best"),
    ):
        page.evaluate("hash => { location.hash = hash }", route)
        page.wait_for_selector(f".view {shown}")
        assert page.evaluate("document.documentElement.scrollWidth") <= 360, route


def test_dark_or_light_is_remembered(open_page: Callable[..., Page]) -> None:
    page = open_page(color_scheme="light")
    before = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.get_by_label("Dark or light").click()
    after = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert before != after
    page.reload()
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == after


def test_every_control_has_a_name(open_page: Callable[..., Page]) -> None:
    page = open_page()
    page.wait_for_selector("tbody tr")
    controls = page.locator("button, a, input:not([type=hidden]), select").all()
    named = "e => (e.getAttribute('aria-label') || e.labels?.[0]?.innerText || e.innerText || '').trim()"
    assert all(control.evaluate(named) for control in controls)


@pytest.mark.parametrize(
    ("route", "told"),
    [
        ("#/nothing", "There is no such page."),
        ("#/constructor", "There is no such page."),
        ("#/run/%ff", "There is no such page."),
        ("#/run/nowhere", "path: expected one that exists"),
        ("#/run/..%2F..%2Fetc", "not found"),
        ("#/run/broken", "run.json: expected JSON"),
        ("#/campaign/nowhere", "path: expected one that exists"),
        ("#/compare/nowhere/broken", "expected"),
    ],
)
def test_what_is_not_there_is_said(open_page: Callable[..., Page], route: str, told: str) -> None:
    page = open_page(route)
    assert told in page.wait_for_selector(".failure").inner_text()  # ty: ignore[unresolved-attribute]
    if "There is" not in told:
        page.wait_for_timeout(100)
        forgive(open_page, r"status of 4\d\d ")
    page.click(".brand")
    page.wait_for_selector("tbody tr")


def test_the_token_becomes_a_cookie(folder: Path, serve: Callable[..., str], browser: Browser) -> None:
    address = re.sub(r"//[^:]+:", "//127.0.0.1:", serve(str(folder), "--host", "0.0.0.0"))
    page = browser.new_page()
    assert page.goto(address.partition("?")[0]).status == 403  # ty: ignore[unresolved-attribute]
    page.goto(address)
    page.wait_for_selector("tbody tr")
    assert "token" not in page.url
    page.reload()
    page.wait_for_selector("tbody tr")
    (cookie,) = page.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")  # ty: ignore[invalid-key]
    page.close()
