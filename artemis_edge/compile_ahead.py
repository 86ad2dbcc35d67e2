"""Kernels compiled in a process of its own: the compiler's memory goes with it.

Compiling takes 300 MB that a process never gives back (measured: 1415 MB at the peak of a 20-minute walk where it
compiled for itself, 1084 MB where the kernels came from the cache). It happens once for an installation and a kind
of input; what is compiled is kept in the cache of ``_jit``.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from artemis_edge._jit import cache_dir
from artemis_edge.errors import UserError
from artemis_edge.frames import FrameSource, SyncedFrame

if TYPE_CHECKING:
    from artemis_edge.runtime import Request


def compile_ahead(request: Request, source: FrameSource, span: range) -> None:
    """Compile for this kind of input, unless that was done; where it fails, the run compiles for itself."""
    marker = cache_dir() / f"compiled-{_kind(request, source, span)}"
    if marker.exists():
        return
    child = multiprocessing.get_context("spawn").Process(target=_compile, args=(request,), daemon=True)
    child.start()
    child.join()
    if child.exitcode == 0:
        with contextlib.suppress(OSError):
            marker.parent.mkdir(parents=True, exist_ok=True)
            marker.touch()


def _kind(request: Request, source: FrameSource, span: range) -> str:
    """What decides which kernels are compiled: the types in the first frame and where its pose comes from."""
    try:
        frame = next(iter(source.frames(span.start, span.start + 1)), None)
    except UserError:
        frame = None
    poses = "own" if request.own_odometry or (request.poses is None and source.poses is None) else "given"
    text = f"{sys.version} {poses} {_types(frame)} {bool(request.queries)}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _types(frame: SyncedFrame | None) -> list[tuple[object, ...]]:
    if frame is None:
        return []
    scans = [(s.points.dtype, s.offset_s is None, s.intensity is None) for s in frame.scans]
    return [*scans, (len(frame.images) > 0, len(frame.imu.stamp_ns) > 0)]


def _compile(request: Request) -> None:
    """The child: as ``runtime.warm_up_run``, of which only the cache remains."""
    import tempfile

    from artemis_edge import runtime
    from artemis_edge.datasets import open_input

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    source = open_input(request.input, request.config.input, request.config.exclusion)
    span = runtime.frame_span(source, request)
    odometry = runtime.choose_odometry(source, request, span)
    with tempfile.TemporaryDirectory(prefix="artemis-compile-") as name:
        runtime.warm_up_here(
            request.config, odometry, Path(name), source, span, runtime.warm_pipeline(request)
        )
