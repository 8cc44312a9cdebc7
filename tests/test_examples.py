"""What README.md, docs/ and examples/ show works."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import turgor
from turgor.errors import InvalidInput
from turgor.simulate import open_gpu

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# the python blocks of a page are one program
PROGRAMS = {
    page.stem: "\n".join(re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL))
    for page in PAGES
}
NEEDS = ("cmaes", "distributed", "ribs", "stable_baselines3")  # packages of examples, which turgor itself does without
SHORT = {"train_ppo": ["--steps", "64", "--agents", "2"]}  # options that make an example short


def skip_without_its_packages(code: str) -> None:
    for package in NEEDS:
        if re.search(rf"^(import|from) {package}\b", code, re.MULTILINE) and not importlib.util.find_spec(package):
            pytest.skip(f"needs the package {package}")


@pytest.mark.parametrize("example", ["random_search", "with_cmaes", "with_ribs"])
def test_an_optimizer_of_ones_own_takes_few_lines(example: str) -> None:
    assert len((ROOT / "examples" / f"{example}.py").read_text(encoding="utf-8").splitlines()) < 40


@pytest.mark.parametrize("example", [e for e in EXAMPLES if e.stem != "with_ribs"], ids=lambda path: path.stem)
def test_example_runs(example: Path, tmp_path: Path) -> None:
    skip_without_its_packages(example.read_text(encoding="utf-8"))
    options = SHORT.get(example.stem, [])
    subprocess.run([sys.executable, "-W", "error", str(example), *options], cwd=tmp_path, check=True, timeout=300)


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


@pytest.mark.parametrize("page", [page for page, code in PROGRAMS.items() if code])
def test_page_shows_what_works(page: str, tmp_path: Path) -> None:
    code = PROGRAMS[page]
    skip_without_its_packages(code)
    if 'device="cuda"' in code:
        try:
            open_gpu()
        except InvalidInput as reason:
            pytest.skip(f"needs a GPU: {reason}")
    subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=tmp_path, check=True, timeout=300)


def test_pages_name_what_exists() -> None:
    assert PROGRAMS["README"]
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for command in sorted(
            set(re.findall(r"turgor (evolve|evaluate|video|bench|resume|reproduce|crosscheck)\b", text))
        ):
            subprocess.run([sys.executable, "-m", "turgor", command, "--help"], check=True, stdout=subprocess.DEVNULL)
        for link in re.findall(r"\]\(([^)#:]+)\)", text):
            assert (page.parent / link).exists(), f"{page} links to {link}"
