"""Exposures and the lens's fall-off, from places that several images show."""

from __future__ import annotations

import numpy as np

from artemis_edge.frames import F32, F64, I64, CameraModel
from artemis_edge.lens import falloff as darkened
from artemis_edge.refinement.exposure import SHADES, Exposures, radius2, undoing
from artemis_edge.refinement.reliability import Observations

MODEL = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)


def _seen(slots: F64 | I64, pixel: F32, colour: F32) -> Observations:
    n = len(slots)
    ones = np.ones(n, np.float32)
    return Observations(slots.astype(np.int32), pixel, ones, ones, colour.copy(), ones, ones.copy(), ones)


def _images(gains: F64, falloff: float, people: float = 0.0) -> Exposures:
    rng = np.random.default_rng(3)
    bright = rng.uniform(60, 120, (600, 1)).astype(np.float32).repeat(3, axis=1)
    exposures = Exposures(True)
    for gain in gains:
        slots = rng.permutation(600)[:400]
        pixel = rng.uniform((0, 0), (640, 480), (400, 2)).astype(np.float32)
        shade = np.exp(-falloff * radius2(MODEL, pixel))[:, None]
        colour = bright[slots] / gain * shade * rng.normal(1.0, 0.02, (400, 3))
        colour[: int(people * 400)] = 30.0
        exposures.add("cam", MODEL, _seen(slots, pixel, colour.astype(np.float32)))
    return exposures


def test_gains_and_fall_off_are_found() -> None:
    gains = np.array([1.0, 1.3, 0.8, 1.1, 0.7])
    found, falloff = _images(gains, 0.4, people=0.1).solve()
    shade = undoing(falloff["cam"])
    np.testing.assert_allclose(found / found[:1], (gains / gains[0])[:, None].repeat(3, 1), rtol=0.03)
    assert shade.shape == (SHADES,)
    np.testing.assert_allclose(shade, np.exp(0.4 * np.linspace(0, 1, SHADES)), rtol=0.04)


def test_images_without_anything_in_common_keep_their_exposure() -> None:
    exposures = Exposures(True)
    for k in range(2):
        pixel = np.full((5, 2), 100.0, np.float32)
        colour = np.full((5, 3), 50.0 + 100.0 * k, np.float32)
        exposures.add("cam", MODEL, _seen(np.arange(5.0) + 10 * k, pixel, colour))
    exposures.add(
        "cam", MODEL, _seen(np.empty(0), np.empty((0, 2), np.float32), np.empty((0, 3), np.float32))
    )
    gains, falloff = exposures.solve()
    np.testing.assert_array_equal(gains, np.ones((3, 3), np.float32))
    np.testing.assert_array_equal(undoing(falloff["cam"]), np.ones(SHADES, np.float32))


def test_fall_off_of_a_lens_pixel_by_pixel() -> None:
    camera = CameraModel(5, 4, 3.0, 3.0, 1.5, 2.2)
    q = np.array([[(u - 1.5) ** 2 + (v - 2.2) ** 2 for u in range(5)] for v in range(4)]) / (3.5**2 + 2.2**2)
    np.testing.assert_allclose(
        darkened(camera, (-0.7, 0.2, -0.1)), np.exp(-0.7 * q + 0.2 * q**2 - 0.1 * q**3), rtol=1e-6
    )
    np.testing.assert_array_equal(darkened(camera, ()), np.ones((4, 5), np.float32))
