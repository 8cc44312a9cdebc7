"""What the engine asks of the CUDA driver: memory, transfers, launches. One GPU, one call after the other."""

from __future__ import annotations

import ctypes
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from cuda.bindings import driver

from turgor.errors import InvalidInput

Argument = tuple[Any, float]  # of a kernel: its C type (see ctypes) and value


class Memory:
    """An array on the device, C order; freed when nobody refers to it any more."""

    def __init__(self, address: int, shape: Sequence[int], itemsize: int, free: Callable[[int], None]) -> None:
        self.address, self.shape, self.itemsize = address, tuple(shape), itemsize
        self._free = free

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def nbytes(self) -> int:
        return self.size * self.itemsize

    def __del__(self) -> None:
        if self.address:
            self._free(self.address)


class Device:
    """A GPU. Raises `InvalidInput` where there is none, or where it fails."""

    def __init__(self, number: int = 0) -> None:
        try:
            _ask(driver.cuInit(0))
            self._device = _ask(driver.cuDeviceGet(number))
        except (InvalidInput, RuntimeError, OSError) as error:
            raise InvalidInput("device: expected an NVIDIA GPU and its driver for 'cuda'", str(error)) from None
        attribute = driver.CUdevice_attribute
        self.compute_capability = (
            _ask(driver.cuDeviceGetAttribute(attribute.CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR, self._device)),
            _ask(driver.cuDeviceGetAttribute(attribute.CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR, self._device)),
        )
        self.name = _ask(driver.cuDeviceGetName(128, self._device)).split(b"\0")[0].decode()
        self._context = _ask(driver.cuDevicePrimaryCtxRetain(self._device))
        self.busy = 0.0  # [s], in launches so far

    def load(self, code: bytes) -> None:
        """Has the one kernel of this machine code ready."""
        self._enter()
        image = np.frombuffer(code, np.uint8)
        self._module = _ask(driver.cuModuleLoadData(image.ctypes.data))
        self._kernel = _ask(driver.cuModuleGetFunction(self._module, entry_of(code)))

    def free_bytes(self) -> int:
        self._enter()
        return int(_ask(driver.cuMemGetInfo())[0])

    def zeros(self, shape: Sequence[int], itemsize: int = 4) -> Memory:
        """Room for an array."""
        memory = self._room(shape, itemsize)
        if memory.nbytes:
            _ask(driver.cuMemsetD8(memory.address, 0, memory.nbytes))
        return memory

    def upload(self, array: np.ndarray) -> Memory:
        """A copy of `array` [C order] on the device."""
        assert array.flags.c_contiguous
        memory = self._room(array.shape, array.itemsize)
        if memory.nbytes:
            _ask(driver.cuMemcpyHtoD(memory.address, array.ctypes.data, memory.nbytes))
        return memory

    def download(self, memory: Memory, array: np.ndarray) -> None:
        """Copies `memory` to `array` [C order], of the same size."""
        assert array.flags.c_contiguous
        assert array.nbytes == memory.nbytes
        self._enter()
        if memory.nbytes:
            _ask(driver.cuMemcpyDtoH(array.ctypes.data, memory.address, memory.nbytes))

    def launch(self, grid: int, block: int, arguments: Sequence[Argument]) -> None:
        """Runs the kernel in `grid` blocks of `block` threads, to the end."""
        self._enter()
        values, kinds = tuple(value for _, value in arguments), tuple(kind for kind, _ in arguments)
        began = time.perf_counter()
        _ask(driver.cuLaunchKernel(self._kernel, grid, 1, 1, block, 1, 1, 0, 0, (values, kinds), 0))
        _ask(driver.cuCtxSynchronize())
        self.busy += time.perf_counter() - began

    def _room(self, shape: Sequence[int], itemsize: int) -> Memory:
        self._enter()
        size = int(np.prod(shape, dtype=np.int64)) * itemsize
        address = int(_ask(driver.cuMemAlloc(size))) if size else 0
        return Memory(address, shape, itemsize, self._free)

    def _free(self, address: int) -> None:
        with suppress(InvalidInput):  # the process ends
            self._enter()
            _ask(driver.cuMemFree(address))

    def _enter(self) -> None:
        """Makes this the device of the calling thread."""
        _ask(driver.cuCtxSetCurrent(self._context))


def entry_of(code: bytes) -> bytes:
    """The name of the kernel, which alone has a section of such a name."""
    found = re.search(rb"\0\.nv\.constant0\.(\w+)\0", code)
    assert found is not None
    return found[1]


def flat(array: Memory) -> list[Argument]:
    """An array as a kernel of Numba takes it."""
    strides = [array.itemsize * int(np.prod(array.shape[k + 1 :], dtype=np.int64)) for k in range(len(array.shape))]
    numbers = [array.size, array.itemsize]
    return [
        (ctypes.c_void_p, 0),  # its owner, and whose part it is
        (ctypes.c_void_p, 0),
        *((ctypes.c_int64, number) for number in numbers),
        (ctypes.c_void_p, array.address),
        *((ctypes.c_int64, number) for number in (*array.shape, *strides)),
    ]


def _ask(answer: tuple[Any, ...]) -> Any:
    """What the driver answers: nothing, a value or several. Raises `InvalidInput` for an error."""
    error, *values = answer
    if error != driver.CUresult.CUDA_SUCCESS:
        raise InvalidInput("device: expected the GPU to do its work", error.name)
    return values[0] if len(values) == 1 else tuple(values)
