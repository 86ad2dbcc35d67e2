"""A textured GLB in a real web viewer (three.js in headless Chromium) beside our own picture of the map.

Needs Chromium and `make viewer-test`, which fetches three.js.
"""

import shutil
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest

from artemis_edge.export.glb import write_glb
from artemis_edge.frames import CameraModel
from artemis_edge.render import render_coloured
from artemis_edge.trajectory import matrix_from_quaternion
from tests.textured import square_room
from tests.viewer.browser import CHROMIUM, page, serving

HERE = Path(__file__).parent
THREE = HERE / "node_modules" / "three"
WIDTH, HEIGHT, FOCAL = 320, 240, 200.0

pytest.importorskip("websockets")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
    pytest.mark.skipif(not THREE.is_dir(), reason="three.js is not there; run `make viewer-test`"),
]


def test_three_js_shows_the_texture_where_we_do(tmp_path: Path) -> None:
    mesh, atlas = square_room()
    write_glb(tmp_path / "room.glb", mesh, atlas)
    shutil.copy(HERE / "page.html", tmp_path)
    (tmp_path / "node_modules").symlink_to(HERE / "node_modules")
    options = {
        "glb": "/room.glb", "width": WIDTH, "height": HEIGHT,
        "fov": np.degrees(2 * np.arctan(0.5 * HEIGHT / FOCAL)), "eye": "-1,0.2,0", "target": "2,-0.3,-0.4",
    }  # fmt: skip
    with serving(tmp_path) as address:
        url = f"{address}/page.html?{urlencode(options)}"
        with page(url, tmp_path, WIDTH, HEIGHT) as shown:
            title = shown.until(
                lambda: (t := shown.evaluate("document.title")) != "loading" and t, "the model"
            )
            assert title == "drawn"
            seen = shown.picture(tmp_path / "seen.png")
    ours = render_coloured(mesh, atlas, camera(), looking([-1, 0, 0.2], [2, 0.4, -0.3]))
    blank = (seen == 255).all(axis=2)
    assert 0.4 < ours.covered.mean() < 0.95
    assert np.mean(blank == ours.covered) < 0.01  # the same outline
    difference = np.abs(seen.astype(float) - ours.values).max(axis=2)
    textured = ours.covered & ~blank & (atlas.page[np.maximum(ours.triangle, 0)] >= 0)
    assert np.median(difference[textured]) <= 3.0 and np.percentile(difference[textured], 95) < 10.0
    floor = (
        ours.covered & ~blank & ~textured
    )  # colours of vertices: a viewer blends them as light, we as they are
    assert floor.sum() > 1000 and np.median(difference[floor]) < 100.0


def camera() -> CameraModel:
    return CameraModel(WIDTH, HEIGHT, FOCAL, FOCAL, 0.5 * WIDTH - 0.5, 0.5 * HEIGHT - 0.5)


def looking(eye: list[float], target: list[float]) -> np.ndarray:
    """T_world_cam of a camera with z up."""
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = matrix_from_quaternion(np.array(eye, float), np.array([0.0, 0.0, 0.0, 1.0]))
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return T
