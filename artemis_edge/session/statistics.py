"""What a run cost and lost, frame by frame, and its summary for ``report.json``."""

from __future__ import annotations

import platform
import resource
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

import numpy as np

from artemis_edge.frames import TrackedFrame

_PACKAGES = ("artemis-edge", "numpy", "numba", "opencv-python-headless", "scipy")
_DIGITS = 3  # of milliseconds


@dataclass(slots=True)
class RunStatistics:
    """Collected by whoever runs the pipeline, one entry a frame in each list, milliseconds.

    ``frame_ms`` wall time from the frame handed in to its delta ready; ``cpu_ms`` CPU time (user + system) of
    all threads that run the stages; ``stage_ms`` wall time by stage, in the order of the pipeline.
    ``flush_ms`` is the postponed work done once after the last frame, ``warmup_s`` what came before the first
    frame; neither is in ``frame_ms``, but ``flush_cpu_ms`` is part of the mean CPU time.
    ``frames_degenerate`` are those whose scan left a direction of travel open.
    ``frames_dropped`` were in the input and are not in the map, ``lost`` says what and why, by
    reason. ``input_hz`` 0 when the input has no rate. ``peak_rss_mb`` is measured when the report is
    written unless it is set. ``continued`` says which map was continued and where in it, ``notes`` are sentences of
    the odometry for whoever made the recording.
    """

    input_name: str = ""
    input_hz: float = 0.0
    frame_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    stage_ms: dict[str, list[float]] = field(default_factory=dict)
    flush_ms: float = 0.0
    flush_cpu_ms: float = 0.0
    warmup_s: float = 0.0
    frames_degenerate: int = 0
    frames_dropped: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    peak_rss_mb: float | None = None
    map_bytes: int = 0
    kept_bytes: int = 0
    config_toml: str = ""
    continued: Mapping[str, Any] | None = None
    notes: list[str] = field(default_factory=list)

    def add_frame(
        self,
        frame_ms: float,
        cpu_ms: float,
        stage_ms: Mapping[str, float],
        tracked: TrackedFrame | None = None,
    ) -> None:
        """One frame is done. A stage that did not run in every frame has fewer entries."""
        self.frames_degenerate += tracked is not None and tracked.degenerate
        self.frame_ms.append(frame_ms)
        self.cpu_ms.append(cpu_ms)
        for name, spent in stage_ms.items():
            self.stage_ms.setdefault(name, []).append(spent)

    def add_lost(self, lost: Mapping[str, int]) -> None:
        """Count what was lost, by reason."""
        for reason, count in lost.items():
            self.lost[reason] = self.lost.get(reason, 0) + count

    def summary(self) -> dict[str, Any]:
        """The part of ``report.json`` that is about the run (times in ms, memory in MB of 1e6 bytes)."""
        peak = peak_rss_mb() if self.peak_rss_mb is None else self.peak_rss_mb
        return {
            "input": self.input_name,
            "frames": len(self.frame_ms),
            "frames_dropped": self.frames_dropped,
            "frames_degenerate": self.frames_degenerate,
            "lost": dict(sorted(self.lost.items())),
            "frame_ms": _figures(self.frame_ms, ("p50", "p95", "p99", "mean", "max")),
            "cpu_ms": _figures(self.cpu_ms, ("p50", "mean")) | {"mean": self._cpu_mean_ms()},
            "stages": {
                name: _figures(times, ("p50", "p99", "mean")) for name, times in self.stage_ms.items()
            },
            "flush_ms": round(self.flush_ms, _DIGITS),
            "warmup_s": round(self.warmup_s, _DIGITS),
            "peak_rss_mb": round(peak, 1),
            "map_bytes": self.map_bytes,
            "kept_bytes": self.kept_bytes,
            "realtime_factor": self._realtime_factor(),
            "input_hz": round(self.input_hz, _DIGITS),
            **({} if self.continued is None else {"continued": dict(self.continued)}),
            **({"notes": self.notes} if self.notes else {}),
            "versions": versions(),
        }

    def _cpu_mean_ms(self) -> float:
        """CPU time of all frames and of the flush, divided by the frames."""
        spent_ms = sum(self.cpu_ms) + self.flush_cpu_ms
        return round(spent_ms / max(len(self.cpu_ms), 1), _DIGITS)

    def _realtime_factor(self) -> float | None:
        """How many times faster than the input all frames and the flush were; None if it has no pace."""
        spent_s = (sum(self.frame_ms) + self.flush_ms) / 1000.0
        if self.input_hz <= 0.0 or spent_s <= 0.0:
            return None
        return round(len(self.frame_ms) / self.input_hz / spent_s, _DIGITS)


def _figures(times: Sequence[float], wanted: tuple[str, ...]) -> dict[str, float]:
    """Percentiles (``pNN``), mean and max; zeros of nothing."""
    values = np.asarray(times if len(times) else [0.0], np.float64)
    known = {"mean": values.mean(), "max": values.max()}
    return {
        name: round(float(known[name] if name in known else np.percentile(values, int(name[1:]))), _DIGITS)
        for name in wanted
    }


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far."""
    unit = 1 if sys.platform == "darwin" else 1024  # Linux counts kibibytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def versions() -> dict[str, str]:
    """Of everything that can change a result."""
    found = {"python": platform.python_version(), "platform": f"{platform.system()} {platform.machine()}"}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "unknown"
    return found
