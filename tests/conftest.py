"""Fixtures of several files."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from browser import launch


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A real browser; tests that ask for it are skipped where there is none."""
    with launch() as started:
        yield started


@pytest.fixture
def all_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Agents are spread over all threads, however little there is to do."""
    monkeypatch.setattr("turgor.simulate.LEAST_WORK", 1)
