"""The memory of texels: charts come, go, and are refined; camera and weights against their plain definitions."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from artemis_edge.frames import CameraModel
from artemis_edge.refinement import texels as tx
from artemis_edge.refinement.camera import make_camera, sees_sphere, to_camera, to_pixel, view_bounds
from artemis_edge.refinement.reliability import PARTS, Trust, geometric, photometric, sample, takes_no_part
from artemis_edge.refinement.texel_pages import pack_charts, unpack_charts

TRUST = Trust(40.0, 0.02, 0.1, 400.0, 16.0, 0.2, 0.03)


def test_charts_are_found_where_they_were_put() -> None:
    texels = tx.allocate(1.0)
    rng = np.random.default_rng(0)
    model: dict[int, int] = {}
    for _ in range(3000):
        x, y, z = rng.integers(-6, 6, 3).tolist()
        key = tx.chart_key(x, y, z, int(rng.integers(6)))
        if key in model and rng.random() < 0.5:
            tx.remove_chart(texels, model.pop(key))
        elif key not in model:
            chart = tx.add_chart(texels, key, 0)
            if chart >= 0:
                model[key] = chart
        for known, chart in list(model.items())[:5]:
            assert tx.find_chart(texels, known) == chart
    assert tx.used_texels(texels) == 64 * len(model)


def test_without_memory_a_chart_is_refused_and_counted() -> None:
    texels = tx.allocate(1.0)
    while tx.add_chart(texels, tx.chart_key(int(texels.counter[tx.N_CHARTS]), 0, 0, 0), 3) >= 0:
        pass
    assert texels.counter[tx.REFUSED] == 1
    assert tx.find_chart(texels, tx.chart_key(0, 0, 0, 1)) == -1


def test_refining_keeps_colours_and_shares_information_out() -> None:
    texels = tx.allocate(1.0)
    chart = tx.add_chart(texels, tx.chart_key(1, 2, 3, 4), 0)
    at = texels.chart[chart, tx.AT]
    texels.texel[at : at + 64] = np.arange(256).reshape(64, 4)
    old = texels.texel[at : at + 64].reshape(8, 8, 4).copy()
    assert tx.refine_chart(texels, chart, 1)
    at = texels.chart[chart, tx.AT]
    new = texels.texel[at : at + 256].reshape(16, 16, 4)
    np.testing.assert_array_equal(new[::2, ::2, :3], old[..., :3])
    np.testing.assert_array_equal(new[1::2, 1::2, 3], np.maximum(old[..., 3] // 4, 1))


def test_discounted_texels_stay_known() -> None:
    texels = tx.allocate(1e6)
    at = texels.chart[tx.add_chart(texels, tx.chart_key(1, 2, 3, 0), 0), tx.AT]
    texels.texel[at : at + 4, 3] = (0, 5, 160, 65535)
    tx.discount(texels, 100)
    assert texels.texel[at : at + 4, 3].tolist() == [0, 5, 100, 100]


def test_a_surface_that_wavers_about_a_border_keeps_its_chart() -> None:
    texels = tx.allocate(1.0)
    chart = tx.add_chart(texels, tx.place_key(2, 4, 5, -1), 0)
    assert tx.chart_near(texels, 2, 4, 5, -0.1) == chart
    assert tx.chart_near(texels, 2, 4, 5, 0.1) == chart
    assert tx.chart_near(texels, 2, 4, 5, 0.5) == -1
    assert tx.chart_near(texels, 2, 4, 6, 0.1) == -1


def test_charts_come_back_as_they_were() -> None:
    texels = tx.allocate(1.0)
    charts = [tx.add_chart(texels, tx.chart_key(k, -k, 3, k % 6), k % 3) for k in range(5)]
    for chart in charts:
        at, level = texels.chart[chart, :2]
        texels.texel[at : at + (8 << level) ** 2] = chart + 1
    data = pack_charts(texels, np.array(charts, np.int32))
    fresh = tx.allocate(1.0)
    unpack_charts(fresh, data)
    assert pack_charts(fresh, np.arange(5, dtype=np.int32)) == data
    with pytest.raises(ValueError, match="cut off"):
        unpack_charts(fresh, data[:20])
    with pytest.raises(ValueError, match="not a page"):
        unpack_charts(fresh, b"")


def test_pixels_are_those_of_opencv() -> None:
    model = CameraModel(640, 480, 400.0, 410.0, 320.0, 250.0, (-0.1, 0.02, 0.001, -0.002, 0.003))
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]
    T[:3, 3] = (1.0, 2.0, 3.0)
    camera = make_camera(model, T, view_bounds(model))
    K = np.array([[400.0, 0, 320], [0, 410.0, 250], [0, 0, 1]])
    rng = np.random.default_rng(1)
    for point in rng.uniform(-1, 1, (20, 3)) * (2, 2, 1) + (0, 0, 4):
        world = T[:3, :3] @ point + T[:3, 3]
        x, y, z = to_camera(camera, *world)
        np.testing.assert_allclose((x, y, z), point, atol=1e-9)
        expected = cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), K, np.array(model.distortion))[0]
        np.testing.assert_allclose(to_pixel(camera, x / z, y / z), expected[0, 0], atol=1e-6)
        u, v = expected[0, 0]
        if 0 <= u < 640 and 0 <= v < 480:
            assert sees_sphere(camera, *world, 0.01, 0.2, 50.0)
    behind = T[:3, :3] @ np.array([0.0, 0.0, -5.0]) + T[:3, 3]
    assert not sees_sphere(camera, *behind, 1.0, 0.2, 50.0)


def test_weights_are_those_of_equations_9_to_11() -> None:
    near, front = 1 / 5.0, 1 / 4.9
    r = abs(5.0 - 4.9) / 4.9
    assert geometric(front, near, 0.0, 0.02) == pytest.approx(math.exp(-0.5 * (r / 0.02) ** 2))
    assert geometric(near, front, 0.0, 0.02) == 1.0
    assert geometric(front, near, 0.01, 0.02) == 1.0
    assert photometric(50.0**2, 1e12, TRUST) == pytest.approx(math.exp(-0.5 * (50 / 40) ** 2))
    assert photometric(50.0**2, 0.0, TRUST) == 1.0
    assert photometric(50.0**2, 1.0, TRUST) > photometric(50.0**2, 4.0, TRUST)


def test_every_part_of_the_surface_has_its_turn() -> None:
    for number in (0, 5, 1_000_003):
        turns = [not takes_no_part(number, 7, stamp) for stamp in range(PARTS)]
        assert sum(turns) == 7
        assert not takes_no_part(number, PARTS, 3)


def test_sampling_is_bilinear() -> None:
    image = np.random.default_rng(0).integers(0, 255, (6, 7, 3), np.uint8)
    for u, v in ((0.0, 0.0), (2.25, 3.5), (5.99, 4.99)):
        a, b, i, j = u - int(u), v - int(v), int(u), int(v)
        p = image.astype(float)
        expected = (p[j, i] * (1 - a) + p[j, i + 1] * a) * (1 - b) + (
            p[j + 1, i] * (1 - a) + p[j + 1, i + 1] * a
        ) * b
        np.testing.assert_allclose(sample(image, u, v), expected)
