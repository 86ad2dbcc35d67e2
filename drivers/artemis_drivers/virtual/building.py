"""Houses with relief: recessed windows and doors, sills, cornices, balconies, awnings, shop signs."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, Shape
from artemis_drivers.virtual.shapes import box, cylinder, merged, panel, pose, prism, solid, tube
from artemis_drivers.virtual.textures import SHOP_SIGNS

Rng = np.random.Generator
BELOW_GROUND = 0.8  # metres that a house reaches below the street
_PANE_M = 0.012  # thickness of window panes


@dataclass(frozen=True, slots=True)
class Hole:
    """Opening in a facade: extent in x and z, depth of the recess, material of what fills it."""

    x0: float
    x1: float
    z0: float
    z1: float
    depth: float
    material: str

    @property
    def glazed(self) -> bool:
        """Filled with a pane that beams pass."""
        return self.material.startswith("window")


@dataclass(frozen=True, slots=True)
class HouseStyle:
    """What a house looks like."""

    wall: str
    base: str
    wall_tint: Colour
    base_tint: Colour
    trim_tint: Colour
    ground_floor_m: float
    floor_m: float
    floors: int

    @property
    def height_m(self) -> float:
        """Height of the eaves."""
        return self.ground_floor_m + self.floor_m * self.floors


def random_style(rng: Rng) -> HouseStyle:
    """A style drawn from ``rng``."""
    warm = np.array([1.0, 0.93, 0.82]) * rng.uniform(0.75, 1.0)
    tints = [
        (0.86, 0.5, 0.4),
        (0.75, 0.62, 0.5),
        tuple(warm),
        (0.72, 0.8, 0.82),
        (0.95, 0.85, 0.55),
        (0.5, 0.68, 0.45),
        (0.42, 0.5, 0.72),
        (0.4, 0.4, 0.42),
        (0.7, 0.25, 0.25),
        tuple(rng.uniform(0.3, 1.0, 3)),
    ]
    tint = np.array(tints[rng.integers(len(tints))]) * rng.uniform(0.8, 1.1)
    base = np.array([1.0, 0.97, 0.92]) * rng.uniform(0.5, 0.85)
    return HouseStyle(
        wall=str(rng.choice(["brick_a", "brick_b", "plaster_a", "plaster_b"])),
        base=str(rng.choice(["stone", "plaster_b", "brick_b"])),
        wall_tint=(float(tint[0]), float(tint[1]), float(tint[2])),
        base_tint=(float(base[0]), float(base[1]), float(base[2])),
        trim_tint=tuple((rng.uniform(0.3, 0.98) * rng.uniform(0.85, 1.0, 3)).tolist()),
        ground_floor_m=float(rng.uniform(3.4, 4.2)),
        floor_m=float(rng.uniform(2.8, 3.3)),
        floors=int(rng.integers(2, 5)),
    )


def add_house(builder: MeshBuilder, rng: Rng, T_world_house: F64, width: float, depth: float) -> None:
    """House with its front in the x-z plane (0..width, street on the -y side, street level z = 0)."""
    style = random_style(rng)
    builder.begin("building")
    holes = _ground_floor(rng, style, width) + _upper_windows(rng, style, width)
    _add_walls(builder, style, holes, T_world_house, width, depth)
    for hole in holes:
        _add_filling(builder, rng, style, hole, T_world_house)
        if hole.glazed:
            _add_room(builder, rng, hole, T_world_house)
    _add_trim(builder, style, holes, T_world_house, width)
    _add_roof(builder, rng, style, T_world_house, width, depth)
    _add_shop_signs(builder, rng, style, holes, T_world_house)
    builder.begin("glass")
    for hole in (h for h in holes if h.glazed):
        pane = fitted_panel(hole.x1 - hole.x0, hole.z1 - hole.z0, _PANE_M)
        T_pane = T_world_house @ pose(hole.x0, hole.depth, hole.z0)
        builder.add(pane, (hole.material, "pane"), (1.0, 1.0, 1.0), T_pane)


def _ground_floor(rng: Rng, style: HouseStyle, width: float) -> list[Hole]:
    top = style.ground_floor_m - 0.95
    door_width = rng.uniform(1.0, 1.3)
    door_left = rng.random() < 0.5
    door_x = 0.6 if door_left else width - 0.6 - door_width
    holes = [Hole(door_x, door_x + door_width, 0.02, min(2.35, top), 0.28, "door")]
    x, end = (door_x + door_width + 0.6, width - 0.6) if door_left else (0.6, door_x - 0.6)
    count = max(int((end - x) / 2.6), 1)
    pitch = (end - x) / count
    for k in range(count):
        shutter = rng.random() < 0.25
        z0 = 0.02 if shutter else rng.uniform(0.55, 0.8)
        material = "shutter" if shutter else f"window_{rng.integers(4)}"
        margin = rng.uniform(0.15, 0.35)
        x0 = x + k * pitch
        holes.append(Hole(x0 + margin, x0 + pitch - margin, z0, top, rng.uniform(0.14, 0.22), material))
    return holes


def _upper_windows(rng: Rng, style: HouseStyle, width: float) -> list[Hole]:
    count = max(int(width / rng.uniform(2.1, 2.8)), 2)
    pitch = width / count
    wide, high = rng.uniform(0.95, 1.3), min(rng.uniform(1.4, 1.8), style.floor_m - 1.1)
    depth = rng.uniform(0.12, 0.2)
    holes = []
    for floor in range(style.floors):
        z0 = style.ground_floor_m + floor * style.floor_m + 0.75
        for k in range(count):
            x0 = (k + 0.5) * pitch - wide / 2
            holes.append(Hole(x0, x0 + wide, z0, z0 + high, depth, f"window_{rng.integers(4)}"))
    return holes


def _quads(corners: F64) -> Shape:
    """Shape of quads (n, 4, 3), corners counter-clockwise seen from outside."""
    n = len(corners)
    pattern = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    triangles = (np.arange(n, dtype=np.int32)[:, None, None] * 4 + pattern).reshape(-1, 3)
    return solid(corners.reshape(-1, 3), triangles)


def _front(holes: list[Hole], width: float, z0: float, z1: float) -> Shape:
    """The wall's face (y = 0) between two heights, cut on a grid through all edges of the openings."""
    xs = np.unique([0.0, width, *(h.x0 for h in holes), *(h.x1 for h in holes)])
    inside = [z for h in holes for z in (h.z0, h.z1) if z0 < z < z1]
    zs = np.unique([z0, z1, *inside])
    cells = []
    for xa, xb in itertools.pairwise(xs):
        for za, zb in itertools.pairwise(zs):
            x, z = (xa + xb) / 2, (za + zb) / 2
            if not any(h.x0 < x < h.x1 and h.z0 < z < h.z1 for h in holes):
                cells.append([(xa, 0, za), (xb, 0, za), (xb, 0, zb), (xa, 0, zb)])
    return _quads(np.array(cells, np.float64))


def _reveal(hole: Hole) -> Shape:
    """The four sides of an opening, seen from inside it."""
    a, b, c, d, y = hole.x0, hole.x1, hole.z0, hole.z1, hole.depth
    return _quads(
        np.array(
            [
                [(a, 0, c), (a, y, c), (a, y, d), (a, 0, d)],
                [(b, y, c), (b, 0, c), (b, 0, d), (b, y, d)],
                [(a, 0, c), (b, 0, c), (b, y, c), (a, y, c)],
                [(a, y, d), (b, y, d), (b, 0, d), (a, 0, d)],
            ],
            np.float64,
        )
    )


def _without_part(shape: Shape, part: int) -> Shape:
    keep = shape.part != part
    return Shape(shape.vertices, shape.triangles[keep], shape.uv[keep], shape.part[keep])


def _add_walls(
    builder: MeshBuilder, style: HouseStyle, holes: list[Hole], T: F64, width: float, depth: float
) -> None:
    low = [h for h in holes if h.z1 <= style.ground_floor_m]
    high = [h for h in holes if h.z1 > style.ground_floor_m]
    base = merged([_front(low, width, -BELOW_GROUND, style.ground_floor_m), *(_reveal(h) for h in low)])
    wall = merged([_front(high, width, style.ground_floor_m, style.height_m), *(_reveal(h) for h in high)])
    builder.add(base, style.base, style.base_tint, T)
    builder.add(wall, style.wall, style.wall_tint, T)
    body = _without_part(box((0, 0, -BELOW_GROUND), (width, depth, style.height_m)), 2)
    builder.add(body, style.wall, style.wall_tint, T)


def fitted_panel(width: float, height: float, thickness: float) -> Shape:
    """A :func:`panel` whose front shows the whole picture of a 1 m material once."""
    shape = panel(width, height, thickness)
    scale = np.where((shape.part == 0)[:, None, None], [[[1 / width, 1 / height]]], 1.0)
    return Shape(shape.vertices, shape.triangles, shape.uv * scale, shape.part)


def _add_filling(builder: MeshBuilder, rng: Rng, style: HouseStyle, hole: Hole, T: F64) -> None:
    wide, high = hole.x1 - hole.x0, hole.z1 - hole.z0
    if not hole.glazed:
        filling = fitted_panel(wide, high, 0.05) if hole.material != "shutter" else panel(wide, high, 0.05)
        r, g, b = rng.uniform(0.3, 1.0, 3)
        tint: Colour = (float(r), float(g), float(b))
        builder.add(filling, (hole.material, "wood"), tint, T @ pose(hole.x0, hole.depth, hole.z0))
    frame = 0.06
    if hole.glazed:
        bars = merged(
            [
                box((0, -0.03, 0), (frame, 0.02, high)),
                box((wide - frame, -0.03, 0), (wide, 0.02, high)),
                box((frame, -0.03, 0), (wide - frame, 0.02, frame)),
                box((frame, -0.03, high - frame), (wide - frame, 0.02, high)),
            ]
        )
        builder.add(bars, "wood", style.trim_tint, T @ pose(hole.x0, hole.depth, hole.z0))
        sill = box((hole.x0 - 0.07, -0.09, hole.z0 - 0.07), (hole.x1 + 0.07, hole.depth, hole.z0))
        builder.add(sill, "concrete", style.trim_tint, T)
    if hole.z0 > style.ground_floor_m and rng.random() < 0.12:
        _add_balcony(builder, T @ pose(hole.x0 - 0.35, 0, hole.z0 - 0.75), wide + 0.7)


def _add_room(builder: MeshBuilder, rng: Rng, hole: Hole, T: F64) -> None:
    """What lies behind a pane: a curtain or blind close to it, or the room's far wall."""
    y0 = hole.depth - 0.02
    y1 = y0 + (rng.uniform(0.15, 0.5) if rng.random() < 0.5 else rng.uniform(1.5, 4.0))
    a, b, c, d = hole.x0, hole.x1, hole.z0, hole.z1
    back = [(a, y1, c), (b, y1, c), (b, y1, d), (a, y1, d)]
    sides = [
        [(a, y0, c), (a, y1, c), (a, y1, d), (a, y0, d)],
        [(b, y1, c), (b, y0, c), (b, y0, d), (b, y1, d)],
        [(a, y0, c), (b, y0, c), (b, y1, c), (a, y1, c)],
        [(a, y1, d), (b, y1, d), (b, y0, d), (a, y0, d)],
    ]
    room = _quads(np.array([back, *sides], np.float64))
    r, g, b_ = rng.uniform(0.3, 0.9, 3)
    builder.add(room, "cloth", (float(r), float(g), float(b_)), T)


def _add_balcony(builder: MeshBuilder, T: F64, width: float) -> None:
    depth, high = 0.9, 1.0
    builder.add(box((0, -depth, -0.14), (width, 0.1, 0.0)), "concrete", (1, 1, 1), T)
    rails = [box((0, -depth, high - 0.05), (width, -depth + 0.05, high))]
    rails += [box((x, -depth, high - 0.05), (x + 0.05, 0.05, high - 0.005)) for x in (0.0, width - 0.05)]
    for x in np.linspace(0.02, width - 0.05, max(int(width / 0.14), 2)):
        rails.append(box((x, -depth + 0.01, -0.02), (x + 0.025, -depth + 0.035, high - 0.02)))
    builder.add(merged(rails), "metal", (0.25, 0.25, 0.27), T)


def _add_trim(builder: MeshBuilder, style: HouseStyle, holes: list[Hole], T: F64, width: float) -> None:
    top, band = style.height_m, style.ground_floor_m
    parts = [
        box((-0.02, -0.28, top - 0.3), (width + 0.02, 0.1, top)),
        box((-0.01, -0.16, top - 0.45), (width + 0.01, 0.1, top - 0.29)),
        box((0, -0.07, band - 0.12), (width, 0.1, band + 0.06)),
    ]
    parts += [
        box((0, -0.035, band + f * style.floor_m - 0.05), (width, 0.1, band + f * style.floor_m + 0.05))
        for f in range(1, style.floors)
    ]
    builder.add(merged(parts), "concrete", style.trim_tint, T)
    edges = [0.0, *(x for h in sorted(holes, key=lambda h: h.x0) if h.z0 < 0.5 for x in (h.x0, h.x1)), width]
    plinth = [
        box((a, -0.05, -BELOW_GROUND), (b, 0.1, 0.5))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if b - a > 0.05
    ]
    builder.add(merged(plinth), "stone", style.base_tint, T)
    pipe = np.array([[width - 0.12, -0.09, 0.05], [width - 0.12, -0.09, top - 0.46]])
    builder.add(tube(pipe, (0.05, 0.05), 8), "metal", (0.6, 0.62, 0.62), T)


def _add_roof(builder: MeshBuilder, rng: Rng, style: HouseStyle, T: F64, width: float, depth: float) -> None:
    rise, out = rng.uniform(1.8, 3.2), 0.25
    top = style.height_m
    profile = [(-out, top - 0.05), (depth + out, top - 0.05), (depth / 2, top + rise)]
    gable = prism(profile, -width, 0.0)  # profile runs along x: turn it so that it runs along y
    tint = np.array([0.8, 0.42, 0.34]) if rng.random() < 0.6 else rng.uniform(0.4, 0.6, 3)
    builder.add(
        gable, ("roof", "plaster_a"), (tuple(tint.tolist()), style.wall_tint), T @ pose(yaw=np.pi / 2)
    )
    x = rng.uniform(1.0, width - 1.6)
    chimney = box((x, depth * 0.3, top), (x + 0.6, depth * 0.3 + 0.6, top + rise + 0.5))
    builder.add(chimney, "brick_a", (0.8, 0.5, 0.42), T)


def _add_shop_signs(builder: MeshBuilder, rng: Rng, style: HouseStyle, holes: list[Hole], T: F64) -> None:
    shops = [h for h in holes if h.z0 < 1.0 and h.material.startswith("window")]
    if not shops or rng.random() < 0.35:
        return
    material = f"shop_sign_{rng.integers(SHOP_SIGNS)}"
    left, right = min(h.x0 for h in shops), max(h.x1 for h in shops)
    wide = min(right - left, rng.uniform(2.0, 3.4))
    x = left + rng.random() * (right - left - wide)
    builder.begin("sign")
    T_board = T @ pose(x, -0.09, style.ground_floor_m - 0.82)
    builder.add(fitted_panel(wide, 0.62, 0.12), (material, "metal"), (1, 1, 1), T_board)
    if rng.random() < 0.5:
        builder.begin("sign")
        T_blade = T @ pose(left - 0.15, -0.85, style.ground_floor_m - 0.5, yaw=np.pi / 2)
        builder.add(fitted_panel(0.75, 0.75, 0.06), (material, "metal"), (1, 1, 1), T_blade)
        T_back = T_blade @ pose(0.75, 0.059, 0, yaw=np.pi)
        builder.add(fitted_panel(0.75, 0.75, 0.02), (material, "metal"), (1, 1, 1), T_back)
        builder.add(box((0.7, 0.01, 0.6), (0.9, 0.05, 0.64)), "metal", (0.3, 0.3, 0.3), T_blade)
    if rng.random() < 0.5:
        _add_awning(builder, rng, T @ pose(left - 0.1, 0, style.ground_floor_m - 0.95), right - left + 0.2)


def _add_awning(builder: MeshBuilder, rng: Rng, T: F64, width: float) -> None:
    builder.begin("building")
    out = rng.uniform(0.8, 1.2)
    slope = prism([(-0.05, -0.03), (out, -0.45), (out, -0.42), (-0.05, 0.0)], 0.0, width)
    valance = box((out - 0.02, 0, -0.62), (out, width, -0.44))
    awning = merged([slope, valance])
    tint = rng.uniform(0.3, 1.0, 3)
    T_awning = T @ pose(yaw=-np.pi / 2)
    builder.add(awning, "cloth", (float(tint[0]), float(tint[1]), float(tint[2])), T_awning)


def add_gate_wall(builder: MeshBuilder, rng: Rng, T: F64, width: float) -> None:
    """Wall with a wooden gate that closes the gap between two houses; front like :func:`add_house`."""
    builder.begin("building")
    high = rng.uniform(2.2, 2.9)
    gate = Hole(width / 2 - 0.6, width / 2 + 0.6, 0.02, 2.0, 0.12, "door")
    face = merged([_front([gate], width, -BELOW_GROUND, high), _reveal(gate)])
    body = _without_part(box((0, 0, -BELOW_GROUND), (width, 0.3, high)), 2)
    r, g, b = rng.uniform(0.5, 1.0, 3)
    tint = (float(r), float(g), float(b))
    builder.add(face, "brick_b", tint, T)
    builder.add(body, "brick_b", tint, T)
    builder.add(
        fitted_panel(1.2, 1.98, 0.05), ("door", "wood"), (0.5, 0.6, 0.5), T @ pose(gate.x0, 0.12, 0.02)
    )
    builder.add(box((-0.01, -0.06, high), (width + 0.01, 0.36, high + 0.09)), "concrete", (0.9, 0.9, 0.9), T)
    for x in (0.15, width - 0.15):
        builder.add(cylinder(0.09, high + 0.05, high + 0.3, 8), "concrete", (1, 1, 1), T @ pose(x, 0.15))
