"""``reprocess --cluster``: a batch on the workers of a Dask cluster (dask.distributed, extra ``cluster``).

A worker starts the same process for a recording as a batch on one machine does (batch_child.py), so that the results
are the same bytes. Dask gives what a lost worker had to another one. Recordings and results are where all workers see
them under one path: a shared folder.
"""

from __future__ import annotations

import contextlib
import gc
import signal
import time
import uuid
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec

from artemis_edge.batch import overall
from artemis_edge.batch_child import Child, Done, Task
from artemis_edge.errors import InputError
from artemis_edge.progress import progress, say
from artemis_edge.runtime import Request
from artemis_edge.session.results import prepare, remove_empty

_CONNECT_S = 10.0
_LOOK_S = 0.5
_TOLD_S = 1.0


def on_cluster(address: str, requests: Sequence[Request], plain: bool) -> list[Done]:
    """How each request ended, in their order. Raises InputError where the cluster cannot do them at all."""
    made = {request.out: prepare(request.out) for request in requests}
    try:
        with _connected(address) as client:
            _require_workers(client, address, requests)
            done = _all_done(Batch(client, requests), plain)
        for request, ended in zip(requests, done, strict=True):
            if not ended.error:
                del made[request.out]
        return done
    finally:
        remove_empty(folder for folders in made.values() for folder in folders)


def _all_done(batch: Batch, plain: bool) -> list[Done]:
    with progress(f"mapping {len(batch.shares)} recordings on the cluster", plain) as report:
        while not batch.over:
            try:
                batch.look()
                report(*overall(batch.shares))
                time.sleep(_LOOK_S)
            except KeyboardInterrupt:
                batch.stop()
    return batch.results


class Batch:
    """The requests as tasks of a client; ``look`` often. ``shares`` 0..1 of each, ``results`` once ``over``."""

    def __init__(self, client: Any, requests: Sequence[Request]) -> None:
        from distributed import Event

        name = f"artemis-edge-{uuid.uuid4().hex}"
        self._requests = requests
        self._stopped = Event(name, client=client)
        self._asked = 0
        self._attempts = [0] * len(requests)
        self.shares = [0.0] * len(requests)
        self._done: dict[int, Done] = {}
        client.subscribe_topic(name, self._hear)
        self._futures = [
            client.submit(
                work, _text(Task.of(request, signal.SIGKILL)), k, name, key=f"{name}-{k}", pure=False
            )
            for k, request in enumerate(requests)
        ]

    @property
    def over(self) -> bool:
        """Whether all have ended."""
        return len(self._done) == len(self._requests)

    @property
    def results(self) -> list[Done]:
        """How each ended."""
        return [self._done[k] for k in range(len(self._requests))]

    def look(self) -> None:
        """Take what has ended."""
        for k, future in enumerate(self._futures):
            if k not in self._done and future.done():
                self._done[k] = self._ended(future)
                self.shares[k] = 1.0
                say(f"{self._requests[k].input.name}: {self._done[k].error or 'done'}")

    def stop(self) -> None:
        """As Ctrl-C here: what is mapped is saved; a second time nothing is waited for."""
        self._asked += 1
        if self._asked == 1:
            say("stopping after this frame; what is mapped is kept (once more to stop at once)")
            self._stopped.set()
            return
        for k, future in enumerate(self._futures):
            future.cancel()
            self._done.setdefault(k, Done(error="interrupted", code=1))

    def _ended(self, future: Any) -> Done:
        if future.status == "finished":
            return msgspec.convert(future.result(), Done)
        if future.status == "cancelled":
            return Done(error="the scheduler forgot it; see whether it still runs", code=1)
        fault = future.exception()
        if type(fault).__name__ == "KilledWorker":
            return Done(error="every worker that mapped it died; see how much memory they have", code=1)
        return Done(error=f"its worker failed ({fault}); see the worker's log", code=1)

    def _hear(self, event: tuple[float, Any]) -> None:
        """What the workers tell, in a thread of the client's."""
        told = event[1]
        k = int(told["number"])
        if told.get("begins"):  # Dask adds the worker's address to every message
            self._attempts[k] += 1
            if self._attempts[k] > 1:
                say(f"{self._requests[k].input.name}: its worker is gone; done again by {told['worker']}")
        self.shares[k] = min(float(told.get("share", 0.0)), 0.99)


def work(text: str, number: int, name: str) -> dict[str, Any]:
    """On a worker: map one recording in a process of its own; returns a Done as plain values."""
    from distributed import Event, get_worker

    worker = get_worker()
    worker.log_event(name, {"number": number, "begins": True})
    child = Child(msgspec.json.decode(text, type=Task))
    stopped, asked, told = Event(name), False, time.monotonic()
    while child.result is None:
        time.sleep(_LOOK_S)
        now = time.monotonic()
        if now - told > _TOLD_S:
            told, (done, total, _) = now, child.progress
            worker.log_event(name, {"number": number, "share": done / total if total else 0.0})
            if not asked and _is_set(stopped):
                asked = True
                child.stop()
    plain: dict[str, Any] = msgspec.to_builtins(child.result)
    return plain


def _is_set(event: Any) -> bool:
    with contextlib.suppress(OSError, TimeoutError):  # the scheduler is busy, or gone
        return bool(event.is_set())
    return False


def _text(task: Task) -> str:
    return msgspec.json.encode(task).decode()


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """A client that could not connect must not be collected while another starts: it would wait for its lock."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--cluster needs the extra 'cluster': pip install 'artemis-edge[cluster]'") from None
    try:
        with _no_collection():
            client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError):
        raise InputError(
            f"no Dask scheduler answers at {address}; start one with 'dask scheduler' and workers with "
            f"'dask worker {address}'"
        ) from None
    except TypeError as error:  # how Dask says that a protocol is not installed or not configured
        raise InputError(
            f"--cluster {address}: Dask cannot use this protocol here ({error}); give tcp://HOST:PORT, or configure "
            "Dask for it"
        ) from None
    try:
        yield client
    finally:
        client.close()


def _require_workers(client: Any, address: str, requests: Sequence[Request]) -> None:
    """Some workers, with this version of the program, that see the same folders."""
    needed = (path for r in requests for path in (r.input, r.out, r.poses, r.go_on) if path is not None)
    paths = sorted({str(path.resolve()) for path in needed})
    if not client.scheduler_info()["workers"]:
        raise InputError(f"the cluster at {address} has no workers; start some with 'dask worker {address}'")
    try:
        found: dict[str, tuple[str, list[str]]] = client.run(_look, paths)
    except ModuleNotFoundError:
        raise InputError("a worker has no artemis-edge; install the same version with every worker") from None
    ours = metadata.version("artemis-edge")
    for worker, (version, missing) in sorted(found.items()):
        if version != ours:
            raise InputError(
                f"the worker {worker} has artemis-edge {version}, this is {ours}; install the same"
            )
        if missing:
            raise InputError(
                f"the worker {worker} does not see {missing[0]}; give paths of a folder that all machines share"
            )


def _look(paths: list[str]) -> tuple[str, list[str]]:
    """On a worker: its version, and which paths it does not see."""
    return metadata.version("artemis-edge"), [path for path in paths if not Path(path).exists()]
