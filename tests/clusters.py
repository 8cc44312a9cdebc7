"""Real clusters for the tests: a scheduler and workers, each a process of its own, on this machine alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


class RealCluster:
    """`dask scheduler` and some `dask worker`s, whose processes can be killed, stopped and joined by others."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []
        self._file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--port", "0", "--scheduler-file", str(self._file))
        wait_until(lambda: self._file.exists() and self._file.read_text().endswith("}"))  # Dask writes it in place
        self.address: str = json.loads(self._file.read_text())["address"]

    def __enter__(self) -> RealCluster:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.wait()

    def add_worker(self, environment: Mapping[str, str] | None = None, threads: int = 1) -> subprocess.Popen[bytes]:
        """One more worker, named by its process's number; it has joined some time later."""
        options = ("--no-nanny", "--nthreads", str(threads), "--local-directory", str(self._folder))
        return self._start("worker", self.address, *options, environment=environment)

    def _start(self, kind: str, *options: str, environment: Mapping[str, str] | None = None) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "dask", kind, *options, "--host", "127.0.0.1", "--no-dashboard"]
        log = open(self._folder / f"{kind}{len(self._processes)}.log", "wb")  # noqa: SIM115
        process = subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, **(environment or {})})
        log.close()
        self._processes.append(process)
        return process


def once_at_work(client: Any, process: subprocess.Popen[bytes], then: Callable[[], object]) -> threading.Thread:
    """Does `then`, in another thread, as soon as the worker in `process` has something to do."""

    def watch() -> None:
        address = address_of(client, process)
        wait_until(lambda: client.processing().get(address))
        then()

    thread = threading.Thread(target=watch)
    thread.start()
    return thread


def address_of(client: Any, process: subprocess.Popen[bytes]) -> str:
    """Of the worker in `process`."""
    return {pid: address for address, pid in client.run(os.getpid).items()}[process.pid]


def wait_until(true: Callable[[], object], seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.02)


def errors_of(stderr: str) -> str:
    """What a command said on stderr, apart from a notice of the engine's, which a busy machine brings about."""
    lines = stderr.splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith("turgor: compiling the engine"))
