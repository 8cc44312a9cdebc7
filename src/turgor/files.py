"""Files that survive: written whole or not at all, arrays that can be told from torn ones, folders with one writer."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import logging
import math
import os
import socket
import stat
import time
import zipfile
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from turgor.errors import InvalidInput, describe

LOCK = ".lock"
PARTIALS = ".*.partial*"  # files that were being written
OWN = (".json", ".csv", ".npz")  # what is written under the lock alone
PATIENCE = 3.0  # [s]: the processes of a campaign whose first one was killed end within a generation
FORGOTTEN = 3600.0  # [s] after which nobody draws a picture any more
DIGEST = "sha256"  # the array that holds the checksum of the others
ARRAYS_BYTES = 4_000_000_000  # larger files of arrays are not read
NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)

log = logging.getLogger("turgor")


class NotWritten(InvalidInput):
    """A file that could not be written: a full disk, a folder that is read-only. What it held before is still there."""


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Turns what the system says against writing `path` into `NotWritten`."""
    try:
        yield
    except OSError as error:
        raise NotWritten(f"{path}: expected to be able to write it", error.strerror or describe(error)) from None


@contextlib.contextmanager
def whole(path: Path) -> Generator[Path]:
    """Where to write a file that is to be the old one or the new one, whatever happens meanwhile: it is synced and gets
    its name at the end of the block, and is gone if that raises. Raises `NotWritten`."""
    if not path.name:
        raise NotWritten("expected the name of a file", repr(str(path)))
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    with writing(path):
        try:
            yield partial
            _sync(partial, os.O_RDWR)
            os.replace(partial, path)
            if os.name == "posix":  # so that the name survives a power cut; elsewhere the system sees to it
                _sync(path.parent, os.O_RDONLY)
        finally:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes) -> None:
    """Writes `data` as `whole` does. Raises `NotWritten`."""
    with whole(path) as partial:
        partial.write_bytes(data)


def _sync(path: Path, mode: int) -> None:
    handle = os.open(path, mode)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read_whole(path: Path, most: int) -> bytes:
    """What a plain file of at most `most` bytes holds. Raises `InvalidInput` for another, and `OSError`."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise InvalidInput(f"{path}: expected a file", "something else")
    if found.st_size > most:
        raise InvalidInput(f"{path}: expected at most {most / 1e6:.0f} MB", f"{found.st_size / 1e6:.0f} MB")
    return path.read_bytes()


# --- arrays -------------------------------------------------------------------------------------------------------


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes `arrays` as one .npz file with a checksum. Raises `NotWritten`."""
    assert not any(array.dtype.hasobject for array in arrays.values())
    data = io.BytesIO()
    np.savez(data, **arrays, **{DIGEST: _digest(arrays)})  # ty: ignore[invalid-argument-type]
    write_whole(path, data.getvalue())


def read_arrays(path: Path, *, checksum: bool = True) -> dict[str, np.ndarray]:
    """The arrays of a .npz file that `write_arrays` wrote: numbers and text, never objects.

    What the file declares is looked at before any memory is taken: it may not be more than the file holds. Raises
    `InvalidInput` for a file that cannot be read, is torn, or was changed after it was written. `checksum=False`
    takes a file without a checksum as well.
    """
    try:
        data = read_whole(path, ARRAYS_BYTES)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            _check_members(archive, len(data))
            arrays = {m.filename.removesuffix(".npy"): _read_array(archive, m) for m in archive.infolist()}
    except Exception as error:  # zipfile and NumPy stumble over a stranger's bytes in many ways
        if isinstance(error, MemoryError | InvalidInput):
            raise
        reason = describe(getattr(error, "strerror", None) or error)
        raise InvalidInput(f"{path}: expected arrays written by turgor", reason) from None
    digest = arrays.pop(DIGEST, None)
    if digest is None and checksum:
        raise InvalidInput(f"{path}: expected arrays written by turgor", "no checksum")
    if digest is not None and not np.array_equal(digest, _digest(arrays)):
        raise InvalidInput(f"{path}: expected the arrays that turgor wrote", "others: the checksum differs")
    return arrays


def _check_members(archive: zipfile.ZipFile, size: int) -> None:
    members = archive.infolist()
    if len({member.filename for member in members}) != len(members):
        raise ValueError("two arrays of one name")
    if any(m.compress_type != zipfile.ZIP_STORED or m.file_size != m.compress_size for m in members):
        raise ValueError("compressed arrays")
    if sum(member.file_size for member in members) > size:
        raise ValueError("arrays larger than the file")


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        if version not in headers:
            raise ValueError(f"an array of format {version}")
        shape, _, dtype = headers[version](file)
        held = member.file_size - file.tell()
    if dtype.hasobject or dtype.names or dtype.subdtype:
        raise ValueError(f"an array of {dtype}")
    if any(n < 0 for n in shape) or math.prod(int(n) for n in shape) * dtype.itemsize != held:
        raise ValueError(f"an array of shape {list(shape)} in {held} bytes")
    with archive.open(member) as file:  # to its end, so that its own checksum counts too
        return np.lib.format.read_array(io.BytesIO(file.read()), allow_pickle=False)


def _digest(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """SHA-256 of names, types, shapes and bytes, uint8 [32]."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {np.shape(arrays[name])}\n".encode())
        digest.update(array.tobytes())
    return np.frombuffer(digest.digest(), dtype=np.uint8)


# --- one writer ---------------------------------------------------------------------------------------------------


class FolderLock:
    """Keeps other processes from writing in `folder` until it is released or this process is gone, however it ends.

    Raises `InvalidInput` with the other's process id where the folder is taken.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / LOCK
        self._handle: int | None = None
        with writing(self._path):
            while self._handle is None:
                self._handle = self._open()
            for partial in folder.glob(PARTIALS):  # of a process that was killed; a picture may be drawn without lock
                if partial.suffix in OWN or time.time() - partial.stat().st_mtime > FORGOTTEN:
                    partial.unlink(missing_ok=True)

    def _open(self) -> int | None:
        """A handle that holds the lock; None where the file was removed meanwhile."""
        from filelock import lock_descriptor

        handle = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            until = time.monotonic() + PATIENCE
            while not (locked := self._lock(lock_descriptor, handle)) and time.monotonic() < until:
                time.sleep(PATIENCE / 50)
            if not locked:
                os.lseek(handle, 1, os.SEEK_SET)
                owner = os.read(handle, 200).decode(errors="replace")
                folder = self._path.parent
                raise InvalidInput(
                    f"{folder}: expected a folder that no other process writes; wait for that one, or end it",
                    f"process {describe(owner)}" if owner else "another process",
                )
            if os.fstat(handle).st_nlink == 0:
                os.close(handle)
                return None
            # the first byte is what is locked: on Windows nobody else may read it
            os.ftruncate(handle, 0)
            os.write(handle, f" {os.getpid()} on {socket.gethostname()}".encode())
        except BaseException:
            os.close(handle)
            raise
        return handle

    @staticmethod
    def _lock(lock: Any, handle: int) -> bool:
        try:
            return lock(handle, blocking=False)
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            log.warning("note: this file system has no locks; see to it yourself that one process writes a run")
            return True

    def release(self) -> None:
        """Lets others in."""
        if self._handle is not None:
            with contextlib.suppress(OSError):  # Windows keeps a file that is open
                self._path.unlink()
            os.close(self._handle)
            self._handle = None


def is_left_over(path: Path) -> bool:
    """Whether `path` is what a process that was killed leaves in its folder."""
    return path.name == LOCK or path.match(PARTIALS)
