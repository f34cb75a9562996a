"""Workers are rented: of this machine's cores, of a Dask cluster, of a Slurm queue. The run's state is not theirs."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import suppress
from typing import Any

from vaneloop.base.errors import InputError, meant
from vaneloop.base.extras import needed, needs
from vaneloop.fleet.folder import Folder
from vaneloop.fleet.leases import BEATS, Me

__all__ = ["PLACES", "known", "rent"]

PLACES = "local, slurm, tcp://HOST:PORT (a Dask scheduler)"
SCHEDULERS = ("tcp://", "tls://", "ws://")
ANSWERS = 30.0  # s within which a Dask scheduler answers


def known(on: str) -> None:
    """Raise InputError where ``on`` is none of the `PLACES`."""
    if on not in ("local", "slurm") and not on.startswith(SCHEDULERS):
        raise InputError(f"--on {on!r} is not known{meant(on, ['local', 'slurm'])}; allowed: {PLACES}")


def rent(
    folder: Folder, on: str, workers: int, queue: dict[str, str], every: float, told: Callable[[int, int], None]
) -> dict[str, int]:
    """Have ``workers`` processes work on the run until it is done; return how many logs came to what.

    on     one of `PLACES`
    queue  options of the Slurm queue (dask-jobqueue's SLURMCluster): queue, account, walltime, memory ...
    every  s between heartbeats
    told   function that takes chunks done and all, called every second
    Raises InputError where the place cannot be reached, or a worker cannot go on (a full disk).
    """
    needs(f"--on {on}", "distributed")
    import dask
    from dask.distributed import Client, wait

    # the run's own leases see to lost work: a worker that dies is no reason to give its task up
    dask.config.set({"distributed.scheduler.allowed-failures": 1_000_000, "distributed.worker.daemon": False})
    starter = Me(folder.path, every, kind="starter")
    cluster, client = None, None
    try:
        cluster = _cluster(on, workers, queue)
        try:
            client = Client(cluster if cluster is not None else on, timeout=ANSWERS)
        except (OSError, ValueError) as e:
            raise InputError(f"--on {on}: no Dask scheduler answers ({type(e).__name__})") from None
        run = str(folder.path.resolve())
        tasks = [
            client.submit(_work, run, starter.name, every, key=f"fleet-{starter.name}-{i}", pure=False)
            for i in range(workers)
        ]
        all_chunks = len(folder.chunks())
        while not all(t.done() for t in tasks):
            told(len(folder.finished()), all_chunks)
            with suppress(TimeoutError, CancelledError):
                wait(tasks, timeout=1.0)
        counts: dict[str, int] = {}
        for task in tasks:
            for status, n in _result(task).items():
                counts[status] = counts.get(status, 0) + n
        return counts
    finally:
        starter.leave()
        for rented in (client, cluster):
            if rented is not None:
                rented.close()


def _result(task: Any) -> dict[str, int]:
    """What a task gave back. An InputError of the worker passes; another error is ours to mend."""
    try:
        return dict(task.result())
    except CancelledError:
        raise InputError("the Dask scheduler has gone; what is done is kept, run the same command again") from None


def _cluster(on: str, workers: int, queue: dict[str, str]) -> Any:
    """A cluster of our own; None: ``on`` names one that is there."""
    known(on)
    if on.startswith(SCHEDULERS):
        return None
    if on == "local":
        from dask.distributed import LocalCluster

        # each worker's logs are read in a process of its own, whose memory is not Dask's to count
        return LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, memory_limit=0, silence_logs=logging.CRITICAL,
            dashboard_address="127.0.0.1:0",  # any port: without one Dask takes 8787, and warns where that is taken
        )  # fmt: skip
    options = {"cores": 1, "processes": 1, "memory": "4GB", "walltime": "08:00:00", **queue}
    cluster = needed(f"--on {on}", "dask_jobqueue").SLURMCluster(**options)
    cluster.scale(jobs=workers)
    return cluster


def _work(run: str, starter: str, every: float) -> dict[str, int]:
    """Work on the run, in a process of the cluster."""
    from vaneloop.fleet.worker import work

    return work(run, starter=starter, every=every, patience=BEATS * every)
