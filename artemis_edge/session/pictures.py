"""Pictures of a map: from above, in perspective, heat maps of precision and recall (the paper's Fig. 5)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from artemis_edge.evaluate.mesh import Comparison, MeshEvaluation
from artemis_edge.export.mesh import Mesh, finite_rows
from artemis_edge.frames import F32, F64, I32, U8, CameraModel, Trajectory
from artemis_edge.raster import Lamp, Looks, Projection, shade
from artemis_edge.render import View, depth_of, from_above, perspective, visible, write_png
from artemis_edge.session import drawing

Kind = Literal["texture", "label", "confidence", "height"]

WIDTH = 1200
HEIGHT = 800
_SUPERSAMPLING = 2
# The box of a picture leaves out this share of vertices at each end: a few far ones must not shrink the rest.
_TRIM_PERCENT = 0.2
_HEIGHT_TRIM_PERCENT = 2.0
_MARGIN = 0.03
_SMALLEST_M = 1.0
_NARROWEST = 0.25  # a corridor's picture has room for legend and scale
_LIGHT = np.array([-0.35, 0.45, 0.82])
_AMBIENT = 0.45
_EDGE_STRENGTH = 12.0
_UNDIMMED = np.empty((0, 0), np.float32)
_TILTED = 0.7  # cosine: an axis counts as "up" when the sensor's z is this close to it


@dataclass(frozen=True, slots=True)
class Scene:
    """A mesh and a path float64 (n, 3), turned so that z is up; ``low``, ``high`` (3,) the box to show."""

    mesh: Mesh
    vertices: F32
    normals: F32
    path: F64
    low: F64
    high: F64


def scene(mesh: Mesh, trajectory: Trajectory) -> Scene:
    """Turn mesh and trajectory upright: given poses may have a world whose z does not point up."""
    R = _upright(trajectory)
    path = trajectory.T_world_lidar[:, :3, 3] @ R.T
    vertices = (mesh.vertices @ R.T.astype(np.float32)).astype(np.float32)
    finite = vertices[finite_rows(vertices)]
    ends = [path[finite_rows(path)]]
    if len(finite):
        ends.append(np.percentile(finite, [_TRIM_PERCENT, 100.0 - _TRIM_PERCENT], axis=0))
    corners = np.concatenate([*ends, np.zeros((0, 3))])
    if len(corners) == 0:
        corners = np.zeros((1, 3))
    low, high = corners.min(axis=0), corners.max(axis=0)
    least = np.array([*[max(_SMALLEST_M, _NARROWEST * float(np.max((high - low)[:2])))] * 2, _SMALLEST_M])
    grow = np.maximum((high - low) * _MARGIN, 0.5 * (least - (high - low)))
    return Scene(mesh, vertices, mesh.normals @ R.T.astype(np.float32), path, low - grow, high + grow)


def _upright(trajectory: Trajectory) -> F64:
    """Rotation (3, 3) that makes the world's up axis z: the axis nearest to the sensors' mean z."""
    if len(trajectory) == 0:
        return np.eye(3)
    mean = trajectory.T_world_lidar[:, :3, 2].mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    if axis == 2 or abs(mean[axis]) < _TILTED:
        return np.eye(3)
    up = np.zeros(3)
    up[axis] = np.sign(mean[axis])
    forward = np.eye(3)[0 if axis != 0 else 1]
    return np.stack([forward, np.cross(up, forward), up])


def map_from_above(shown: Scene, kind: Kind) -> U8:
    """The map straight from above with path and scale bar, RGB uint8, within 1200 x 800 pixels."""
    return next(maps_from_above(shown, (kind,)))


def maps_from_above(shown: Scene, kinds: Iterable[Kind]) -> Iterator[U8]:
    """As :func:`map_from_above`, one of each kind."""
    extent = shown.high - shown.low
    metres_per_pixel = float(max(extent[0] / WIDTH, extent[1] / HEIGHT))
    view = from_above(shown.low, shown.high, metres_per_pixel / _SUPERSAMPLING)
    points, triangle, _ = visible(view, shown.vertices, shown.mesh.faces)
    ends = _pixels(view, shown.path) / _SUPERSAMPLING
    for kind in kinds:
        image = _shaded(view, points, triangle, shown, kind)
        _draw_path(image, ends)
        drawing.scale_bar(image, metres_per_pixel)
        _explain(image, shown, kind)
        yield image


def perspective_view(shown: Scene, kind: Kind | None = None) -> U8:
    """The map from behind and above the way that was gone, RGB uint8 (800, 1200, 3).

    Without a ``kind``: its texture, or its height where no camera has given it any colour.
    """
    if kind is None:
        kind = "texture" if len(shown.vertices) and np.ptp(shown.mesh.colours) > 0 else "height"
    eye, target = _viewpoint(shown)
    size = _SUPERSAMPLING * np.array([WIDTH, HEIGHT])
    f = 0.75 * size[0]
    camera = CameraModel(int(size[0]), int(size[1]), f, f, size[0] / 2, size[1] / 2)
    view = perspective(camera, _looking_at(eye, target), near_m=0.3, cull=True)
    points, triangle, nearness = visible(view, shown.vertices, shown.mesh.faces)
    image = _shaded(view, points, triangle, shown, kind, _edges(depth_of(view, nearness)))
    _draw_path(image, _pixels(view, shown.path) / _SUPERSAMPLING)
    return image


def heat_maps(comparison: Comparison) -> U8:
    """Precision (mesh samples) and recall (reference points) from above, RGB uint8; darker is worse."""
    points = np.concatenate([comparison.mesh_points, comparison.reference_points])
    low, high = np.percentile(points, [_TRIM_PERCENT, 100.0 - _TRIM_PERCENT], axis=0)
    within = f"within {comparison.tau_m:g} m"
    panels = [
        _heat_map(points_, distance, comparison.tau_m, low, high, f"{name} {share:.3f} {within}")
        for name, share, points_, distance in (
            ("Precision", comparison.precision, comparison.mesh_points, comparison.mesh_distance),
            ("Recall", comparison.recall, comparison.reference_points, comparison.reference_distance),
        )
    ]
    wide = panels[0].shape[1] > panels[0].shape[0]
    return np.concatenate(panels, axis=0 if wide else 1)


def write_heat_maps(path: Path, evaluation: MeshEvaluation) -> None:
    """Heat maps of the first threshold as PNG; raises RunError when the file cannot be written."""
    write_png(path, heat_maps(evaluation.comparisons[0]))


def _shaded(view: View, points: F32, triangle: I32, shown: Scene, kind: Kind, dim: F32 = _UNDIMMED) -> U8:
    """Lit from above, RGB uint8; ``points`` and ``triangle`` as of ``render.visible``."""
    colours = np.ascontiguousarray(_colours(shown, kind), np.uint8)
    looks = Looks(colours, np.ascontiguousarray(shown.normals, np.float32))
    lamp = Lamp(_LIGHT / np.linalg.norm(_LIGHT), _AMBIENT, np.array(drawing.PAPER, np.uint8))
    image = np.empty((*(n // _SUPERSAMPLING for n in triangle.shape), 3), np.uint8)
    shade(points, shown.mesh.faces, triangle, view.projection, looks, lamp, dim, image)
    return image


def _colours(shown: Scene, kind: Kind) -> U8:
    mesh = shown.mesh
    if kind == "label":
        return drawing.LABEL_COLOURS[mesh.labels % len(drawing.LABEL_COLOURS)]
    if kind == "confidence":
        return drawing.scale_colours(mesh.confidence)
    if kind == "height":
        low, high = _heights(shown)
        return drawing.scale_colours((shown.vertices[:, 2] - low) / (high - low))
    return mesh.colours


def _edges(depth: F32) -> F32:
    """Darkening (h, w) 0..1 beside nearer surfaces (eye-dome lighting, Boucheny 2009)."""
    log_depth = np.log2(np.where(np.isnan(depth), np.float32(1e4), depth))
    drop = np.zeros_like(depth)
    for axis in (0, 1):
        for step in (-_SUPERSAMPLING, _SUPERSAMPLING):
            drop += np.clip(log_depth - np.roll(log_depth, step, axis), 0.0, 0.1)
    shade: F32 = np.exp2(-_EDGE_STRENGTH / 4.0 * drop)
    return shade


def _pixels(view: View, points: F64) -> F64:
    """Pixels float64 (n, 2) of world points; NaN for points nearer than the near plane."""
    p: Projection = view.projection
    q = points @ view.T_view_world[:3, :3].T + view.T_view_world[:3, 3]
    with np.errstate(all="ignore"):
        z = np.where(q[:, 2:] >= p.near, 1.0 if p.orthographic else q[:, 2:], np.nan)
        return q[:, :2] / z * [p.fx, p.fy] + [p.cx, p.cy]


def _draw_path(image: U8, pixels: F64) -> None:
    drawing.polyline(image, pixels)
    if len(pixels):
        drawing.dot(image, pixels[0], drawing.INK)
        drawing.dot(image, pixels[-1])


def _heights(shown: Scene) -> tuple[float, float]:
    """Ends of the height scale (m); at least a metre apart."""
    z = shown.vertices[:, 2][np.isfinite(shown.vertices[:, 2])]
    if len(z) == 0:
        return 0.0, _SMALLEST_M
    low, high = np.percentile(z, [_HEIGHT_TRIM_PERCENT, 100.0 - _HEIGHT_TRIM_PERCENT])
    return float(low), float(max(high, low + _SMALLEST_M))


def _explain(image: U8, shown: Scene, kind: Kind) -> None:
    if kind == "confidence":
        drawing.colour_bar(image, [(0.0, "0"), (0.5, "0.5"), (1.0, "1")], "confidence")
    elif kind == "height":
        low, high = _heights(shown)
        ticks = [(k, f"{low + k * (high - low):.1f} m") for k in (0.0, 0.5, 1.0)]
        drawing.colour_bar(image, ticks, "height")
    elif kind == "label":
        palette = drawing.LABEL_COLOURS
        names = [
            (name, tuple(int(c) for c in palette[n % len(palette)]))
            for n, name in sorted(shown.mesh.label_names.items())
        ]
        drawing.legend(image, names)  # type: ignore[arg-type]


def _viewpoint(shown: Scene) -> tuple[F64, F64]:
    """Eye and target: behind the start of the path, high enough to look over what surrounds it."""
    extent = shown.high - shown.low
    reach = 0.5 * float(np.hypot(extent[0], extent[1]))
    middle = 0.5 * (shown.low + shown.high)
    start = shown.path[0] if len(shown.path) else middle
    way = (shown.path[-1] - start if len(shown.path) else np.zeros(3)) * [1, 1, 0]
    if np.linalg.norm(way) < 0.05 * reach:  # standing: look along the longer side of the map
        way = np.array([1.0, 0.0, 0.0] if extent[0] >= extent[1] else [0.0, 1.0, 0.0])
        start = middle
    way /= np.linalg.norm(way)
    target = 0.5 * (start + middle)
    eye = target - 0.75 * reach * way + [0.0, 0.0, 0.55 * reach]
    return eye, target


def _looking_at(eye: F64, target: F64) -> F64:
    """T_world_cam (4, 4) of a camera at ``eye`` with ``target`` in its middle, upright in a z-up world."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, eye
    return T


def _heat_map(points: F64, distance: F64, tau_m: float, low: F64, high: F64, title: str) -> U8:
    """Mean distance per pixel, up to 2 tau, of all points above one another."""
    extent = np.maximum(high - low, _SMALLEST_M)
    metres_per_pixel = float(max(extent[0] / WIDTH, extent[1] / HEIGHT))
    cell = max(metres_per_pixel, tau_m)  # points are tau/2 apart: no gaps between them
    columns, rows = (int(np.ceil(n / cell)) for n in extent[:2])
    u, v = np.floor((points[:, 0] - low[0]) / cell), np.floor((high[1] - points[:, 1]) / cell)
    inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    flat = (v[inside] * columns + u[inside]).astype(np.int64)
    count = np.bincount(flat, minlength=rows * columns)
    worse = np.bincount(flat, np.minimum(distance[inside] / (2.0 * tau_m), 1.0), rows * columns)
    shade = drawing.scale_colours(1.0 - worse / np.maximum(count, 1))
    cells = np.where(count[:, None] > 0, shade, np.uint8(255)).reshape(rows, columns, 3).astype(np.uint8)
    size = (max(round(extent[0] / metres_per_pixel), 320), max(round(extent[1] / metres_per_pixel), 240))
    image = np.full((size[1] + 44, size[0], 3), 255, np.uint8)
    image[44:] = cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST)
    drawing.text(image, title, (16, 30), size_px=18.0)
    ticks = [(0.0, "0"), (0.5, f"{tau_m:g} m"), (1.0, f"{2 * tau_m:g} m")]
    drawing.colour_bar(image, ticks, "distance", bright_low=True)
    drawing.scale_bar(image, metres_per_pixel)
    return image
