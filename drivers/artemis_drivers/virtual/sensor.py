"""A global-shutter colour sensor: motion blur, vignetting, photon and read noise, gain, Bayer mosaic, exposure.

Model of EMVA Standard 1288 (linear camera): electrons = light x exposure x efficiency, photon noise with the
variance of the electrons, read noise, saturation, gain, quantisation. The size, pixel and 10 bits are those of
the PYTHON 1300 (onsemi NOIP1SN1300A/D; 1280 x 1024, 4.8 um), the sensor class of handheld LiDAR-camera rigs;
full well 10 000 e- and read noise 10 e- (60 dB) are typical of it, the colour filters' efficiencies assumed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import kernel, njit
from artemis_drivers.virtual.mesh_builder import F32, F64, U8, U16
from artemis_drivers.virtual.shading import Film

_LONGEST_TRAIL = (
    64  # samples along a trail of motion blur; beyond as many pixels they are more than 1 px apart
)
_SHORTEST_TRAIL = 0.3  # pixels; less motion does not blur
_METER_STEP = 8  # the exposure meter looks at every eighth pixel
_WHITE_S = 0.004  # exposure at which ``SensorSpec.white`` fills the well


@dataclass(frozen=True, slots=True)
class SensorSpec:
    """``white``: linear light (1 = a white wall in the sun) that fills the well in 4 ms at full efficiency.

    ``noise`` multiplies photon and read noise. The automatic exposure aims at a mean of ``target`` of the full
    range and changes by at most a factor ``step`` a frame, ``delay`` frames after the frame that it measured;
    without ``auto`` the exposure and gain are those given.
    """

    full_well_e: float = 10_000.0
    read_noise_e: float = 10.0
    bits: int = 10
    efficiency: tuple[float, float, float] = (0.75, 1.0, 0.7)  # red, green, blue relative to green
    white: float = 0.87
    noise: float = 1.0
    auto: bool = True
    exposure_s: float = 0.004
    gain: float = 1.0
    shortest_s: float = 0.00005
    longest_s: float = 0.005  # handheld rigs keep below 5 ms and take gain instead
    highest_gain: float = 8.0
    target: float = 0.22
    step: float = 2.0
    delay: int = 2


class Exposure(NamedTuple):
    """Exposure time in seconds and gain of one frame."""

    exposure_s: float
    gain: float


#: At which ``SensorSpec.white`` fills the well.
REFERENCE = Exposure(_WHITE_S, 1.0)


@dataclass(slots=True)
class AutoExposure:
    """Exposure before gain, damped, in force only ``delay`` frames later, as in real cameras."""

    spec: SensorSpec
    _coming: deque[Exposure] = field(default_factory=deque)

    def next(self, mean_light: float) -> Exposure:
        """Setting of the next frame; before the first frame the camera has settled on ``mean_light``."""
        s = self.spec
        if not s.auto:
            return Exposure(s.exposure_s, s.gain)
        if not self._coming:
            wanted = s.target * s.white * _WHITE_S / max(mean_light, 1e-6)
            self._coming.extend([self._split(wanted)] * (s.delay + 1))
        return self._coming.popleft()

    def measured(self, used: Exposure, mean: float) -> None:
        """Take in the mean (0..1 of the full range) of a frame made with ``used``."""
        if not self.spec.auto:
            return
        change = (self.spec.target / max(mean, 1e-3)) ** 0.7
        change = min(max(change, 1 / self.spec.step), self.spec.step)
        self._coming.append(self._split(used.exposure_s * used.gain * change))

    def _split(self, product: float) -> Exposure:
        s = self.spec
        exposure = min(max(product, s.shortest_s), s.longest_s)
        return Exposure(exposure, min(max(product / exposure, 1.0), s.highest_gain))


class Optics(NamedTuple):
    """What kernels need of the lens: focal lengths, distortion k1 k2 p1 p2 k3."""

    fx: float
    fy: float
    k: tuple[float, float, float, float, float]


class Amplifier(NamedTuple):
    """Electrons per light (before efficiency), saturation and read noise in electrons, numbers per electron,
    the highest number, and the factor on the noise.
    """

    electrons: float
    full_well: float
    read_noise: float
    numbers: float
    top: float
    noise: float


def amplifier(spec: SensorSpec, used: Exposure) -> Amplifier:
    """The numbers of one exposure."""
    top = float(2**spec.bits - 1)
    electrons = spec.full_well_e / spec.white * used.exposure_s / _WHITE_S
    per_electron = top / spec.full_well_e * used.gain
    return Amplifier(electrons, spec.full_well_e, spec.read_noise_e, per_electron, top, spec.noise)


@kernel(forceinline=True)
def _flow(moved: F64, part: int, lens: Optics, x: float, y: float, inverse_depth: float) -> tuple[Any, Any]:
    """Pixels by which what is seen on the line of sight (x, y, 1) moves when its point p moves by D (p, 1): the
    derivatives of the perspective and of the lens. D is ``moved[part]``.
    """
    k = part
    c = moved[k, 2, 0] * x + moved[k, 2, 1] * y + moved[k, 2, 2] + moved[k, 2, 3] * inverse_depth
    dx = moved[k, 0, 0] * x + moved[k, 0, 1] * y + moved[k, 0, 2] + moved[k, 0, 3] * inverse_depth - x * c
    dy = moved[k, 1, 0] * x + moved[k, 1, 1] * y + moved[k, 1, 2] + moved[k, 1, 3] * inverse_depth - y * c
    k1, k2, p1, p2, k3 = lens.k
    r2, dr2 = x * x + y * y, 2 * (x * dx + y * dy)
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    swell = (k1 + r2 * (2 * k2 + 3 * r2 * k3)) * dr2
    du = dx * radial + x * swell + 2 * p1 * (x * dy + y * dx) + p2 * (dr2 + 4 * x * dx)
    dv = dy * radial + y * swell + p1 * (dr2 + 4 * y * dy) + 2 * p2 * (x * dy + y * dx)
    return lens.fx * du, lens.fy * dv


@kernel(forceinline=True)
def _under_hat(x: float) -> float:
    """Integral from -inf to ``x`` of the hat function that interpolates linearly between pixels."""
    if x <= -1.0:
        return 0.0
    if x >= 1.0:
        return 1.0
    return 0.5 * (1.0 + x) * (1.0 + x) if x < 0.0 else 1.0 - 0.5 * (1.0 - x) * (1.0 - x)


@kernel(forceinline=True)
def _between_pixels(light: F32, major: Any, minor: float, across: bool, colour: int) -> Any:
    """Light at a whole coordinate along one axis and any along the other, the border continued."""
    height, width = light.shape[:2]
    length, wide = (width, height) if across else (height, width)
    m = min(max(major, 0), length - 1)
    minor = min(max(minor, 0.0), wide - 1.001)
    n = int(minor)
    share = minor - n
    if across:
        return light[n, m, colour] + share * (light[n + 1, m, colour] - light[n, m, colour])
    return light[m, n, colour] + share * (light[m, n + 1, colour] - light[m, n, colour])


@kernel(forceinline=True)
def _trail(light: F32, i: int, j: int, colour: int, du: float, dv: float) -> Any:
    """Mean light over the exposure at pixel (i, j), whose point moves by (du, dv) pixels meanwhile.

    What is seen here at a moment is, in the middle of the exposure, as far on the other side; the path being
    symmetric, its mean is the integral of the picture along it, interpolated at every row or column it crosses.
    """
    across = abs(du) >= abs(dv)
    length = abs(du) if across else abs(dv)
    if not length > _SHORTEST_TRAIL:
        return light[i, j, colour]
    slope = dv / du if across else du / dv
    half = 0.5 * min(length, _LONGEST_TRAIL)
    height, width = light.shape[:2]
    whole = int(half)  # steps to either side that are nearer than this count fully
    reach, aside = whole + 2, int((whole + 1) * abs(slope)) + 2
    rows, columns = (aside, reach) if across else (reach, aside)
    if not (rows <= i < height - rows and columns <= j < width - columns):
        return _trail_at_border(light, i, j, colour, half, slope, across)
    if half <= 1.0:
        return _short_trail(light, i, j, colour, half, slope, across)
    total = 0.0
    for m in range(-whole + 1, whole):
        total += _step(light, i, j, colour, m, slope, across, aside)
    rest = half - whole
    last = _step(light, i, j, colour, whole, slope, across, aside)
    last += _step(light, i, j, colour, -whole, slope, across, aside)
    beyond = _step(light, i, j, colour, whole + 1, slope, across, aside)
    beyond += _step(light, i, j, colour, -whole - 1, slope, across, aside)
    return (total + _under_hat(rest) * last + _under_hat(rest - 1.0) * beyond) / (2.0 * half)


@kernel(forceinline=True)
def _step(light: F32, i: int, j: int, colour: int, m: int, slope: float, across: bool, aside: int) -> Any:
    """Light ``m`` whole steps along a trail; it leaves its row or column by less than ``aside``."""
    minor = aside + m * slope  # not negative, so that cutting off decimals rounds down
    n = int(minor)
    if across:
        row, column = i - aside + n, j + m
        near, far = light[row, column, colour], light[row + 1, column, colour]
    else:
        row, column = i + m, j - aside + n
        near, far = light[row, column, colour], light[row, column + 1, colour]
    return near + (minor - n) * (far - near)


@kernel(forceinline=True)
def _trail_at_border(light: F32, i: int, j: int, colour: int, half: float, slope: float, across: bool) -> Any:
    """:func:`_trail` of ``half`` pixels to either side, where it may leave the picture."""
    reach = int(half + 1.0)
    total = 0.0
    for m in range(-reach, reach + 1):
        weight = _under_hat(half - m) - _under_hat(-half - m)
        major, minor = (j + m, i + m * slope) if across else (i + m, j + m * slope)
        total += weight * _between_pixels(light, major, minor, across, colour)
    return total / (2.0 * half)


@kernel(forceinline=True)
def _short_trail(light: F32, i: int, j: int, colour: int, half: float, slope: float, across: bool) -> Any:
    """:func:`_trail` where it reaches the next row or column only, ``half`` <= 1, and not at the border."""
    aside, share = 1 if slope >= 0.0 else -1, abs(slope)
    if across:
        a, b = light[i, j + 1, colour], light[i, j - 1, colour]
        c, d = light[i + aside, j + 1, colour], light[i - aside, j - 1, colour]
    else:
        a, b = light[i + 1, j, colour], light[i - 1, j, colour]
        c, d = light[i + 1, j + aside, colour], light[i - 1, j - aside, colour]
    ends = a + b + share * (c + d - a - b)
    return (1.0 - 0.5 * half) * light[i, j, colour] + 0.25 * half * ends


@njit
def expose(
    film: Film,
    lines: F32,
    moved: F64,
    lens: Optics,
    falloff: F32,
    noise: F32,
    efficiency: F64,
    amplifier: Amplifier,
    rows: tuple[int, int],
    raw: U16,
) -> None:
    """Numbers of the mosaic (red at even rows and columns, blue at odd ones) into ``raw`` (h, w).

    ``lines`` float32 (h, w, 2) x / z and y / z; ``moved`` (k, 4, 4) per part the matrix D by which a point p of
    it, in camera coordinates, moves over the exposure: by D (p, 1); ``falloff`` (h, w) vignetting; ``noise``
    (h, w) white, unit variance. Only ``rows`` first to before last are made.
    """
    height, width = raw.shape
    light = film.light.reshape(height, width, 3)
    for i in range(rows[0], rows[1]):
        for j in range(width):
            n, colour = i * width + j, (i & 1) + (j & 1)
            x, y, part = lines[i, j, 0], lines[i, j, 1], film.part[n]
            inverse_depth = 1.0 / film.depth[n]
            du, dv = _flow(moved, part, lens, x, y, inverse_depth)
            value = _trail(light, i, j, colour, du, dv)
            e = max(value, 0.0) * falloff[i, j] * efficiency[colour] * amplifier.electrons
            e += noise[i, j] * amplifier.noise * np.sqrt(e + amplifier.read_noise * amplifier.read_noise)
            number = min(max(e, 0.0), amplifier.full_well) * amplifier.numbers
            raw[i, j] = int(min(number, amplifier.top) + 0.5)


def metered(raw: U16, spec: SensorSpec) -> float:
    """Mean of the green pixels, 0..1 of the full range."""
    top = float(2**spec.bits - 1)
    return float(raw[::_METER_STEP, 1::_METER_STEP].mean()) / top


def developed(raw: U16, spec: SensorSpec) -> U8:
    """BGR uint8 (h, w, 3): interpolated mosaic, white balance, square root as the transfer curve."""
    colours = cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2BGR)
    out = np.empty(colours.shape, np.uint8)
    _curve(colours, _curves(spec), out)
    return out


def ideal(light: F32, spec: SensorSpec, used: Exposure) -> U8:
    """RGB uint8 (h, w, 3) of linear light as :func:`developed` would show it without mosaic and noise."""
    scale = used.exposure_s / _WHITE_S * used.gain / spec.white
    return np.asarray(np.rint(255 * np.sqrt(np.clip(light * np.float32(scale), 0, 1))), np.uint8)


def _curves(spec: SensorSpec) -> U8:
    """Per colour (blue, green, red) the byte of each number, uint8 (3, 2 ** bits)."""
    top = 2**spec.bits - 1
    share = np.arange(top + 1) / top / np.array(spec.efficiency[::-1])[:, None]
    return np.asarray(np.rint(255 * np.sqrt(np.minimum(share, 1.0))), np.uint8)


@njit
def _curve(colours: U16, curves: U8, out: U8) -> None:
    for i in range(colours.shape[0]):
        for j in range(colours.shape[1]):
            for c in range(3):
                out[i, j, c] = curves[c, colours[i, j, c]]


def bayer_bytes(raw: U16, spec: SensorSpec) -> U8:
    """The mosaic with 8 bits, linear (``bayer_rggb8``)."""
    return np.asarray(raw >> (spec.bits - 8), np.uint8)


def white_noise(height: int, width: int, seed: int) -> NDArray[np.float32]:
    """Field from which :func:`cut` takes the noise of every image."""
    rng = np.random.default_rng([seed, 13])
    return rng.standard_normal((height + _NOISE_MARGIN, width + _NOISE_MARGIN), np.float32)


_NOISE_MARGIN = 256


def cut(field_of_noise: F32, seed: int, index: int) -> F32:
    """Noise of image ``index``: one field of white noise, cut at another place for every image, is as random
    and much cheaper than a new one.
    """
    row, column = np.random.default_rng([seed, 11, index]).integers(0, _NOISE_MARGIN, 2)
    height, width = (n - _NOISE_MARGIN for n in field_of_noise.shape)
    return field_of_noise[row : row + height, column : column + width]
