"""What a worker must have: the same versions and sources as the process that it works for, or its bits may differ."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.metadata
import platform
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import turgor
from turgor.errors import InvalidInput
from turgor.runs import PACKAGES

HINTS = {
    "the BLAS kernels": " (OPENBLAS_CORETYPE chooses)",
    "the loops of NumPy": " (NPY_DISABLE_CPU_FEATURES chooses)",
}
COMPARED = (*PACKAGES, "scipy")


@cache
def own_versions() -> dict[str, str]:
    """Versions of this process that bits depend on, and a hash of turgor's sources."""
    found = {name: importlib.metadata.version(name) for name in COMPARED}
    return {**found, "python": python_of(platform.python_version()), "sources": _sources()}


@cache
def own_kernels() -> dict[str, str]:
    """Which kernels OpenBLAS and NumPy chose for this processor: the bits of a whole run depend on them, because its
    strategy's do; those of a simulation do not."""
    from threadpoolctl import threadpool_info

    importlib.import_module("scipy.linalg")  # has a BLAS of its own, which is known once it is loaded
    libraries = [library for library in threadpool_info() if library["user_api"] == "blas"]
    blas = {library.get("architecture", library["internal_api"]) for library in libraries}
    loops: set[str] = set()
    with contextlib.suppress(ImportError):  # from NumPy 2.1 on
        introspect = importlib.import_module("numpy.lib.introspect")
        found = introspect.opt_func_info(signature="float64").values()
        loops = {kinds["current"].partition("(")[0] for function in found for kinds in function.values()}
    return {"the BLAS kernels": _joined(blas), "the loops of NumPy": _joined(loops)}


def _joined(names: set[str]) -> str:
    return "+".join(sorted(names)) or "unknown"


def check_versions(worker: str, found: Mapping[str, str | None], expected: Mapping[str, str]) -> None:
    """Raises `InvalidInput` that names the address of a `worker` that has other versions or kernels, and both."""
    for name, version in expected.items():
        if name in found and found[name] != version:
            what = "turgor's sources" if name == "sources" else name
            raise InvalidInput(
                f"cluster: expected {what} {version} on every worker, as here{HINTS.get(name, '')}",
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
