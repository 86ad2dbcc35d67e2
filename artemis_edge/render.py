"""Views of a mesh: depth, triangles and vertex values per pixel; in perspective, through a lens, from above.

Used for reference depth maps, previews, pictures and ``artemis-edge render``. Kernels: ``raster.py``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from artemis_edge.atlas_raster import find_texels, sample_page
from artemis_edge.errors import InputError
from artemis_edge.export.atlas import Atlas
from artemis_edge.export.atomic import replacing, write_bytes
from artemis_edge.export.ply import Mesh
from artemis_edge.export.png import png_bytes
from artemis_edge.frames import F32, F64, I32, U8, Bool, CameraModel
from artemis_edge.highlighted import highlighted_triangles
from artemis_edge.known_lenses import known_falloff
from artemis_edge.lens import CAMERA_RULE, is_camera, undistorted_lines
from artemis_edge.lens import falloff as left_by_lens
from artemis_edge.opened_map import map_folder, open_map
from artemis_edge.progress import say
from artemis_edge.raster import NOTHING, Projection, draw, interpolate, project
from artemis_edge.trajectory import FARTHEST_M, inverse, matrix_from_quaternion

NEAR_M = 0.05
# The canvas behind a lens is finer than the picture, so that borders fall within half a pixel of their place.
_LENS_OVERSAMPLING = 2.0
_LARGEST_CANVAS = 1 << 25
_LONGEST_SIDE = 65_535  # of pictures that other programs open
_SHORTEST = 1e-6  # a quaternion off the unit length by more than this factor is a slip of the pen
# Where in a pixel the colours are taken whose mean it shows, beside its centre: the turned grid of multisampling
_WITHIN_PX = ((0.125, 0.375), (0.375, -0.125), (-0.125, -0.375), (-0.375, 0.125))
# What is highlighted keeps some of its own colour, so that it can be recognised.
_TINT, _TINT_SHARE = np.array([255.0, 64.0, 0.0], np.float32), np.float32(0.6)
_NO_VALUES = np.empty((0, 0), np.float32)


@dataclass(frozen=True, slots=True)
class View:
    """An image of ``height`` x ``width`` pixels without lens distortion, and where it is taken from."""

    width: int
    height: int
    projection: Projection
    T_view_world: F64


@dataclass(frozen=True, slots=True)
class Rendering:
    """``depth`` float32 (h, w) metres along z, NaN where nothing; ``triangle`` int32 (h, w), -1 where
    nothing; ``values`` float32 (h, w, k): the vertices' values interpolated, 0 where nothing.
    """

    depth: F32
    triangle: I32
    values: F32

    @property
    def covered(self) -> Bool:
        """Bool (h, w): the pixel shows a triangle."""
        shown: Bool = self.triangle != NOTHING
        return shown


def perspective(camera: CameraModel, T_world_cam: F64, near_m: float = NEAR_M, cull: bool = False) -> View:
    """Pinhole view of ``camera`` (its distortion left aside); ``cull`` hides triangles seen from behind."""
    projection = Projection(camera.fx, camera.fy, camera.cx, camera.cy, near_m, False, cull)
    return View(camera.width, camera.height, projection, inverse(T_world_cam))


def from_above(low: F64, high: F64, metres_per_pixel: float, cull: bool = True) -> View:
    """Orthographic view straight down on the box ``low`` .. ``high`` (3,); world z is up, +y up in the image.

    With ``cull``, ceilings seen from behind do not hide the floor.
    """
    width, height = (max(int(np.ceil(extent / metres_per_pixel)), 1) for extent in (high - low)[:2])
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = high[2]
    scale = 1.0 / metres_per_pixel
    cx, cy = -0.5 - low[0] * scale, -0.5 + high[1] * scale
    return View(width, height, Projection(scale, scale, cx, cy, -np.inf, True, cull), T)


def render(view: View, vertices: F32, faces: I32, values: F32 = _NO_VALUES) -> Rendering:
    """Draw faces int32 (m, 3) of ``vertices`` float32 (n, 3); ``values`` float32 (n, k) are interpolated."""
    points, triangle, nearness = visible(view, vertices, faces)
    if values.shape[1] == 0:
        return Rendering(depth_of(view, nearness), triangle, np.zeros((*triangle.shape, 0), np.float32))
    sight = _Sight(points, triangle, _sight_lines(view), view.projection.orthographic)
    return _interpolated(sight, faces, values)


def depth_map(view: View, vertices: F32, faces: I32) -> F32:
    """Reference depth float32 (h, w): metres along z, NaN where nothing."""
    return depth_of(view, visible(view, vertices, faces)[2])


def render_camera(
    camera: CameraModel, T_world_cam: F64, vertices: F32, faces: I32, values: F32 = _NO_VALUES
) -> Rendering:
    """As :func:`render`, through the camera's lens, so that the result overlays its photograph.

    What is seen at a pixel is decided on a finer pinhole canvas; where its line of sight meets that triangle
    is computed exactly. Pixels that no line of sight of the lens model reaches show nothing.
    """
    return _interpolated(_look(camera, T_world_cam, vertices, faces), faces, values)


@dataclass(frozen=True, slots=True)
class _Sight:
    """What each pixel shows: ``points`` (n, 3) in view coordinates, ``triangle`` and sight ``lines`` per pixel."""

    points: F32
    triangle: I32
    lines: F32
    orthographic: bool = False


def _look(camera: CameraModel, T_world_cam: F64, vertices: F32, faces: I32) -> _Sight:
    if not any(camera.distortion):
        view = perspective(camera, T_world_cam)
        points, triangle, _ = visible(view, vertices, faces)
        return _Sight(points, triangle, _sight_lines(view))
    lines = undistorted_lines(camera)
    canvas = _canvas_behind(camera, lines, T_world_cam)
    points, triangle, _ = visible(canvas, vertices, faces)
    p = canvas.projection
    reached = np.isfinite(lines[..., 0])
    x, y = np.nan_to_num(lines[..., 0]), np.nan_to_num(lines[..., 1])
    u = np.rint(p.fx * x + p.cx).astype(np.int64).clip(0, canvas.width - 1)
    v = np.rint(p.fy * y + p.cy).astype(np.int64).clip(0, canvas.height - 1)
    return _Sight(points, np.where(reached, triangle[v, u], np.int32(NOTHING)), lines)


def visible(view: View, vertices: F32, faces: I32) -> tuple[F32, I32, F32]:
    """Points float32 (n, 3) in view coordinates; per pixel the triangle int32 (h, w) and nearness float32 (h, w).

    Nearness is 1 / z, of an orthographic view -z; where nothing is seen NOTHING and -inf.
    """
    points, image = np.empty((2, len(vertices), 3), np.float32)
    project(vertices, view.T_view_world, view.projection, points, image)
    nearness = np.full((view.height, view.width), -np.inf, np.float32)
    triangle = np.full((view.height, view.width), NOTHING, np.int32)
    draw(points, image, faces, view.projection, 0, nearness, triangle)
    return points, triangle, nearness


def depth_of(view: View, nearness: F32) -> F32:
    """Metres along z, NaN where nothing, from the nearness of :func:`visible`."""
    with np.errstate(divide="ignore"):
        depth = -nearness if view.projection.orthographic else 1.0 / nearness
    return np.where(nearness == -np.inf, np.float32(np.nan), depth)


def _sight_lines(view: View) -> F32:
    p = view.projection
    lines = np.empty((view.height, view.width, 2), np.float32)
    lines[..., 0] = (np.arange(view.width) - p.cx) / p.fx
    lines[..., 1] = ((np.arange(view.height) - p.cy) / p.fy)[:, None]
    return lines


def _interpolated(sight: _Sight, faces: I32, values: F32) -> Rendering:
    shape = sight.triangle.shape
    depth = np.full(shape, np.nan, np.float32)
    out = np.zeros((*shape, values.shape[1]), np.float32)
    values = np.ascontiguousarray(values, np.float32)
    interpolate(sight.points, faces, sight.triangle, sight.lines, sight.orthographic, values, out, depth)
    return Rendering(depth, sight.triangle, out)


def _canvas_behind(camera: CameraModel, lines: F32, T_world_cam: F64) -> View:
    """Pinhole view that holds every line of sight; coarser only where the lens is so wide that it must be."""
    if not np.isfinite(lines).any():
        raise InputError("no pixel has a line of sight with this distortion; check k1 k2 p1 p2 k3")
    low, high = np.nanmin(lines, axis=(0, 1)), np.nanmax(lines, axis=(0, 1))
    f = np.array([camera.fx, camera.fy]) * _LENS_OVERSAMPLING
    f *= min(1.0, np.sqrt(_LARGEST_CANVAS / np.prod((high - low) * f + 2.0)))
    width, height = (int(n) for n in np.ceil((high - low) * f) + 2)
    cx, cy = 1.0 - low * f
    projection = Projection(float(f[0]), float(f[1]), float(cx), float(cy), NEAR_M, False, False)
    return View(width, height, projection, inverse(T_world_cam))


def render_coloured(mesh: Mesh, atlas: Atlas | None, camera: CameraModel, T_world_cam: F64) -> Rendering:
    """As :func:`render_camera`, with ``values`` (h, w, 3) 0..255 from the atlas where a triangle is textured, else
    from the vertices.
    """
    sight = _look(camera, T_world_cam, mesh.vertices, mesh.faces)
    seen = _interpolated(sight, mesh.faces, mesh.colours.astype(np.float32))
    if atlas is not None:
        _paint(sight, mesh.faces, atlas, seen.values)
    return seen


def picture(
    mesh: Mesh, atlas: Atlas | None, camera: CameraModel, T_world_cam: F64, falloff: Sequence[float] = ()
) -> Rendering:
    """As :func:`render_coloured`, as a camera takes it: a pixel gathers the light of its whole area, and of that the
    lens leaves ``falloff`` (``lens.log_falloff``). What is covered, and the depth, are those of pixels' centres.
    """
    seen = render_coloured(mesh, atlas, camera, T_world_cam)
    count = seen.covered.astype(np.float32)
    for right, down in _WITHIN_PX:
        moved = replace(camera, cx=camera.cx - right, cy=camera.cy - down)
        part = render_coloured(mesh, atlas, moved, T_world_cam)
        seen.values[:] += part.values
        count += part.covered
    share = np.where(seen.covered, 1.0 / np.maximum(count, np.float32(1.0)), np.float32(0.0))
    if falloff:
        share *= left_by_lens(camera, falloff)
    seen.values[:] *= share[..., None]
    return seen


def _paint(sight: _Sight, faces: I32, atlas: Atlas, out: F32) -> None:
    shape = sight.triangle.shape
    page, uv = np.empty(shape, np.int32), np.zeros((*shape, 2), np.float32)
    find_texels(
        sight.points, faces, sight.triangle, sight.lines, sight.orthographic, atlas.page, atlas.uv, page, uv
    )
    for number in np.unique(page[page >= 0]).tolist():
        sample_page(atlas.pages[number], number, page, uv, out)


def overlay(
    mesh: Mesh,
    camera: CameraModel,
    T_world_cam: F64,
    atlas: Atlas | None = None,
    highlighted: Bool | None = None,
    falloff: Sequence[float] = (),
) -> tuple[U8, F32]:
    """RGBA uint8 (h, w, 4) of :func:`picture`, alpha 0 where nothing, and depth float32 (h, w).

    ``highlighted`` bool (m,) names triangles to tint.
    """
    seen = picture(mesh, atlas, camera, T_world_cam, falloff)
    colours = seen.values
    if highlighted is not None:
        tinted = seen.covered & highlighted[np.maximum(seen.triangle, 0)]
        colours[tinted] += _TINT_SHARE * (_TINT - colours[tinted])
    rgba = np.zeros((camera.height, camera.width, 4), np.uint8)
    rgba[..., :3] = np.rint(colours).clip(0, 255)
    rgba[..., 3] = np.where(seen.covered, 255, 0)
    return rgba, seen.depth


def run(
    map_path: Path,
    pose: str,
    intrinsics: str,
    distortion: str | None,
    out: Path,
    depth: Path | None = None,
    highlight: str | None = None,
    falloff: bool = True,
) -> None:
    """The command ``render``: texts as given there, PNG to ``out``, depth as .npy to ``depth``.

    With ``falloff`` the picture of a camera of the map is darkened as its lens does.
    """
    camera, T_world_cam = parse_camera(intrinsics, distortion), parse_pose(pose)
    mesh, atlas = open_map(map_path)
    chosen = None if highlight is None else highlighted_triangles(map_path, mesh, highlight)
    lens = known_falloff(map_folder(map_path), camera) if falloff else ()
    rgba, z = overlay(mesh, camera, T_world_cam, atlas, chosen, lens)
    if not rgba[..., 3].any():
        say("note: nothing of the map is in view from there; --pose is T_world_cam, z forward, y down")
    write_png(out, rgba)
    if depth is not None:
        with replacing(depth) as file:
            np.save(file, z)


def write_png(path: Path, image: U8) -> None:
    """Write RGB or RGBA uint8 (h, w, 3 or 4) as PNG."""
    write_bytes(path, png_bytes(image))


def parse_pose(text: str) -> F64:
    """T_world_cam (4, 4) of "tx ty tz qx qy qz qw"; raises InputError."""
    numbers = _numbers(text, 7, "--pose", "tx ty tz qx qy qz qw")
    if np.abs(numbers[:3]).max() > FARTHEST_M:
        raise InputError(f"--pose: tx ty tz lie beyond {FARTHEST_M / 1000:,.0f} km; they are in metres")
    if not _SHORTEST < np.abs(numbers[3:]).max() < 1.0 / _SHORTEST:
        raise InputError("--pose: the quaternion qx qy qz qw must have the length 1, or near it")
    return matrix_from_quaternion(numbers[:3], numbers[3:])


def parse_camera(intrinsics: str, distortion: str | None) -> CameraModel:
    """Camera of "w h fx fy cx cy" and "k1 k2 p1 p2 k3"; raises InputError."""
    w, h, fx, fy, cx, cy = _numbers(intrinsics, 6, "--intrinsics", "w h fx fy cx cy").tolist()
    if not (w >= 1 and h >= 1 and w == int(w) and h == int(h)):
        raise InputError("--intrinsics: w and h must be whole numbers of pixels")
    if not is_camera(fx, fy, cx, cy):
        raise InputError(f"--intrinsics: {CAMERA_RULE}")
    if w * h > _LARGEST_CANVAS or max(w, h) > _LONGEST_SIDE:
        raise InputError(
            f"--intrinsics: {w:.0f} x {h:.0f} pixels are too many; ask for at most 33 megapixels and "
            f"{_LONGEST_SIDE} on a side"
        )
    k1, k2, p1, p2, k3 = (
        (0.0,) * 5
        if distortion is None
        else _numbers(distortion, 5, "--distortion", "k1 k2 p1 p2 k3").tolist()
    )
    return CameraModel(int(w), int(h), fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def _numbers(text: str, count: int, option: str, form: str) -> F64:
    try:
        numbers = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f'{option}: write it as {count} numbers "{form}"')
    return numbers
