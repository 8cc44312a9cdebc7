"""A real browser for tests: skipped, visibly, where playwright or the browser is missing."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
LOCAL = ("127.0.0.1", "localhost", "::1", "", None)


def browser_path() -> str | None:
    """Chromium: what the variable CHROMIUM names, or what is found on the path."""
    named = os.environ.get("CHROMIUM")
    return named or next((found for found in map(shutil.which, NAMES) if found), None)


@contextmanager
def launch() -> Iterator[Any]:
    """A playwright browser; the test is skipped where there is none."""
    pytest.importorskip("playwright", reason="needs playwright, of the group dev")
    path = browser_path()
    if path is None or not Path(path).exists():
        pytest.skip("needs Chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def watched_page(browser: Any, **options: Any) -> Iterator[Any]:
    """A page in a context of its own with `options`; fails at the end for an error in the console, an error of the
    page, or a request to another host."""
    context = browser.new_context(**options)
    page = context.new_page()
    problems: list[str] = []
    page.on("console", lambda message: message.type == "error" and problems.append(f"console: {message.text}"))
    page.on("pageerror", lambda error: problems.append(f"page: {error}"))
    page.on("request", lambda request: is_foreign(request.url) and problems.append(f"request: {request.url}"))
    try:
        yield page
        assert not problems
    finally:
        context.close()


def until(page: Any, condition: str, seconds: float = 20.0) -> None:
    """Waits for a condition in JavaScript; playwright's own `wait_for_function` needs a page that allows eval."""
    deadline = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < deadline, f"not within {seconds:g} s: {condition}"
        page.wait_for_timeout(20)


def is_foreign(url: str) -> bool:
    """Whether the address is on another machine."""
    parts = urlsplit(url)
    return parts.scheme not in ("data", "blob", "about") and parts.hostname not in LOCAL
