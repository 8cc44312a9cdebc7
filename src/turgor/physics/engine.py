"""The kernel's machine code: from its file, or made by `build.py`, which alone needs Numba and takes some seconds.

The file is known by the sources of the engine, the processor and LLVM, so that it is never older than what it was made
from. It lies where Numba would have put it: in the folder NUMBA_CACHE_DIR if that is set, else beside the sources, else
among the user's caches. Where no folder can be written to, every process makes it anew.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import struct
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numpy as np

ENTRY = "turgor_run_blocks"
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


def run_blocks(words: Sequence[int]) -> None:
    """Calls `step.run_blocks` with `words_of` LASTING and PASSING arrays, and COUNTS. Meanwhile other threads run."""
    if not _loaded:
        load()
    _loaded[0](_WORDS.pack(*words))


_WORDS = struct.Struct(f"{sum(1 + n for _, n in (LASTING | PASSING).values()) + len(COUNTS)}q")


def load() -> None:
    """Has the machine code in memory."""
    with _loading:
        if _loaded:
            return
        code = next(_found(), None)
        if code is None:
            code = _made()
            _keep(code)
        machine = target_machine()
        compiled = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        compiled.add_object_file(llvm.ObjectFileRef.from_data(code))
        compiled.finalize_object()
        function = ctypes.CFUNCTYPE(None, ctypes.c_char_p)(compiled.get_function_address(ENTRY))
        _loaded.extend([function, compiled])


def is_ready() -> bool:
    """Whether the machine code need not be made."""
    return bool(_loaded) or next(_found(), None) is not None


def _made() -> bytes:
    from turgor.physics.build import machine_code
    from turgor.physics.step import ARGUMENTS, run_blocks

    return machine_code(run_blocks, ARGUMENTS)


# --- the processor ------------------------------------------------------------------------------------------------


def processor() -> tuple[str, str]:
    """This processor's name and features as LLVM knows them, or those in NUMBA_CPU_NAME, NUMBA_CPU_FEATURES."""
    name, features = os.environ.get("NUMBA_CPU_NAME"), os.environ.get("NUMBA_CPU_FEATURES")
    return name or llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten() if features is None else features


def target_machine() -> Any:
    """LLVM's description of the processor, for code that is made for it alone."""
    with contextlib.suppress(RuntimeError):  # what only old versions need
        llvm.initialize()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = processor()
    triple = llvm.get_process_triple()
    return llvm.Target.from_triple(triple).create_target_machine(
        cpu=name, features=features, opt=3, reloc="static" if triple.startswith("x86") else "default",
        codemodel="jitdefault", jit=True,
    )  # fmt: skip


# --- the file -----------------------------------------------------------------------------------------------------


def _folders() -> list[Path]:
    """Where the file may lie, the best first."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return [Path(given)]
    user = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
    return [_sources / "__pycache__", Path(user) / "turgor"]


@cache
def _name() -> str:
    """The file's name: which sources of which folder, for which processor."""
    where = "\n".join([str(_sources), *processor(), llvm.get_process_triple(), llvmlite.__version__])
    what = b"".join(source.read_bytes() for source in sorted(_sources.glob("*.py")))
    return f"kernel-{hashlib.sha256(where.encode()).hexdigest()[:12]}-{hashlib.sha256(what).hexdigest()[:12]}"


def _found() -> Iterator[bytes]:
    """The contents of files that are there and whole."""
    for folder in _folders():
        with contextlib.suppress(OSError):
            data = (folder / _name()).read_bytes()
            digest, code = data[:32], data[32:]
            if hashlib.sha256(code).digest() == digest:
                yield code


def _keep(code: bytes) -> None:
    """Writes the file, and removes those of older sources."""
    from turgor.files import NotWritten, write_whole

    for folder in _folders():
        with contextlib.suppress(OSError, NotWritten):
            folder.mkdir(parents=True, exist_ok=True)
            write_whole(folder / _name(), hashlib.sha256(code).digest() + code)
            for old in folder.glob(_name().rpartition("-")[0] + "-*"):
                if old.name != _name():
                    old.unlink(missing_ok=True)
            return
