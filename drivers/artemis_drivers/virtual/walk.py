"""A handheld walk along a path: gait, sway, tremor, looks to the sides and upwards, fast turns, stops, stairs.

Amplitudes are those of a person who carries a scanner in front of the chest: gait of about two steps a second
moves the rig up and down by 2 cm and rolls it by a degree (our assumption). Cadence grows with the root of the
speed (Grieve & Gear, "The relationships between length of stride, step frequency, time of swing and speed of
walking", 1966).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.motion import Motion

Rng = np.random.Generator
_KNOT_S = 0.02  # spacing of the spline's samples: five of a period of the fastest tremor
_DEG = np.pi / 180
_PATH_M = 0.05  # spacing at which the path is sampled
_SPEED_WAVE = 0.12  # slow changes of the walking speed, share of it
_STEEP = 0.2  # rise over run from which a path is walked like stairs
_PEAK = 630 / 256  # steepest slope of _smooth: the peak rate of a turn is this by its mean rate
_EARLY_M = 0.25  # over which the walker slows down
_STRIKE = (1.0, 0.15, 0.05)  # heel strike: harmonics of the step in the up and down movement
_TREMOR_HZ = (1.0, 9.0)  # hands and arms; physiological tremor of the hand lies at 8 to 12 Hz
_TREMOR_WAVES = 24
_VIEW_M = 15.0  # places farther away are not looked at
_TURN_BACK = 150 * _DEG  # nobody looks at what is farther behind
_HIGHEST_LOOK = 60 * _DEG
_SLOWEST_LOOK = 40 * _DEG  # peak rate of a look while the path turns
_LOOK_S = 5.0  # how long a look lasts at most, nearly


@dataclass(frozen=True, slots=True)
class Gait:
    """How the walker moves; metres, seconds, Hz, degrees. 0 leaves looks or stops out."""

    still_s: float = 1.0
    start_s: float = 1.5  # from standing to full speed
    speed: float = 1.2
    step_hz: float = 2.0
    bob_m: float = 0.02
    sway_m: float = 0.025
    roll_deg: float = 1.0
    pitch_deg: float = 0.7
    look_deg: float = 60.0
    look_every_s: float = 6.0
    look_up_deg: float = 14.0  # looks go up by as much as this
    tilt_down_deg: float = 4.0
    turn_deg_s: float = 150.0  # fastest turn of a look together with the path's
    stop_every_s: float = 20.0
    stop_s: float = 1.5
    corner_deg_s: float = 70.0  # the walk slows down where the path turns faster
    corner_m: float = 0.35  # corners of the path are rounded (sigma)
    stairs_pace: float = 0.45  # share of the speed on stairs
    tremor_deg: float = 0.1  # one sigma
    tremor_m: float = 0.0005


def walk(
    path: F64, seconds: float, seed: int, gait: Gait | None = None, looks_at: F64 | None = None
) -> Motion:
    """Walk along ``path`` (n, 3), the line of the eyes, for ``seconds``; body x looks ahead, z up.

    The rig starts exactly level and still for ``gait.still_s``. ``looks_at`` (m, 3) are places that looks turn
    to when one is near. Raises ValueError when the path is too short.
    """
    gait = gait or Gait()
    rng = np.random.default_rng([seed, 21])
    t = np.arange(0.0, seconds + 8 * _KNOT_S, _KNOT_S)
    route = _Route.of(path, gait)
    travelled = _travelled(route, _pace(t, gait, rng) * gait.speed, t)
    if travelled[-1] > route.length_m:
        raise ValueError(
            f"the path of {route.length_m:.1f} m is too short for a walk of {travelled[-1]:.1f} m"
        )
    position, ahead = route.line(travelled), route.line(travelled, 1)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    rate = np.gradient(travelled, t) / gait.speed
    step = 2 * np.pi * gait.step_hz * _integral(np.sqrt(np.clip(rate, 0, None)), t)
    going, awake = _smooth(rate / 0.6), _smooth((t - gait.still_s) / gait.start_s)[:, None]
    angles = np.column_stack([heading, np.zeros_like(t), np.zeros_like(t)])
    angles += awake * _carried(t, gait, rng) * _DEG + going[:, None] * _swing(step, gait, rng) * _DEG
    angles[:, :2] += awake * _looks(t, position, heading, gait, rng, looks_at)
    angles[:, 1] += awake[:, 0] * 10 * _DEG * gaussian_filter1d(route.steep(travelled), 0.5 / _KNOT_S)
    position[:, 2] += going * gait.bob_m * sum(a * np.cos((k + 1) * step) for k, a in enumerate(_STRIKE))
    sway = going * gait.sway_m * np.sin(step / 2)
    position += sway[:, None] * np.column_stack([-np.sin(heading), np.cos(heading), np.zeros_like(t)])
    position += awake * gait.tremor_m * _tremor(t, rng)
    angles += awake * gait.tremor_deg * _DEG * _tremor(t, rng)
    return Motion.through(t, position, angles)


def path_needed_m(seconds: float, gait: Gait | None = None) -> float:
    """Length of path that a walk of ``seconds`` uses at most, metres."""
    gait = gait or Gait()
    return (1.01 + _SPEED_WAVE) * gait.speed * max(seconds - gait.still_s, 0.0) + 2.0


@dataclass(frozen=True, slots=True)
class _Route:
    """The path with rounded corners as a spline over its length, and how fast it is walked."""

    line: BSpline
    arc: F64
    share: F64  # of the walking speed, at ``arc``
    slope: F64  # 1 on stairs, 0 elsewhere

    @property
    def length_m(self) -> float:
        return float(self.arc[-1])

    def steep(self, travelled: F64) -> F64:
        return np.asarray(np.interp(travelled, self.arc, self.slope), np.float64)

    @classmethod
    def of(cls, path: F64, gait: Gait) -> _Route:
        points = _resampled(path)
        width = gait.corner_m / _PATH_M
        if width > 0:
            pad = min(int(4 * width) + 1, len(points) - 1)
            before, after = 2 * points[0] - points[pad:0:-1], 2 * points[-1] - points[-2 : -pad - 2 : -1]
            rounded = gaussian_filter1d(np.concatenate([before, points, after]), width, axis=0)
            points = _resampled(rounded[pad : len(rounded) - pad])
        arc = np.asarray(np.arange(len(points)) * _PATH_M, np.float64)
        line = make_interp_spline(arc, points, 5)
        ahead, bend = line(arc, 1), line(arc, 2)
        flat = np.maximum(np.linalg.norm(ahead[:, :2], axis=1), 1e-6)
        turn = np.abs(ahead[:, 0] * bend[:, 1] - ahead[:, 1] * bend[:, 0]) / flat**2  # rad per metre of path
        steep = np.asarray(np.abs(ahead[:, 2]) > _STEEP * flat, np.float64)
        share = np.minimum(1.0, gait.corner_deg_s * _DEG / np.maximum(turn * gait.speed, 1e-9))
        share = np.minimum(share, 1 - (1 - gait.stairs_pace) * steep)
        early = minimum_filter1d(share, int(4 * _EARLY_M / _PATH_M) + 1)  # slow already before the corner
        return cls(line, arc, np.asarray(gaussian_filter1d(early, _EARLY_M / _PATH_M), np.float64), steep)


def _resampled(path: F64) -> F64:
    """Points every _PATH_M along a line (n, 3); the rest beyond the last is left out."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(int(arc[-1] / _PATH_M + 1e-6) + 1) * _PATH_M
    return np.column_stack([np.interp(at, arc, path[:, a]) for a in range(3)])


def _pace(t: F64, gait: Gait, rng: Rng) -> F64:
    """Share of the full speed over time: the start, slow changes, stops."""
    pace = _smooth((t - gait.still_s) / gait.start_s)
    pace = pace * (1 + _SPEED_WAVE * np.sin(2 * np.pi * t / 9.7 + rng.uniform(0, 2 * np.pi)))
    at = gait.still_s + gait.start_s
    while gait.stop_every_s > 0:
        at += gait.stop_every_s * rng.uniform(0.6, 1.4)
        if at > t[-1]:
            break
        slow = rng.uniform(0.9, 1.3)
        end = at + slow + gait.stop_s * rng.uniform(0.5, 1.5)
        pace *= 1 - _smooth((t - at) / slow) * (1 - _smooth((t - end) / slow))
        at = end + slow
    return pace


def _travelled(route: _Route, speed: F64, t: F64) -> F64:
    """Length of path behind the walker: Heun's method on d(arc)/dt = speed(t) share(arc)."""
    out = np.zeros(len(t))
    share = np.interp  # of the path's own speed limit
    for k in range(len(t) - 1):
        first = speed[k] * share(out[k], route.arc, route.share)
        second = speed[k + 1] * share(out[k] + first * _KNOT_S, route.arc, route.share)
        out[k + 1] = out[k] + 0.5 * (first + second) * _KNOT_S
    return out


def _integral(rate: F64, t: F64) -> F64:
    return np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(t))])


def _smooth(x: F64) -> F64:
    """From 0 to 1 over 0..1 with four continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**5 * (126 - 420 * x + 540 * x**2 - 315 * x**3 + 70 * x**4))


def _swing(step: F64, gait: Gait, rng: Rng) -> F64:
    """Yaw, pitch, roll of the gait, degrees (n, 3)."""
    phase = rng.uniform(0, 2 * np.pi, 3)
    return np.column_stack(
        [
            1.5 * np.sin(step / 2 + phase[0]),
            gait.pitch_deg * np.sin(step + phase[1]),
            gait.roll_deg * np.sin(step / 2 + phase[2]),
        ]
    )


def _carried(t: F64, gait: Gait, rng: Rng) -> F64:
    """Yaw, pitch, roll of the slowly drifting arms, degrees (n, 3)."""
    phase = rng.uniform(0, 2 * np.pi, 3)
    return np.column_stack(
        [
            3.0 * np.sin(2 * np.pi * t / 5.3 + phase[0]),
            gait.tilt_down_deg + 1.5 * np.sin(2 * np.pi * t / 4.1 + phase[1]),
            1.0 * np.sin(2 * np.pi * t / 6.7 + phase[2]),
        ]
    )


def _tremor(t: F64, rng: Rng) -> F64:
    """Band-limited noise (n, 3) of unit variance, amplitudes falling with the frequency."""
    low, high = _TREMOR_HZ
    hertz = low * (high / low) ** rng.uniform(0, 1, (_TREMOR_WAVES, 3))
    phase = rng.uniform(0, 2 * np.pi, (_TREMOR_WAVES, 3))
    amplitude = 1 / hertz / np.sqrt((0.5 / hertz**2).sum(axis=0))
    out = np.zeros((len(t), 3))
    for f, p, a in zip(hertz, phase, amplitude, strict=True):
        out += a * np.sin(2 * np.pi * t[:, None] * f + p)
    return out


def _looks(t: F64, position: F64, heading: F64, gait: Gait, rng: Rng, places: F64 | None) -> F64:
    """Yaw and pitch of the looks around, radians (n, 2): in turn to both sides and up the fronts of houses,
    or to a place worth it.
    """
    out = np.zeros((len(t), 2))
    side = rng.choice([-1.0, 1.0])
    begin = gait.still_s + 1.5
    while gait.look_every_s > 0 and begin < t[-1]:
        turn, hold = rng.uniform(1.2, 1.8), rng.uniform(0.5, 1.2)
        goal = np.array([side * gait.look_deg * rng.uniform(0.6, 1.1), -rng.uniform(0.0, gait.look_up_deg)])
        goal *= _DEG
        k = min(int((begin + turn) / _KNOT_S), len(t) - 1)
        found = _towards(places, position[k], heading[k])
        goal = goal if found is None else found
        if gait.turn_deg_s > 0:
            spare = max(gait.turn_deg_s * _DEG - _fastest(heading, begin), _SLOWEST_LOOK)
            turn = max(turn, _PEAK * float(np.hypot(*goal)) / spare)
        look = _smooth((t - begin) / turn) * (1 - _smooth((t - begin - turn - hold) / turn))
        out += look[:, None] * goal
        side = -side
        begin += max(gait.look_every_s * rng.uniform(0.8, 1.25), 2 * turn + hold)
    return out


def _fastest(heading: F64, begin: float) -> float:
    """Fastest turn of the heading during a look that begins then, rad/s."""
    part = heading[int(begin / _KNOT_S) :][: int(_LOOK_S / _KNOT_S)]
    return float(np.abs(np.diff(part)).max(initial=0.0)) / _KNOT_S


def _towards(places: F64 | None, eye: F64, heading: float) -> F64 | None:
    """Yaw from the heading and pitch (positive down) to the nearest place, None when none is near and ahead."""
    if places is None or len(places) == 0:
        return None
    offset = places - eye
    distance = np.linalg.norm(offset, axis=1)
    yaw = np.angle(np.exp(1j * (np.arctan2(offset[:, 1], offset[:, 0]) - heading)))
    cost = np.where((distance < _VIEW_M) & (np.abs(yaw) < _TURN_BACK), distance, np.inf)
    k = int(np.argmin(cost))
    if not np.isfinite(cost[k]):
        return None
    pitch = -np.arctan2(offset[k, 2], np.hypot(offset[k, 0], offset[k, 1]))
    return np.array([yaw[k], np.clip(pitch, -_HIGHEST_LOOK, _HIGHEST_LOOK)])
