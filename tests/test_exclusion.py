"""Zones of the operator: what falls into them is not mapped, and counted."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from artemis_edge.config import ExclusionConfig, load
from artemis_edge.datasets import open_input
from artemis_edge.errors import InputError
from artemis_edge.exclusion import LOST, Zones
from artemis_edge.frames import LidarScan, SyncedFrame
from tests import small_session

RULES = ExclusionConfig(
    behind_m=1.5,
    behind_deg=90.0,
    boxes=((1.0, -1.0, -1.0, 2.0, 1.0, 0.5),),
    cylinders=((0.0, 3.0, 0.5, -2.0, 2.0),),
)


def _inside(x: float, y: float, z: float) -> bool:
    """The slow and obvious twin."""
    behind = math.hypot(x, y) < 1.5 and abs(math.degrees(math.atan2(y, -x))) <= 45.0
    box = 1.0 <= x <= 2.0 and -1.0 <= y <= 1.0 and -1.0 <= z <= 0.5
    return behind or box or (math.hypot(x, y - 3.0) <= 0.5 and -2.0 <= z <= 2.0)


def _frame(*scans: LidarScan) -> SyncedFrame:
    return SyncedFrame(0, 10, tuple(scans), lost={"packets": 2})


def test_zones_hold_what_their_definition_says() -> None:
    points = np.random.default_rng(3).uniform(-4, 4, (4000, 3)).astype(np.float32)
    expected = np.array([_inside(*p) for p in points.tolist()])
    found = Zones.of(RULES).inside(points)
    np.testing.assert_array_equal(found, expected)
    assert 50 < found.sum() < 1000
    assert not Zones.of(RULES).inside(np.full((2, 3), np.nan, np.float32)).any()


def test_points_of_every_scan_are_left_out_with_their_columns_and_counted() -> None:
    turned = np.eye(4)
    turned[:3, :3] = np.diag([-1.0, -1.0, 1.0])  # looks backwards
    ahead = np.array([[0.5, 0, 0], [5, 0, 0]], np.float32)
    time = np.array([0.1, 0.2], np.float32)
    whole = LidarScan(ahead, 10, time, time * 2)
    back = LidarScan(ahead, 10, T_lidar_sensor=turned)
    frame = Zones.of(ExclusionConfig(behind_m=1.0)).applied(_frame(whole, back))
    assert frame.scans[0] is whole
    np.testing.assert_array_equal(frame.scans[1].points, ahead[1:])
    assert frame.lost == {"packets": 2, LOST: 1}
    box = Zones.of(ExclusionConfig(boxes=((0, -1, -1, 1, 1, 1),))).applied(_frame(whole))
    np.testing.assert_array_equal(box.scans[0].offset_s, time[1:])
    np.testing.assert_array_equal(box.scans[0].intensity, time[1:] * 2)


def test_without_zones_nothing_is_touched() -> None:
    frame = _frame(LidarScan(np.zeros((3, 3), np.float32), 10))
    assert Zones.of(ExclusionConfig()).applied(frame) is frame
    assert Zones.of(RULES).applied(_frame()).lost == {"packets": 2}


def test_a_recording_is_read_without_them(tmp_path: Path) -> None:
    path = small_session.write(tmp_path / "walk", frames=2, points=500, camera=False)
    rules = load(sets=["exclusion.boxes=[[1.5, 0, -2, 6, 3, 3]]"]).exclusion
    (whole, _), (less, _) = (list(open_input(path, None, r).frames()) for r in (None, rules))
    n = len(whole.scans[0].points)
    assert less.lost[LOST] == n - len(less.scans[0].points) > 10
    assert not Zones.of(rules).inside(less.scans[0].points).any()


@pytest.mark.parametrize(
    "rules",
    [
        ExclusionConfig(boxes=((1, 0, 0, 0, 1, 1),)),
        ExclusionConfig(boxes=((0, 0, 0, 1, 1, math.nan),)),
        ExclusionConfig(cylinders=((0, 0, 0, 0, 1),)),
        ExclusionConfig(cylinders=((0, 0, 1, 1, 1),)),
    ],
)
def test_a_zone_that_holds_nothing_is_refused(rules: ExclusionConfig) -> None:
    with pytest.raises(InputError, match="holds nothing"):
        Zones.of(rules)
