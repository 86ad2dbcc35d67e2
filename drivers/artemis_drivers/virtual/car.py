"""Cars: a lofted body, a cabin with windows and seats, wheels, lights, mirrors and number plates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from artemis_drivers.virtual.building import fitted_panel
from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, Shape
from artemis_drivers.virtual.shapes import box, cylinder, ellipsoid, loft, merged, pose
from artemis_drivers.virtual.textures import PLATES

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class _Kind:
    """Proportions: lengths in metres, positions as a share of the length from the rear."""

    length: float
    width: float
    roof: float  # height of the roof
    belt: float  # height of the lower edge of the windows
    cabin: tuple[float, float, float, float]  # rear foot, rear roof, front roof, front foot
    bonnet: float  # height of the bonnet at the front wheels


_KINDS = (
    _Kind(3.95, 1.72, 1.48, 0.93, (0.03, 0.10, 0.58, 0.74), 0.86),
    _Kind(4.55, 1.80, 1.45, 0.93, (0.14, 0.27, 0.56, 0.72), 0.85),
    _Kind(4.65, 1.82, 1.50, 0.95, (0.02, 0.08, 0.58, 0.73), 0.88),
    _Kind(4.95, 1.92, 1.95, 1.10, (0.01, 0.04, 0.72, 0.86), 1.02),
)


def add_car(builder: MeshBuilder, rng: Rng, T_world_car: F64) -> None:
    """Car standing on z = 0 around the origin, front towards +x."""
    kind = _KINDS[rng.integers(len(_KINDS))]
    scale = rng.uniform(0.96, 1.04)
    T = T_world_car @ pose(-kind.length * scale / 2) @ np.diag([scale, scale, scale, 1.0])
    paint = _paint(rng)
    builder.begin("car")
    builder.add(_body(kind), "car_paint", paint, T)
    builder.add(_cabin(kind), ("car_paint", "pane"), paint, T)
    _add_seats(builder, rng, kind, T)
    _add_wheels(builder, kind, T)
    _add_details(builder, rng, kind, paint, T)


def _paint(rng: Rng) -> Colour:
    """Half of all cars are white, grey or black, the others have any colour."""
    if rng.random() < 0.5:
        grey = float(rng.choice([0.12, 0.3, 0.5, 0.68, 0.9]) * rng.uniform(0.85, 1.1))
        return (grey, grey, 1.03 * grey)
    r, g, b = rng.uniform(0.06, 0.95, 3)
    return (float(r), float(g), float(b))


def _add_seats(builder: MeshBuilder, rng: Rng, kind: _Kind, T: F64) -> None:
    """What a beam meets through the windows: two front seats with headrests and a rear bench."""
    rear, front = kind.cabin[0] * kind.length, kind.cabin[3] * kind.length
    middle, top = 0.45 * rear + 0.55 * front, kind.roof - 0.22
    grey = float(rng.uniform(0.15, 0.5))
    half = 0.78 * kind.width / 2
    seats = [box((rear + 0.55, -half, kind.belt - 0.3), (rear + 0.72, half, top - 0.12))]
    for side in (-0.5, 0.5):
        y = side * half
        seats.append(box((middle - 0.1, y - 0.22, kind.belt - 0.3), (middle + 0.05, y + 0.22, top - 0.12)))
        seats.append(box((middle - 0.08, y - 0.12, top - 0.14), (middle + 0.02, y + 0.12, top + 0.05)))
    builder.add(merged(seats), "cloth", (grey, grey, grey), T)


def _body(kind: _Kind) -> Shape:
    """Lower body as cross sections along x."""
    deck = kind.belt + 0.02
    # share of length, share of half width, lower edge, shoulder, top
    stations = [
        (0.000, 0.86, 0.42, 0.62, 0.72),
        (0.012, 0.93, 0.34, 0.72, deck - 0.10),
        (0.050, 0.97, 0.28, 0.76, deck - 0.02),
        (0.160, 1.00, 0.22, 0.80, deck),
        (0.420, 1.00, 0.20, 0.79, deck),
        (0.700, 1.00, 0.21, 0.77, deck),
        (0.780, 0.99, 0.22, 0.75, kind.bonnet + 0.03),
        (0.900, 0.96, 0.25, 0.68, kind.bonnet - 0.05),
        (0.975, 0.91, 0.30, 0.58, kind.bonnet - 0.16),
        (1.000, 0.80, 0.38, 0.52, kind.bonnet - 0.27),
    ]
    rings = []
    for share, wide, low, shoulder, top in stations:
        w = wide * kind.width / 2
        side = shoulder - low
        half = [
            (0.80 * w, low),
            (0.97 * w, low + 0.2 * side),
            (w, low + 0.75 * side),
            (0.99 * w, shoulder),
            (0.90 * w, top),
            (0.50 * w, top + 0.025),
        ]
        ring = [(-y, z) for y, z in half[:1]] + half + [(-y, z) for y, z in half[:0:-1]]
        rings.append([(share * kind.length, y, z) for y, z in ring])
    return loft(np.array(rings, np.float64))


def _cabin(kind: _Kind) -> Shape:
    """Cabin as horizontal sections; the middle band is glass except for the pillars (part 1)."""
    rear, rear_roof, front_roof, front = (share * kind.length for share in kind.cabin)
    low, high = kind.belt, kind.roof
    bands = [(low - 0.10, 0.0), (low, 0.02), (high - 0.09, 0.90), (high - 0.02, 0.99), (high, 1.06)]
    rings = []
    for z, t in bands:
        xr, xf = rear + (rear_roof - rear) * t, front + (front_roof - front) * t
        w = kind.width / 2 * (0.93 - 0.17 * min(t, 1.0))
        inset = 0.10 if t < 1 else 0.2
        post = [xr + (xf - xr) * s for s in (0.0, 0.06, 0.09, 0.46, 0.50, 0.91, 0.94, 1.0)]
        right = [(x, -w) for x in post[1:-1]]
        ring = [(xr, -w + inset), *right, (xf, -w + inset), (xf + 0.04 * (1 - t), 0.0), (xf, w - inset)]
        ring += [(x, w) for x, _ in right[::-1]] + [(xr, w - inset), (xr - 0.02, 0.0)]
        rings.append([(x, y, z) for x, y in ring])
    shape = loft(np.array(rings, np.float64))
    n = len(rings[0])
    band, side = np.divmod(np.arange(len(shape.triangles)) // 2, n)
    panes = np.isin(side, [2, 4, 7, 8, 11, 13, 16, 17])
    glass = (band == 1) & panes & (shape.part == 0)
    return Shape(shape.vertices, shape.triangles, shape.uv, glass.astype(np.int32))


def _add_wheels(builder: MeshBuilder, kind: _Kind, T: F64) -> None:
    radius = 0.31 if kind.roof < 1.7 else 0.34
    side = kind.width / 2
    for x in (0.175 * kind.length, 0.815 * kind.length):
        for sign in (-1.0, 1.0):
            T_wheel = T @ pose(x, sign * (side - 0.11), radius, roll=np.pi / 2)
            builder.add(
                cylinder(radius + 0.055, -0.10, 0.10, 14),
                "rubber",
                (0.08, 0.08, 0.08),
                T_wheel @ pose(z=-sign * 0.012),
            )
            builder.add(
                cylinder(radius, -0.11, 0.11, 18),
                "rubber",
                (0.16, 0.16, 0.17),
                T_wheel @ pose(z=-sign * 0.015),
            )
            builder.add(
                cylinder(radius * 0.62, -0.11, 0.11, 12),
                "metal",
                (0.75, 0.75, 0.78),
                T_wheel @ pose(z=-sign * 0.028),
            )


def _add_details(builder: MeshBuilder, rng: Rng, kind: _Kind, paint: Colour, T: F64) -> None:
    length, half = kind.length, kind.width / 2
    for sign in (-1.0, 1.0):
        mirror = T @ pose(kind.cabin[3] * length - 0.32, sign * (half + 0.06), kind.belt + 0.08)
        builder.add(ellipsoid((0.07, 0.11, 0.075), 10, 6), "car_paint", paint, mirror)
        front = T @ pose(0.965 * length, sign * 0.66 * half, 0.62 * kind.bonnet + 0.06)
        builder.add(ellipsoid((0.14, 0.19, 0.085), 10, 6), "lamp", (0.95, 0.97, 1.0), front)
        rear = T @ pose(0.012 * length, sign * 0.72 * half, 0.74 * kind.belt + 0.06)
        builder.add(ellipsoid((0.07, 0.15, 0.10), 10, 6), "lamp", (0.75, 0.05, 0.05), rear)
    builder.add(box((-0.02, -0.7 * half, 0.36), (0.1, 0.7 * half, 0.46)), "plastic", (0.12, 0.12, 0.12), T)
    grille = box((length - 0.12, -0.55 * half, 0.38), (length + 0.012, 0.55 * half, 0.5))
    builder.add(grille, "plastic", (0.1, 0.1, 0.1), T)
    material = f"plate_{rng.integers(PLATES)}"
    for T_plate in (pose(length + 0.03, -0.26, 0.40, yaw=np.pi / 2), pose(-0.04, 0.26, 0.5, yaw=-np.pi / 2)):
        builder.add(fitted_panel(0.52, 0.115, 0.05), (material, "plastic"), (1, 1, 1), T @ T_plate)
