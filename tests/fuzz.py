"""Fuzzing in numbers: many inputs, in processes that are watched.

    python tests/fuzz.py --inputs 100000              over all targets, each its share
    python tests/fuzz.py --inputs 5000 --only theta   one of them
    python tests/fuzz.py --replay FILE                one that failed, again

A failure is an exception other than `InvalidInput`, a command that says more than a line, an input that takes longer
than `SLOWEST` seconds, a crash, or memory above `MEMORY`. Each is kept as a file. The process that tries inputs may
not allocate more than `MEMORY` beyond what it has when it starts.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import logging
import multiprocessing
import sys
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

SLOWEST = 5.0  # [s]
MEMORY = 1_000_000_000  # [byte]
# of 100 inputs, what each target gets
SHARES = {
    "run.json": 14, "history.csv": 5, "champion.npz": 9, "checkpoint.npz": 5, "command": 5, "message": 35, "visit": 0.3,
    "request": 1.7, "task": 17, "replay": 4, "theta": 4,
}  # fmt: skip


def work(name: str, seed: int, first: int, last: int, place: str) -> None:
    """Tries inputs `first` to `last`; the process ends where one hangs or crashes it. Writes a line for each failure
    and, in the end, the numbers."""
    from fuzzing import TARGETS, corpus, input_of, try_input

    target, folder = TARGETS[name], Path(place)
    warnings.simplefilter("error")
    logging.disable()  # what is taken from elsewhere is told in lines
    corpus()
    for k in range(3):  # whatever is loaded or compiled once
        _quietly(try_input, target, input_of(target, -1, k))
    _limit_memory()
    counts = {"inputs": 0, "accepted": 0, "refused": 0, "slowest": 0.0, "slowest_input": 0, "peak": 0}
    log = open(folder / f"{name}.log", "a", encoding="utf-8")  # noqa: SIM115
    for k in range(first, last):
        (folder / f"{name}.at").write_text(str(k))
        data = input_of(target, seed, k)
        (folder / f"{name}.now").write_bytes(data)
        faulthandler.dump_traceback_later(4 * SLOWEST, exit=True, file=log)
        began = time.perf_counter()
        try:
            counts["accepted" if try_input(target, data) else "refused"] += 1
        except Exception as error:
            _keep(folder, name, k, data, "".join(traceback.format_exception(error)))
        took = time.perf_counter() - began
        faulthandler.cancel_dump_traceback_later()
        if took > SLOWEST:
            _keep(folder, name, k, data, f"took {took:.1f} s")
        if took > counts["slowest"]:
            counts["slowest"], counts["slowest_input"] = took, k
        counts["inputs"] += 1
        if k % 50 == 0 or k == last - 1:
            counts["peak"] = max(counts["peak"], _peak())
            (folder / f"{name}-{first}.counts").write_text(json.dumps(counts))
    log.close()
    if counts["peak"] > MEMORY:
        _keep(folder, name, last, b"", f"memory of {counts['peak'] / 1e6:.0f} MB")


def _quietly(call: Any, *arguments: Any) -> None:
    with contextlib.suppress(Exception):  # tried again where it counts
        call(*arguments)


def _limit_memory() -> None:
    try:
        import resource
    except ImportError:  # Windows: the peak is looked at in the end
        return
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    if pages:
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, -1))


def _peak() -> int:
    """Most memory that this process has had [byte]."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _keep(folder: Path, name: str, k: int, data: bytes, reason: str) -> None:
    stem = folder / f"failure-{name}-{k}"
    stem.with_name(stem.name + ".input").write_bytes(data)
    stem.with_name(stem.name + ".txt").write_text(reason, errors="backslashreplace")


def fuzz(name: str, seed: int, inputs: int, folder: Path) -> dict[str, Any]:
    """The numbers of a target, over as many processes as it takes."""
    first, context = 0, multiprocessing.get_context("spawn")
    while first < inputs:
        process = context.Process(target=work, args=(name, seed, first, inputs, str(folder)))
        process.start()
        process.join()
        if process.exitcode == 0:
            break
        at = folder / f"{name}.at"
        k = int(at.read_text()) if at.exists() else -1
        if k < first:
            raise SystemExit(f"{name}: could not start")
        _keep(folder, name, k, (folder / f"{name}.now").read_bytes(), f"ended the process: {process.exitcode}")
        first = k + 1
    parts = [json.loads(path.read_text()) for path in folder.glob(f"{name}-*.counts")]
    sums = {key: sum(part[key] for part in parts) for key in ("inputs", "accepted", "refused")}
    slowest = max(parts, key=lambda part: part["slowest"])
    failures = len(list(folder.glob(f"failure-{name}-*.txt")))
    return {**sums, "slowest": slowest["slowest"], "peak": max(part["peak"] for part in parts), "failures": failures}


def main() -> int:
    """Exit status: 1 where there are failures."""
    parser = argparse.ArgumentParser(description="Try hostile inputs.")
    parser.add_argument("--inputs", type=int, default=10_000, help="over all targets (default: 10000)")
    parser.add_argument("--only", nargs="+", choices=SHARES, help="these targets alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("fuzz"), help="where failures are kept (default: fuzz)")
    parser.add_argument("--replay", type=Path, help="try the input in this file again, with its traceback")
    options = parser.parse_args()
    if options.replay is not None:
        from fuzzing import TARGETS, try_input

        name = options.replay.name.removeprefix("failure-").rpartition("-")[0]
        print("accepted" if try_input(TARGETS[name], options.replay.read_bytes()) else "refused")
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    names = options.only or list(SHARES)
    total = sum(SHARES[name] for name in names)
    failed = 0
    print(
        f"{'target':<15}{'inputs':>8}{'refused':>9}{'accepted':>9}{'slowest [ms]':>14}{'peak [MB]':>11}{'failures':>10}"
    )
    for name in names:
        found = fuzz(name, options.seed, round(options.inputs * SHARES[name] / total), options.out)
        failed += found["failures"]
        print(
            f"{name:<15}{found['inputs']:>8}{found['refused']:>9}{found['accepted']:>9}{1e3 * found['slowest']:>14.0f}"
            f"{found['peak'] / 1e6:>11.0f}{found['failures']:>10}",
            flush=True,
        )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
