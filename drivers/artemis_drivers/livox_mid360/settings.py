"""Configuration of one Mid-360, as in firmware_cfg/lidar/*.toml."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Port = Annotated[int, Meta(ge=1, le=65535)]
POINT_TYPES = {"cartesian_mm": 1, "cartesian_cm": 2, "spherical": 3}
PATTERNS = {"non_repetitive": 0, "repetitive": 1, "repetitive_slow": 2}


class Mid360Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One Mid-360. Ports are this computer's own, as the official SDK's defaults."""

    name: str = "lidar_1"
    serial: Annotated[str, Meta(description="Serial number; empty: any Mid-360.")] = ""
    host_ip: Annotated[str, Meta(description="This computer's address; empty: the one in its network.")] = ""
    command_port: Port = 56101
    push_port: Port = 56201
    point_port: Port = 56301
    imu_port: Port = 56401
    point_type: Literal["cartesian_mm", "cartesian_cm", "spherical"] = "cartesian_mm"
    pattern: Literal["non_repetitive", "repetitive", "repetitive_slow"] = "non_repetitive"
    imu: Annotated[bool, Meta(description="Send the built-in IMU at 200 Hz.")] = True
