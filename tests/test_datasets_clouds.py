"""Point clouds of any layout, their times and intensities; cameras and images."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.datasets.cameras import camera_model, encoded_image, info_topics
from artemis_edge.datasets.clouds import CloudPoints, decode_cloud, settle_format
from artemis_edge.session.cdr import CdrError
from artemis_edge.session.messages import (
    FIELD_TYPES,
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    LivoxCustomMsg,
    PointCloud2,
    PointField,
)

STAMP = 1_700_000_000_500_000_000
XYZ = [("x", "f4"), ("y", "f4"), ("z", "f4")]
P = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 6.0], [7.0, -8.0, 9.0], [10.0, 11.0, -12.0]])


def _cloud(
    fields: list[tuple[str, str]],
    values: dict[str, Any],
    *,
    big: bool = False,
    pad: int = 0,
    rows: int = 1,
    row_pad: int = 0,
    points: np.ndarray = P,
) -> PointCloud2:
    """A cloud with the fields one after another, ``pad`` bytes before each, ``row_pad`` after each row."""
    order, offset, places = ">" if big else "<", 0, []
    for _, code in fields:
        offset += pad
        places.append(offset)
        offset += np.dtype(code).itemsize
    layout: Any = {
        "names": [name for name, _ in fields],
        "formats": [order + code for _, code in fields],
        "offsets": places,
        "itemsize": offset + pad,
    }
    dtype = np.dtype(layout)
    records = np.zeros(len(points), dtype)
    for axis, name in enumerate("xyz"):
        records[name] = points[:, axis]
    for name, column in values.items():
        records[name] = column
    width, step = len(points) // rows, dtype.itemsize
    data = b"".join(row.tobytes() + b"\xff" * row_pad for row in records.reshape(rows, width))
    described = tuple(
        PointField(name, place, FIELD_TYPES[code]) for (name, code), place in zip(fields, places, strict=True)
    )
    return PointCloud2(Header(STAMP, "l"), rows, width, described, step, step * width + row_pad, data, big)


def _decode(message: PointCloud2 | LivoxCustomMsg) -> CloudPoints:
    return decode_cloud(message, settle_format(message))


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("code", ["f4", "f8", "i2"])
@pytest.mark.parametrize(("pad", "rows", "row_pad"), [(0, 1, 0), (3, 1, 0), (0, 2, 0), (1, 2, 5), (0, 4, 16)])
def test_layouts(big: bool, code: str, pad: int, rows: int, row_pad: int) -> None:
    fields = [("ring", "u2"), ("z", code), ("x", code), ("intensity", "f4"), ("y", code)]
    cloud = _cloud(fields, {"intensity": [0, 0.25, 0.5, 1]}, big=big, pad=pad, rows=rows, row_pad=row_pad)
    got = _decode(cloud)
    assert np.array_equal(got.points, P) and got.points.dtype == np.float32
    assert got.points.flags.c_contiguous and got.points.flags.writeable and got.points.dtype.isnative
    assert got.intensity is not None and got.intensity.tolist() == [0, 0.25, 0.5, 1]
    assert (got.offset_s, got.lost) == (None, {})


@pytest.mark.parametrize(
    ("name", "code", "values", "expected"),
    [
        # Ouster and our sessions: nanoseconds after the header
        ("t", "u4", [0, 10, 50_000_000, 100_000_000], [0, 1e-8, 0.05, 0.1]),
        # Velodyne: seconds, here before the header
        ("time", "f4", [-0.1, -0.05, -0.01, 0], [-0.1, -0.05, -0.01, 0]),
        # milliseconds, microseconds and nanoseconds as floats
        ("time", "f4", [0, 10, 50, 100], [0, 0.01, 0.05, 0.1]),
        ("time", "f4", [0, 1e4, 5e4, 1e5], [0, 0.01, 0.05, 0.1]),
        ("t", "f8", [0, 1e7, 5e7, 1.04e8], [0, 0.01, 0.05, 0.104]),
        # RoboSense and Hesai: seconds since 1970
        ("timestamp", "f8", STAMP * 1e-9 + np.array([0, 0.01, 0.05, 0.1]), [0, 0.01, 0.05, 0.1]),
        # livox_ros_driver2 as PointCloud2: nanoseconds since 1970 as float64, and as an integer
        ("timestamp", "f8", STAMP + np.array([0, 1e7, 5e7, 1e8]), [0, 0.01, 0.05, 0.1]),
        ("timestamp", "i4", [0, 10_000_000, 50_000_000, 100_000_000], [0, 0.01, 0.05, 0.1]),
        # a clock of its own: seconds since the sensor was switched on
        ("timestamp", "f8", 12345.5 + np.array([0, 0.01, 0.05, 0.1]), [0, 0.01, 0.05, 0.1]),
        ("timestamp", "f8", 1.5e9 + np.array([0.1, 0, 0.05, 0.01]), [0.1, 0, 0.05, 0.01]),
    ],
)
def test_time_conventions(name: str, code: str, values: Any, expected: list[float]) -> None:
    got = _decode(_cloud([*XYZ, (name, code)], {name: values}))
    assert got.offset_s is not None and got.offset_s.dtype == np.float32
    # float64 seconds since 1970 resolve 0.24 microseconds
    np.testing.assert_allclose(got.offset_s, expected, atol=5e-7, rtol=1e-6)


def test_all_points_at_the_stamp_are_not_timed() -> None:
    assert _decode(_cloud([*XYZ, ("t", "u4")], {"t": 0})).offset_s is None


def test_the_unit_is_settled_once() -> None:
    """A later cloud with but a few points must not be read in another unit."""
    settled = settle_format(_cloud([*XYZ, ("time", "f4")], {"time": [0, 10, 50, 100]}))
    later = decode_cloud(_cloud([*XYZ, ("time", "f4")], {"time": [0.5, 0.6, 0.7, 0.8]}), settled)
    np.testing.assert_allclose(later.offset_s, [0.0005, 0.0006, 0.0007, 0.0008], rtol=1e-5)


def test_window_start() -> None:
    assert settle_format(
        _cloud([*XYZ, ("time", "f4")], {"time": [-0.1, -0.05, 0, 0]})
    ).start_s == pytest.approx(-0.1)
    assert settle_format(_cloud(XYZ, {})).start_s == 0.0


@pytest.mark.parametrize(
    ("code", "values", "expected"),
    [
        ("f4", [0, 0.5, 1, 0.25], [0, 0.5, 1, 0.25]),
        ("f4", [0, 51, 255, 102], [0, 0.2, 1, 0.4]),
        ("u1", [0, 1, 1, 0], [0, 1 / 255, 1 / 255, 0]),
        ("u2", [0, 0, 2047, 1023.5], [0, 0, 1, 1023 / 2047]),
        ("f4", [0, np.nan, np.inf, -1], [0, 0, 1, 0]),
    ],
)
def test_intensity_is_zero_to_one(code: str, values: Any, expected: list[float]) -> None:
    got = _decode(_cloud([*XYZ, ("intensity", code)], {"intensity": values}))
    assert got.intensity is not None and got.intensity.dtype == np.float32
    np.testing.assert_allclose(got.intensity, expected, rtol=1e-5)


def test_points_that_are_none_are_counted() -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [0, 0, 0], [np.inf, 1, 1]])
    got = _decode(_cloud([*XYZ, ("t", "u4")], {"t": [1, 2, 3, 4]}, points=points))
    assert got.lost == {"nan_points": 2, "no_return": 1}
    assert got.points.tolist() == [[1, 2, 3]]
    assert got.offset_s is not None and got.offset_s.tolist() == [np.float32(1e-9)]


def test_empty_cloud() -> None:
    got = _decode(_cloud([*XYZ, ("t", "u4")], {}, points=np.empty((0, 3))))
    assert got.points.shape == (0, 3)


def test_livox() -> None:
    points = np.zeros(4, LivoxCustomMsg.POINT)
    points["offset_time"], points["reflectivity"] = [0, 1000, 2000, 99_000_000], [0, 51, 255, 7]
    for axis, name in enumerate("xyz"):
        points[name] = P[:, axis]
    points["x"][1] = points["y"][1] = points["z"][1] = 0.0
    got = _decode(LivoxCustomMsg(Header(STAMP, "livox"), STAMP, points))
    assert got.points.tolist() == P[[0, 2, 3]].tolist() and got.lost == {"no_return": 1}
    np.testing.assert_allclose(got.offset_s, [0, 2e-6, 0.099], rtol=1e-6)
    np.testing.assert_allclose(got.intensity, [0, 1, 7 / 255], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"data": b"\0" * 47}, "47 bytes .* 48 are needed"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "are needed"),
        ({"point_step": 8}, "beyond the 8 bytes"),
        ({"point_step": 2**31, "row_step": 2**33}, "larger than the cloud"),
        ({"height": 2, "width": 2, "row_step": 23}, "are needed"),
        ({"fields": (PointField("x", 0, 7), PointField("y", 4, 7))}, "lacks the fields"),
        ({"fields": (PointField("x", 0, 99), PointField("y", 4, 7), PointField("z", 8, 7))}, "lacks"),
    ],
)
def test_clouds_that_do_not_fit_their_description(change: dict[str, Any], says: str) -> None:
    with pytest.raises(CdrError, match=says):
        _decode(replace(_cloud(XYZ, {}), **change))


_SMALL = st.integers(0, 40)
_ANY = st.one_of(_SMALL, st.integers(0, 2**32 - 1))


@given(
    st.tuples(_ANY, _ANY, _ANY, _ANY),
    st.lists(
        st.builds(
            PointField,
            st.sampled_from(["x", "y", "z", "t", "time", "intensity", ""]),
            _ANY,
            st.integers(0, 9),
        ),
        max_size=8,
    ),
    st.binary(max_size=200),
    st.booleans(),
)
@settings(max_examples=300, deadline=None)
def test_arbitrary_descriptions(
    sizes: tuple[int, int, int, int], fields: list[PointField], data: bytes, big: bool
) -> None:
    height, width, point_step, row_step = sizes
    message = PointCloud2(Header(STAMP, "l"), height, width, tuple(fields), point_step, row_step, data, big)
    try:
        got = _decode(message)
    except CdrError:
        return
    assert np.isfinite(got.points).all() and len(got.points) <= len(data)
    assert got.offset_s is None or (len(got.offset_s) == len(got.points) and np.isfinite(got.offset_s).all())
    assert got.intensity is None or ((got.intensity >= 0) & (got.intensity <= 1)).all()


def _info(
    model: str = "plumb_bob", d: tuple[float, ...] = (0.1, -0.2, 0.003, 0.004, 0.5), **change: Any
) -> CameraInfo:
    k = np.array([500.0, 0, 320, 0, 510, 240, 0, 0, 1])
    p = np.array([450.0, 0, 300, 0, 0, 460, 200, 0, 0, 0, 1, 0])
    parts: dict[str, Any] = {"k": k, "p": p, "width": 640, "height": 480} | change
    header = Header(0, "cam")
    return CameraInfo(
        header, parts["height"], parts["width"], model, np.array(d), parts["k"], np.eye(3).ravel(), parts["p"]
    )


def test_camera_models() -> None:
    model = camera_model(_info(), rectified=False)
    assert model is not None
    assert (model.width, model.height, model.fx, model.fy, model.cx, model.cy) == (
        640,
        480,
        500,
        510,
        320,
        240,
    )
    assert model.distortion == (0.1, -0.2, 0.003, 0.004, 0.5)
    rectified = camera_model(_info(), rectified=True)
    assert rectified is not None and (rectified.fx, rectified.cy, rectified.distortion) == (
        450,
        200,
        (0, 0, 0, 0, 0),
    )
    bare = camera_model(_info("", ()), rectified=False)
    assert bare is not None and bare.distortion == (0, 0, 0, 0, 0)
    four = camera_model(_info(d=(0.1, 0.2, 0.3, 0.4)), rectified=False)
    assert four is not None and four.distortion == (0.1, 0.2, 0.3, 0.4, 0)
    eight = camera_model(_info("rational_polynomial", (0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0)), rectified=False)
    assert eight is not None


def test_lenses_that_are_none() -> None:
    assert camera_model(_info("equidistant", (0.1, 0.2, 0.3, 0.4)), rectified=False) is None
    assert camera_model(_info("rational_polynomial", (0.1,) * 8), rectified=False) is None
    assert camera_model(_info(k=np.zeros(9)), rectified=False) is None
    assert camera_model(_info(k=np.full(9, np.nan)), rectified=False) is None
    assert camera_model(_info(width=0), rectified=False) is None


def test_info_topics() -> None:
    assert info_topics("/cam_0/image_raw/compressed")[0] == "/cam_0/camera_info"
    assert info_topics("/camera/image/compressed")[0] == "/camera/camera_info"
    assert "/camera/color/camera_info" in info_topics("/camera/color/image_raw")


@pytest.mark.parametrize(
    ("encoding", "pixel", "bgr"),
    [
        ("bgr8", (10, 20, 30), (10, 20, 30)),
        ("rgb8", (10, 20, 30), (30, 20, 10)),
        ("bgra8", (10, 20, 30, 0), (10, 20, 30)),
        ("rgba8", (10, 20, 30, 0), (30, 20, 10)),
        ("mono8", (77,), (77, 77, 77)),
    ],
)
def test_raw_images_are_kept_without_loss(
    encoding: str, pixel: tuple[int, ...], bgr: tuple[int, ...]
) -> None:
    row = bytes(pixel) * 4 + b"\xee\xee"
    message = Image(Header(0, "c"), 3, 4, encoding, len(row), row * 3)
    pixels = cv2.imdecode(np.frombuffer(encoded_image(message), np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None and pixels.shape == (3, 4, 3)
    assert (pixels == bgr).all()


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns(pattern: str) -> None:
    """A scene of one colour, seen through the mosaic, comes back as that colour."""
    colour = {"r": 200, "g": 120, "b": 40}
    tile = np.array(
        [[colour[pattern[0]], colour[pattern[1]]], [colour[pattern[2]], colour[pattern[3]]]], np.uint8
    )
    mosaic = np.tile(tile, (8, 8))
    message = Image(Header(0, "c"), 16, 16, f"bayer_{pattern}8", 16, mosaic.tobytes())
    pixels = cv2.imdecode(np.frombuffer(encoded_image(message), np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    assert pixels[8, 8].tolist() == [40, 120, 200]


def test_images_that_are_none() -> None:
    for message in (
        Image(Header(0, "c"), 2, 2, "16UC1", 4, bytes(8)),
        Image(Header(0, "c"), 2, 2, "bgr8", 6, bytes(11)),
        Image(Header(0, "c"), 2, 2, "bgr8", 5, bytes(12)),
        Image(Header(0, "c"), 0, 2, "mono8", 2, b""),
        Image(Header(0, "c"), 2**32 - 1, 2**32 - 1, "mono8", 2**32 - 1, b""),
    ):
        with pytest.raises(CdrError):
            encoded_image(message)


def test_compressed_images_are_passed_on() -> None:
    assert encoded_image(CompressedImage(Header(0, "c"), "jpeg", memoryview(b"abc"))) == b"abc"
