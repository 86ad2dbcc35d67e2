"""Where images are segmented: in a process of its own (live and in the field), or here (tests, small tools).

One image at a time. Nothing here waits unless it is asked to.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Protocol

from artemis_edge.errors import RunError, UserError
from artemis_edge.segmentation.backend import Backend, Prompt, Segmentation
from artemis_edge.segmentation.trial import decode

# The network may have what the mapping leaves: it is late by design.
_NICENESS = 10
_STOP_S = 2.0
_START_S = 60.0


@dataclass(frozen=True, slots=True)
class Job:
    """A photograph, still encoded, and what to look for in it."""

    encoded: bytes
    prompts: tuple[Prompt, ...]


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a job: None and a sentence where the photograph could not be used. ``cpu_ms`` it took."""

    segmentation: Segmentation | None
    cpu_ms: float
    fault: str = ""


def run_job(backend: Backend, job: Job) -> Result:
    """One photograph through a backend; a fault is a result, not an exception: it costs one mask."""
    start = time.process_time()
    fault, found = "", None
    try:
        image = decode(job.encoded)
        if image is None:
            fault = "the photograph cannot be decoded"
        else:
            found = backend.segment(image, job.prompts)
    except UserError as error:
        fault = str(error)
    except Exception as error:  # whatever a library makes of an odd photograph
        fault = f"the network failed on the photograph ({type(error).__name__}: {error})"
    return Result(found, (time.process_time() - start) * 1e3, fault)


class Engine(Protocol):
    """Segments one image at a time."""

    @property
    def busy(self) -> bool:
        """Whether a job is under way or its result was not fetched yet."""
        ...

    def submit(self, job: Job) -> None:
        """Hand over a job; only when not busy."""
        ...

    def fetch(self, wait: bool) -> Result | None:
        """The result of the job, if it is done or ``wait``. Raises RunError where the engine has failed."""
        ...

    def close(self) -> None:
        """End it."""
        ...


class HereEngine:
    """Segments in this process when the result is fetched; for tests and tools that wait anyway."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._job: Job | None = None

    @property
    def busy(self) -> bool:
        """Whether a job waits to be fetched."""
        return self._job is not None

    def submit(self, job: Job) -> None:
        """Keep the job."""
        self._job = job

    def fetch(self, wait: bool) -> Result | None:
        """Do it now."""
        job, self._job = self._job, None
        return None if job is None else run_job(self._backend, job)

    def close(self) -> None:
        """Nothing to end."""


class ProcessEngine:
    """A process with the network, joined by a pipe. A crash of it costs masks, nothing else.

    A thread carries jobs and results over the pipe: a photograph is larger than the pipe's buffer, and the process
    at the other end may have to wait for its turn on the CPU. The thread sleeps in system calls; the caller never does.
    """

    def __init__(self, opener: Callable[[], Backend]) -> None:
        """``opener`` makes the backend, in the process; it is a function that can be pickled."""
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, opener), name="segmentation", daemon=True
        )
        self._process.start()
        theirs.close()
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._results: queue.SimpleQueue[Result | str | RunError] = queue.SimpleQueue()
        self._busy = self._starting = True
        self._fault: RunError | None = None
        self._carrier = threading.Thread(target=self._carry, name="segmentation pipe", daemon=True)
        self._carrier.start()

    @property
    def busy(self) -> bool:
        """Whether it starts, a job is under way or its result was not fetched yet."""
        return self._busy

    @property
    def process_id(self) -> int:
        """Of the process with the network."""
        return self._process.pid or 0

    def wait_until_ready(self) -> None:
        """Wait for the network to be loaded; raises RunError with its sentence where it cannot be."""
        try:
            self._take(self._results.get(timeout=_START_S) if self._starting else "")
        except queue.Empty:
            raise RunError(
                f"the segmentation process did not start within {_START_S:.0f} s; try again"
            ) from None

    def submit(self, job: Job) -> None:
        """Hand over a job; only when not busy."""
        self._busy = True
        self._jobs.put(job)

    def fetch(self, wait: bool) -> Result | None:
        """The result, if it is there or ``wait``; None while it starts, or where nothing is under way."""
        if self._fault is not None:
            raise self._fault
        if not self._busy:
            return None
        try:
            return self._take(self._results.get(block=wait))
        except queue.Empty:
            return None

    def close(self) -> None:
        """Ask the process to end, and end it where it does not."""
        self._jobs.put(None)
        self._process.join(0.0 if self._busy else _STOP_S)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join(_STOP_S)
        self._carrier.join(_STOP_S)
        self._pipe.close()

    def _take(self, item: Result | str | RunError) -> Result | None:
        """A result; the word that it has started, with a sentence where it could not; or the fault that ended it."""
        if isinstance(item, RunError):
            self._fault = item
            raise item
        self._busy = False
        if isinstance(item, Result):
            return item
        self._starting = False
        if item:
            raise RunError(item)
        return None

    def _carry(self) -> None:
        """The life of the thread."""
        try:
            self._results.put(self._pipe.recv())
            while (job := self._jobs.get()) is not None:
                self._pipe.send(job)
                self._results.put(self._pipe.recv())
            self._pipe.send(None)
        except (EOFError, OSError):
            self._process.join(_STOP_S)
            code = self._process.exitcode
            self._results.put(
                RunError(
                    f"the segmentation process ended (exit code {code}); the map goes on without new masks"
                )
            )


def _serve(pipe: Connection, opener: Callable[[], Backend]) -> None:
    """The life of the process: load, say so, then jobs until None or the end of the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us in its own time
    os.nice(_NICENESS)
    try:
        backend = opener()
    except UserError as error:
        pipe.send(str(error))
        return
    pipe.send("")
    try:
        while isinstance(job := pipe.recv(), Job):
            pipe.send(run_job(backend, job))
    except (EOFError, OSError):
        return
