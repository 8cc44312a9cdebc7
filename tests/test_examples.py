"""What README.md, docs/ and examples/ show works."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import turgor

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NEEDS = ("cmaes", "ribs")  # packages of examples, which turgor itself does without


def python_blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


README_BLOCKS = python_blocks("README.md")
OPTIMIZERS_BLOCKS = python_blocks("docs/optimizers.md")


def skip_without_its_packages(code: str) -> None:
    for package in NEEDS:
        if re.search(rf"^(import|from) {package}\b", code, re.MULTILINE) and not importlib.util.find_spec(package):
            pytest.skip(f"needs the package {package}")


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short(example: Path) -> None:
    assert len(example.read_text(encoding="utf-8").splitlines()) < 40


@pytest.mark.parametrize("example", [e for e in EXAMPLES if e.stem != "with_ribs"], ids=lambda path: path.stem)
def test_example_runs(example: Path, tmp_path: Path) -> None:
    skip_without_its_packages(example.read_text(encoding="utf-8"))
    subprocess.run([sys.executable, "-W", "error", str(example)], cwd=tmp_path, check=True, timeout=300)


def test_example_with_ribs_maps_gaits_and_saves_them_by_name(tmp_path: Path) -> None:
    example = ROOT / "examples" / "with_ribs.py"
    skip_without_its_packages(example.read_text(encoding="utf-8"))
    task = turgor.make_task("hilly", body="small", condition="pressure", seed=0)
    subprocess.run([sys.executable, "-W", "error", str(example), "240"], cwd=tmp_path, check=True, timeout=300)
    gaits = np.load(tmp_path / "gaits.npz")
    assert len(gaits.files) > 5
    for name in gaits.files[:5]:
        gait = turgor.Simulator(task).record(gaits[name])
        column, row = "ABCDEFGHIJKLMN".index(name[0]), int(name[1:]) - 1
        assert np.clip(np.floor((gait.area_ratio.mean() - 0.1) / 0.1), 0, 13) == column
        assert np.clip(np.floor((gait.touch.mean() - 0.1) / 0.05), 0, 11) == row
    assert (tmp_path / "gaits.png").stat().st_size > 10_000


@pytest.mark.parametrize("code", OPTIMIZERS_BLOCKS)
def test_page_on_optimizers_runs(code: str, tmp_path: Path) -> None:
    skip_without_its_packages(code)
    subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=tmp_path, check=True, timeout=300)


@pytest.mark.parametrize("code", README_BLOCKS)
def test_readme_runs(code: str, tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=tmp_path, check=True, timeout=300)


def test_readme_commands_exist() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert README_BLOCKS
    for command in sorted(set(re.findall(r"turgor (evolve|evaluate|video|bench|resume)\b", text))):
        subprocess.run([sys.executable, "-m", "turgor", command, "--help"], check=True, stdout=subprocess.DEVNULL)
    for page, folder in (("README.md", ROOT), ("docs/optimizers.md", ROOT / "docs")):
        for link in re.findall(r"\]\(([^)#:]+)\)", (ROOT / page).read_text(encoding="utf-8")):
            assert (folder / link).exists(), f"{page} links to {link}"
