"""Workers are rented: of this machine's cores, of a Dask cluster, of a Slurm queue. The run's state is not theirs.

Those of this machine are processes of ours that answer through a pipe: nothing listens. The scheduler that a Slurm
queue's jobs need listens, and takes only who has the keys that were made for it.
"""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import suppress
from typing import IO, Any

from vaneloop.base.child import python
from vaneloop.base.errors import InputError, meant
from vaneloop.base.extras import needed, needs
from vaneloop.fleet.folder import Folder
from vaneloop.fleet.leases import BEATS, Me
from vaneloop.fleet.worker import work

__all__ = ["PLACES", "hired", "known", "rent"]

PLACES = "local, slurm, tcp://HOST:PORT (a Dask scheduler)"
SCHEDULERS = ("tcp://", "tls://", "ws://")
ANSWERS = 30.0  # s within which a Dask scheduler answers
HIRED = "from vaneloop.fleet.rent import hired; hired()"
LOST = 20  # workers that may end in succession with no log done between; a log that ends them is given up earlier
LEAVES = 10.0  # s that a worker has for leaving in order
MOST_SAID = 1 << 16  # bytes of a worker's answer


def known(on: str) -> None:
    """Raise InputError where ``on`` is none of the `PLACES`, or needs a package that is not installed."""
    if on not in ("local", "slurm") and not on.startswith(SCHEDULERS):
        raise InputError(f"--on {on!r} is not known{meant(on, ['local', 'slurm'])}; allowed: {PLACES}")
    if on != "local":
        needs(f"--on {on}", "distributed", *(("dask_jobqueue", "cryptography") if on == "slurm" else ()))


def rent(
    folder: Folder, on: str, workers: int, queue: dict[str, str], every: float, told: Callable[[int, int], None],
    trust: str = "", device: str = "auto",
) -> dict[str, int]:  # fmt: skip
    """Have ``workers`` processes work on the run until it is done; return how many logs came to what.

    on     one of `PLACES`
    queue  options of the Slurm queue (dask-jobqueue's SLURMCluster): queue, account, walltime, memory ...
    every  s between heartbeats
    told   function that takes chunks done and all, called every second
    trust, device  as `vaneloop.fleet.worker.work` takes them
    Raises InputError where the place cannot be reached, or a worker cannot go on (a full disk, a GPU that fails).
    """
    known(on)
    starter = Me(folder.path, every, kind="starter")
    try:
        words = (str(folder.path.resolve()), starter.name, every, trust, device)
        all_chunks = len(folder.chunks())
        step = lambda: told(len(folder.finished()), all_chunks)  # noqa: E731
        counts = _hire(folder, workers, words, step) if on == "local" else _dask(on, workers, queue, words, step)
    finally:
        starter.leave()
    total: dict[str, int] = {}
    for came in counts:
        for status, n in came.items():
            total[status] = total.get(status, 0) + n
    return total


class _Hired:
    """A worker on this machine: a process in a session of its own, so that Ctrl-C reaches only who rents it."""

    def __init__(self, words: tuple[Any, ...]):
        self.errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (as long as the process)
        self.process = subprocess.Popen(
            python(HIRED, *map(str, words)), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=self.errors,
            start_new_session=True,
        )  # fmt: skip

    def said(self) -> dict[str, Any] | None:
        """The answer of a process that has ended; None: it was killed, or failed."""
        assert self.process.stdout is not None
        with contextlib.suppress(ValueError):
            return dict(json.loads(self.process.stdout.read(MOST_SAID)))
        return None

    def last_words(self) -> str:
        """How the process ended, in words."""
        self.errors.seek(0)
        said = self.errors.read().decode("utf-8", "replace").strip().splitlines()
        code = self.process.returncode
        return f"{f'signal {-code}' if code < 0 else f'exit code {code}'}{f' ({said[-1][:160]})' if said else ''}"

    def close(self) -> None:
        """End the process, if it has not ended, and close its files."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for file in (self.process.stdout, self.errors):
            if file is not None:
                file.close()


def _hire(folder: Folder, workers: int, words: tuple[Any, ...], step: Callable[[], None]) -> list[dict[str, int]]:
    """Have processes of this machine work. One that is killed has a successor."""
    at_work = [_Hired(words) for _ in range(workers)]
    came: list[dict[str, Any]] = []
    lost, progress = 0, -1
    try:
        while at_work:
            step()
            with suppress(subprocess.TimeoutExpired):
                at_work[0].process.wait(1.0)
            for worker in [w for w in at_work if w.process.poll() is not None]:
                said, how = worker.said(), worker.last_words()
                at_work.remove(worker)
                worker.close()
                if said is not None:
                    came.append(said)
                    continue
                done = len(folder.finished()) + sum(n for _, n in folder.begun())
                lost, progress = (lost + 1 if done == progress else 1), done
                if lost > LOST:
                    raise RuntimeError(f"{lost} workers ended one after the other, the last with {how}")
                at_work.append(_Hired(words))
    finally:
        for worker in at_work:
            worker.process.send_signal(signal.SIGTERM)
        until = time.monotonic() + LEAVES
        for worker in at_work:
            with suppress(subprocess.TimeoutExpired):
                worker.process.wait(max(until - time.monotonic(), 0.0))
            worker.close()
    for said in came:
        if "refused" in said:
            raise InputError(str(said["refused"]))
    return [dict(said["came"]) for said in came]


def hired() -> None:
    """Work on a run as a process of `_hire`, and answer with a line. The words: run, starter, s between heartbeats,
    trust, device.
    """
    run, starter, every, trust, device = sys.argv[1:6]
    try:
        said: dict[str, Any] = {"came": _work(run, starter, float(every), trust, device)}
    except InputError as e:
        said = {"refused": str(e)}
    print(json.dumps(said), flush=True)


def _dask(
    on: str, workers: int, queue: dict[str, str], words: tuple[Any, ...], step: Callable[[], None]
) -> list[dict[str, int]]:
    """Have workers of a Dask scheduler work."""
    import dask
    from dask.distributed import Client, wait

    # the run's own leases see to lost work: a worker that dies is no reason to give its task up
    dask.config.set({
        "distributed.scheduler.allowed-failures": 1_000_000, "distributed.worker.daemon": False,
        "distributed.scheduler.http.routes": [],  # pages that anybody could read
    })  # fmt: skip
    cluster, client = None, None
    try:
        cluster = _cluster(on, workers, queue, words[0])
        try:
            client = Client(cluster if cluster is not None else on, timeout=ANSWERS)
        except (OSError, ValueError) as e:
            raise InputError(f"--on {on}: no Dask scheduler answers ({type(e).__name__})") from None
        tasks = [client.submit(_work, *words, key=f"fleet-{words[1]}-{i}", pure=False) for i in range(workers)]
        while not all(t.done() for t in tasks):
            step()
            with suppress(TimeoutError, CancelledError):
                wait(tasks, timeout=1.0)
        return [_result(t) for t in tasks]
    finally:
        for rented in (client, cluster):
            if rented is not None:
                rented.close()


def _result(task: Any) -> dict[str, int]:
    """What a task gave back. An InputError of the worker passes; another error is ours to mend."""
    try:
        return dict(task.result())
    except CancelledError:
        raise InputError("the Dask scheduler has gone; what is done is kept, run the same command again") from None


def _cluster(on: str, workers: int, queue: dict[str, str], run: str) -> Any:
    """A cluster of our own, whose scheduler and workers know each other by keys that are made for it; None: ``on``
    names one that is there. The keys' files, which only the user can read, lie in the run's folder while it lasts.
    """
    if on.startswith(SCHEDULERS):
        return None
    from distributed.security import Security

    options = {
        "cores": 1, "processes": 1, "memory": "4GB", "walltime": "08:00:00", **queue,
        "security": Security.temporary(), "shared_temp_directory": run,
        "scheduler_options": {"dashboard": False, "dashboard_address": "127.0.0.1:0"},
        "worker_extra_args": ["--no-dashboard", "--dashboard-address", "127.0.0.1:0"],
    }  # fmt: skip
    cluster = needed(f"--on {on}", "dask_jobqueue").SLURMCluster(**options)
    cluster.scale(jobs=workers)
    return cluster


def _work(run: str, starter: str, every: float, trust: str, device: str) -> dict[str, int]:
    """Work on the run, in a process of the cluster."""
    return work(run, starter=starter, every=every, patience=BEATS * every, trust=trust, device=device)
