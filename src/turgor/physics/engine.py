"""The kernel's machine code: from its file, or made by `build.py`, which alone needs Numba and takes some seconds. What
GPUs are given (PTX) is kept in the same way.

The file is known by the sources of the engine, the processor and LLVM, so that it is never older than what it was made
from. It lies where Numba would have put it: in the folder NUMBA_CACHE_DIR if that is set, else beside the sources, else
among the user's caches. Where no folder can be written to, every process makes it anew.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import hashlib
import math
import os
import struct
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from turgor.errors import InvalidInput, describe

ENTRY = "turgor_run_blocks"
KERNEL, PTX = "kernel", "ptx"  # what a file holds: machine code for this processor, or what is made for GPUs
THREADS = 128  # of a block of a GPU's grid
DIGEST = 32  # [byte], the checksum before the machine code
# The arguments of `step.run_blocks`: arrays in C order, type and dimensions of each. Those of a batch ...
LASTING = {
    "constants": (np.float32, 1),
    "layouts": (np.int64, 2),
    "tables": (np.float32, 1),
    "grounds": (np.float32, 2),
    "memory": (np.float32, 2),
    "brains": (np.float32, 2),
    "results": (np.float32, 2),
    "position": (np.float32, 3),
    "velocity": (np.float32, 3),
}
PASSING = {  # ... those of one call ...
    "scripts": (np.float32, 2),
    "traces": (np.float32, 2),
    "fresh": (np.bool_, 1),
    "commands": (np.float32, 2),
    "observations": (np.float32, 2),
    "stands": (np.float32, 2),
}
COUNTS = ("drive", "first_step", "steps", "last_step")  # ... and whole numbers
WORD_BYTES = 8  # of an address or a whole number

_sources = Path(__file__).parent
_loading = threading.Lock()
_loaded: list[Any] = []  # the function, and what it lives in


def words_of(arrays: Iterable[np.ndarray], kinds: Mapping[str, tuple[type, int]]) -> list[int]:
    """What the machine code is told of `arrays` that are LASTING or PASSING: address and shape of each."""
    words = []
    for array, (dtype, dimensions) in zip(arrays, kinds.values(), strict=True):
        assert (array.dtype, array.ndim, array.flags.c_contiguous) == (dtype, dimensions, True)
        words.append(array.ctypes.data)
        words.extend(array.shape)
    return words


def in_words(array: np.ndarray) -> bytes:
    """An array that lies among the words."""
    return array.tobytes().ljust(WORD_BYTES * words_in(array.shape, array.itemsize), b"\0")


def words_in(shape: Sequence[int], size: int) -> int:
    """The words that an array of numbers of `size` bytes takes, where it lies among them."""
    return -(-math.prod(shape) * size // WORD_BYTES)


def run_blocks(words: Sequence[int]) -> None:
    """Calls `step.run_blocks` with `words_of` LASTING and PASSING arrays, and COUNTS. Meanwhile other threads run."""
    if not _loaded:
        load()
    _loaded[0](_WORDS.pack(*words))


_WORDS = struct.Struct(f"{sum(1 + n for _, n in (LASTING | PASSING).values()) + len(COUNTS)}q")


def load(before_making: Callable[[], object] = lambda: None) -> None:
    """Has the machine code in memory; calls `before_making` if it has to be made. Raises `InvalidInput` where the
    installed Numba cannot make it."""
    with _loading:
        if _loaded:
            return
        _loaded.extend(function_of(code_of(KERNEL, before_making)))


def function_of(code: bytes) -> tuple[Any, Any]:
    """The function ENTRY of machine code, to be called with words, and what it lives in."""
    compiled = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target_machine())
    compiled.add_object_file(llvm.ObjectFileRef.from_data(code))
    compiled.finalize_object()
    return ctypes.CFUNCTYPE(None, ctypes.c_char_p)(compiled.get_function_address(ENTRY)), compiled


def code_of(kind: str, before_making: Callable[[], object]) -> bytes:
    """The machine code of the KERNEL, or PTX; calls `before_making` if it has to be made."""
    code = _found(kind)
    if code is None:
        before_making()
        code = _made(kind)
        _keep(code, kind)
    return code


def _made(kind: str = KERNEL) -> bytes:
    collecting = gc.isenabled()
    gc.disable()  # Numba makes millions of objects that it keeps
    try:
        from turgor.physics.build import machine_code, ptx
        from turgor.physics.step import ARGUMENTS, THREAD_ARGUMENTS, run_agent, run_blocks

        if kind == PTX:
            return ptx(run_agent, THREAD_ARGUMENTS).encode()
        return machine_code(run_blocks, ARGUMENTS)
    except Exception as error:
        _blame_numba(error)
        raise
    finally:
        if collecting:
            gc.enable()


def _blame_numba(error: Exception) -> None:
    """Raises `InvalidInput` where Numba cannot be imported, or is none of those that turgor allows."""
    from importlib import metadata

    from packaging.requirements import Requirement

    try:
        required = metadata.requires("turgor") or ()
    except metadata.PackageNotFoundError:  # sources that are not installed: nobody has said what they need
        return
    allowed = next(r for r in map(Requirement, required) if r.name == "numba")
    found = metadata.version("numba")
    if isinstance(error, ImportError) or found not in allowed.specifier:
        expected = f"expected {allowed} to make the engine with ('pip check' lists what does not fit)"
        raise InvalidInput(expected, f"numba {found}: {describe(error)}") from error


# --- the processor ------------------------------------------------------------------------------------------------


def processor() -> tuple[str, str]:
    """This processor's name and features as LLVM knows them, or those in NUMBA_CPU_NAME and NUMBA_CPU_FEATURES."""
    name = os.environ.get("NUMBA_CPU_NAME")
    features = os.environ.get("NUMBA_CPU_FEATURES", "" if name == "generic" else None)
    if features is None:
        try:
            features = llvm.get_host_cpu_features().flatten()
        except RuntimeError:  # where LLVM cannot tell
            features = ""
    return name or llvm.get_host_cpu_name(), features


def target_machine() -> Any:
    """LLVM's description of the processor, for code that runs here alone."""
    with contextlib.suppress(RuntimeError):  # raised by versions that need it no more
        llvm.initialize()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = processor()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    place = "static" if target.name.startswith("x86") else "default"  # as Numba has it
    return target.create_target_machine(
        cpu=name, features=features, opt=3, reloc=place, codemodel="jitdefault", jit=True
    )


# --- the file -----------------------------------------------------------------------------------------------------


def _folders() -> list[Path]:
    """Where the file may lie, the best first."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return [Path(given)]
    user = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or os.path.expanduser("~/.cache")
    return [_sources / "__pycache__", Path(user) / "turgor"]


@cache
def _name(kind: str = KERNEL) -> str:
    """The file's name: which sources of which folder, for which processor."""
    where = "\n".join([str(_sources), *processor(), llvm.get_process_triple(), llvmlite.__version__])
    what = b"".join(source.read_bytes() for source in sorted(_sources.glob("*.py")))
    return f"{kind}-{hashlib.sha256(where.encode()).hexdigest()[:12]}-{hashlib.sha256(what).hexdigest()[:12]}"


def _found(kind: str = KERNEL) -> bytes | None:
    """What the file holds, if there is one that is whole."""
    for folder in _folders():
        with contextlib.suppress(OSError):
            data = (folder / _name(kind)).read_bytes()
            digest, code = data[:DIGEST], data[DIGEST:]
            if hashlib.sha256(code).digest() == digest:
                return code
    return None


def _keep(code: bytes, kind: str = KERNEL) -> None:
    """Writes the file into the first folder that takes it, and removes those of older sources there."""
    from turgor.files import NotWritten, write_whole

    name = _name(kind)
    for folder in _folders():
        with contextlib.suppress(OSError, NotWritten):
            folder.mkdir(parents=True, exist_ok=True)
            write_whole(folder / name, hashlib.sha256(code).digest() + code)
            _remove_older(folder, name)
            return


def _remove_older(folder: Path, name: str) -> None:
    for file in folder.glob(f"{name.rpartition('-')[0]}-*"):
        if file.name != name:
            with contextlib.suppress(OSError):  # Windows keeps a file that another process reads
                file.unlink()
