"""What docs/ shows works: the python blocks of a page run one after the other, as one program."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parent.parent / "docs"
BLOCKS = {
    page: re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL) for page in DOCS.glob("*.md")
}


@pytest.mark.parametrize("page", sorted(page for page, blocks in BLOCKS.items() if blocks), ids=lambda page: page.stem)
def test_a_pages_code_runs(page: Path, tmp_path: Path) -> None:
    code = "\n".join(BLOCKS[page])
    subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=tmp_path, check=True, timeout=300)


@pytest.mark.parametrize("page", sorted(BLOCKS), ids=lambda page: page.stem)
def test_a_pages_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / link).exists(), f"{page.name} links to {link}"
