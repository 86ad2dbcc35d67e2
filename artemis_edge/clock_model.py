"""Relating clocks: affine models of one clock in another, from events seen by both.

An event is stamped by a device and again by the host when the news arrives. News is late by an unknown delay
that is never negative, so the truth runs along the lower edge of the points (device, arrival). The line below
all points that is nearest to them in the mean is an edge of their lower convex hull (Moon, Skelly & Towsley,
"Estimation and removal of clock skew from network delay measurements", INFOCOM 1999).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from artemis_edge.frames import F64

SECOND_NS = 1_000_000_000
PPM = 1e-6


@dataclass(frozen=True, slots=True)
class AffineClock:
    """``y = y0 + (1 + skew)(x - x0)``: clock x read in clock y; int64 nanoseconds, exact near ``x0``."""

    x0: int
    y0: int
    skew: float = 0.0

    def to_y(self, x: int) -> int:
        """The reading of clock y when clock x reads ``x``."""
        return self.y0 + (x - self.x0) + round((x - self.x0) * self.skew)

    def to_x(self, y: int) -> int:
        """The reading of clock x when clock y reads ``y``."""
        return self.x0 + (y - self.y0) - round((y - self.y0) * self.skew / (1 + self.skew))

    @property
    def skew_ppm(self) -> float:
        """How much faster clock y runs."""
        return self.skew / PPM


@dataclass(frozen=True, slots=True)
class FitQuality:
    """``span_s`` of device time that carries the fit, number of events in it, and the median delay above the
    line of the best event of each bin: by about as much the line may be wrong.
    """

    span_s: float
    events: int
    doubt_ns: int


class EnvelopeFit:
    """The lower-envelope line of the latest ``window_s`` seconds of events.

    Events are thinned to the earliest arrival of each ``bin_s`` seconds: the others cannot touch the line.
    A skew beyond ``max_skew_ppm`` is no property of a quartz: it is cut there, which steadies short spans.
    """

    def __init__(self, window_s: float = 60.0, bin_s: float = 0.5, max_skew_ppm: float = 200.0) -> None:
        self._window = round(window_s / bin_s)
        self._bin_ns = round(bin_s * SECOND_NS)
        self._max_skew = max_skew_ppm * PPM
        self._bins: deque[_Bin] = deque()
        self._model: AffineClock | None = None
        self._skew: float | None = None
        self._stale = False
        self.ignored = 0

    def add(self, x_ns: int, y_ns: int) -> None:
        """An event of device time ``x_ns`` that arrived at ``y_ns``; one older than the window is ignored."""
        number = x_ns // self._bin_ns
        at = len(self._bins)
        while at > 0 and self._bins[at - 1].number > number:
            at -= 1
        if at > 0 and self._bins[at - 1].number == number:
            self._bins[at - 1].add(x_ns, y_ns)
        elif at == 0 and self._bins and number <= self._bins[-1].number - self._window:
            self.ignored += 1
            return
        else:
            self._bins.insert(at, _Bin(number, x_ns, y_ns))
            self._stale = True
        while self._bins[0].number <= self._bins[-1].number - self._window:
            self._bins.popleft()
        if self._model is not None and y_ns < self._model.to_y(x_ns):
            self._stale = True

    @property
    def span_s(self) -> float:
        """Device time from the first to the last event, s."""
        return (self._bins[-1].x - self._bins[0].x) / SECOND_NS if self._bins else 0.0

    def model(self, skew: float | None = None) -> AffineClock | None:
        """The line, or None before the first event. ``skew``: known from elsewhere, only the offset is sought."""
        if not self._bins:
            return None
        if self._stale or self._model is None or skew != self._skew:
            self._model = lower_line(*self._points(), self._max_skew, skew)
            self._skew = skew
            self._stale = False
        return self._model

    def quality(self) -> FitQuality:
        """How well the latest line is supported."""
        model = self.model(self._skew)
        if model is None:
            return FitQuality(0.0, 0, 0)
        delays = [bin_.y - model.to_y(bin_.x) for bin_ in self._bins]
        return FitQuality(self.span_s, sum(bin_.events for bin_ in self._bins), int(np.median(delays)))

    def restart(self) -> None:
        """Forget everything: one of the clocks began anew."""
        self._bins.clear()
        self._model = None

    def _points(self) -> tuple[list[int], list[int]]:
        return [bin_.x for bin_ in self._bins], [bin_.y for bin_ in self._bins]


class _Bin:
    """The earliest arrival of an interval."""

    __slots__ = ("events", "number", "x", "y")

    def __init__(self, number: int, x: int, y: int) -> None:
        self.number, self.x, self.y, self.events = number, x, y, 1

    def add(self, x: int, y: int) -> None:
        """Keep the one with the least delay."""
        self.events += 1
        if y - x < self.y - self.x:
            self.x, self.y = x, y


def lower_line(x: list[int], y: list[int], max_skew: float, skew: float | None = None) -> AffineClock:
    """The line below all points (int nanoseconds, ascending x) that is nearest to them at mid-span.

    With ``skew`` given, the highest line of that slope.
    """
    x0, y0 = x[0], y[0]
    # differences are small enough for float64: a day of nanoseconds is exact to 0.01 ns
    along: F64 = np.array([value - x0 for value in x], np.float64)
    delay: F64 = np.array([b - y0 - (a - x0) for a, b in zip(x, y, strict=True)], np.float64)
    slope = _edge_slope(along, delay) if skew is None else skew
    slope = min(max(slope, -max_skew), max_skew)
    offset = float(np.min(delay - slope * along))
    return AffineClock(x0, y0 + round(offset), slope)


def _edge_slope(along: F64, delay: F64) -> float:
    """Slope of the lower hull's edge at mid-span; 0 for a single point."""
    hull = _lower_hull(along, delay)
    if len(hull) < 2:
        return 0.0
    middle = 0.5 * (along[0] + along[-1])
    right = next(k for k in range(1, len(hull)) if along[hull[k]] >= middle)
    a, b = hull[right - 1], hull[right]
    return float((delay[b] - delay[a]) / (along[b] - along[a]))


def _lower_hull(x: F64, y: F64) -> list[int]:
    """Rows of the lower convex hull of points with ascending x (Andrew's monotone chain)."""
    hull: list[int] = []
    for k in range(len(x)):
        if hull and x[hull[-1]] == x[k]:
            if y[hull[-1]] <= y[k]:
                continue
            hull.pop()
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (x[b] - x[a]) * (y[k] - y[a]) > (y[b] - y[a]) * (x[k] - x[a]):
                break
            hull.pop()
        hull.append(k)
    return hull
