"""What the viewer costs: size of a replay, frames and first frame in headless Chromium, bytes to a playground visitor.

./run python benchmarks/viewer.py
"""

import asyncio
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import websockets
from playwright.sync_api import sync_playwright

from turgor.evolution.loop import evolve
from turgor.task import make_task
from turgor.web.export import export_runs
from turgor.web.replay import replay_of_run

SECONDS = 5
STATS = "({frames, fps, drawing, firstFrame}) => ({frames, fps, drawing, firstFrame})"


async def visit(address: str, body: str) -> tuple[float, float]:
    """Frames/s and bytes/s that a visitor of the playground gets."""
    socket = address.rstrip("/").replace("http", "ws") + "/api/play"
    async with websockets.connect(socket, origin=address.rstrip("/"), compression=None) as visitor:
        start = {"type": "start", "task": "hilly", "body": body, "seed": 0, "gravity": 10.0, "frequency": 8.0}
        await visitor.send(json.dumps(start))
        frames, count, began, seen = 0, 0, None, time.monotonic()
        while began is None or time.monotonic() - began < SECONDS:
            message = await visitor.recv()
            if isinstance(message, bytes):
                began = began or time.monotonic()
                frames, count = frames + 1, count + len(message)
            if time.monotonic() - seen > 0.2:
                await visitor.send('{"type":"seen"}')
                seen = time.monotonic()
        took = time.monotonic() - began
    return frames / took, count / took


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recipe = {"name": "hilly", "body": "large", "condition": "pressure", "seed": 0}
        evolve(make_task("hilly", body="large"), 250, 0, folder / "runs" / "large", recipe=recipe)
        page = folder / "replay.html"
        page.write_text(export_runs([folder / "runs" / "large"]), encoding="utf-8")
        print(f"replay of 30 s, large: {len(replay_of_run(folder / 'runs' / 'large')) / 1e3:.0f} kB")
        print(f"the same as an HTML file: {page.stat().st_size / 1e3:.0f} kB")
        with sync_playwright() as playwright:
            flags = ["--no-sandbox", "--disable-gpu"]
            browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=flags)
            tab = browser.new_page(viewport={"width": 1280, "height": 900})
            tab.goto(page.as_uri())
            tab.wait_for_timeout(1000 * SECONDS)
            stats = tab.evaluate(f"({STATS})(window.player.stats)")
            browser.close()
        print(f"large, with charts: {stats['fps']:.0f} frames/s, {stats['drawing']:.1f} ms of drawing a frame")
        print(f"first frame: {stats['firstFrame']:.0f} ms after the replay is there")
        command = [sys.executable, "-m", "turgor", "view", str(folder / "runs"), "--no-browser", "--port", "0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            address = server.stdout.readline().split()[-1]
            for body in ("small", "medium", "large"):
                frames, rate = asyncio.run(visit(address, body))
                print(f"a visitor of the playground, {body}: {frames:.0f} frames/s, {rate / 1e3:.1f} kB/s")
            server.terminate()


if __name__ == "__main__":
    main()
