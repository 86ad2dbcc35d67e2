"""What gives way when the mapping is behind, the machine warm or the battery low: in which order, and in replay."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from artemis_edge import health, topics
from artemis_edge.config import Config
from artemis_edge.frames import LidarScan, SyncedFrame
from artemis_edge.load import LADDER, SAVING, Load
from artemis_edge.service.overload import Machine, OverloadControl, Readings
from artemis_edge.session.feed import LiveFeed
from artemis_edge.session.message_ring import MessageRing, Sent
from artemis_edge.session.messages import Text
from artemis_edge.session.stream_mapping import StreamMapping, thinned
from tests.conftest import FakeMapper

OVERLOADED, LEVEL = Readings(3.0), Readings(0.1)


def levels(control: OverloadControl, seconds: range, readings: Readings) -> list[int]:
    for second in seconds:
        control.look(float(second), readings)
    return [control.load.level]


def test_the_order_is_preview_texture_segmentation_constraint_points() -> None:
    reached = [[name.split()[0] for name in load.reduced()] for load in LADDER]
    order = ["preview", "texture", "masks", "sweeps", "points"]
    assert all(names == order[: len(names)] for names in reached)
    assert [len(names) for names in reached] == sorted(len(names) for names in reached)
    assert reached[0] == [] and reached[-1] == order
    assert [load.level for load in LADDER] == list(range(len(LADDER)))
    assert LADDER[SAVING].most_sweeps == Load().most_sweeps and LADDER[SAVING].every_point == 1


def test_it_gives_way_step_by_step_and_comes_back() -> None:
    control = OverloadControl()
    assert control.look(0.0, OVERLOADED) is None, "a moment is no overload"
    load = control.look(1.1, OVERLOADED)
    assert load is not None and load.level == 1 and load.why == "the mapping is 3.0 s behind"
    assert control.look(2.0, OVERLOADED) is None, "a step needs time to show"
    levels(control, range(3, 60), OVERLOADED)
    assert control.load.level == len(LADDER) - 1
    assert levels(control, range(60, 69), LEVEL) == [len(LADDER) - 1], "not at once"
    levels(control, range(69, 200), LEVEL)
    assert control.load == Load(why="the mapping keeps up")


def test_no_further_step_before_the_last_one_was_reached() -> None:
    control = OverloadControl()
    levels(control, range(3), OVERLOADED)
    levels(control, range(3, 50), Readings(5.0, reached=False))
    assert control.load.level == 1
    assert levels(control, range(50, 53), Readings(5.0)) == [2]


@pytest.mark.parametrize("readings", [Readings(0.1, True, 85.0), Readings(0.1, True, None, 10.0)])
def test_warmth_and_a_low_battery_save_as_long_as_they_last(readings: Readings) -> None:
    control = OverloadControl(hot_c=80.0, low_percent=15.0)
    levels(control, range(1, 300), readings)
    assert control.load.level == SAVING, "and no further: they are no reason for a worse map"
    assert "85 C" in control.load.why or "10 %" in control.load.why
    levels(control, range(300, 320), Readings(0.1, True, 76.0, 10.0))
    assert control.load.level == SAVING, "warm still, or low still"
    levels(control, range(320, 600), Readings(0.1, True, 60.0))
    assert control.load.level == 0


def test_the_machine_is_read_where_it_tells(tmp_path: Path) -> None:
    thermal, power = tmp_path / "thermal", tmp_path / "power"
    assert (health.temperature_c(thermal), health.battery(power)) == (None, None)
    for number, millidegrees in enumerate(("61000", "not a number", "72500")):
        (thermal / f"thermal_zone{number}").mkdir(parents=True)
        (thermal / f"thermal_zone{number}" / "temp").write_text(millidegrees)
    (power / "AC").mkdir(parents=True)
    (power / "AC" / "type").write_text("Mains\n")
    (power / "BAT0").mkdir()
    fields = {
        "type": "Battery",
        "capacity": "40",
        "energy_now": "20",
        "power_now": "10",
        "status": "Discharging",
    }
    for name, value in fields.items():
        (power / "BAT0" / name).write_text(value + "\n")
    assert health.temperature_c(thermal) == 72.5
    assert health.battery(power) == health.Battery(40.0, 120.0, False)
    machine = Machine()
    machine.look(0.0)
    assert machine.readings(0.5, True).behind_s == 0.5


def test_every_second_point_stays() -> None:
    points = np.arange(21, dtype=np.float32).reshape(7, 3)
    scan = LidarScan(points, 5, np.arange(7, dtype=np.float32), None)
    frame = SyncedFrame(0, 5, (scan,))
    assert thinned(frame, 1) is frame
    (half,) = thinned(frame, 2).scans
    assert half.points[:, 0].tolist() == [0, 6, 12, 18] and half.intensity is None
    assert half.offset_s is not None and half.offset_s.tolist() == [0, 2, 4, 6]


def test_decisions_are_messages_and_take_effect_in_their_order(
    tmp_path: Path, fake_pipeline: list[FakeMapper]
) -> None:
    mapping = StreamMapping(Config(), tmp_path)
    text = Text(json.dumps(LADDER[9].plain())).encode()
    assert not mapping.take(Sent(0, topics.OVERLOAD.name, Text.ROS_TYPE, 0, 0, text))
    assert mapping.load == fake_pipeline[-1].load == LADDER[9]
    for damaged in (b"", Text('{"every_point": 0}').encode(), Text("[]").encode()):
        mapping.take(Sent(1, topics.OVERLOAD.name, Text.ROS_TYPE, 0, 0, damaged))
    assert mapping.load == LADDER[9] and mapping.statistics.lost == {"loads_undecodable": 3}


def test_how_far_behind_a_feed_is(tmp_path: Path) -> None:
    ring = MessageRing.create(0.1)
    feed = LiveFeed(ring, tmp_path, 0)
    assert ring.latest_log_ns() is None and feed.behind_s() == 0.0
    for k in range(3):
        ring.publish("/a", "std_msgs/msg/String", k * 10**9, 0, b"x")
    feed.take()
    assert feed.behind_s() == 0.0, "of the message at 0 s nothing is known"
    feed.take()
    assert feed.behind_s() == 1.0
    feed.take()
    assert feed.behind_s() == 0.0
