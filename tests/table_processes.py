"""Processes that make a table and are killed on the way; prints what came of it as JSON.

A script of its own, because it forks: `test_table` runs it in a fresh interpreter. The generator is
a stand-in that needs no JAX, whose threads do not survive a fork.
"""

import json
import os
import signal
import sys
import time
import traceback
from pathlib import Path

import numpy as np
import tqdm  # noqa: F401
import zarr  # noqa: F401

from hylios_fit import table
from hylios_fit.threads import one_blas_thread

CHUNKS = 3
STEP = 8
EVERY = 5  # of the moments at which it could be killed: before and after each rename


def stand_in(log, crowd=1):
    """Rows at once, but none before so many processes are at work (or half a minute is over)."""

    def add_rows(parameters, form):
        with open(log, "a") as file:
            file.write(f"{os.getpid()} {form} {parameters[0]}\n".replace("\n ", " "))
        end = time.monotonic() + 30.0
        while len(workers(log)) < crowd and time.monotonic() < end:
            time.sleep(0.002)
        wave = parameters.sum(axis=1)[:, None] * table.WAVELENGTHS
        return 0.5 + 0.4 * np.sin(wave), 1e-4 * (2.0 + np.cos(wave))

    return add_rows


def make(path, *sizes):
    for chunks in sizes:
        table.generate(
            path, chunks * STEP, resume=True, generator="adding", progress=False, threads=1
        )


def forked(function, *arguments):
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        function(*arguments)
        status = 0
    except BaseException:
        traceback.print_exc()
    os._exit(status)


def ended(pid):
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def killed_at(moment, function, *arguments):
    """Die before or after one of the renames by which files appear."""
    replace = os.replace
    count = 0

    def counted(source, target):
        nonlocal count
        if count == moment:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)
        if count + 1 == moment:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 2

    os.replace = counted
    function(*arguments)


def content(path):
    return {
        str(file.relative_to(path)): file.read_bytes()
        for file in path.rglob("*")
        if file.is_file() and file.suffix != ".partial"
    }


def finished(path):
    return len(list(path.glob("standard_error/c/*/0")))


def lines(log):
    return log.read_text().splitlines() if log.exists() else []


def workers(log):
    return {line.partition(" ")[0] for line in lines(log)}


def kills(folder, whole):
    """Killed at many moments, each time gone on with: chunks made twice, tables that differ."""
    found = {"moments": 0, "again": 0, "different": 0, "leftovers": 0, "failed": 0}
    for moment in range(0, 10_000, EVERY):
        path, log = folder / f"{moment}.zarr", folder / f"{moment}.log"
        table.add_rows = stand_in(log)
        status = ended(forked(killed_at, moment, make, path, 1, CHUNKS))
        if status == 0:
            break
        assert status == -signal.SIGKILL, status
        before = finished(path)
        log.unlink(missing_ok=True)
        found["failed"] += ended(forked(make, path, CHUNKS)) != 0
        found["moments"] += 1
        found["again"] += len(lines(log)) - (CHUNKS - before) * len(table.FORMS)
        found["different"] += content(path) != whole
        found["leftovers"] += (folder / f".{path.name}.new").exists()
    return found


def together(folder, whole):
    """Three at one table, one of them killed while it is at work."""
    path, log = folder / "together.zarr", folder / "together.log"
    table.add_rows = stand_in(log, crowd=3)
    begun = [forked(make, path, CHUNKS)]
    while not lines(log):
        time.sleep(0.002)
    begun += [forked(make, path, CHUNKS) for _ in range(2)]
    os.kill(begun[0], signal.SIGKILL)
    statuses = [ended(pid) for pid in begun]
    made = [line.partition(" ") for line in lines(log) if not line.startswith(f"{begun[0]} ")]
    return {
        "statuses": statuses,
        "workers": len(workers(log)) - 1,
        "made": len(made),
        "twice": len(made) - len({what for _, _, what in made}),
        "different": content(path) != whole,
    }


def main(folder):
    table.GROUPS, table.SHARE, table.WAIT = 1, 4, 0.02
    table._empty(STEP, 0, 0)  # imports what it needs, once for all forks
    one_blas_thread()
    table.add_rows = stand_in(folder / "whole.log")
    assert ended(forked(make, folder / "whole.zarr", CHUNKS)) == 0
    whole = content(folder / "whole.zarr")
    print(json.dumps({"kills": kills(folder, whole), "together": together(folder, whole)}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
