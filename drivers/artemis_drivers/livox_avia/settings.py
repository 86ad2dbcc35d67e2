"""Configuration of one Avia, as in firmware_cfg/lidar/*.toml."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

RETURN_MODES = ("first", "strongest", "dual", "triple")
FIRST_COMMAND_PORT, FIRST_DATA_PORT = 55501, 56001  # of the official SDK's first device

Port = Annotated[int, Meta(ge=1, le=65535)]


class StoredExtrinsic(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mounting kept inside the device (not used by this software): degrees and millimetres."""

    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    x_mm: int = 0
    y_mm: int = 0
    z_mm: int = 0


class AviaConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One Avia. Addresses and ports left empty are found out."""

    name: str = "lidar_0"
    broadcast_code: Annotated[str, Meta(description="Serial number, 14 or 15 characters; empty: any.")] = ""
    host_ip: Annotated[str, Meta(description="This computer's address; empty: the one in its network.")] = ""
    command_port: Annotated[Port, Meta(description="Own UDP port for commands.")] = FIRST_COMMAND_PORT
    data_port: Annotated[Port, Meta(description="Own UDP port for points and IMU.")] = FIRST_DATA_PORT
    return_mode: Literal["first", "strongest", "dual", "triple"] = "strongest"
    coordinate: Literal["cartesian", "spherical"] = "cartesian"
    imu: Annotated[bool, Meta(description="Send the built-in IMU at 200 Hz.")] = True
    rain_fog: Annotated[bool, Meta(description="Suppress echoes of rain and fog.")] = False
    high_sensitivity: Annotated[
        bool | None, Meta(description="Stored in the device; none: leave. Firmware 11.06 or newer.")
    ] = None
    scan_pattern: Annotated[
        Literal["non_repetitive", "repetitive"] | None, Meta(description="Stored; none: leave.")
    ] = None
    extrinsic: StoredExtrinsic | None = None

    @property
    def data_type(self) -> int:
        """Type of the point packets that this configuration asks for."""
        returns = {"first": 0, "strongest": 0, "dual": 1, "triple": 2}[self.return_mode]
        return ((2, 4, 7), (3, 5, 8))[self.coordinate == "spherical"][returns]
