"""The playground: visitors on real sockets, and the page in a real browser."""

import asyncio
import contextlib
import json
import struct
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import uvicorn
import websockets
from browser import until, watched_page
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles

from turgor.web import playground
from turgor.web.playground import Playground
from turgor.web.session import Session, Start

STATIC = Path(playground.__file__).parent / "static"
PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><link rel="icon" href="data:,">
<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="stylesheet" href="static/play.css">
<div id="here"></div><script type="module" nonce="ours">
import {start} from "./static/play.js";
window.playing = start(document.getElementById("here"), "api/play");
</script>"""


MALFORMED = [
    "", "nonsense", "[]", "null", '{"type":"x"}', '{"type":"pause","on":1}', '{"type":"reset","more":1}', "[" * 4000,
    '{"type":"control","pressure":NaN}', '{"type":"control","pressure":1e999}', '{"type":"start","task":"moon"}',
    '{"type":"drag","mass":-1,"x":0,"y":0}', " " * 5000, "\x00", "💥" * 50, b"", b"\xff\x00", b"\x00" * 5000,
]  # fmt: skip


# --- visitors -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def served(ground: Playground) -> Iterator[str]:
    """The playground and a page, served by a thread; yields host and port."""
    app = Starlette(
        routes=[
            Route("/", page),
            WebSocketRoute("/api/play", ground.play),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
    )
    config = uvicorn.Config(
        app, host="127.0.0.1", port=0, log_level="critical", ws="websockets-sansio", ws_per_message_deflate=False,
        timeout_graceful_shutdown=1,
    )  # fmt: skip
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
        assert thread.is_alive()
    try:
        yield f"127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(10)


async def page(request: Request) -> HTMLResponse:
    strict = "default-src 'self'; script-src 'self' 'nonce-ours'; img-src data:"
    return HTMLResponse(PAGE, headers={"Content-Security-Policy": strict})


@pytest.fixture(scope="module")
def ground() -> Playground:
    Session(Start())  # the engine is compiled
    return Playground()


@pytest.fixture(scope="module")
def host(ground: Playground) -> Iterator[str]:
    with served(ground) as place:
        yield place


class Client:
    """A browser without a page."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self.frames: list[tuple[float, bytes]] = []  # when, what
        self.texts: list[dict[str, Any]] = []
        self._seen = 0.0

    async def say(self, kind: str, **fields: Any) -> None:
        await self.socket.send(json.dumps({"type": kind, **fields}))

    async def hear(self) -> None:
        """Takes one message."""
        data = await asyncio.wait_for(self.socket.recv(), 15)
        if isinstance(data, str):
            self.texts.append(json.loads(data))
            return
        self.frames.append((time.monotonic(), data))
        if time.monotonic() - self._seen > 0.2:
            self._seen = time.monotonic()
            await self.say("seen")

    async def hear_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self.hear(), max(end - time.monotonic(), 0.001))

    async def hear_until(self, done: Callable[[], bool]) -> None:
        while not done():
            await self.hear()

    async def live(self, seconds: float) -> None:
        """Takes messages while the agent lives for so long, however slow the machine."""
        end = seconds + (float(self.numbers()[0]) if self.frames else 0.0)
        await self.hear_until(lambda: bool(self.frames) and self.numbers()[0] >= end)

    def numbers(self, k: int = -1) -> np.ndarray:
        data = self.frames[k][1]
        masses = (len(data) - 12) // 9
        return np.frombuffer(data[: 12 + 8 * masses], "<f4")


def visit(host: str, story: Callable[[Client], Awaitable[None]], **options: Any) -> Client:
    async def whole() -> Client:
        async with websockets.connect(f"ws://{host}/api/play", compression=None, **options) as socket:
            client = Client(socket)
            await story(client)
            return client

    return asyncio.run(whole())


def test_a_visitor_sees_the_agent_in_real_time(host: str, ground: Playground) -> None:
    async def story(client: Client) -> None:
        await client.say("start", task="flat", body="medium")
        await client.hear_for(2.0)

    client = visit(host, story)
    assert client.texts[0]["type"] == "scene"
    times = [struct.unpack("<f", frame[:4])[0] for _, frame in client.frames]
    assert times == sorted(times)
    assert 20 < len(times) <= 125
    assert {len(frame) for _, frame in client.frames} == {4 * (3 + 30) + 15}
    real = client.frames[-1][0] - client.frames[0][0]
    assert 0.3 * real < times[-1] < real + 0.15  # a busy machine drops time, and never runs ahead
    assert not [text for text in client.texts if text["type"] == "error"]


def test_pressure_drag_pause_and_reset_over_the_socket(host: str) -> None:
    async def story(client: Client) -> None:
        await client.say("start", task="flat", body="small")
        await client.say("control", pressure=1.0)
        await client.live(1.0)
        full = client.numbers()[2]
        await client.say("control", pressure=0.0, wave={"amplitude": 0, "frequency": 1, "length": 1, "direction": 1})
        await client.live(1.2)
        assert client.numbers()[2] < full - 0.2
        await client.say("drag", mass=2, x=10.0, y=25.0)
        await client.live(1.5)
        assert client.numbers()[3 + 2 * 2 + 1] > 15
        await client.say("drop")
        await client.say("pause", on=True)
        await client.hear_for(0.3)
        shown = len(client.frames)
        await client.hear_for(0.4)
        assert len(client.frames) == shown
        await client.say("reset")
        await client.hear_until(lambda: client.numbers()[0] == 0.0)
        await client.say("pause", on=False)
        await client.hear_until(lambda: client.numbers()[0] > 0.2)
        await client.say("start", task="escape", body="large", seed=4)
        await client.hear_until(lambda: sum(text["type"] == "scene" for text in client.texts) == 2)

    visit(host, story)


def test_a_bad_message_is_answered_and_the_visit_goes_on(host: str) -> None:
    async def story(client: Client) -> None:
        await client.say("reset")
        await client.say("start", task="flat")
        await client.socket.send("nonsense")
        await client.socket.send(b"\x00\x01")
        await client.say("drag", mass=10, x=0, y=0)
        await client.hear_for(0.6)
        errors = [text["message"] for text in client.texts if text["type"] == "error"]
        for error, expected in zip(errors, ("a start first", "JSON is malformed", "JSON text", "0 to 9"), strict=True):
            assert expected in error
        assert client.numbers()[0] > 0.1

    visit(host, story)


def test_a_thousand_malformed_messages_end_one_visit_and_nobody_elses(host: str, ground: Playground) -> None:
    async def story() -> None:
        url = f"ws://{host}/api/play"
        async with websockets.connect(url, compression=None) as good, contextlib.AsyncExitStack() as stack:
            client = Client(good)
            await client.say("start", task="flat")
            await client.hear_for(0.5)
            sent = 0
            while sent < 1000:
                bad = await stack.enter_async_context(websockets.connect(url, compression=None))
                with contextlib.suppress(websockets.ConnectionClosed):
                    for text in MALFORMED * 4:
                        sent += 1
                        await bad.send(text)
                    while True:
                        await asyncio.wait_for(bad.recv(), 5)
                assert (bad.close_code, bad.close_reason) == (1008, "more than 50 bad messages")
            before = len(client.frames)
            await client.hear_for(1.0)
            assert len(client.frames) > before + 30

    asyncio.run(story())
    assert wait_for(lambda: ground.visitors == 0)


def test_too_many_messages_are_too_many(host: str) -> None:
    async def story(client: Client) -> None:
        await client.say("start", task="flat")
        with contextlib.suppress(websockets.ConnectionClosed):
            for _ in range(3000):
                await client.say("control", pressure=0.5)
        with contextlib.suppress(websockets.ConnectionClosed):
            while True:
                client.texts.append(json.loads(data) if isinstance(data := await client.socket.recv(), str) else {})
        assert client.socket.close_code == 1008
        assert any("at most 240 a second" in text.get("message", "") for text in client.texts)

    visit(host, story)


def test_a_visitor_who_stops_reading_is_shown_out(
    host: str, ground: Playground, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(playground, "STALLED", 1.5)

    async def story() -> None:
        url = f"ws://{host}/api/play"
        silent = await websockets.connect(url, compression=None, max_queue=1, ping_interval=None)
        reading = await websockets.connect(url, compression=None)
        client = Client(reading)
        await silent.send('{"type":"start","task":"flat"}')
        await client.say("start", task="flat")
        await client.hear_for(2.5)  # the silent one's socket is not read from
        count = 0
        with contextlib.suppress(websockets.ConnectionClosed):
            while True:
                data = await asyncio.wait_for(silent.recv(), 5)
                count += isinstance(data, bytes)
        assert silent.close_code == 1008
        assert count <= 62  # a second's, and the first
        before = len(client.frames)
        await client.hear_for(0.5)
        assert len(client.frames) > before + 15
        await reading.close()

    asyncio.run(story())
    assert wait_for(lambda: ground.visitors == 0)


def test_a_visitor_who_says_nothing_is_paused(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(playground, "IDLE", 0.5)

    async def story(client: Client) -> None:
        await client.say("start", task="flat")
        await client.hear_until(lambda: "paused" in client.texts[-1].get("message", "") if client.texts else False)
        shown = len(client.frames)
        await client.hear_for(0.4)
        assert len(client.frames) == shown
        await client.say("control", pressure=0.5)
        await client.hear_for(0.3)
        assert len(client.frames) > shown

    visit(host, story)


def test_a_visitor_without_an_agent_makes_room(host: str, ground: Playground, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(playground, "ABSENT", 0.3)

    async def story(client: Client) -> None:
        with pytest.raises(websockets.ConnectionClosed):
            await client.hear()
        assert client.socket.close_code == 1001

    visit(host, story)
    assert wait_for(lambda: ground.visitors == 0)


def test_an_agent_that_left_the_world_starts_again(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Session, "lost", property(lambda session: session.steps > 30))

    async def story(client: Client) -> None:
        await client.say("start", task="flat")
        await client.hear_for(1.3)
        assert client.numbers()[0] < 0.6
        assert any("left the world" in text.get("message", "") for text in client.texts)

    visit(host, story)


def test_a_playground_that_is_full_says_so() -> None:
    async def story(host: str) -> None:
        url = f"ws://{host}/api/play"
        async with websockets.connect(url), websockets.connect(url) as second:
            assert "full: 1 visitors" in json.loads(await second.recv())["message"]
            with pytest.raises(websockets.ConnectionClosed):
                await second.recv()
            assert second.close_code == 1013

    with served(Playground(most=1)) as host:
        asyncio.run(story(host))


def test_two_hundred_visitors_at_once(host: str, ground: Playground) -> None:
    """Each with an agent of their own: every one gets frames, and the server still answers. How fast is for the
    benchmark: here only that nobody starves."""
    visitors = 200

    async def one(k: int, ready: Barrier) -> Client:
        async with websockets.connect(f"ws://{host}/api/play", compression=None, open_timeout=30) as socket:
            client = Client(socket)
            await client.say("start", task="flat", body=["small", "medium", "large"][k % 3])
            await client.say("control", pressure=(k % 10) / 10)
            await client.hear_until(lambda: len(client.frames) > 1)
            await ready.wait()
            client.frames.clear()
            await client.hear_until(lambda: len(client.frames) >= 10)
            return client

    async def all_of_them() -> list[Client]:
        ready = Barrier(visitors)
        return await asyncio.gather(*(one(k, ready) for k in range(visitors)))

    clients = asyncio.run(all_of_them())
    assert min(float(client.numbers()[0] - client.numbers(0)[0]) for client in clients) > 0.5
    assert any("rate" in text and text["rate"] == 10 for text in clients[0].texts)
    assert len({client.frames[-1][1][4:8] for client in clients}) > 10  # pressures of their own
    assert wait_for(lambda: ground.visitors == 0)


class Barrier:
    """asyncio.Barrier in a line: waits until all have come."""

    def __init__(self, count: int) -> None:
        self.missing, self.all_here = count, asyncio.Event()

    async def wait(self) -> None:
        self.missing -= 1
        if self.missing == 0:
            self.all_here.set()
        await self.all_here.wait()


def wait_for(true: Callable[[], bool], seconds: float = 8.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.05)
    return False


# --- the page in a browser ----------------------------------------------------------------------------------------

LATER = "parseFloat(document.querySelector('[data-play=read-time]')?.textContent) > 0.2"


@contextlib.contextmanager
def opened(browser: Any, host: str, **options: Any) -> Iterator[Any]:
    """The page, once its agent moves."""
    with watched_page(browser, **options) as tab:
        tab.set_default_timeout(10_000)
        tab.goto(f"http://{host}/")
        until(tab, LATER)
        yield tab


def reading(tab: Any, name: str) -> float:
    return float(tab.locator(f"[data-play=read-{name}]").inner_text().split()[0].replace("−", "-"))


def test_the_pressure_slider_down_makes_the_area_smaller(browser: Any, host: str) -> None:
    with opened(browser, host, viewport={"width": 1200, "height": 800}) as tab:
        tab.click("[data-value=flat]")
        slider = tab.get_by_label("Pressure", exact=True)
        slider.fill("1")
        tab.wait_for_timeout(900)
        full, pressure = reading(tab, "area"), reading(tab, "pressure")
        slider.fill("0")
        assert wait_for(lambda: reading(tab, "pressure") == pytest.approx(0.2 * pressure, rel=0.02))
        assert wait_for(lambda: reading(tab, "area") < full - 0.15)
        painted = tab.evaluate(
            """() => { const c = document.querySelector("canvas"), g = c.getContext("2d");
            return new Set(new Uint32Array(g.getImageData(0, 0, c.width, c.height).data.buffer)).size }"""
        )
        assert painted > 50


def test_keys_drive_pause_and_reset(browser: Any, host: str) -> None:
    with opened(browser, host, viewport={"width": 1200, "height": 800}) as tab:
        tab.click("[data-value=flat]")
        for _ in range(10):
            tab.keyboard.press("ArrowRight")
        for _ in range(8):
            tab.keyboard.press("ArrowDown")
        assert wait_for(lambda: abs(reading(tab, "distance")) > 0.1)
        assert tab.locator("[data-play=amplitude]").input_value() == "1"
        assert tab.locator("[data-value='-1']").get_attribute("aria-pressed") == "true"
        tab.keyboard.press("Space")
        tab.wait_for_timeout(300)
        held = reading(tab, "time")
        tab.wait_for_timeout(300)
        assert reading(tab, "time") == held
        assert tab.locator("[data-play=pause]").inner_text() == "Resume"
        tab.keyboard.press("Space")
        tab.keyboard.press("r")
        tab.wait_for_timeout(300)
        assert reading(tab, "time") < held
        for _ in range(20):
            tab.keyboard.press("ArrowLeft")
        assert tab.locator("[data-value='1']").get_attribute("aria-pressed") == "true"


def test_the_pointer_drags_the_nearest_mass(browser: Any, host: str) -> None:
    with opened(browser, host, viewport={"width": 1200, "height": 800}) as tab:
        tab.click("[data-value=flat]")
        tab.wait_for_timeout(900)
        before, box = reading(tab, "distance"), tab.locator("canvas").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + 0.6 * box["height"]
        tab.mouse.move(x + 60, y)
        tab.mouse.down()
        tab.mouse.move(x + 330, y - 60, steps=8)
        assert wait_for(lambda: reading(tab, "distance") > before + 3)
        tab.mouse.up()


def test_a_page_on_a_telephone(browser: Any, host: str) -> None:
    with opened(browser, host, viewport={"width": 360, "height": 740}, has_touch=True) as tab:
        assert tab.evaluate("document.documentElement.scrollWidth") <= 360
        unnamed = """() => [...document.querySelectorAll("input, button, canvas")].filter(
            (e) => !(e.getAttribute("aria-label") || e.textContent.trim())).map((e) => e.outerHTML)"""
        unnamed = tab.evaluate(unnamed)
        assert [tag for tag in unnamed if "reconnect" not in tag] == []
        tab.tap("[data-value=large]")
        tab.tap("[data-value=escape]")
        until(tab, "document.querySelector('[data-play=terrain]').disabled")
        tab.wait_for_timeout(600)
        before, box = reading(tab, "distance"), tab.locator("canvas").bounding_box()
        finger = tab.context.new_cdp_session(tab)

        def touch(kind: str, *place: float) -> None:
            points = [{"x": box["x"] + x * box["width"], "y": box["y"] + 0.6 * box["height"]} for x in place]
            finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        touch("touchStart", 0.55)
        for k in range(6):
            touch("touchMove", 0.55 + 0.05 * k)
        assert wait_for(lambda: reading(tab, "distance") > before + 1)
        touch("touchEnd")
        tab.evaluate("playing.stop()")
        assert tab.locator("canvas").count() == 0


def test_a_closed_connection_can_be_opened_again(browser: Any, host: str) -> None:
    script = """const Real = WebSocket; window.sockets = [];
        window.WebSocket = class extends Real { constructor(...a) { super(...a); sockets.push(this); } };"""
    context = browser.new_context(viewport={"width": 800, "height": 700})
    tab = context.new_page()
    tab.add_init_script(script)
    tab.set_default_timeout(10_000)
    tab.goto(f"http://{host}/")
    until(tab, LATER)
    tab.evaluate("sockets.at(-1).close()")
    tab.get_by_role("button", name="Reconnect").click()
    until(tab, "sockets.length === 2 && sockets[1].readyState === 1")
    tab.wait_for_timeout(200)
    until(tab, LATER)
    assert tab.locator("[data-play=closed]").is_hidden()
    context.close()
