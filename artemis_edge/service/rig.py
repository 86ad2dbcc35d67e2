"""The devices of a rig with their drivers, made from the settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from artemis_drivers.base import Driver, DriverError, Health, State
from artemis_drivers.camera.driver import Camera
from artemis_drivers.imu_serial.driver import CHUNK_BYTES, IMU_CHUNK, SerialImu
from artemis_drivers.imu_serial.samples import IMU_SAMPLE
from artemis_drivers.livox import livox_driver
from artemis_drivers.livox_host import LivoxHost
from artemis_drivers.ring import Ring
from artemis_drivers.trigger.board import TriggerBoard
from artemis_drivers.trigger.events import CAN_FRAME, EVENTS_SLOTS, TRIGGER_EVENT
from artemis_drivers.udp import Interface, interfaces

from artemis_edge.service.settings import RunConfig, device_name

_IMU_SLOTS = 4096
_CHUNK_SLOTS = (4 << 20) // CHUNK_BYTES


@dataclass(slots=True)
class Rig:
    """``lidars`` in the order of the settings; the rest is None or empty where the rig has none."""

    config: RunConfig
    livox: LivoxHost
    imu: SerialImu | None = None
    imu_samples: Ring | None = None
    imu_chunks: Ring | None = None
    board: TriggerBoard | None = None
    events: Ring | None = None
    frames: Ring | None = None
    cameras: list[Camera] = field(default_factory=list)
    armed: bool = False

    @property
    def drivers(self) -> list[Driver]:
        """In the order in which they are started: a camera before what triggers it."""
        parts: list[Driver | None] = [self.livox, self.imu, *self.cameras, self.board]
        return [part for part in parts if part is not None]

    def start(self) -> None:
        """Start all drivers; DriverError where one cannot work at all, and then none runs."""
        started: list[Driver] = []
        try:
            for driver in self.drivers:
                driver.start()
                started.append(driver)
        except DriverError:
            for driver in reversed(started):
                driver.stop()
            raise

    def stop(self) -> None:
        """LiDAR, cameras, IMU: first what costs most when it is cut off. The board still shows what is going on."""
        for part in (self.livox, *self.cameras, self.imu):
            if part is not None:
                part.stop()

    def stop_board(self) -> None:
        """After its lights are out."""
        if self.board is not None:
            self.board.stop()

    def health(self) -> list[Health]:
        """Every device."""
        return [health for driver in self.drivers for health in driver.health()]

    def running(self) -> bool:
        """Whether every device delivers; a camera may wait for triggers."""
        return all(health.state == State.RUNNING for health in self.health())


def make_rig(config: RunConfig, own_addresses: Callable[[], list[Interface]] = interfaces) -> Rig:
    """The drivers of all devices; DriverError for settings that contradict each other."""
    avias = [entry.avia for entry in config.lidar if entry.avia is not None]
    mid360s = [entry.mid360 for entry in config.lidar if entry.mid360 is not None]
    rig = Rig(config, livox_driver(avias, mid360s, own_addresses=own_addresses))
    order = [device_name(entry) for entry in config.lidar]
    rig.livox.lidars = tuple(sorted(rig.livox.lidars, key=lambda lidar: order.index(lidar.name)))
    if config.imu is not None:
        rig.imu_samples, rig.imu_chunks = Ring(IMU_SAMPLE, _IMU_SLOTS), Ring(IMU_CHUNK, _CHUNK_SLOTS)
        rig.imu = SerialImu(config.imu.device, rig.imu_samples, rig.imu_chunks)
    if config.trigger is not None:
        rig.events, rig.frames = Ring(TRIGGER_EVENT, EVENTS_SLOTS), Ring(CAN_FRAME, EVENTS_SLOTS)
        rig.board = TriggerBoard(config.trigger, rig.events, rig.frames)
    rig.cameras = [Camera(entry.device, triggers=lambda: rig.armed) for entry in config.camera]
    return rig
