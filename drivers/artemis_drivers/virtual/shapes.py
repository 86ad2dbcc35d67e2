"""Closed solids from code: boxes, prisms, lofts, tubes, ellipsoids, leaf cards and letter panels.

All lengths are metres; every triangle is wound so that its normal points out of the solid.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from artemis_drivers.virtual.mesh_builder import F64, I32, Shape

Numbers = Sequence[float] | F64


def pose(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> F64:
    """4 x 4 transform: translation, then Rz(yaw) Ry(pitch) Rx(roll), radians."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    T = np.eye(4)
    T[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    T[:3, 3] = x, y, z
    return T


def planar_uv(vertices: F64, triangles: I32) -> F64:
    """Texture coordinates (m, 3, 2) in metres: corners projected along the main axis of the triangle."""
    corners = vertices[triangles]
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axis = np.argmax(normal, axis=1)
    u = np.where(axis == 0, 1, 0)
    v = np.where(axis == 2, 1, 2)
    rows = np.arange(len(triangles))
    return np.stack([corners[rows, :, u], corners[rows, :, v]], axis=-1)


def solid(vertices: F64, triangles: I32, part: I32 | None = None, uv: F64 | None = None) -> Shape:
    """A shape with planar texture coordinates unless others are given."""
    triangles = np.ascontiguousarray(triangles, np.int32)
    part = np.zeros(len(triangles), np.int32) if part is None else part
    return Shape(vertices, triangles, planar_uv(vertices, triangles) if uv is None else uv, part)


def merged(shapes: Sequence[Shape]) -> Shape:
    """Several shapes as one."""
    first = np.cumsum([0] + [len(s.vertices) for s in shapes[:-1]])
    return Shape(
        np.concatenate([s.vertices for s in shapes]),
        np.concatenate([s.triangles + np.int32(k) for s, k in zip(shapes, first, strict=True)]),
        np.concatenate([s.uv for s in shapes]),
        np.concatenate([s.part for s in shapes]),
    )


_BOX_QUADS = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def box(low: Numbers, high: Numbers) -> Shape:
    """Axis-parallel box; parts 0..5: bottom, top, -y, +x, +y, -x."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    base = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    vertices = np.array([(x, y, z0) for x, y in base] + [(x, y, z1) for x, y in base], np.float64)
    triangles = np.array([t for a, b, c, d in _BOX_QUADS for t in ((a, b, c), (a, c, d))], np.int32)
    return solid(vertices, triangles, np.repeat(np.arange(6, dtype=np.int32), 2))


def loft(rings: F64, closed_ends: bool = True) -> Shape:
    """Solid through cross sections ``rings`` (k, n, 3).

    Seen against the direction from first to last ring, each ring runs counter-clockwise. Part 0 are the
    sides, part 1 the end caps (fans around the ring's mean, so rings must be star-shaped about it).
    """
    k, n, _ = rings.shape
    i, j = np.meshgrid(np.arange(k - 1), np.arange(n), indexing="ij")
    a, b = i * n + j, i * n + (j + 1) % n
    c, d = b + n, a + n
    sides = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    vertices, triangles, part = rings.reshape(-1, 3), [sides], [np.zeros(len(sides), np.int32)]
    if closed_ends:
        ends = np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
        vertices = np.concatenate([vertices, ends])
        ring, following = np.arange(n), (np.arange(n) + 1) % n
        first = np.stack([np.full(n, k * n), following, ring], -1)
        last = np.stack([np.full(n, k * n + 1), (k - 1) * n + ring, (k - 1) * n + following], -1)
        triangles += [first, last]
        part.append(np.ones(2 * n, np.int32))
    return solid(vertices, np.concatenate(triangles).astype(np.int32), np.concatenate(part))


def prism(polygon: Sequence[tuple[float, float]], y0: float, y1: float) -> Shape:
    """Polygon in the x-z plane (counter-clockwise seen from -y, star-shaped), extruded along y."""
    xz = np.array(polygon, np.float64)
    rings = np.stack([np.column_stack([xz[:, 0], np.full(len(xz), y), xz[:, 1]]) for y in (y1, y0)])
    return loft(rings)


def tube(path: F64, radius: Numbers, sides: int = 10) -> Shape:
    """Round solid along ``path`` (k, 3) with a radius at each point; texture wraps around it in metres."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    helper = np.array([1.0, 0.0, 0.0]) if abs(tangent[0, 0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(helper, tangent)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(tangent, right)
    angle = 2 * np.pi * np.arange(sides) / sides
    r = np.asarray(radius, np.float64)[:, None, None]
    around = np.cos(angle)[:, None] * right[:, None, :] + np.sin(angle)[:, None] * up[:, None, :]
    shape = loft(path[:, None, :] + r * around)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return Shape(shape.vertices, shape.triangles, _tube_uv(shape, along, max(radius), sides), shape.part)


def _tube_uv(shape: Shape, along: F64, radius: float, sides: int) -> F64:
    uv = shape.uv.copy()
    rows = np.flatnonzero(shape.part == 0)
    corner = shape.triangles[rows]
    ring, k = corner // sides, corner % sides
    # the last strip ends at angle 1, not back at 0
    k = np.where((k == 0) & (k.max(axis=1, keepdims=True) == sides - 1), sides, k)
    uv[rows, :, 0] = 2 * np.pi * radius * k / sides
    uv[rows, :, 1] = along[ring]
    return uv


def cylinder(radius: float, z0: float, z1: float, sides: int = 12, top_radius: float | None = None) -> Shape:
    """Upright cylinder or frustum about the z axis."""
    return tube(
        np.array([[0.0, 0.0, z0], [0.0, 0.0, z1]]),
        (radius, radius if top_radius is None else top_radius),
        sides,
    )


def ellipsoid(radii: Numbers, sides: int = 12, rings: int = 8) -> Shape:
    """Ellipsoid about the origin (z radius last)."""
    theta = np.pi * (np.arange(rings) + 0.5) / rings - np.pi / 2
    phi = 2 * np.pi * np.arange(sides) / sides
    x = np.cos(theta)[:, None] * np.cos(phi)
    y = np.cos(theta)[:, None] * np.sin(phi)
    z = np.repeat(np.sin(theta)[:, None], sides, axis=1)
    shape = loft(np.stack([x, y, z], axis=-1))
    vertices = shape.vertices.copy()
    vertices[-2:] = [0, 0, -1], [0, 0, 1]  # the caps' centres become the poles
    return solid(vertices * np.asarray(radii, np.float64), shape.triangles)


def limb(a: Numbers, b: Numbers, ra: float, rb: float, sides: int = 10) -> Shape:
    """Rounded limb between two points: a tube with hemispherical ends."""
    start, end = np.asarray(a, np.float64), np.asarray(b, np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    steps = np.array([-1.0, -0.7, 0.0])
    path = np.concatenate([start + ra * steps[:, None] * axis, end - rb * steps[::-1, None] * axis])
    thin = np.sqrt(1 - steps**2)
    radius = np.concatenate([ra * np.maximum(thin, 0.05), rb * np.maximum(thin[::-1], 0.05)])
    return tube(path, tuple(radius), sides)


def panel(width: float, height: float, thickness: float) -> Shape:
    """Board in the x-z plane facing -y, lower left at the origin.

    Part 0 is the front with texture coordinates 0..width, 0..height (letters read from -y), part 1 the rest.
    """
    board = box((0, 0, 0), (width, thickness, height))
    front = board.part == 2
    return Shape(board.vertices, board.triangles, board.uv, np.where(front, 0, 1).astype(np.int32))


def disc_panel(radius: float, thickness: float, sides: int = 24) -> Shape:
    """Round board in the x-z plane facing -y, centred on the origin; part 0 front, part 1 the rest."""
    angle = 2 * np.pi * np.arange(sides) / sides
    shape = prism(
        list(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True)), -thickness / 2, thickness / 2
    )
    normal_y = np.cross(
        shape.vertices[shape.triangles[:, 1]] - shape.vertices[shape.triangles[:, 0]],
        shape.vertices[shape.triangles[:, 2]] - shape.vertices[shape.triangles[:, 0]],
    )[:, 1]
    front = (shape.part == 1) & (normal_y < 0)
    uv = shape.uv + np.where(front, radius, 0.0)[:, None, None]
    return Shape(shape.vertices, shape.triangles, uv, np.where(front, 0, 1).astype(np.int32))


def leaf_cards(centres: F64, normals: F64, spin: F64, length: float, width: float) -> Shape:
    """Pointed leaves, folded a little: flat closed tetrahedra. ``centres``, ``normals`` (n, 3), ``spin`` (n,)
    radians.
    """
    n = len(centres)
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    a = np.cross(helper, normals)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normals, a)
    along = np.cos(spin)[:, None] * a + np.sin(spin)[:, None] * b
    across = np.cross(normals, along)
    fold = normals * 0.006  # metres: thin enough to look flat, thick enough for float32
    rim = [along * length + fold, across * width - fold, fold - along * length, -across * width - fold]
    vertices = (centres[:, None, :] + np.stack(rim, axis=1) / 2).reshape(-1, 3)
    pattern = np.array([(0, 1, 2), (0, 2, 3), (1, 0, 3), (1, 3, 2)], np.int32)
    triangles = (np.arange(n, dtype=np.int32)[:, None, None] * 4 + pattern).reshape(-1, 3)
    local = np.array([(length / 2, 0), (0, width / 2), (-length / 2, 0), (0, -width / 2)], np.float64)
    uv = np.tile(local[pattern], (n, 1, 1)) + np.repeat(spin, len(pattern))[:, None, None]
    return Shape(vertices, triangles, uv, np.zeros(len(triangles), np.int32))


def bar(a: Numbers, b: Numbers, thickness: float) -> Shape:
    """Square bar between two points."""
    return tube(np.stack([np.asarray(a, np.float64), np.asarray(b, np.float64)]), (thickness / 1.414,) * 2, 4)
