"""Charts of the report as inline SVG: stage times (the paper's Fig. 3), times over frames, trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from artemis_edge.frames import F64
from artemis_edge.session.drawing import round_length

PERIOD_MS = 100.0  # a 10 Hz LiDAR leaves this long for a frame
_COLOURS = ("#2a668a", "#22908a", "#5cb76c", "#e0a526", "#e45a2e", "#c04a8c", "#7a5cc4", "#5a6570")
_INK, _QUIET, _GRID, _ACCENT = "#26292f", "#6b727c", "#e3e5e8", "#e23e57"
_WIDTH = 560  # of the time charts: half the page, so that their writing shows at its own size
_PATH_WIDTH = 1120
_MOST_COLUMNS = 700  # more frames than this are drawn as the largest of each column


def stage_chart(stages: dict[str, dict[str, float]]) -> str:
    """A bar to the median and a whisker to p99 per stage; ``stages`` as in ``report.json``."""
    left, right, row = 140, 100, 30
    largest = max([s["p99"] for s in stages.values()] + [1.0])
    scale = (_WIDTH - left - right) / largest
    height = row * len(stages) + 36
    parts = _grid(left, 0, _WIDTH - right, height - 28, largest, scale)
    for k, (name, times) in enumerate(stages.items()):
        y, colour = k * row + 6, _COLOURS[k % len(_COLOURS)]
        p50, p99 = left + times["p50"] * scale, left + times["p99"] * scale
        parts += [
            _text(left - 10, y + 14, name, anchor="end"),
            f'<rect x="{left}" y="{y}" width="{p50 - left:.1f}" height="18" rx="2" fill="{colour}"/>',
            _line(p50, y + 9, p99, y + 9, _INK),
            _line(p99, y + 4, p99, y + 14, _INK),
            _text(p99 + 8, y + 14, f"{times['p50']:.1f} / {times['p99']:.1f}", colour=_QUIET),
        ]
    return _svg(_WIDTH, height, parts, "Stage times: median and 99th percentile in milliseconds")


def time_chart(frame_ms: Sequence[float]) -> str:
    """Time of each frame in ms, with the line of a 10 Hz LiDAR's period."""
    left, bottom, top, height = 56, 30, 10, 240
    times = np.asarray(frame_ms, np.float64)
    largest = 1.08 * max(float(times.max()) if len(times) else 0.0, PERIOD_MS)
    down = (height - bottom - top) / largest
    groups = np.array_split(times, min(len(times), _MOST_COLUMNS)) if len(times) else []
    across = (_WIDTH - left - 12) / max(len(groups) - 1, 1)
    points = " ".join(
        f"{left + k * across:.1f},{height - bottom - g.max() * down:.1f}" for k, g in enumerate(groups)
    )
    parts = []
    for tick in _ticks(largest):
        y = height - bottom - tick * down
        parts += [_line(left, y, _WIDTH - 12, y, _GRID), _text(left - 8, y + 4, f"{tick:g}", anchor="end")]
    limit = height - bottom - PERIOD_MS * down
    parts += [
        f'<polyline points="{points}" fill="none" stroke="{_COLOURS[0]}" stroke-width="1.3"/>',
        f'<line x1="{left}" y1="{limit:.1f}" x2="{_WIDTH - 12}" y2="{limit:.1f}" stroke="{_ACCENT}" '
        'stroke-width="1.5" stroke-dasharray="6 4"/>',
        _text(_WIDTH - 14, limit - 6, f"{PERIOD_MS:g} ms", anchor="end", colour=_ACCENT),
        _text(left, height - 8, "frame 0", colour=_QUIET),
        _text(_WIDTH - 12, height - 8, f"frame {max(len(times) - 1, 0)}", anchor="end", colour=_QUIET),
    ]
    return _svg(_WIDTH, height, parts, "Time of each frame in milliseconds")


def trajectory_chart(path: F64, reference: F64 | None = None) -> str:
    """Path (n, 3) from above, +y up, with the reference (m, 3) dashed below it when there is one."""
    lines = [path[:, :2]] if reference is None else [reference[:, :2], path[:, :2]]
    corners = np.concatenate([*lines, np.zeros((0, 2))])
    if len(corners) == 0:
        return ""
    low, extent = corners.min(axis=0), np.maximum(np.ptp(corners, axis=0), 1.0)
    height = int(np.clip(_PATH_WIDTH * extent[1] / extent[0], 160, 420)) + 60
    scale = float(min((_PATH_WIDTH - 60) / extent[0], (height - 80) / extent[1]))
    offset = 0.5 * (np.array([_PATH_WIDTH, height - 20]) - extent * scale)
    parts = []
    for line in lines:
        dashed = reference is not None and line is lines[0]
        style = f'stroke="{_QUIET}" stroke-width="3" stroke-dasharray="5 4"' if dashed else ""
        style = style or f'stroke="{_ACCENT}" stroke-width="2.2"'
        drawn = (line - low) * scale + offset
        points = " ".join(f"{u:.1f},{height - 20 - v:.1f}" for u, v in drawn)
        parts.append(f'<polyline points="{points}" fill="none" stroke-linejoin="round" {style}/>')
    for k, colour in ((0, _INK), (-1, _ACCENT)) if len(path) else ():
        u, v = (path[k, :2] - low) * scale + offset
        parts.append(f'<circle cx="{u:.1f}" cy="{height - 20 - v:.1f}" r="5" fill="{colour}"/>')
    bar = round_length(0.1 * _PATH_WIDTH / scale)
    parts += [
        f'<rect x="16" y="{height - 12}" width="{bar * scale:.1f}" height="4" fill="{_INK}"/>',
        _text(16, height - 18, f"{bar:g} m"),
    ]
    return _svg(_PATH_WIDTH, height, parts, "Trajectory from above")


def _grid(left: float, top: float, right: float, bottom: float, largest: float, scale: float) -> list[str]:
    parts = []
    for tick in _ticks(largest):
        x = left + tick * scale
        if x <= right:
            parts += [
                _line(x, top, x, bottom, _GRID),
                _text(x, bottom + 20, f"{tick:g} ms", anchor="middle", colour=_QUIET),
            ]
    return parts


def _ticks(largest: float) -> list[float]:
    step = round_length(largest / 3.0)
    return [k * step for k in range(int(largest / step) + 1)]


def _line(x1: float, y1: float, x2: float, y2: float, colour: str) -> str:
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}"/>'


def _text(x: float, y: float, words: str, *, anchor: str = "start", colour: str = _INK) -> str:
    place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text {place} fill="{colour}" font-size="13">{escape(words)}</text>'


def _svg(width: int, height: int, parts: Sequence[str], title: str) -> str:
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">'
        f"<title>{escape(title)}</title>\n{body}\n</svg>"
    )
