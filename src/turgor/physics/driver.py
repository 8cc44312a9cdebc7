"""What the engine asks of NVIDIA's driver: memory, copies, launches. One GPU, one call after the other."""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from ctypes import POINTER, byref, c_char_p, c_int, c_size_t, c_uint, c_uint64, c_void_p
from functools import cache
from typing import Any

import numpy as np

from turgor.errors import InvalidInput

LIBRARY = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
# NVIDIA's CUDA Driver API: the functions in use, as cuda.h declares them; each returns 0 or the number of an error.
FUNCTIONS: dict[str, Sequence[Any]] = {
    "cuInit": [c_uint],
    "cuGetErrorName": [c_int, POINTER(c_char_p)],
    "cuDeviceGet": [POINTER(c_int), c_int],
    "cuDeviceGetName": [c_void_p, c_int, c_int],
    "cuDevicePrimaryCtxRetain": [POINTER(c_void_p), c_int],
    "cuCtxSetCurrent": [c_void_p],
    "cuCtxSynchronize": [],
    "cuModuleLoadDataEx": [POINTER(c_void_p), c_char_p, c_uint, POINTER(c_int), POINTER(c_void_p)],
    "cuModuleGetFunction": [POINTER(c_void_p), c_void_p, c_char_p],
    "cuMemGetInfo_v2": [POINTER(c_size_t), POINTER(c_size_t)],
    "cuMemAlloc_v2": [POINTER(c_uint64), c_size_t],
    "cuMemFree_v2": [c_uint64],
    "cuMemsetD8_v2": [c_uint64, ctypes.c_ubyte, c_size_t],
    "cuMemcpyHtoD_v2": [c_uint64, c_void_p, c_size_t],
    "cuMemcpyDtoH_v2": [c_void_p, c_uint64, c_size_t],
    "cuLaunchKernel": [c_void_p, *[c_uint] * 7, c_void_p, POINTER(c_void_p), POINTER(c_void_p)],
}
ERROR_LOG, ERROR_LOG_SIZE = 5, 6  # options of the driver's assembler
LOG_BYTES, MOST_SAID = 4096, 300  # of its errors, and of what is told of them


class Memory:
    """An array on the device, C order; freed when nobody refers to it any more."""

    def __init__(self, address: int, array: np.ndarray, free: Callable[[int], None]) -> None:
        self.address, self.shape, self.nbytes = address, array.shape, array.nbytes
        self._free = free

    @property
    def words(self) -> list[int]:
        """What the kernel is told of it, as in `engine.words_of`."""
        return [self.address, *self.shape]

    def __del__(self) -> None:
        if self.address:
            self._free(self.address)


class Device:
    """A GPU. Raises `InvalidInput` where there is none, or where it fails."""

    def __init__(self, number: int = 0) -> None:
        device, context, name = c_int(), c_void_p(), ctypes.create_string_buffer(128)
        try:
            ask("cuInit", 0)
            ask("cuDeviceGet", byref(device), number)
        except (InvalidInput, OSError, AttributeError) as error:  # AttributeError: an old driver
            raise InvalidInput("device: expected an NVIDIA GPU and its driver for 'cuda'", str(error)) from None
        ask("cuDeviceGetName", name, len(name), device)
        ask("cuDevicePrimaryCtxRetain", byref(context), device)
        self.name = name.value.decode()
        self.busy = 0.0  # [s], in launches so far
        self._context = context

    def load(self, ptx: bytes, entry: str) -> None:
        """Has the kernel `entry` of a PTX text ready. The driver makes machine code of it, and keeps that."""
        self._enter()
        module, kernel, log = c_void_p(), c_void_p(), ctypes.create_string_buffer(LOG_BYTES)
        options = (c_int * 2)(ERROR_LOG, ERROR_LOG_SIZE)
        values = (c_void_p * 2)(ctypes.addressof(log), LOG_BYTES)
        error = call("cuModuleLoadDataEx", byref(module), ptx, len(options), options, values)
        if error:
            said = " ".join(log.value.decode(errors="replace").split())
            raise InvalidInput("device: expected a GPU that can run the engine", f"{error} {said[:MOST_SAID]}".strip())
        ask("cuModuleGetFunction", byref(kernel), module, entry.encode())
        self._kernel = kernel

    def free_bytes(self) -> int:
        """Memory that is free [byte]."""
        self._enter()
        free, total = c_size_t(), c_size_t()
        ask("cuMemGetInfo_v2", byref(free), byref(total))
        return free.value

    def upload(self, array: np.ndarray) -> Memory:
        """A copy of `array` [C order] on the device."""
        assert array.flags.c_contiguous
        memory = self._room(array)
        if memory.nbytes:
            ask("cuMemcpyHtoD_v2", memory.address, array.ctypes.data, memory.nbytes)
        return memory

    def zeros(self, shape: Sequence[int]) -> Memory:
        """Room for float32 of a `shape`."""
        memory = self._room(np.broadcast_to(np.float32(0), shape))
        if memory.nbytes:
            ask("cuMemsetD8_v2", memory.address, 0, memory.nbytes)
        return memory

    def download(self, memory: Memory, array: np.ndarray) -> None:
        """Copies `memory` to `array` [C order], of the same size."""
        assert array.flags.c_contiguous
        assert array.nbytes == memory.nbytes
        self._enter()
        if memory.nbytes:
            ask("cuMemcpyDtoH_v2", array.ctypes.data, memory.address, memory.nbytes)

    def launch(self, grid: int, block: int, argument: bytes) -> None:
        """Runs the kernel in `grid` blocks of `block` threads, to the end."""
        self._enter()
        arguments = (c_void_p * 1)(ctypes.cast(c_char_p(argument), c_void_p))
        began = time.perf_counter()
        ask("cuLaunchKernel", self._kernel, grid, 1, 1, block, 1, 1, 0, None, arguments, None)
        ask("cuCtxSynchronize")
        self.busy += time.perf_counter() - began

    def _room(self, array: np.ndarray) -> Memory:
        self._enter()
        address = c_uint64()
        if array.nbytes:
            ask("cuMemAlloc_v2", byref(address), array.nbytes)
        return Memory(address.value, array, self._free)

    def _free(self, address: int) -> None:
        with suppress(InvalidInput):  # the process ends
            self._enter()
            ask("cuMemFree_v2", address)

    def _enter(self) -> None:
        """Makes this the device of the calling thread."""
        ask("cuCtxSetCurrent", self._context)


def ask(name: str, *values: Any) -> None:
    """Calls a function of the driver. Raises `InvalidInput` for an error, `OSError` without a driver."""
    error = call(name, *values)
    if error:
        raise InvalidInput("device: expected the GPU to do its work", error)


def call(name: str, *values: Any) -> str:
    """Calls a function of the driver; returns the name of its error, empty if there is none."""
    error, called = getattr(library(), name)(*values), c_char_p()
    if error:
        library().cuGetErrorName(error, byref(called))
    return (called.value or b"%d" % error).decode() if error else ""


@cache
def library() -> Any:
    """The driver's functions. Raises `OSError` without one."""
    found = ctypes.CDLL(LIBRARY)
    for name, kinds in FUNCTIONS.items():
        getattr(found, name).argtypes, getattr(found, name).restype = kinds, c_int
    return found
