"""Kernels compiled in processes of their own: the compiler's memory goes with them.

Compiling takes 300 MB that a process never gives back (measured: 1415 MB at the peak of a 20-minute walk where it
compiled for itself, 1084 MB where the kernels came from the cache). It happens once for an installation and a kind
of input; what is compiled is kept in the cache of ``_jit``. Odometry and map are compiled side by side: 30 and 90 s
of the 118 s that one process takes for both.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Sequence
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from artemis_edge._jit import cache_dir, sources_hash
from artemis_edge.errors import UserError
from artemis_edge.frames import FrameSource, Odometry, SyncedFrame, Trajectory

if TYPE_CHECKING:
    from artemis_edge.runtime import Request

_FRAMES, _AFTER_OTHERS = 3, 19
ODOMETRY, MAP = "odometry", "map"


class Compilation:
    """Processes that compile; ``marker`` is left where all of them came to their end."""

    def __init__(self, children: Sequence[SpawnProcess], marker: Path) -> None:
        self._children, self._marker = children, marker
        for child in children:
            child.start()

    def working(self) -> bool:
        """Whether it is not at its end yet."""
        return any(child.is_alive() for child in self._children)

    def wait(self) -> None:
        """Until everything is compiled; where that fails, the run compiles for itself."""
        for child in self._children:
            child.join()
        if all(child.exitcode == 0 for child in self._children):
            with contextlib.suppress(OSError):  # then it is compiled again another time
                self._marker.parent.mkdir(parents=True, exist_ok=True)
                self._marker.touch()


def compile_ahead(request: Request, source: FrameSource, span: range) -> None:
    """Compile for this kind of input, unless that was done; where it fails, the run compiles for itself."""
    begin(request, source, span).wait()


def begin(request: Request, source: FrameSource, span: range) -> Compilation:
    """As :func:`compile_ahead`, in the background."""
    own = request.estimates(source)
    marker = cache_dir() / f"compiled-{_kind(request, source, span, own)}"
    parts = () if marker.exists() else (MAP, ODOMETRY) if own else (MAP,)
    make = multiprocessing.get_context("spawn").Process
    return Compilation([make(target=_compile, args=(request, part), daemon=True) for part in parts], marker)


def _kind(request: Request, source: FrameSource, span: range, own: bool) -> str:
    """What decides which kernels are compiled: the types in the first frame and where its pose comes from."""
    try:
        frame = next(iter(source.frames(span.start, span.start + 1)), None)
    except UserError:
        frame = None
    poses = "own" if own else "given"
    text = f"{sources_hash()} {sys.version} {poses} {_types(frame)} {bool(request.queries)}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _types(frame: SyncedFrame | None) -> list[tuple[object, ...]]:
    if frame is None:
        return []
    scans = [(s.points.dtype, s.offset_s is None, s.intensity is None) for s in frame.scans]
    return [*scans, (len(frame.images) > 0, len(frame.imu.stamp_ns) > 0)]


def _compile(request: Request, part: str) -> None:
    """The child, of which only the cache remains."""
    from artemis_edge import runtime
    from artemis_edge.datasets import open_input

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if part == ODOMETRY:
        os.nice(_AFTER_OTHERS)  # the map takes three times as long: what else there is shares the other core
    try:
        source = open_input(request.input, request.config.input)
        span = runtime.frame_span(source, request)
        odometry = runtime.choose_odometry(source, request, span)
        if part == ODOMETRY:
            _track(odometry(), source, span)
        else:
            _map(request, _still(source) if request.estimates(source) else odometry, source, span)
    except UserError:  # which the run itself will meet and tell
        sys.exit(1)


def _track(odometry: Odometry, source: FrameSource, span: range) -> None:
    for frame in source.frames(span.start, min(span.start + _FRAMES, span.stop)):
        odometry.track(frame)


def _map(request: Request, odometry: Callable[[], Odometry], source: FrameSource, span: range) -> None:
    """The map as ``runtime.warm_up_run`` makes it."""
    import tempfile

    from artemis_edge import runtime

    with tempfile.TemporaryDirectory(prefix="artemis-compile-") as name:
        runtime.warm_up_here(
            request.config, odometry, Path(name), source, span, runtime.warm_pipeline(request)
        )


def _still(source: FrameSource) -> Callable[[], Odometry]:
    """Poses that need no estimation."""
    from artemis_edge.odometry.given_poses import GivenPoses

    stamps = np.asarray(source.stamp_ns, np.int64)
    still = GivenPoses(Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1))))
    return lambda: still
