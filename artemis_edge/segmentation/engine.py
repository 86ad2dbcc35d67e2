"""Where images are segmented: in a process of its own (live and in the field), or here (tests, small tools).

One image at a time. Nothing here waits unless it is asked to: a job is handed over only to an engine that is idle,
which stands ready to take it, so that the hand-over of a photograph costs its copy and no more.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
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
    """One photograph through a backend; a fault is a result, not an exception."""
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
    """A process with the network, joined by a pipe. A crash of it costs masks, nothing else."""

    def __init__(self, opener: Callable[[], Backend]) -> None:
        """``opener`` makes the backend, in the process; it is a function that can be pickled."""
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, opener), name="segmentation", daemon=True
        )
        self._process.start()
        theirs.close()
        self._busy = False
        self._starting = True

    @property
    def busy(self) -> bool:
        """Whether it starts, a job is under way or its result was not fetched yet."""
        return self._busy or self._starting

    @property
    def process_id(self) -> int:
        """Of the process with the network."""
        return self._process.pid or 0

    def wait_until_ready(self) -> None:
        """Wait for the network to be loaded; raises RunError with its sentence where it cannot be."""
        if not self._starting:
            return
        if not self._pipe.poll(_START_S):
            raise RunError(f"the segmentation process did not start within {_START_S:.0f} s; try again")
        fault = self._receive()
        self._starting = False
        if isinstance(fault, str) and fault:
            raise RunError(fault)

    def submit(self, job: Job) -> None:
        """Send the job; the process stands in its receive call and takes it."""
        try:
            self._pipe.send(job)
            self._busy = True
        except OSError:
            raise self._gone() from None

    def fetch(self, wait: bool) -> Result | None:
        """The result, if it is there or ``wait``; None while it starts."""
        if self._starting:
            if wait or self._pipe.poll():
                self.wait_until_ready()
            return None
        if not self._busy or not (wait or self._pipe.poll()):
            return None
        result = self._receive()
        self._busy = False
        return result if isinstance(result, Result) else None

    def close(self) -> None:
        """Ask the process to end, and end it where it does not."""
        with contextlib.suppress(OSError):
            self._pipe.send(None)
        self._process.join(0.0 if self._busy else _STOP_S)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join(_STOP_S)
        self._pipe.close()

    def _receive(self) -> object:
        try:
            return self._pipe.recv()
        except (EOFError, OSError):
            raise self._gone() from None

    def _gone(self) -> RunError:
        self._process.join(_STOP_S)
        code = self._process.exitcode
        return RunError(
            f"the segmentation process ended (exit code {code}); the map goes on without new masks"
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
