"""What a worker must have: the same versions and sources as the process that it works for, or its bits may differ."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import turgor
from turgor.errors import InvalidInput
from turgor.runs import PACKAGES

COMPARED = (*PACKAGES, "scipy")


@cache
def own_versions() -> dict[str, str]:
    """Versions of this process that bits depend on, and a hash of turgor's sources."""
    found = {name: importlib.metadata.version(name) for name in COMPARED}
    return {**found, "python": python_of(platform.python_version()), "sources": _sources()}


def check_versions(worker: str, found: Mapping[str, str | None], expected: Mapping[str, str]) -> None:
    """Raises `InvalidInput` that names the address of a `worker` that has other versions, and both versions."""
    for name, version in expected.items():
        if name in found and found[name] != version:
            what = "turgor's sources" if name == "sources" else name
            raise InvalidInput(
                f"cluster: expected {what} {version} on every worker, as it is here",
                f"{found[name] or 'none'} on {worker}",
            )


def python_of(version: str) -> str:
    """Major and minor version of Python: what pickled code depends on."""
    return ".".join(version.split(".")[:2])


@cache
def _sources() -> str:
    """Hash of all of turgor's sources, 12 hexadecimal digits: copies of one version may have been edited."""
    root = Path(turgor.__file__).parent
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(root.rglob("*.py")))).hexdigest()[:12]
