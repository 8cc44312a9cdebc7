"""The engine takes no more instructions than it did: see benchmarks/instructions.py."""

from __future__ import annotations

import importlib.util
import platform
import shutil
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "instructions.py"

pytestmark = [
    pytest.mark.skipif(shutil.which("callgrind_control") is None, reason="needs valgrind"),
    pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="counted for AVX2"),
]


@pytest.fixture(scope="module")
def instructions() -> ModuleType:
    spec = importlib.util.spec_from_file_location("instructions", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_case_is_recorded(instructions: ModuleType) -> None:
    assert list(instructions.recorded()) == list(instructions.CASES)


def test_no_case_takes_more_instructions_than_recorded(instructions: ModuleType) -> None:
    before = instructions.recorded()
    counts = {case: instructions.count(case) for case in before}
    grown = {case: f"{counts[case] / before[case] - 1:+.1%}" for case in counts}
    limit = 1 + instructions.GROWTH
    message = f"{grown}; if it is worth it, ./run python benchmarks/instructions.py --write in the same change"
    assert all(counts[case] <= limit * before[case] for case in counts), message
