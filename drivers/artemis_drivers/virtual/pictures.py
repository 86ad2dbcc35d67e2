"""Drawings of procedural materials: float pictures (SIZE, SIZE, 3), 0..1, that tile unless they fill a board.

All are drawn from a generator, around mid grey where an object's tint colours them.
"""

from __future__ import annotations

import string
from collections.abc import Sequence

import cv2
import numpy as np

from artemis_drivers.virtual.mesh_builder import F32, F64

Rng = np.random.Generator
SIZE = 512  # pixels of a material's picture, power of two


def value_noise(rng: Rng, cells: int, size: int = SIZE) -> F32:
    """Tileable smooth noise in about -1..1 with ``cells`` x ``cells`` random values, (size, size)."""
    values = rng.uniform(-1, 1, (cells, cells)).astype(np.float32)
    # twice along the first axis, turned in between: whole rows are mixed, which is quick
    return _stretched_rows(np.ascontiguousarray(_stretched_rows(values, size).T), size)


def _stretched_rows(values: F32, size: int) -> F32:
    """Cubic convolution (Keys 1981, a = -0.75) of periodic rows, to ``size`` rows."""
    count, a = len(values), -0.75
    at = (np.arange(size) + 0.5) * count / size - 0.5
    left = np.floor(at).astype(np.int64)
    t = at - left
    near, far = 1 - t, 2 - t
    weights = (
        a * (t + 1) ** 3 - 5 * a * (t + 1) ** 2 + 8 * a * (t + 1) - 4 * a,
        (a + 2) * t**3 - (a + 3) * t**2 + 1,
        (a + 2) * near**3 - (a + 3) * near**2 + 1,
        a * far**3 - 5 * a * far**2 + 8 * a * far - 4 * a,
    )
    out = np.zeros((size, values.shape[1]), np.float32)
    for k, weight in enumerate(weights):
        out += weight.astype(np.float32)[:, None] * values[(left + k - 1) % count]
    return out


def grid() -> tuple[F32, F32]:
    """Row and column of every pixel, each (SIZE, SIZE)."""
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(np.float32)
    return y, x


def fractal(rng: Rng, cells: tuple[int, ...], size: int = SIZE) -> F32:
    """Sum of noises of the given cell counts, each half as strong as the one before, about -1..1."""
    total = np.zeros((size, size), np.float32)
    for octave, count in enumerate(cells):
        total += value_noise(rng, count, size) * np.float32(0.5**octave)
    return np.asarray(total / np.float32(1.5))


def stretched(rng: Rng, rows: int, columns: int) -> F32:
    """Random values -1..1, ``rows`` x ``columns`` of them, stretched over the picture."""
    values = rng.uniform(-1, 1, (rows, columns)).astype(np.float32)
    return np.asarray(cv2.resize(values, (SIZE, SIZE), interpolation=cv2.INTER_CUBIC), np.float32)


def tinted(brightness: F32, colour: Sequence[float] | F32 | F64) -> F32:
    """Grey (SIZE, SIZE) times a colour."""
    return np.asarray(brightness[..., None] * np.array(colour, np.float32), np.float32)


def grain(rng: Rng, strength: float) -> F32:
    """White noise of the given standard deviation."""
    return rng.standard_normal((SIZE, SIZE), np.float32) * np.float32(strength)


def write(
    picture: F32, text: str, box: tuple[int, int, int, int], colour: Sequence[float] | F32 | F64
) -> None:
    """Letters that fill ``box`` (x, y, width, height) of the picture, whatever the font's own size."""
    x, y, width, height = box
    mask = np.zeros((200, 120 + 90 * len(text)), np.uint8)
    cv2.putText(mask, text, (30, 130), cv2.FONT_HERSHEY_TRIPLEX, 3.0, 255, 9, cv2.LINE_AA)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    letters = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    cover = cv2.resize(letters, (width, height), interpolation=cv2.INTER_AREA)[..., None] / 255.0
    part = picture[y : y + height, x : x + width]
    part[:] = part * (1 - cover) + np.asarray(colour) * cover


def asphalt(rng: Rng) -> F32:
    """Worn asphalt with light stones and cracks."""
    base = 0.36 + 0.05 * fractal(rng, (4, 9, 21)) + 0.05 * fractal(rng, (128, 256)) + grain(rng, 0.03)
    stones = value_noise(rng, 170) > 0.72
    base[stones] += rng.uniform(0.05, 0.22)
    picture = tinted(base, (1.0, 0.99, 0.97))
    cracks(rng, picture, 5, 0.55)
    return picture


def cracks(rng: Rng, picture: F32, count: int, darkness: float) -> None:
    """Draw fine dark lines into the picture."""
    mask = np.zeros((SIZE, SIZE), np.uint8)
    for _ in range(count):
        steps = rng.normal(0, 9, (26, 2)) + rng.normal(0, 10, 2)
        line = (rng.uniform(0, SIZE, 2) + np.cumsum(steps, axis=0)).astype(np.int32)
        cv2.polylines(mask, [line.reshape(-1, 1, 2)], False, 255, 1, cv2.LINE_AA)
    picture *= 1 - (1 - darkness) * (mask[..., None] / 255.0)


def worn_paint(rng: Rng) -> F32:
    """White paint, partly worn off asphalt."""
    worn = fractal(rng, (8, 40, 128)) + 0.3 * value_noise(rng, 256)
    cover = np.clip((worn + 0.55) * 4, 0, 1)[..., None]
    paint = tinted(0.86 + 0.05 * fractal(rng, (16, 64)), (1.0, 0.99, 0.95))
    return np.asarray(cover * paint + (1 - cover) * asphalt(rng), np.float32)


def cells(rng: Rng, rows: int, columns: int, joint_px: int, stagger: bool) -> tuple[F32, F32]:
    """Masonry: a random value per stone (SIZE, SIZE) and 1 on stone, 0 in the joint."""
    y, x = grid()
    high, wide = SIZE / rows, SIZE / columns
    row = (y / high).astype(int)
    shifted = x + np.float32(wide / 2 * stagger) * (row % 2).astype(np.float32)
    column = (shifted / wide).astype(int) % columns
    value: F32 = rng.uniform(-1, 1, (rows, columns)).astype(np.float32)[row, column]
    down, along = (np.abs(v / np.float32(step) % 1 - 0.5) for v, step in ((y, high), (shifted, wide)))
    edge = np.minimum((0.5 - down) * high, (0.5 - along) * wide)
    wobble = edge + 1.2 * value_noise(rng, 128)
    return value, np.asarray(np.clip((wobble - joint_px / 2) / 1.5, 0, 1), np.float32)


def masonry(
    rng: Rng, rows: int, columns: int, joint_px: int, spread: float, mortar: float, stagger: bool = True
) -> F32:
    """Stones or bricks of varied brightness with mortar between; ``spread`` of brightness, ``mortar`` grey."""
    value, stone = cells(rng, rows, columns, joint_px, stagger)
    body = 0.72 + spread * value + 0.07 * fractal(rng, (32, 90, 200)) + grain(rng, 0.02)
    joint = mortar + 0.06 * fractal(rng, (64, 200)) + grain(rng, 0.02)
    hue = 0.04 * np.roll(value, 37, axis=1)
    picture = tinted(body, (1.0, 1.0, 1.0))
    picture[..., 0] += hue
    picture[..., 2] -= hue
    return np.asarray(stone[..., None] * picture + (1 - stone[..., None]) * tinted(joint, (1, 0.98, 0.94)))


def plaster(rng: Rng) -> F32:
    """Rough plaster with stains, streaks and cracks."""
    base = 0.8 + 0.06 * fractal(rng, (3, 7, 15)) + 0.06 * fractal(rng, (90, 200)) + grain(rng, 0.025)
    streaks = np.repeat(value_noise(rng, 24)[:1], SIZE, axis=0) * (0.5 + 0.5 * value_noise(rng, 4))
    picture = tinted(np.asarray(base - 0.05 * np.clip(streaks, 0, 1), np.float32), (1, 1, 1))
    cracks(rng, picture, 4, 0.7)
    return picture


def concrete(rng: Rng) -> F32:
    """Concrete with pores."""
    base = 0.62 + 0.06 * fractal(rng, (5, 12, 30)) + 0.05 * fractal(rng, (120, 256)) + grain(rng, 0.03)
    pores = value_noise(rng, 128) > 0.8
    base[pores] -= 0.2
    return tinted(base, (1, 0.99, 0.97))


def wood(rng: Rng, planks: int) -> F32:
    """Planks with grain and knots."""
    y, x = grid()
    plank = np.asarray(y * planks // SIZE, np.int64) % planks
    stretch = stretched(rng, SIZE, 16)
    grain = np.sin(y * 0.55 + 6 * value_noise(rng, 6) + 2.5 * stretch)
    base = 0.7 + 0.1 * grain + 0.12 * rng.uniform(-1, 1, planks).astype(np.float32)[plank] + 0.05 * stretch
    for centre in rng.uniform(40, SIZE - 40, (10, 2)).astype(int):  # knots
        part = np.s_[centre[1] - 20 : centre[1] + 20, centre[0] - 40 : centre[0] + 40]
        squared = ((x[part] - centre[0]) / 2.2) ** 2 + (y[part] - centre[1]) ** 2
        base[part] -= 0.35 * np.exp(-squared / 36)
    base[(y * planks % SIZE) < planks * 3] *= 0.45
    return tinted(base, (1.0, 0.93, 0.84))


def bark(rng: Rng) -> F32:
    """Furrowed bark."""
    ridges = stretched(rng, 20, 70)
    base = 0.5 + 0.25 * ridges + 0.1 * fractal(rng, (30, 90, 200)) + grain(rng, 0.03)
    return tinted(base, (1.0, 0.88, 0.75))


def leaf(rng: Rng) -> F32:
    """Leaf with veins."""
    base = 0.75 + 0.22 * fractal(rng, (6, 14, 40)) + grain(rng, 0.04)
    veins = np.abs(value_noise(rng, 48)) < 0.06
    base[veins] += 0.12
    picture = tinted(base, (0.62, 0.9, 0.36))
    picture[..., 0] += 0.18 * np.clip(value_noise(rng, 10), 0, 1)
    return picture


def paint(rng: Rng) -> F32:
    """Car paint with dirt and scratches."""
    base = 0.88 + 0.04 * fractal(rng, (4, 10)) + 0.02 * fractal(rng, (60, 200)) + grain(rng, 0.012)
    dirt = np.clip(fractal(rng, (12, 50, 140)) - 0.25, 0, 1)
    picture = tinted(base - 0.35 * dirt, (1, 1, 1))
    cracks(rng, picture, 3, 0.75)
    return picture


def metal(rng: Rng) -> F32:
    """Brushed metal with rust."""
    brushed = stretched(rng, SIZE, 24)
    base = 0.72 + 0.05 * brushed + 0.05 * fractal(rng, (8, 30)) + grain(rng, 0.015)
    rust = np.clip(3 * (fractal(rng, (14, 40, 120)) - 0.45), 0, 1)[..., None]
    return np.asarray((1 - rust) * tinted(base, (1, 1, 1)) + rust * np.array([0.45, 0.27, 0.14]))


def window(rng: Rng) -> F32:
    """Dark room behind glass, with curtains, a cross bar and things on the sill: one picture a pane."""
    picture = tinted(0.16 + 0.05 * fractal(rng, (3, 8)), (0.9, 1.0, 1.1))
    x = np.arange(SIZE, dtype=np.float32)
    folds = 0.62 + 0.12 * np.sin(x * 0.21 + 2 * np.sin(x * 0.03))
    left, right = rng.integers(60, 190), SIZE - rng.integers(60, 190)
    colour = rng.uniform(0.6, 1.0, 3)
    picture[:, :left] = folds[None, :left, None] * colour
    picture[:, right:] = folds[None, right:, None] * colour
    for _ in range(4):
        x0, height = rng.integers(80, 420), rng.integers(30, 110)
        cv2.ellipse(
            picture,
            (int(x0), SIZE - 10),
            (int(height // 3), int(height)),
            0,
            0,
            360,
            rng.uniform(0.1, 0.7, 3).tolist(),
            -1,
        )
    picture += 0.05 * value_noise(rng, 5)[..., None]
    bar = 14
    picture[:, SIZE // 2 - bar : SIZE // 2 + bar] = 0.85
    picture[SIZE // 3 - bar : SIZE // 3 + bar] = 0.85
    return picture + grain(rng, 0.01)[..., None]


def glass(rng: Rng) -> F32:
    """Dark glass."""
    base = 0.14 + 0.05 * fractal(rng, (3, 7, 20)) + 0.02 * np.clip(fractal(rng, (60, 200)), 0, 1)
    return tinted(base + grain(rng, 0.006), (0.9, 1.0, 1.05))


def door(rng: Rng) -> F32:
    """Wooden door with panels and a knob."""
    picture = wood(rng, 6)
    for x0 in (70, 290):
        for y0, y1 in ((50, 230), (290, 460)):
            cv2.rectangle(picture, (x0, y0), (x0 + 150, y1), (0.35, 0.33, 0.3), 6)
    cv2.circle(picture, (462, 270), 13, (0.9, 0.8, 0.4), -1)
    return picture


def shutter(rng: Rng) -> F32:
    """Roller shutter with a painted word."""
    y = np.arange(SIZE, dtype=np.float32)[:, None]
    base = 0.7 + 0.12 * np.sin(y * 2 * np.pi / 32) + 0.05 * fractal(rng, (6, 30, 128)) + grain(rng, 0.015)
    picture = tinted(base, (1, 1, 1))
    write(picture, word(rng, 4), (40, 180, 430, 190), rng.uniform(0, 1, 3))
    return picture


def roof(rng: Rng) -> F32:
    """Roof tiles."""
    y, x = grid()
    value, stone = cells(rng, 16, 12, 3, True)
    curve = np.cos((x % (SIZE / 12)) / (SIZE / 12) * 2 * np.pi)
    base = (0.66 + 0.1 * value - 0.1 * curve - 0.15 * ((y % 32) / 32)) * (0.4 + 0.6 * stone)
    return tinted(base + 0.05 * fractal(rng, (40, 150)), (1, 0.95, 0.9))


def cloth(rng: Rng) -> F32:
    """Woven cloth with folds."""
    y, x = grid()
    weave = 0.04 * (np.sin(x * 0.8) + np.sin(y * 0.8))
    folds = 0.14 * fractal(rng, (4, 10, 22))
    return tinted(0.75 + weave + folds + grain(rng, 0.03), (1, 1, 1))


def skin(rng: Rng) -> F32:
    """Skin."""
    return tinted(0.85 + 0.05 * fractal(rng, (8, 40, 150)), (1.0, 0.82, 0.7))


def cardboard(rng: Rng) -> F32:
    """Cardboard with print and tape."""
    picture = tinted(0.78 + 0.04 * fractal(rng, (4, 20, 90)) + grain(rng, 0.02), (0.9, 0.72, 0.5))
    write(picture, word(rng, 5), (60, 120, 300, 90), (0.2, 0.15, 0.1))
    write(picture, word(rng, 7), (60, 250, 240, 40), (0.25, 0.2, 0.15))
    picture[380:420] *= (0.9, 0.85, 0.7)
    return picture


def word(rng: Rng, length: int) -> str:
    """A readable invented word: consonants and vowels in turn."""
    vowels = "AEIOU"
    consonants = "".join(c for c in string.ascii_uppercase if c not in vowels + "QX")
    letters = [rng.choice(list(consonants if k % 2 == 0 else vowels)) for k in range(length)]
    return "".join(letters)


def shop_sign(rng: Rng) -> F32:
    """Letters on a board; drawn square, used on boards of any shape (texture is scaled to the board)."""
    ground, ink = rng.uniform(0.1, 0.95, 3), rng.uniform(0.0, 1.0, 3)
    if abs(ground.mean() - ink.mean()) < 0.4:
        ink = np.full(3, 0.97 if ground.mean() < 0.5 else 0.05)
    picture = tinted(np.ones((SIZE, SIZE), np.float32), ground) + 0.03 * fractal(rng, (6, 40, 200))[..., None]
    cv2.rectangle(picture, (14, 14), (SIZE - 15, SIZE - 15), ink.tolist(), 8)
    write(picture, word(rng, int(rng.integers(4, 8))), (40, 90, 430, 240), ink)
    write(picture, word(rng, 9), (70, 390, 370, 70), ink)
    return picture


def road_sign(rng: Rng, kind: int) -> F32:
    """Round or square road sign fronts with a number or letters."""
    picture = np.full((SIZE, SIZE, 3), 0.93, np.float32)
    centre = (SIZE // 2, SIZE // 2)
    if kind == 0:
        cv2.circle(picture, centre, 250, (0.78, 0.05, 0.08), -1)
        cv2.circle(picture, centre, 190, (0.95, 0.95, 0.95), -1)
        write(picture, str(rng.choice([20, 30, 50])), (130, 170, 250, 170), (0.05, 0.05, 0.05))
    elif kind == 1:
        cv2.circle(picture, centre, 250, (0.05, 0.2, 0.7), -1)
        cv2.circle(picture, centre, 215, (0.8, 0.05, 0.08), 50)
        cv2.line(picture, (100, 100), (412, 412), (0.8, 0.05, 0.08), 46)
    else:
        ground = [(0.04, 0.2, 0.65), (0.95, 0.8, 0.1), (0.05, 0.4, 0.2)][kind - 2]
        picture[:] = ground
        ink = (0.05, 0.05, 0.05) if kind == 3 else (0.97, 0.97, 0.97)
        cv2.rectangle(picture, (18, 18), (SIZE - 19, SIZE - 19), ink, 10)
        write(picture, "P" if kind == 2 else word(rng, 3), (110, 110, 290, 290), ink)
    return picture + 0.02 * fractal(rng, (10, 60, 200))[..., None]


def plate(rng: Rng) -> F32:
    """Number plate."""
    picture = np.full((SIZE, SIZE, 3), 0.92, np.float32)
    text = word(rng, 2) + f" {rng.integers(100, 999)}"
    cv2.rectangle(picture, (5, 5), (SIZE - 6, SIZE - 6), (0.1, 0.1, 0.1), 10)
    write(picture, text, (30, 90, 450, 330), (0.06, 0.06, 0.1))
    return picture


def plastic(rng: Rng) -> F32:
    """Scratched plastic."""
    base = 0.8 + 0.05 * fractal(rng, (6, 20)) + 0.03 * fractal(rng, (100, 250)) + grain(rng, 0.015)
    picture = tinted(base, (1, 1, 1))
    cracks(rng, picture, 8, 0.8)
    return picture


def slow_grey(rng: Rng) -> F32:
    """Slow changes of brightness, multiplied onto all materials."""
    return tinted(0.85 + 0.16 * fractal(rng, (5, 11, 23, 47)), (1, 1, 1))


def stripes(rng: Rng) -> F32:
    """Knitted cloth with coloured cross stripes."""
    y, x = grid()
    colours = rng.uniform(0.25, 1.0, (6, 3)).astype(np.float32)
    band = np.searchsorted(np.sort(rng.uniform(0, SIZE, 11)), y[:, 0]) % 6
    knit = 0.9 + 0.07 * np.sin(x * 1.2) * np.sin(y * 1.2) + 0.1 * fractal(rng, (4, 12))
    return np.asarray(colours[band][:, None] * knit[..., None])


def check(rng: Rng) -> F32:
    """Cloth with crossing stripes."""
    y, x = grid()
    colours = rng.uniform(0.2, 1.0, (4, 3)).astype(np.float32)
    edges = np.sort(rng.uniform(0, SIZE // 2, 7))
    along = colours[np.searchsorted(edges, x[0] % (SIZE // 2)) % 4]
    across = colours[np.searchsorted(edges, y[:, 0] % (SIZE // 2)) % 4]
    folds = 1 + 0.12 * fractal(rng, (4, 10)) + grain(rng, 0.03)
    return np.asarray((along[None] + across[:, None]) / 2 * folds[..., None])


def denim(rng: Rng) -> F32:
    """Blue twill, washed out in places."""
    y, x = grid()
    twill = 0.06 * np.sin((x + y) * 1.1) + 0.12 * np.clip(fractal(rng, (3, 7)), 0, 1) + grain(rng, 0.04)
    return tinted(0.62 + twill, (0.85, 0.95, 1.15))


def marble(rng: Rng) -> F32:
    """Pale stone with veins."""
    y, x = grid()
    veins = np.abs(np.sin((x + y) * 2 * np.pi / SIZE * 2 + 5 * fractal(rng, (4, 8, 16))))
    base = 0.9 - 0.3 * np.exp(-veins * 14) + 0.05 * fractal(rng, (40, 120)) + grain(rng, 0.015)
    return tinted(base, (1.0, 0.99, 0.96))


def grass(rng: Rng) -> F32:
    """Lawn with bare and yellow spots."""
    base = 0.5 + 0.2 * fractal(rng, (60, 128, 256)) + 0.1 * fractal(rng, (4, 9)) + grain(rng, 0.06)
    picture = tinted(base, (0.72, 0.95, 0.42))
    dry = np.clip(2.5 * (fractal(rng, (5, 13, 40)) - 0.1), 0, 1)[..., None]
    return np.asarray(picture * (1 - dry) + dry * tinted(base, (1.05, 0.9, 0.62)))


def gravel(rng: Rng) -> F32:
    """Small stones."""
    stones = value_noise(rng, 90) + 0.6 * value_noise(rng, 170)
    base = 0.6 + 0.22 * stones + grain(rng, 0.04) + 0.05 * fractal(rng, (4, 9))
    picture = tinted(base, (1.0, 0.95, 0.87))
    picture[..., 0] += 0.06 * value_noise(rng, 90)
    return picture


def hedge(rng: Rng) -> F32:
    """Dense small leaves with dark gaps."""
    base = 0.45 + 0.35 * value_noise(rng, 60) + 0.2 * value_noise(rng, 120) + grain(rng, 0.05)
    return tinted(np.clip(base, 0.06, 1.0), (0.6, 0.9, 0.35))


def terrazzo(rng: Rng) -> F32:
    """Polished floor of chips, in slabs."""
    chips = value_noise(rng, 128)
    base = 0.68 + 0.18 * np.sign(chips) * (np.abs(chips) > 0.45) + grain(rng, 0.02)
    _, slab = cells(rng, 2, 2, 4, False)
    return tinted((base + 0.04 * fractal(rng, (3, 7))) * (0.6 + 0.4 * slab), (1.0, 0.97, 0.92))


def lino(rng: Rng) -> F32:
    """Flecked linoleum with scuffs."""
    base = 0.66 + 0.05 * fractal(rng, (64, 160, 256)) + 0.03 * fractal(rng, (3, 8)) + grain(rng, 0.02)
    picture = tinted(base, (1.0, 0.98, 0.94))
    cracks(rng, picture, 7, 0.8)
    return picture


def bare(rng: Rng) -> F32:
    """Painted smooth wall: hardly anything to see but the roller's traces."""
    base = 0.85 + 0.012 * fractal(rng, (3, 7, 15)) + 0.012 * fractal(rng, (120, 256)) + grain(rng, 0.008)
    return tinted(base, (1.0, 0.99, 0.97))


def ceiling(rng: Rng) -> F32:
    """Perforated panels in a grid."""
    y, x = grid()
    holes = (np.sin(x * 2 * np.pi / 16) * np.sin(y * 2 * np.pi / 16)) > 0.75
    _, panel = cells(rng, 2, 2, 5, False)
    base = (0.88 - 0.3 * holes + 0.03 * fractal(rng, (4, 30))) * (0.5 + 0.5 * panel)
    return tinted(base.astype(np.float32), (1.0, 1.0, 0.98))


def books(rng: Rng) -> F32:
    """Spines of books on one board, with titles and dark gaps above."""
    picture = tinted(0.12 + 0.03 * fractal(rng, (4, 30)), (1.0, 0.9, 0.8))
    x = 4
    while x < SIZE - 14:
        wide, top = int(rng.integers(14, 46)), int(rng.integers(20, 190))
        right = min(x + wide, SIZE - 2)
        colour = rng.uniform(0.1, 1.0, 3) * rng.uniform(0.5, 1.0)
        picture[top : SIZE - 4, x:right] = colour
        ink = np.full(3, 0.95 if colour.mean() < 0.5 else 0.08)
        for at in rng.integers(top + 20, SIZE - 60, 2):
            picture[at : at + 8, x + 3 : right - 3] = ink
        if right - x > 26:
            turned = np.full((right - x - 12, 150, 3), colour, np.float32)
            write(turned, word(rng, 6), (4, 2, 140, right - x - 18), ink)
            picture[top + 30 : top + 180, x + 6 : right - 6] = np.rot90(turned, -1)[: SIZE - top - 30]
        picture[top:, x : x + 2] *= 0.5
        x = right + int(rng.integers(0, 4))
    return np.asarray(picture + grain(rng, 0.02)[..., None])


def poster(rng: Rng) -> F32:
    """Printed sheet: a headline, shapes and lines of text."""
    picture = tinted(np.ones((SIZE, SIZE), np.float32), rng.uniform(0.2, 1.0, 3))
    for _ in range(7):
        centre, colour = rng.integers(60, SIZE - 60, 2), rng.uniform(0, 1, 3).tolist()
        size = int(rng.integers(20, 120))
        if rng.random() < 0.5:
            cv2.circle(picture, centre.tolist(), size, colour, -1, cv2.LINE_AA)
        else:
            cv2.rectangle(picture, (centre - size).tolist(), (centre + size // 2).tolist(), colour, -1)
    ink = np.full(3, 0.97 if picture.mean() < 0.5 else 0.04)
    write(picture, word(rng, int(rng.integers(5, 8))), (30, 30, 450, 100), ink)
    for y in range(380, 480, 24):
        write(picture, " ".join(word(rng, 5) for _ in range(4)), (40, y, 430, 14), ink)
    return np.asarray(picture + grain(rng, 0.012)[..., None])


def goods(rng: Rng) -> F32:
    """Packets side by side on shelves, with names."""
    value, box = cells(rng, 4, 6, 6, False)
    colours = rng.uniform(0.15, 1.0, (24, 3)).astype(np.float32)
    picture = colours[(np.abs(value) * 997).astype(int) % 24] * (0.3 + 0.7 * box[..., None])
    for row in range(4):
        for column in range(6):
            ink = (0.95, 0.95, 0.95) if rng.random() < 0.5 else (0.08, 0.08, 0.1)
            write(picture, word(rng, 5), (column * 85 + 14, row * 128 + 40, 58, 22), ink)
    return np.asarray(picture + grain(rng, 0.015)[..., None])


def lamp(rng: Rng) -> F32:
    """Frosted glass of a lamp."""
    return tinted(0.9 + 0.05 * fractal(rng, (8, 40)), (1, 0.98, 0.9))
