"""Procedural materials: seeded, tileable, rich at the scale of centimetres, packed for compiled lookup.

Every material is a square picture of ``metres`` width that repeats, a reflectivity at the LiDAR's 905 nm, and
a gloss. Pictures are drawn around mid grey where an object's tint colours them. A slow grey "macro" picture
is multiplied on top with other periods, so that the repetition does not show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from artemis_drivers.virtual import pictures
from artemis_drivers.virtual.mesh_builder import F32, I32, U8
from artemis_drivers.virtual.pictures import SIZE as SIZE

Rng = np.random.Generator
I64 = NDArray[np.int64]
LEVELS = 9  # mip levels kept: 512 .. 2
SHOP_SIGNS = 8
ROAD_SIGNS = 5
PLATES = 6
PRINTS = 4  # of books, posters and goods each
#: Beginnings of the names of materials that are found indoors only, and on roads and houses only.
INDOORS = ("books_", "goods_", "lino", "bare", "ceiling")
ROADS = ("asphalt", "lane_paint", "kerbstone", "road_sign_", "plate_")
HOUSES = ("roof", "window_", "shop_sign_", "shutter", "glass", "cobbles", "gravel")
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


@dataclass(frozen=True, slots=True)
class _Recipe:
    draw: Callable[[Rng], F32]
    metres: float
    reflectivity: float  # at 905 nm; typical values of diffuse building materials, an assumption
    gloss: float = 0.0
    glass: bool = False


def _recipes() -> dict[str, _Recipe]:
    recipes = {
        "macro": _Recipe(pictures.slow_grey, MACRO_M, 0.0),
        "asphalt": _Recipe(pictures.asphalt, 1.6, 0.15),
        "lane_paint": _Recipe(pictures.worn_paint, 1.6, 0.5),
        "paving": _Recipe(lambda r: pictures.masonry(r, 4, 4, 7, 0.09, 0.35, False), 1.6, 0.3),
        "cobbles": _Recipe(lambda r: pictures.masonry(r, 12, 12, 9, 0.12, 0.3), 1.2, 0.25),
        "kerbstone": _Recipe(pictures.concrete, 1.2, 0.35),
        "concrete": _Recipe(pictures.concrete, 1.6, 0.35),
        "brick_a": _Recipe(lambda r: pictures.masonry(r, 32, 10, 5, 0.13, 0.62), 2.4, 0.35),
        "brick_b": _Recipe(lambda r: pictures.masonry(r, 26, 8, 6, 0.2, 0.45), 2.0, 0.35),
        "plaster_a": _Recipe(pictures.plaster, 2.2, 0.6),
        "plaster_b": _Recipe(pictures.plaster, 1.5, 0.6),
        "stone": _Recipe(lambda r: pictures.masonry(r, 4, 3, 6, 0.08, 0.4), 1.8, 0.45),
        "roof": _Recipe(pictures.roof, 2.4, 0.3),
        "wood": _Recipe(lambda r: pictures.wood(r, 4), 0.5, 0.45),
        "door": _Recipe(pictures.door, 1.0, 0.4),
        "shutter": _Recipe(pictures.shutter, 2.0, 0.4, 0.05),
        "metal": _Recipe(pictures.metal, 0.6, 0.4, 0.08),
        "car_paint": _Recipe(pictures.paint, 1.7, 0.35, 0.1),
        "glass": _Recipe(pictures.glass, 1.3, 0.08, 0.22),
        "pane": _Recipe(pictures.glass, 1.3, 0.08, 0.3, glass=True),
        "rubber": _Recipe(pictures.plastic, 0.4, 0.06),
        "plastic": _Recipe(pictures.plastic, 0.5, 0.35, 0.05),
        "bark": _Recipe(pictures.bark, 0.7, 0.35),
        "leaf": _Recipe(pictures.leaf, 0.6, 0.5),
        "cloth": _Recipe(pictures.cloth, 0.5, 0.4),
        "skin": _Recipe(pictures.skin, 0.3, 0.5),
        "stripes": _Recipe(pictures.stripes, 0.5, 0.4),
        "check": _Recipe(pictures.check, 0.4, 0.4),
        "denim": _Recipe(pictures.denim, 0.4, 0.35),
        "marble": _Recipe(pictures.marble, 1.1, 0.6),
        "grass": _Recipe(pictures.grass, 1.5, 0.5),
        "gravel": _Recipe(pictures.gravel, 1.0, 0.35),
        "hedge": _Recipe(pictures.hedge, 0.8, 0.5),
        "terrazzo": _Recipe(pictures.terrazzo, 1.2, 0.45),
        "lino": _Recipe(pictures.lino, 1.4, 0.4),
        "bare": _Recipe(pictures.bare, 2.0, 0.7),
        "ceiling": _Recipe(pictures.ceiling, 1.2, 0.7),
        "cardboard": _Recipe(pictures.cardboard, 0.6, 0.5),
        "lamp": _Recipe(pictures.lamp, 0.4, 0.3, 0.2),
    }
    for k in range(4):
        recipes[f"window_{k}"] = _Recipe(pictures.window, 1.0, 0.1, 0.12, glass=True)
    for k in range(PRINTS):
        recipes[f"books_{k}"] = _Recipe(pictures.books, 1.0, 0.45)
        recipes[f"poster_{k}"] = _Recipe(pictures.poster, 1.0, 0.6)
        recipes[f"goods_{k}"] = _Recipe(pictures.goods, 1.0, 0.5)
    for k in range(SHOP_SIGNS):
        recipes[f"shop_sign_{k}"] = _Recipe(pictures.shop_sign, 1.0, 0.5)
    for k in range(ROAD_SIGNS):
        recipes[f"road_sign_{k}"] = _Recipe(lambda r, k=k: pictures.road_sign(r, k), 1.0, 0.9)  # type: ignore[misc]
    for k in range(PLATES):
        recipes[f"plate_{k}"] = _Recipe(pictures.plate, 1.0, 0.8)
    return recipes


def _packed(picture: U8) -> I32:
    r, g, b = np.moveaxis(picture.reshape(-1, 3).astype(np.int32), 1, 0)
    return np.asarray(r | g << 8 | b << 16, np.int32)


@dataclass(frozen=True, slots=True)
class Material:
    """One material of an atlas: ``picture`` uint8 (SIZE, SIZE, 3) RGB; the others as in TextureArrays."""

    picture: U8
    metres: float
    reflectivity: float
    gloss: float = 0.0
    glass: bool = False


def pack_atlas(materials: Iterable[tuple[str, Material]]) -> TextureAtlas:
    """Atlas of named materials; the first is the slow picture (MACRO)."""
    levels: list[I32] = []
    start: list[list[int]] = []
    rows: list[tuple[float, float, float, float, bool]] = []
    names: list[str] = []
    count = 0
    for name, m in materials:
        picture = m.picture
        names.append(name)
        rows.append((m.metres, m.reflectivity, m.gloss, float(picture.mean()), m.glass))
        start.append([])
        for _ in range(LEVELS):
            start[-1].append(count)
            levels.append(_packed(picture))
            count += len(levels[-1])
            half = picture.shape[0] // 2
            picture = np.asarray(cv2.resize(picture, (half, half), interpolation=cv2.INTER_AREA), np.uint8)
    metres, reflectivity, gloss, luma, glass = zip(*rows, strict=True)
    arrays = TextureArrays(
        np.concatenate(levels),
        np.array(start, np.int64),
        np.array(metres, np.float32),
        np.array(reflectivity, np.float32),
        np.array(gloss, np.float32),
        np.array(luma, np.float32),
        np.array(glass, np.bool_),
    )
    return TextureAtlas(arrays, {name: k for k, name in enumerate(names)})


def build_atlas(seed: int, leave_out: tuple[str, ...] = ()) -> TextureAtlas:
    """Materials drawn from ``seed``; the same seed gives the same bytes.

    Those whose names begin with one of ``leave_out`` are not drawn: a world saves the time for what it lacks.
    """

    def drawn(name: str, recipe: _Recipe) -> Material:
        rng = np.random.default_rng([seed, 7, *name.encode()])
        picture = np.rint(np.clip(recipe.draw(rng), 0, 1) * 255).astype(np.uint8)
        return Material(picture, recipe.metres, recipe.reflectivity, recipe.gloss, recipe.glass)

    wanted = {n: r for n, r in _recipes().items() if not n.startswith(leave_out)}
    return pack_atlas((name, drawn(name, recipe)) for name, recipe in wanted.items())
