"""The player in a real browser, on pages opened from the disk."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import until, watched_page

from turgor.cli import main
from turgor.evolution.loop import evolve
from turgor.simulate import Simulator
from turgor.task import make_task
from turgor.web.export import export_gallery, export_replays
from turgor.web.replay import read_replay, replay_of_recording, replay_of_run

DARK = {"color_scheme": "dark"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two runs, hilly and escape, their replays and pages."""
    folder = tmp_path_factory.mktemp("player")
    for name, body in (("hilly", "large"), ("escape", "small")):
        recipe = {"name": name, "body": body, "condition": "pressure", "seed": 0}
        task = make_task(name, body=body, steps=600)
        evolve(task, 200, out=folder / "runs" / name, robust_repeats=3, recipe=recipe)
        (folder / f"{name}.tgr").write_bytes(replay_of_run(folder / "runs" / name))
    runs = [str(folder / "runs" / name) for name in ("hilly", "escape")]
    assert main(["export", runs[0], "--out", str(folder / "one.html")]) == 0
    assert main(["export", *runs, "--out", str(folder / "two.html")]) == 0
    assert main(["export", "--gallery", str(folder / "runs"), "--out", str(folder / "gallery.html")]) == 0
    return folder


def opened(page: Any, path: Path) -> None:
    page.goto(path.as_uri())
    until(page, "globalThis.player?.stats.firstFrame")


def of_player(page: Any, what: str) -> Any:
    return page.evaluate(f"player.{what}")


def picture(page: Any, canvas: str = ".player-canvas") -> str:
    """A hash of what the canvas shows after the next frame."""
    script = """(selector) => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(
        () => done(document.querySelector(selector).toDataURL()))))"""
    return hashlib.sha256(page.evaluate(script, canvas).encode()).hexdigest()


def test_numbers_in_the_browser_are_those_of_python(browser: Any, folder: Path) -> None:
    back = [read_replay((folder / f"{name}.tgr").read_bytes()) for name in ("hilly", "escape")]
    with watched_page(browser) as page:
        opened(page, folder / "two.html")
        for k, replay in enumerate(back):
            told = page.evaluate(
                """(k) => { const r = player.replays[k]; return {
                    steps: r.steps, dt: r.dt, position: [...r.position], rest: [...r.rest], pressure: [...r.pressure],
                    touch: [...r.touch], com: [...r.com], area: [...r.areaRatio], speed: [...r.speed],
                    strain: r.header.springs.map((_, j) => r.strain(r.steps, j)) } }""",
                k,
            )
            header = replay.header
            assert (told["steps"], told["dt"]) == (header.steps, header.dt)
            np.testing.assert_allclose(told["position"], replay.position.ravel(), rtol=1e-7, atol=1e-9)
            np.testing.assert_allclose(told["rest"], replay.rest_length.ravel(), rtol=1e-6)
            np.testing.assert_allclose(told["pressure"], replay.pressure.ravel(), rtol=1e-7)
            np.testing.assert_array_equal(told["touch"], replay.touch.ravel())
            com = np.average(replay.position, axis=1, weights=header.mass)
            np.testing.assert_allclose(told["com"], com.ravel(), rtol=1e-6, atol=1e-6)
            second = round(1 / header.dt)
            mean = (com[second:, 0] - com[:-second, 0]) / (second * header.dt)
            np.testing.assert_allclose(told["speed"][second:], mean, rtol=1e-5, atol=1e-5)
            ends = replay.position[-1][np.array(header.springs)]
            strain = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / header.rest
            np.testing.assert_allclose(told["strain"], strain, rtol=1e-5)
            task = make_task("hilly" if k == 0 else "escape", body=header.body)
            area = task.body.area(replay.position)[:, 0] / task.area_reference[0]
            np.testing.assert_allclose(told["area"], area, rtol=1e-4)


def test_the_picture_moves_and_stands(browser: Any, folder: Path) -> None:
    with watched_page(browser) as page:
        opened(page, folder / "one.html")
        until(page, "player.stats.frames > 5 && player.time > 0.1")
        first = picture(page)
        until(page, f"player.time > {of_player(page, 'time') + 0.1}")
        assert picture(page) != first
        page.get_by_role("button", name="Pause", exact=True).click()
        assert picture(page) == picture(page)
        assert of_player(page, "step * player.dt") == pytest.approx(of_player(page, "time"))
        assert of_player(page, "stats.firstFrame") < 5000
        assert of_player(page, "stats.fps") > 5  # of a busy machine


def test_scrubbing_with_slider_and_charts(browser: Any, folder: Path) -> None:
    with watched_page(browser, viewport={"width": 1200, "height": 1300}) as page:
        opened(page, folder / "one.html")
        of_player(page, "pause()")
        slider = page.get_by_role("slider", name="Time")
        slider.fill("300")
        assert of_player(page, "time") == pytest.approx(5)
        picture(page)
        assert slider.get_attribute("aria-valuetext") == "5.0 of 10.0 seconds"
        at_five = picture(page)
        slider.fill("301")
        assert picture(page) != at_five
        slider.fill("300")
        assert picture(page) == at_five
        before = picture(page, ".player-playhead")
        box = page.locator(".player-charts").bounding_box()
        page.mouse.click(box["x"] + box["width"] * 0.75, box["y"] + 60)
        assert of_player(page, "time") == pytest.approx(7.5, abs=0.3)
        assert picture(page, ".player-playhead") != before
        page.mouse.down()
        page.mouse.move(box["x"] + box["width"] * 0.25, box["y"] + 60)
        page.mouse.up()
        assert of_player(page, "time") == pytest.approx(2.3, abs=0.4)


def test_every_key_does_what_the_list_says(browser: Any, folder: Path) -> None:
    with watched_page(browser, reduced_motion="reduce") as page:
        opened(page, folder / "two.html")
        press = page.keyboard.press
        assert not of_player(page, "playing")  # motion is not wanted
        press("Space")
        assert of_player(page, "playing")
        press("Space")
        assert not of_player(page, "playing")
        press("Home")
        assert of_player(page, "step") == 0
        for key, step in (("ArrowRight", 1), ("Shift+ArrowRight", 11), ("ArrowLeft", 10), ("Shift+ArrowLeft", 0)):
            press(key)
            assert of_player(page, "step") == step
        press("End")
        assert of_player(page, "step") == 600
        press("ArrowRight")
        assert of_player(page, "step") == 600
        for key, speed in ((">", 2), (">", 4), (">", 8), (">", 8), ("<", 4)):
            press(key)
            assert of_player(page, "speed") == speed
        assert page.get_by_label("Speed").input_value() == "4"
        for _ in range(8):
            press("<")
        assert of_player(page, "speed") == 1 / 8
        press("+")
        assert of_player(page, "zoom") == pytest.approx(1.25)
        press("f")
        assert not of_player(page, "follow")
        press("0")
        assert of_player(page, "follow")
        assert of_player(page, "zoom") == 1
        press("g")
        assert of_player(page, "mode") == "ghost"
        press("c")
        assert not page.locator(".player-charts").is_visible()
        press("?")
        assert page.get_by_role("dialog", name="Keyboard shortcuts").is_visible()
        assert page.locator("kbd").count() == page.evaluate("document.querySelectorAll('kbd').length") >= 10
        press("Escape")
        assert not page.get_by_role("dialog").is_visible()
        # a key pressed on the slider is the player's, one with Ctrl the browser's
        page.get_by_role("slider").focus()
        press("Home")
        press("Shift+ArrowRight")
        assert of_player(page, "step") == 10
        press("Control+c")
        assert not page.locator(".player-charts").is_visible()


def test_camera_follows_or_stands_free(browser: Any, folder: Path) -> None:
    with watched_page(browser, reduced_motion="reduce") as page:
        opened(page, folder / "one.html")
        of_player(page, "seek(4)")
        start = picture(page)
        box = page.locator(".player-canvas").bounding_box()
        x, y = box["x"] + 300, box["y"] + 200
        page.mouse.move(x, y)
        page.mouse.wheel(0, -240)
        until(page, "player.zoom > 1.2")
        page.get_by_role("button", name="Follow").click()
        at = "player.views[0].camera.left + 300 / player.views[0].camera.scale"
        under = page.evaluate(at)
        page.mouse.move(x, y)
        page.mouse.wheel(0, 240)
        until(page, "player.zoom < 1.1")
        picture(page)
        assert page.evaluate(at) == pytest.approx(under, abs=0.02)  # what is under the mouse stays
        page.mouse.down()
        page.mouse.move(x + 100, y, steps=3)
        page.mouse.up()
        picture(page)
        scale = of_player(page, "views[0].camera.scale")
        assert page.evaluate(at) == pytest.approx(under - 100 / scale, abs=0.02)
        stands = of_player(page, "views[0].camera.x")
        of_player(page, "seek(8)")
        picture(page)
        assert of_player(page, "views[0].camera.x") == stands
        page.keyboard.press("0")
        of_player(page, "seek(4)")
        assert picture(page) == start


def test_two_side_by_side_and_as_ghosts(browser: Any, folder: Path) -> None:
    with watched_page(browser, viewport={"width": 1100, "height": 900}, reduced_motion="reduce") as page:
        opened(page, folder / "two.html")
        of_player(page, "seek(5)")
        assert page.evaluate("player.views.map((v) => [v.left > 0, v.shown])") == [[False, [0]], [True, [1]]]
        side = picture(page)
        page.get_by_role("button", name="Ghosts").click()
        assert page.evaluate("player.views.map((v) => v.shown)") == [[0, 1]]
        assert picture(page) != side
        page.set_viewport_size({"width": 360, "height": 740})
        page.keyboard.press("g")
        until(page, "player.views.length === 2 && player.views[1].top > 0")


def test_ghosts_stay_in_sight(browser: Any, folder: Path, tmp_path: Path) -> None:
    task = make_task("flat", steps=60)
    recording = Simulator(task, threads=1).record(np.zeros(task.parameter_count))
    import msgspec

    position = np.array(recording.position)
    for ahead, seen in ((20, True), (-20, True), (300, False)):
        away = msgspec.structs.replace(recording, position=position + np.array([ahead, 0], dtype=np.float32))
        page_file = tmp_path / "ghosts.html"
        page_file.write_text(export_replays([replay_of_recording(r, task) for r in (recording, away)]))
        with watched_page(browser, reduced_motion="reduce") as page:
            opened(page, page_file)
            of_player(page, 'setMode("ghost")')
            picture(page)
            place = "player.views[0].camera.px(player.replays[%d].com[0]) / player.views[0].width"
            first, second = page.evaluate(f"[{place % 0}, {place % 1}]")
            assert 0.05 < first < 0.95
            assert (0.02 < second < 0.98) == seen


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_at_360_px_nothing_sticks_out_and_all_has_a_name(browser: Any, folder: Path, scheme: str) -> None:
    with watched_page(browser, viewport={"width": 360, "height": 740}, color_scheme=scheme) as page:
        for name in ("one", "two"):
            opened(page, folder / f"{name}.html")
            assert page.evaluate("document.documentElement.scrollWidth") <= 360
            unnamed = """[...document.querySelectorAll("button, input, select, canvas:not([aria-hidden]), dialog")]
                .filter((e) => !e.getAttribute("aria-label") && !e.textContent.trim()).length"""
            assert page.evaluate(unnamed) == 0
        back = page.evaluate("getComputedStyle(document.body).backgroundColor")
        page.get_by_role("button", name="Dark or light").click()
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") != back


def test_destroyed_player_leaves_nothing_behind(browser: Any, folder: Path) -> None:
    with watched_page(browser) as page:
        opened(page, folder / "one.html")
        of_player(page, "destroy()")
        frames = of_player(page, "stats.frames")
        page.keyboard.press("End")
        page.wait_for_timeout(100)
        assert of_player(page, "stats.frames") == frames
        assert page.locator("#place").inner_html() == ""


def test_gallery_moves_what_is_in_sight_and_opens_large(browser: Any, folder: Path) -> None:
    with watched_page(browser, viewport={"width": 700, "height": 500}) as page:
        page.goto((folder / "gallery.html").as_uri())
        cards = page.locator(".gallery-card")
        assert cards.count() == 2
        small = ".gallery-card canvas"
        until(page, f"document.querySelector('{small}').width !== 300")
        first = picture(page, small)
        page.wait_for_timeout(150)
        assert picture(page, small) != first
        cards.nth(1).click()
        until(page, "globalThis.player?.stats.frames > 3")
        assert page.get_by_role("dialog").is_visible()
        assert of_player(page, "steps") == 300  # 10 s at 30 steps/s
        page.keyboard.press("Space")
        assert page.get_by_role("dialog").is_visible()
        page.keyboard.press("Escape")
        assert not page.get_by_role("dialog").is_visible()
        until(page, "!document.querySelector('.player')")


def test_a_gallery_of_many_reads_only_what_is_in_sight(browser: Any, folder: Path, tmp_path: Path) -> None:
    data = (folder / "hilly.tgr").read_bytes()
    (tmp_path / "many.html").write_text(export_gallery([data] * 60))
    with watched_page(browser, viewport={"width": 700, "height": 500}, **DARK) as page:
        page.goto((tmp_path / "many.html").as_uri())
        until(page, "document.querySelector('.gallery-card canvas').width !== 300")
        drawn = "[...document.querySelectorAll('.gallery-card canvas')].map((c) => c.width !== 300)"
        page.wait_for_timeout(200)
        assert page.evaluate(drawn)[0]
        assert not page.evaluate(drawn)[59]
        page.locator(".gallery-card").nth(59).scroll_into_view_if_needed()
        until(page, f"{drawn}[59]")


def test_a_broken_file_tells_so(browser: Any, folder: Path, tmp_path: Path) -> None:
    text = (folder / "one.html").read_text()
    broken = tmp_path / "broken.html"
    broken.write_text(text.replace('id="replay-0">VEdSM', 'id="replay-0">WEdSM'))
    with watched_page(browser) as page:
        page.goto(broken.as_uri())
        page.get_by_text("This replay cannot be shown: replay: expected a file that begins with TGR1").wait_for()


def test_names_are_text(browser: Any, tmp_path: Path) -> None:
    task = make_task("flat", steps=5)
    recording = Simulator(task, threads=1).record(np.zeros(task.parameter_count))
    hostile = "<img src=x onerror=\"document.title='taken'\">"
    path = tmp_path / "hostile.html"
    path.write_text(export_replays([replay_of_recording(recording, task, title=hostile)]))
    with watched_page(browser) as page:
        opened(page, path)
        assert page.title() == hostile
        assert page.locator("img").count() == 0
        assert json.loads(page.evaluate("JSON.stringify(player.replays[0].header)"))["title"] == hostile
