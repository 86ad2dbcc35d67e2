"""Procedural materials: seeded, tileable, rich at the scale of centimetres, packed for compiled lookup.

Every material is a square picture of ``metres`` width that repeats, a reflectivity at the LiDAR's 905 nm, and
a gloss. Pictures are drawn around mid grey where an object's tint colours them. A slow grey "macro" picture
is multiplied on top with other periods, so that the repetition does not show.
"""

from __future__ import annotations

import string
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8

Rng = np.random.Generator
I64 = NDArray[np.int64]
SIZE = 512  # pixels of a material's picture, power of two
LEVELS = 9  # mip levels kept: 512 .. 2
SHOP_SIGNS = 12
ROAD_SIGNS = 5
PLATES = 6
#: Material of slow brightness changes, always index 0.
MACRO = 0
MACRO_M = 11.3  # its width in metres


class TextureArrays(NamedTuple):
    """All materials as kernels take them.

    ``texels`` int32 (n,) red, green << 8, blue << 16; ``start`` int64 (materials, LEVELS) first texel of a
    mip level (square pictures of SIZE >> level pixels); per material float32: ``metres`` width of a picture,
    ``reflectivity`` 0..1 at 905 nm, ``gloss`` 0..1 share of mirrored sky, ``mean_luma`` brightness 0..255.
    ``glass`` bool (materials,): a LiDAR beam passes (but for what is mirrored) and meets what lies behind; the
    camera sees the material's picture, which shows what is behind the pane.
    """

    texels: I32
    start: I64
    metres: F32
    reflectivity: F32
    gloss: F32
    mean_luma: F32
    glass: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class TextureAtlas:
    """The materials of a world; ``index`` maps names to material numbers."""

    arrays: TextureArrays
    index: dict[str, int]


def value_noise(rng: Rng, cells: int, size: int = SIZE) -> F64:
    """Tileable smooth noise in -1..1 with ``cells`` x ``cells`` random values, (size, size)."""
    grid = rng.uniform(-1, 1, (cells, cells))
    pad = 3
    wrapped = np.pad(grid, pad, mode="wrap").astype(np.float32)
    scale = size / cells
    x = ((np.arange(size) + 0.5) / scale - 0.5 + pad).astype(np.float32)
    map_x, map_y = np.meshgrid(x, x)
    return np.asarray(cv2.remap(wrapped, map_x, map_y, cv2.INTER_CUBIC), np.float64)


def fractal(rng: Rng, cells: tuple[int, ...], size: int = SIZE) -> F64:
    """Sum of noises of the given cell counts, each half as strong as the one before, about -1..1."""
    total = np.zeros((size, size))
    for octave, count in enumerate(cells):
        total += value_noise(rng, count, size) * 0.5**octave
    return total / 1.5


def _tinted(brightness: F64, colour: tuple[float, float, float]) -> F64:
    return np.asarray(brightness[..., None] * np.array(colour))


def _grain(rng: Rng, strength: float) -> F64:
    return np.asarray(rng.normal(0, strength, (SIZE, SIZE)))


def _write(picture: F64, text: str, box: tuple[int, int, int, int], colour: Sequence[float] | F64) -> None:
    """Letters that fill ``box`` (x, y, width, height) of the picture, whatever the font's own size."""
    x, y, width, height = box
    mask = np.zeros((200, 120 + 90 * len(text)), np.uint8)
    cv2.putText(mask, text, (30, 130), cv2.FONT_HERSHEY_TRIPLEX, 3.0, 255, 9, cv2.LINE_AA)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    letters = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    cover = cv2.resize(letters, (width, height), interpolation=cv2.INTER_AREA)[..., None] / 255.0
    part = picture[y : y + height, x : x + width]
    part[:] = part * (1 - cover) + np.asarray(colour) * cover


def _asphalt(rng: Rng) -> F64:
    base = 0.36 + 0.05 * fractal(rng, (4, 9, 21)) + 0.05 * fractal(rng, (128, 256)) + _grain(rng, 0.03)
    stones = value_noise(rng, 170) > 0.72
    base[stones] += rng.uniform(0.05, 0.22)
    picture = _tinted(base, (1.0, 0.99, 0.97))
    _cracks(rng, picture, 5, 0.55)
    return picture


def _cracks(rng: Rng, picture: F64, count: int, darkness: float) -> None:
    mask = np.zeros((SIZE, SIZE), np.uint8)
    for _ in range(count):
        steps = rng.normal(0, 9, (26, 2)) + rng.normal(0, 10, 2)
        line = (rng.uniform(0, SIZE, 2) + np.cumsum(steps, axis=0)).astype(np.int32)
        cv2.polylines(mask, [line.reshape(-1, 1, 2)], False, 255, 1, cv2.LINE_AA)
    picture *= 1 - (1 - darkness) * (mask[..., None] / 255.0)


def _worn_paint(rng: Rng) -> F64:
    worn = fractal(rng, (8, 40, 128)) + 0.3 * value_noise(rng, 256)
    cover = np.clip((worn + 0.55) * 4, 0, 1)[..., None]
    paint = _tinted(0.86 + 0.05 * fractal(rng, (16, 64)), (1.0, 0.99, 0.95))
    return cover * paint + (1 - cover) * _asphalt(rng)


def _cells(rng: Rng, rows: int, columns: int, joint_px: int, stagger: bool) -> tuple[F64, F64]:
    """Masonry: a random value per stone (SIZE, SIZE) and 1 on stone, 0 in the joint."""
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    high, wide = SIZE / rows, SIZE / columns
    row = (y / high).astype(int)
    shifted = x + (wide / 2) * (row % 2) * stagger
    column = (shifted / wide).astype(int) % columns
    value = rng.uniform(-1, 1, (rows, columns))[row, column]
    edge = np.minimum.reduce([y % high, high - y % high, shifted % wide, wide - shifted % wide])
    wobble = edge + 1.2 * value_noise(rng, 128)
    return value, np.clip((wobble - joint_px / 2) / 1.5, 0, 1)


def _masonry(
    rng: Rng, rows: int, columns: int, joint_px: int, spread: float, mortar: float, stagger: bool = True
) -> F64:
    value, stone = _cells(rng, rows, columns, joint_px, stagger)
    body = 0.72 + spread * value + 0.07 * fractal(rng, (32, 90, 200)) + _grain(rng, 0.02)
    joint = mortar + 0.06 * fractal(rng, (64, 200)) + _grain(rng, 0.02)
    hue = 0.04 * np.roll(value, 37, axis=1)
    picture = _tinted(body, (1.0, 1.0, 1.0))
    picture[..., 0] += hue
    picture[..., 2] -= hue
    return np.asarray(stone[..., None] * picture + (1 - stone[..., None]) * _tinted(joint, (1, 0.98, 0.94)))


def _plaster(rng: Rng) -> F64:
    base = 0.8 + 0.06 * fractal(rng, (3, 7, 15)) + 0.06 * fractal(rng, (90, 200)) + _grain(rng, 0.025)
    streaks = np.repeat(value_noise(rng, 24)[:1], SIZE, axis=0) * (0.5 + 0.5 * value_noise(rng, 4))
    picture = _tinted(base - 0.05 * np.clip(streaks, 0, 1), (1, 1, 1))
    _cracks(rng, picture, 4, 0.7)
    return picture


def _concrete(rng: Rng) -> F64:
    base = 0.62 + 0.06 * fractal(rng, (5, 12, 30)) + 0.05 * fractal(rng, (120, 256)) + _grain(rng, 0.03)
    pores = value_noise(rng, 128) > 0.8
    base[pores] -= 0.2
    return _tinted(base, (1, 0.99, 0.97))


def _wood(rng: Rng, planks: int) -> F64:
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    plank = (y * planks // SIZE) % planks
    stretch = cv2.resize(rng.uniform(-1, 1, (SIZE, 16)), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    grain = np.sin(y * 0.55 + 6 * value_noise(rng, 6) + 2.5 * stretch)
    base = 0.7 + 0.1 * grain + 0.12 * rng.uniform(-1, 1, planks)[plank] + 0.05 * stretch
    for _ in range(10):  # knots
        centre = rng.uniform(0, SIZE, 2)
        distance = np.hypot((x - centre[0]) / 2.2, y - centre[1])
        base -= 0.35 * np.exp(-((distance / 6) ** 2))
    base[(y * planks % SIZE) < planks * 3] *= 0.45
    return _tinted(base, (1.0, 0.93, 0.84))


def _bark(rng: Rng) -> F64:
    ridges = cv2.resize(rng.uniform(-1, 1, (20, 70)), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    base = 0.5 + 0.25 * ridges + 0.1 * fractal(rng, (30, 90, 200)) + _grain(rng, 0.03)
    return _tinted(base, (1.0, 0.88, 0.75))


def _leaf(rng: Rng) -> F64:
    base = 0.75 + 0.22 * fractal(rng, (6, 14, 40)) + _grain(rng, 0.04)
    veins = np.abs(value_noise(rng, 48)) < 0.06
    base[veins] += 0.12
    picture = _tinted(base, (0.62, 0.9, 0.36))
    picture[..., 0] += 0.18 * np.clip(value_noise(rng, 10), 0, 1)
    return picture


def _paint(rng: Rng) -> F64:
    base = 0.88 + 0.04 * fractal(rng, (4, 10)) + 0.02 * fractal(rng, (60, 200)) + _grain(rng, 0.012)
    dirt = np.clip(fractal(rng, (12, 50, 140)) - 0.25, 0, 1)
    picture = _tinted(base - 0.35 * dirt, (1, 1, 1))
    _cracks(rng, picture, 3, 0.75)
    return picture


def _metal(rng: Rng) -> F64:
    brushed = cv2.resize(rng.uniform(-1, 1, (SIZE, 24)), (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
    base = 0.72 + 0.05 * brushed + 0.05 * fractal(rng, (8, 30)) + _grain(rng, 0.015)
    rust = np.clip(3 * (fractal(rng, (14, 40, 120)) - 0.45), 0, 1)[..., None]
    return np.asarray((1 - rust) * _tinted(base, (1, 1, 1)) + rust * np.array([0.45, 0.27, 0.14]))


def _window(rng: Rng) -> F64:
    """Dark room behind glass, with curtains, a cross bar and things on the sill: one picture a pane."""
    picture = _tinted(0.16 + 0.05 * fractal(rng, (3, 8)), (0.9, 1.0, 1.1))
    x = np.arange(SIZE)
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
    return picture + _grain(rng, 0.01)[..., None]


def _glass(rng: Rng) -> F64:
    base = 0.14 + 0.05 * fractal(rng, (3, 7, 20)) + 0.02 * np.clip(fractal(rng, (60, 200)), 0, 1)
    return _tinted(base + _grain(rng, 0.006), (0.9, 1.0, 1.05))


def _door(rng: Rng) -> F64:
    picture = _wood(rng, 6)
    for x0 in (70, 290):
        for y0, y1 in ((50, 230), (290, 460)):
            cv2.rectangle(picture, (x0, y0), (x0 + 150, y1), (0.35, 0.33, 0.3), 6)
    cv2.circle(picture, (462, 270), 13, (0.9, 0.8, 0.4), -1)
    return picture


def _shutter(rng: Rng) -> F64:
    y = np.arange(SIZE)[:, None]
    base = 0.7 + 0.12 * np.sin(y * 2 * np.pi / 32) + 0.05 * fractal(rng, (6, 30, 128)) + _grain(rng, 0.015)
    picture = _tinted(base, (1, 1, 1))
    _write(picture, _word(rng, 4), (40, 180, 430, 190), rng.uniform(0, 1, 3))
    return picture


def _roof(rng: Rng) -> F64:
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    value, stone = _cells(rng, 16, 12, 3, True)
    curve = np.cos((x % (SIZE / 12)) / (SIZE / 12) * 2 * np.pi)
    base = (0.66 + 0.1 * value - 0.1 * curve - 0.15 * ((y % 32) / 32)) * (0.4 + 0.6 * stone)
    return _tinted(base + 0.05 * fractal(rng, (40, 150)), (1, 0.95, 0.9))


def _cloth(rng: Rng) -> F64:
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    weave = 0.04 * (np.sin(x * 0.8) + np.sin(y * 0.8))
    folds = 0.14 * fractal(rng, (4, 10, 22))
    return _tinted(0.75 + weave + folds + _grain(rng, 0.03), (1, 1, 1))


def _skin(rng: Rng) -> F64:
    return _tinted(0.85 + 0.05 * fractal(rng, (8, 40, 150)), (1.0, 0.82, 0.7))


def _cardboard(rng: Rng) -> F64:
    picture = _tinted(0.78 + 0.04 * fractal(rng, (4, 20, 90)) + _grain(rng, 0.02), (0.9, 0.72, 0.5))
    _write(picture, _word(rng, 5), (60, 120, 300, 90), (0.2, 0.15, 0.1))
    _write(picture, _word(rng, 7), (60, 250, 240, 40), (0.25, 0.2, 0.15))
    picture[380:420] *= (0.9, 0.85, 0.7)
    return picture


def _word(rng: Rng, length: int) -> str:
    """A readable invented word: consonants and vowels in turn."""
    vowels = "AEIOU"
    consonants = "".join(c for c in string.ascii_uppercase if c not in vowels + "QX")
    letters = [rng.choice(list(consonants if k % 2 == 0 else vowels)) for k in range(length)]
    return "".join(letters)


def _shop_sign(rng: Rng) -> F64:
    """Letters on a board; drawn square, used on boards of any shape (texture is scaled to the board)."""
    ground, ink = rng.uniform(0.1, 0.95, 3), rng.uniform(0.0, 1.0, 3)
    if abs(ground.mean() - ink.mean()) < 0.4:
        ink = np.full(3, 0.97 if ground.mean() < 0.5 else 0.05)
    picture = np.ones((SIZE, SIZE, 3)) * ground + 0.03 * fractal(rng, (6, 40, 200))[..., None]
    cv2.rectangle(picture, (14, 14), (SIZE - 15, SIZE - 15), ink.tolist(), 8)
    _write(picture, _word(rng, int(rng.integers(4, 8))), (40, 90, 430, 240), ink)
    _write(picture, _word(rng, 9), (70, 390, 370, 70), ink)
    return picture


def _road_sign(rng: Rng, kind: int) -> F64:
    """Round or square road sign fronts with a number or letters."""
    picture = np.full((SIZE, SIZE, 3), 0.93)
    centre = (SIZE // 2, SIZE // 2)
    if kind == 0:
        cv2.circle(picture, centre, 250, (0.78, 0.05, 0.08), -1)
        cv2.circle(picture, centre, 190, (0.95, 0.95, 0.95), -1)
        _write(picture, str(rng.choice([20, 30, 50])), (130, 170, 250, 170), (0.05, 0.05, 0.05))
    elif kind == 1:
        cv2.circle(picture, centre, 250, (0.05, 0.2, 0.7), -1)
        cv2.circle(picture, centre, 215, (0.8, 0.05, 0.08), 50)
        cv2.line(picture, (100, 100), (412, 412), (0.8, 0.05, 0.08), 46)
    else:
        ground = [(0.04, 0.2, 0.65), (0.95, 0.8, 0.1), (0.05, 0.4, 0.2)][kind - 2]
        picture[:] = ground
        ink = (0.05, 0.05, 0.05) if kind == 3 else (0.97, 0.97, 0.97)
        cv2.rectangle(picture, (18, 18), (SIZE - 19, SIZE - 19), ink, 10)
        _write(picture, "P" if kind == 2 else _word(rng, 3), (110, 110, 290, 290), ink)
    return picture + 0.02 * fractal(rng, (10, 60, 200))[..., None]


def _plate(rng: Rng) -> F64:
    picture = np.full((SIZE, SIZE, 3), 0.92)
    text = _word(rng, 2) + f" {rng.integers(100, 999)}"
    cv2.rectangle(picture, (5, 5), (SIZE - 6, SIZE - 6), (0.1, 0.1, 0.1), 10)
    _write(picture, text, (30, 90, 450, 330), (0.06, 0.06, 0.1))
    return picture


def _plastic(rng: Rng) -> F64:
    base = 0.8 + 0.05 * fractal(rng, (6, 20)) + 0.03 * fractal(rng, (100, 250)) + _grain(rng, 0.015)
    picture = _tinted(base, (1, 1, 1))
    _cracks(rng, picture, 8, 0.8)
    return picture


def _macro(rng: Rng) -> F64:
    return _tinted(0.85 + 0.16 * fractal(rng, (5, 11, 23, 47)), (1, 1, 1))


@dataclass(frozen=True, slots=True)
class _Recipe:
    draw: Callable[[Rng], F64]
    metres: float
    reflectivity: float  # at 905 nm; typical values of diffuse building materials, an assumption
    gloss: float = 0.0
    glass: bool = False


def _recipes() -> dict[str, _Recipe]:
    recipes = {
        "macro": _Recipe(_macro, MACRO_M, 0.0),
        "asphalt": _Recipe(_asphalt, 1.6, 0.15),
        "lane_paint": _Recipe(_worn_paint, 1.6, 0.5),
        "paving": _Recipe(lambda r: _masonry(r, 4, 4, 7, 0.09, 0.35, False), 1.6, 0.3),
        "cobbles": _Recipe(lambda r: _masonry(r, 12, 12, 9, 0.12, 0.3), 1.2, 0.25),
        "kerbstone": _Recipe(_concrete, 1.2, 0.35),
        "concrete": _Recipe(_concrete, 1.6, 0.35),
        "brick_a": _Recipe(lambda r: _masonry(r, 32, 10, 5, 0.13, 0.62), 2.4, 0.35),
        "brick_b": _Recipe(lambda r: _masonry(r, 26, 8, 6, 0.2, 0.45), 2.0, 0.35),
        "plaster_a": _Recipe(_plaster, 2.2, 0.6),
        "plaster_b": _Recipe(_plaster, 1.5, 0.6),
        "stone": _Recipe(lambda r: _masonry(r, 4, 3, 6, 0.08, 0.4), 1.8, 0.45),
        "roof": _Recipe(_roof, 2.4, 0.3),
        "wood": _Recipe(lambda r: _wood(r, 4), 0.5, 0.45),
        "door": _Recipe(_door, 1.0, 0.4),
        "shutter": _Recipe(_shutter, 2.0, 0.4, 0.05),
        "metal": _Recipe(_metal, 0.6, 0.4, 0.08),
        "car_paint": _Recipe(_paint, 1.7, 0.35, 0.1),
        "glass": _Recipe(_glass, 1.3, 0.08, 0.22),
        "pane": _Recipe(_glass, 1.3, 0.08, 0.3, glass=True),
        "rubber": _Recipe(_plastic, 0.4, 0.06),
        "plastic": _Recipe(_plastic, 0.5, 0.35, 0.05),
        "bark": _Recipe(_bark, 0.7, 0.35),
        "leaf": _Recipe(_leaf, 0.6, 0.5),
        "cloth": _Recipe(_cloth, 0.5, 0.4),
        "skin": _Recipe(_skin, 0.3, 0.5),
        "cardboard": _Recipe(_cardboard, 0.6, 0.5),
        "lamp": _Recipe(lambda r: _tinted(0.9 + 0.05 * fractal(r, (8, 40)), (1, 0.98, 0.9)), 0.4, 0.3, 0.2),
    }
    for k in range(4):
        recipes[f"window_{k}"] = _Recipe(_window, 1.0, 0.1, 0.12)
    for k in range(SHOP_SIGNS):
        recipes[f"shop_sign_{k}"] = _Recipe(_shop_sign, 1.0, 0.5)
    for k in range(ROAD_SIGNS):
        recipes[f"road_sign_{k}"] = _Recipe(lambda r, k=k: _road_sign(r, k), 1.0, 0.9)  # type: ignore[misc]
    for k in range(PLATES):
        recipes[f"plate_{k}"] = _Recipe(_plate, 1.0, 0.8)
    return recipes


def _packed(picture: U8) -> I32:
    r, g, b = np.moveaxis(picture.reshape(-1, 3).astype(np.int32), 1, 0)
    return np.asarray(r | g << 8 | b << 16, np.int32)


def build_atlas(seed: int) -> TextureAtlas:
    """All materials drawn from ``seed``; the same seed gives the same bytes."""
    recipes = _recipes()
    levels: list[I32] = []
    start = np.empty((len(recipes), LEVELS), np.int64)
    luma = np.empty(len(recipes), np.float32)
    count = 0
    for m, (name, recipe) in enumerate(recipes.items()):
        rng = np.random.default_rng([seed, 7, *name.encode()])
        picture = np.rint(np.clip(recipe.draw(rng), 0, 1) * 255).astype(np.uint8)
        luma[m] = picture.mean()
        for level in range(LEVELS):
            start[m, level] = count
            levels.append(_packed(picture))
            count += len(levels[-1])
            half = picture.shape[0] // 2
            picture = cv2.resize(picture, (half, half), interpolation=cv2.INTER_AREA)
    arrays = TextureArrays(
        np.concatenate(levels),
        start,
        np.array([r.metres for r in recipes.values()], np.float32),
        np.array([r.reflectivity for r in recipes.values()], np.float32),
        np.array([r.gloss for r in recipes.values()], np.float32),
        luma,
        np.array([r.glass for r in recipes.values()], np.bool_),
    )
    return TextureAtlas(arrays, {name: m for m, name in enumerate(recipes)})
