"""What README.md and examples/ show works."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
# options that make an example short
SHORT = {"train_ppo": ["--steps", "64", "--agents", "2"]}
README_BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example: Path, tmp_path: Path) -> None:
    code = example.read_text(encoding="utf-8")
    if "stable_baselines3" in code and not importlib.util.find_spec("stable_baselines3"):
        pytest.skip('needs the extra "rl"')
    options = SHORT.get(example.stem, [])
    subprocess.run([sys.executable, "-W", "error", str(example), *options], cwd=tmp_path, check=True, timeout=300)


@pytest.mark.parametrize("code", README_BLOCKS)
def test_readme_runs(code: str, tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=tmp_path, check=True, timeout=300)


def test_readme_commands_exist() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert README_BLOCKS
    for command in sorted(set(re.findall(r"turgor (evolve|evaluate|video|bench|resume)\b", text))):
        subprocess.run([sys.executable, "-m", "turgor", command, "--help"], check=True, stdout=subprocess.DEVNULL)
    for link in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (ROOT / link).exists(), f"README.md links to {link}"
