"""Connections: from `--cluster ADDRESS` to a Dask client."""

from __future__ import annotations

import contextlib
import importlib
import logging
from collections.abc import Generator
from typing import TYPE_CHECKING, Any

from turgor.errors import InvalidInput, describe

if TYPE_CHECKING:
    from distributed import Client

LOCAL = "local:"  # N workers on this machine
SCHEMES = ("tcp://", "tls://")
CONNECT_TIMEOUT = 10.0  # [s]
CLOSE_TIMEOUT = 3.0  # [s]
# Ctrl-C reaches every process of a terminal; what it means is the first one's to say
IGNORE_INTERRUPT = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"


@contextlib.contextmanager
def connect(address: str) -> Generator[Client]:
    """A Dask `Client` of the scheduler at `address`, "tcp://HOST:PORT", or of "local:N": N workers of one thread here,
    which end with the block.

    Raises `InvalidInput` for another address, one where no scheduler answers, or where Dask is not installed.
    """
    count = _check_address(address)
    distributed = load_dask()
    _quieten()
    with contextlib.ExitStack() as open_until_the_end:
        if count is None:
            client = _client_of(distributed, address)
        else:
            cluster = open_until_the_end.enter_context(_local_cluster(distributed, count))
            client = distributed.Client(cluster, set_as_default=False)
        try:
            yield client
        finally:
            with contextlib.suppress(TimeoutError):
                client.close(timeout=CLOSE_TIMEOUT)


def load_dask() -> Any:
    """The package `distributed`; raises `InvalidInput` where it is not installed."""
    try:
        return importlib.import_module("distributed")
    except ModuleNotFoundError as error:
        expected = "cluster: expected Dask's distributed; pip install 'turgor[cluster]' brings it"
        raise InvalidInput(expected, f"no module {error.name}") from None


def check_client(executor: Any) -> Client:
    """`executor`, if it is a Dask `Client` in use; raises `InvalidInput` otherwise."""
    client = load_dask().Client
    if not isinstance(executor, client) or executor.asynchronous:
        raise InvalidInput(
            "executor: expected a Dask Client (distributed.Client, not asynchronous)", describe(executor)
        )
    if executor.status != "running":
        raise InvalidInput("executor: expected a Dask Client that is connected", f"one that is {executor.status}")
    return executor


def _quieten() -> None:
    """Leaves it to turgor to tell what happens to the cluster: Dask's own lines would stand between its."""
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)


def _check_address(text: str) -> int | None:
    """The number of workers in "local:N", None for a scheduler's address; raises `InvalidInput`."""
    host, _, port = text.partition("://")[2].rpartition(":")
    if text.startswith(SCHEMES) and host and port.isdecimal():
        return None
    workers = text.removeprefix(LOCAL)
    if not text.startswith(LOCAL) or not workers.isdecimal() or int(workers) < 1:
        raise InvalidInput(
            "cluster: expected a scheduler, tcp://HOST:PORT, or local:N for N workers here", describe(text)
        )
    return int(workers)


def _client_of(distributed: Any, address: str) -> Client:
    try:
        return distributed.Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, RuntimeError) as error:
        reason = describe(error.__cause__ or error) or f"no answer for {CONNECT_TIMEOUT:g} s"
        raise InvalidInput(f"cluster: expected a Dask scheduler at {address} (dask scheduler)", reason) from None


def _local_cluster(distributed: Any, count: int) -> Any:
    return distributed.LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",  # else Dask asks the network which address this machine has
        dashboard_address="127.0.0.1:0",
        worker_dashboard_address="127.0.0.1:0",
        scheduler_kwargs={"dashboard": False},
        preload=IGNORE_INTERRUPT,
        silence_logs=logging.CRITICAL,
    )
