"""The LiDARs that a virtual rig can carry, by name."""

from __future__ import annotations

from artemis_drivers.virtual import avia, hdl64, mid360
from artemis_drivers.virtual.lidar import Sensor

LIDARS: dict[str, Sensor] = {"avia": avia.SENSOR, "mid360": mid360.SENSOR, "hdl64": hdl64.SENSOR}
