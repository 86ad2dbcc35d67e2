"""What a configuration means on the wire: the commands that set it, and those that read it back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from artemis_drivers.livox_avia import payloads
from artemis_drivers.livox_avia.protocol import General, Lidar, Param
from artemis_drivers.livox_avia.settings import RETURN_MODES, AviaConfig
from artemis_drivers.livox_dialogue import Ask


class Item(NamedTuple):
    """One thing to configure. ``expected`` are the bytes a correct read-back begins with."""

    name: str
    requested: str
    ask: Ask
    read: Ask | None
    expected: bytes


def command(cmd: General | Lidar) -> int:
    """Command set and id as one number."""
    return (isinstance(cmd, Lidar) << 8) | cmd


def items(c: AviaConfig) -> Iterator[Item]:
    """What a configuration asks of the device, in the order in which it is applied."""
    spherical = c.coordinate == "spherical"
    yield Item("coordinate", c.coordinate, Ask(command(General.COORDINATE), bytes([spherical])), None, b"")
    mode = bytes([RETURN_MODES.index(c.return_mode)])
    yield _item("return_mode", c.return_mode, Lidar.SET_RETURN_MODE, mode, Lidar.GET_RETURN_MODE)
    yield _item("imu", str(c.imu), Lidar.SET_IMU_RATE, bytes([c.imu]), Lidar.GET_IMU_RATE)
    yield Item("rain_fog", str(c.rain_fog), Ask(command(Lidar.RAIN_FOG), bytes([c.rain_fog])), None, b"")
    if c.high_sensitivity is not None:
        yield _param("high_sensitivity", Param.HIGH_SENSITIVITY, c.high_sensitivity, str(c.high_sensitivity))
    if c.scan_pattern is not None:
        yield _param("scan_pattern", Param.SCAN_PATTERN, c.scan_pattern == "repetitive", c.scan_pattern)
    if c.extrinsic is not None:
        e = c.extrinsic
        value = payloads.Extrinsic(e.roll_deg, e.pitch_deg, e.yaw_deg, e.x_mm, e.y_mm, e.z_mm).encode()
        yield _item("extrinsic", str(e), Lidar.SET_EXTRINSIC, value, Lidar.GET_EXTRINSIC)


def _item(name: str, requested: str, setter: Lidar, value: bytes, getter: Lidar) -> Item:
    return Item(name, requested, Ask(command(setter), value), Ask(command(getter)), b"\0" + value)


def _param(name: str, key: Param, value: bool, requested: str) -> Item:
    pair = payloads.encode_params({key: bytes([value])})
    read = Ask(command(General.GET_PARAMS), payloads.encode_keys([key]))
    return Item(name, requested, Ask(command(General.SET_PARAMS), pair), read, b"\0\0\0\0" + pair)
