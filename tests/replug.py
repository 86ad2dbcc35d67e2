"""Every virtual device of a rig pulled and plugged in again while the service records, one after the other."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from artemis_edge.service import settings
from artemis_edge.session.wire_replay import WireRig, read
from tests import small_session
from tests.livox_ports import reserved
from tests.waiting import until
from tests.wire_service import PATIENCE_S, Service

OUT_S = 1.2  # how long a device is away
_LOOK_S = 0.02
_AFTERWARDS_S = 0.4  # of data after a device is back


@dataclass
class Pulled:
    """What the service said of a device that was pulled: seconds, its state and message while it was away."""

    detected_s: float = float("inf")
    recovered_s: float = float("inf")
    state: str = ""
    message: str = ""


@dataclass
class Seen:
    """``pulled`` by name; the state at the end, exit code, and what the devices count as sent."""

    pulled: dict[str, Pulled] = field(default_factory=dict)
    state: dict[str, Any] = field(default_factory=dict)
    code: int = -1
    killed: bool = False
    powered: bool = False
    photos: int = 0
    packets: dict[str, int] = field(default_factory=dict)
    packets_before: int = 0
    pulses: tuple[int, int] = (0, 0)  # named in time, and too early


@contextmanager
def recording_rig(tmp: Path) -> Iterator[tuple[WireRig, Service]]:
    """A rig that stands still, and the service, which records all of it and maps nothing."""
    played = read(small_session.write(tmp / "walk", frames=2, points=3000))
    with reserved(), WireRig(played, tmp / "rig") as rig:
        config = rig.config()
        config = msgspec.structs.replace(
            config, service=msgspec.structs.replace(config.service, mapping=False)
        )
        (rig.folder / "rig.toml").write_text(settings.to_toml(config))
        service = Service(rig, tmp / "recorded", tmp)
        try:
            assert until(service.listens, PATIENCE_S, 0.1), service.said()
            assert until(lambda: _records(service), PATIENCE_S, 0.1), service.said()
            yield rig, service
        finally:
            service.end()


def _records(service: Service) -> bool:
    """Whether photographs are paired, and the recorder says that it writes."""
    state = service.state()
    if state["phase"] != "recording" or state["pairing"].get("cam_0", {}).get("paired", 0) < 6:
        return False
    return bool(state["session"]["recorder"].get("messages", 0))


def device(service: Service, name: str) -> dict[str, Any]:
    """What the service says of a device."""
    return next(d for d in service.state()["devices"] if d["name"] == name)


def pull(service: Service, name: str, out: Callable[[], None], back: Callable[[], None]) -> Pulled:
    """Pull a device and plug it in again."""
    seen, began = Pulled(), time.monotonic()
    out()
    assert until(lambda: device(service, name)["state"] != "running", PATIENCE_S, _LOOK_S), name
    seen.detected_s = time.monotonic() - began
    time.sleep(max(0.0, began + OUT_S - time.monotonic()))
    away = device(service, name)
    seen.state, seen.message = away["state"], away["message"]
    began = time.monotonic()
    back()
    assert until(lambda: device(service, name)["state"] == "running", PATIENCE_S, _LOOK_S), name
    seen.recovered_s = time.monotonic() - began
    time.sleep(_AFTERWARDS_S)
    return seen


def pull_each(rig: WireRig, service: Service) -> dict[str, Pulled]:
    """LiDAR, IMU, trigger board's stick, camera, by the names that the service gives them."""
    assert rig.imu is not None
    faults = rig.avia.faults
    return {
        "lidar_0": pull(
            service,
            "lidar_0",
            lambda: setattr(faults, "unplugged", True),
            lambda: setattr(faults, "unplugged", False),
        ),
        "imu": pull(service, "imu", rig.imu.unplug, rig.imu.replug),
        "trigger": pull(service, "trigger", rig.board.unplug, rig.board.replug),
        "cam_0": pull(service, "cam_0", rig.unplug_camera, rig.replug_camera),
    }


def kill_the_recorder(service: Service) -> bool:
    """Whether another one records then."""
    os.kill(service.state()["session"]["recorder"]["pid"], signal.SIGKILL)

    def again() -> bool:
        session = service.state()["session"]
        return session["recorder_restarts"] == 1 and session["recorder"].get("messages", 0) > 100

    return until(again, PATIENCE_S, 0.1)


def lose_power(rig: WireRig, service: Service) -> bool:
    """Whether photographs are paired again after the board's power failed for a moment."""
    before = service.state()["pairing"]["cam_0"]["paired"]
    rig.board.power_cycle()
    restarted = until(lambda: device(service, "trigger")["counters"]["board_restarts"] == 1, PATIENCE_S, 0.1)
    return restarted and until(
        lambda: service.state()["pairing"]["cam_0"]["paired"] > before + 10, PATIENCE_S, 0.1
    )


def finish(service: Service, rig: WireRig, seen: Seen) -> None:
    """End the recording in order."""
    seen.state = service.state()
    service.process.send_signal(signal.SIGTERM)
    seen.code = service.process.wait(PATIENCE_S)
    seen.photos, seen.packets = rig.counts["photos"], dict(rig.avia.counters)
    clock = rig.avia.device_time
    seen.pulses = clock.utc_named, clock.utc_early
