"""The service's state in the form that terminal, browser and scripts read (status.py)."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import msgspec
from artemis_drivers.base import Health, State

from artemis_edge.service.settings import RunConfig, device_name
from artemis_edge.status import MapStatus, QueryStatus, Status, Stream, SyncStatus
from artemis_edge.status import State as Phase

_COUNTED = ("points_packets", "samples", "frames", "events")
_LOST = ("points_lost", "lost", "missing", "triggers_lost")
_PACKETS_HZ = {"first": 2500.0, "strongest": 2500.0, "dual": 5000.0, "triple": 8000.0}
_LEAST_SPAN_S = 0.9
_NS = 1e9
_BEHIND_MESSAGES = 4000  # a few seconds of them


class StatusView:
    """Rates need two looks; ``look`` at the devices a few times a second."""

    def __init__(self, config: RunConfig) -> None:
        self._expected = expected_hz(config)
        self._before: dict[str, tuple[float, int]] = {}
        self._hz: dict[str, float] = {}

    def look(self, devices: Sequence[Health]) -> None:
        """Measure rates."""
        now = time.monotonic()
        for health in devices:
            count = sum(health.counters.get(name, 0) for name in _COUNTED)
            then, before = self._before.setdefault(health.name, (now, count))
            if now - then >= _LEAST_SPAN_S:
                self._hz[health.name] = max(0.0, (count - before) / (now - then))
                self._before[health.name] = (now, count)

    def status(self, state: dict[str, Any], devices: Sequence[Health]) -> Status:
        """Of what Daemon.state() says."""
        session = state["session"] or {}
        mapping, recorder = session.get("mapping") or {}, session.get("recorder") or {}
        pose = mapping.get("pose") or [0.0] * 12
        phase: Phase = state["phase"]
        return Status(
            state=phase,
            message=state["fault"] or session.get("fault", "") or _saving(mapping) or _message(devices),
            seconds=session.get("seconds", 0.0),
            session=session.get("folder", ""),
            frames=mapping.get("mapped", 0),
            dropped=mapping.get("dropped", 0),
            streams=[self._stream(health) for health in devices],
            sync=_sync(state),
            frame_ms=mapping.get("frame_ms_list", []),
            disk_minutes=state["disk"]["minutes_left"],
            overload=[*session.get("reduced", []), *_overload(mapping, recorder)],
            temperature_c=session.get("temperature_c"),
            battery_minutes=session.get("battery_minutes"),
            degenerate=bool(mapping.get("degenerate", False)),
            coaching=list(mapping.get("coaching", [])),
            losses={**state["lost"], **mapping.get("lost", {})},
            queries=msgspec.convert(state["queries"], list[QueryStatus]),
            segmentation_hz=float((session.get("segmentation") or {}).get("hz", 0.0)),
            map=MapStatus(
                vertices=mapping.get("vertices", 0),
                triangles=mapping.get("triangles", 0),
                resident_mb=mapping.get("rss_mb", 0.0),
            ),
            position=(pose[3], pose[7], pose[11]),
            yaw=math.atan2(pose[4], pose[0]),
            report=next((e["report"] for e in reversed(state["ended"]) if e.get("report")), ""),
        )

    def _stream(self, health: Health) -> Stream:
        age = (time.monotonic_ns() - health.last_data_ns) / _NS if health.last_data_ns else 0.0
        return Stream(
            name=health.name,
            hz=round(self._hz.get(health.name, 0.0), 1),
            expected_hz=self._expected.get(health.name, 0.0),
            lost=sum(health.counters.get(name, 0) for name in _LOST),
            age_s=round(age, 3),
            state=str(health.state),
            message=health.message,
        )


def expected_hz(config: RunConfig) -> dict[str, float]:
    """Packets, samples or photographs a second by device; those of which it is known."""
    found = {
        device_name(entry): _PACKETS_HZ[entry.avia.return_mode]
        for entry in config.lidar
        if entry.avia is not None
    }
    if config.imu is not None:
        found[config.imu.device.name] = float(config.imu.device.rate_hz)
    for camera in config.camera:
        if config.trigger is not None:
            found[camera.device.name] = config.trigger.rate_hz
    return found


def _saving(mapping: dict[str, Any]) -> str:
    left = mapping.get("photographs_left", 0)
    return f"colouring: {left} photographs are asked again" if left else ""


def _message(devices: Sequence[Health]) -> str:
    """What the first device that does not run says."""
    return next(
        (health.message for health in devices if health.state != State.RUNNING and health.message), ""
    )


def _sync(state: dict[str, Any]) -> SyncStatus:
    clocks = state["clocks"]
    pps = next((clock for clock in clocks if clock["name"] == "pps"), None)
    skew = {clock["name"]: clock["skew_ppm"] for clock in clocks if "skew_ppm" in clock}
    return SyncStatus("none" if pps is None else pps["state"], 0.0, skew)


def _overload(mapping: dict[str, Any], recorder: dict[str, Any]) -> list[str]:
    found = []
    if mapping.get("waiting", 0) > _BEHIND_MESSAGES:
        found.append("the mapping is behind; it catches up from the recording")
    if recorder.get("left_out", 0):
        found.append("the disk is slow: raw packets are left out")
    return found
