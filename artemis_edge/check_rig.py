"""The part of ``check`` that looks at the rig: ports, networks, disk, battery, clock, model.

Nothing is sent to a device, so it can be done while a service has them; whether a device answers is told by the
service itself once it runs.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import stat
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.livox_mid360.settings import Mid360Config
from artemis_drivers.udp import RECEIVE_BUFFER, Interface, interfaces, port_holder

from artemis_edge import health
from artemis_edge.check_finding import Finding, Status
from artemis_edge.service.settings import LidarEntry, RunConfig, ServiceSettings

_LIDAR_NETWORK = ipaddress.IPv4Network("192.168.1.0/24")  # factory addresses are 192.168.1.1xx
_WRITE_MB = 32
_MB = 1_000_000
_POINT_BYTES = 26 + 14  # as PointCloud2, and the packet it came in
_IMAGE_MB = 0.35  # a JPEG of 1280 x 1024 at quality 92
_IMU_BYTES = 320
_MARGIN = 3.0  # a disk that is only just fast enough stalls when it collects its garbage
_FEW_MINUTES, _TOO_FEW_MINUTES = 30.0, 5.0
_LOW_BATTERY = 20
_HOT_C = 85.0


def check_rig(config: RunConfig, own: Callable[[], list[Interface]] = interfaces) -> list[Finding]:
    """One finding a subject."""
    rate = data_rate(config)
    found = [f for entry in config.lidar for f in lidar(entry, own())]
    found.append(receive_buffer())
    if config.imu is not None:
        found.append(serial_port(config.imu.device.name, config.imu.device.port))
    if config.trigger is not None:
        found.append(can_bus(config.trigger.interface, config.trigger.channel))
    found += [camera(entry.device) for entry in config.camera]
    if config.camera and config.trigger is None:
        found.append(
            Finding(
                "trigger",
                "warn",
                "cameras without a trigger board: images are placed in time by their arrival",
            )
        )
    return [*found, *recording_disk(config.service, rate), battery(), temperature(), clock(), model()]


def data_rate(config: RunConfig) -> float:
    """What a recording grows by, MB a second, from what the devices send."""
    returns = {"first": 1, "strongest": 1, "dual": 2, "triple": 3}
    points = sum(
        240_000 * returns[entry.avia.return_mode] if entry.avia is not None else 200_000
        for entry in config.lidar
    )
    rate = points * _POINT_BYTES / _MB
    if config.imu is not None:
        rate += config.imu.device.rate_hz * _IMU_BYTES / _MB
    hz = config.trigger.rate_hz if config.trigger is not None else 10.0
    return rate + len(config.camera) * hz * _IMAGE_MB


def lidar(entry: LidarEntry, own: list[Interface]) -> list[Finding]:
    """Its network and its ports."""
    device = entry.avia or entry.mid360
    assert device is not None
    found = [_network(device, own)]
    for port in _ports(device):
        holder = _taken_by(port)
        if holder:
            found.append(Finding(f"{device.name} port", "fail", f"UDP {port} is used by {holder}; stop it"))
    return found


def _ports(device: AviaConfig | Mid360Config) -> tuple[int, ...]:
    if isinstance(device, AviaConfig):
        return device.command_port, device.data_port
    return device.command_port, device.push_port, device.point_port, device.imu_port


def _taken_by(port: int) -> str:
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind(("", port))
        except OSError:
            return port_holder(port) or "another program"
    return ""


def _network(device: AviaConfig | Mid360Config, own: list[Interface]) -> Finding:
    name = f"{device.name} network"
    addresses = {str(interface.address): interface.name for interface in own}
    if device.host_ip:
        if device.host_ip in addresses:
            return Finding(name, "ok", f"{device.host_ip} is {addresses[device.host_ip]}")
        return Finding(
            name,
            "fail",
            f"no interface has the address {device.host_ip} (host_ip); give it one or clear host_ip",
        )
    fitting = [i for i in own if i.address in _LIDAR_NETWORK]
    if fitting:
        return Finding(name, "ok", f"{fitting[0].name} is {fitting[0].address}")
    others = ", ".join(f"{i.name} {i.address}" for i in own if not i.address.is_loopback) or "none"
    return Finding(
        name,
        "fail",
        f"no interface is in the LiDAR's network {_LIDAR_NETWORK} (there are: {others}); give the one with the "
        f"LiDAR's cable the address 192.168.1.50/24, or name another network's address as host_ip",
    )


def receive_buffer(file: Path = Path("/proc/sys/net/core/rmem_max")) -> Finding:
    """Whether the kernel keeps packets for a second while we are busy."""
    with contextlib.suppress(OSError, ValueError):
        allowed = int(file.read_text())
        if allowed >= RECEIVE_BUFFER:
            return Finding("socket buffer", "ok", f"{allowed / _MB:.0f} MB")
        return Finding(
            "socket buffer",
            "warn",
            f"the kernel allows {allowed / _MB:.1f} MB, a pause of {allowed / 2304 / 2500:.2f} s loses points; "
            f"install systemd/60-artemis.conf, or: sysctl net.core.rmem_max={RECEIVE_BUFFER * 4}",
        )
    return Finding("socket buffer", "warn", "this system does not say how large socket buffers may be")


def serial_port(name: str, port: str) -> Finding:
    """Whether it is there and may be used."""
    path = Path(port)
    if not path.exists():
        return Finding(
            name, "fail", f"{port} is not there; plug the device in, or see firmware_cfg/udev for its name"
        )
    if not os.access(path, os.R_OK | os.W_OK):
        return Finding(name, "fail", f"{port} may not be opened; add this user to its group: {_group(path)}")
    kind = "" if stat.S_ISCHR(path.stat().st_mode) else ", but is no serial port"
    return Finding(name, "fail" if kind else "ok", f"{port} is there{kind}")


def _group(path: Path) -> str:
    try:
        return path.group()
    except (KeyError, OSError):
        return "dialout"


def can_bus(interface: str, channel: str, sysfs: Path = Path("/sys/class/net")) -> Finding:
    """The trigger board's bus."""
    if interface != "socketcan":
        port = channel.split("@")[0]
        return serial_port("trigger", port) if port.startswith("/") else Finding("trigger", "ok", channel)
    folder = sysfs / channel
    if not folder.exists():
        return Finding(
            "trigger", "fail", f"there is no CAN interface {channel}; plug the adapter in, load its driver"
        )
    state = ""
    with contextlib.suppress(OSError):
        state = (folder / "operstate").read_text().strip()
    if state in ("up", "unknown"):
        return Finding("trigger", "ok", f"{channel} is up")
    return Finding(
        "trigger",
        "fail",
        f"{channel} is {state}; ip link set {channel} up type can bitrate 500000 restart-ms 100",
    )


def camera(device: object, usb: Path = Path("/sys/bus/usb/devices")) -> Finding:
    """A camera: the driver's library, and the device on the bus; a folder where files stand in for it."""
    from importlib.util import find_spec

    name = str(getattr(device, "name", "camera"))
    files = getattr(device, "path", None)
    if files is not None:
        there = Path(str(files)).exists()
        return Finding(name, "ok" if there else "fail", f"{files} is {'' if there else 'not '}there")
    if not hasattr(device, "socket"):
        return Finding(name, "ok", "nothing to look at")
    if find_spec("depthai") is None:
        return Finding(name, "fail", "OAK cameras need the extra: pip install 'artemis-edge[oak]'")
    vendors = []
    for file in usb.glob("*/idVendor"):
        with contextlib.suppress(OSError):
            vendors.append(file.read_text().strip())
    if "03e7" not in vendors:
        return Finding(name, "fail", "no OAK on the USB; plug it in (a cable for USB 3), see dmesg")
    return Finding(name, "ok", "an OAK is on the USB")


def recording_disk(service: ServiceSettings, rate_mb_s: float) -> list[Finding]:
    """Whether the disk is fast enough, and for how long it lasts."""
    folder = Path(service.sessions)
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    minutes = max(health.free_disk_mb(place) - service.reserve_mb, 0.0) / rate_mb_s / 60
    text = f"{minutes:.0f} minutes at {rate_mb_s:.0f} MB/s, {service.reserve_mb} MB kept free"
    space: Status = "fail" if minutes < _TOO_FEW_MINUTES else "warn" if minutes < _FEW_MINUTES else "ok"
    found = [Finding("disk space", space, text)]
    if not folder.exists():
        missing = (
            f"{folder} is not there yet: the first recording makes it, in {place}; "
            "if it is on a disk of its own, mount it"
        )
        found.append(Finding("sessions", "warn", missing))
    try:
        speed = write_speed(place)
    except OSError as error:
        return [
            *found,
            Finding("disk", "fail", f"cannot write to {place}: {error.strerror}; choose another folder"),
        ]
    enough = speed >= _MARGIN * rate_mb_s
    tail = "" if enough else f"; the recording needs {rate_mb_s:.0f} and {_MARGIN:.0f} times that to be safe"
    status: Status = "ok" if enough else "fail" if speed < rate_mb_s else "warn"
    return [*found, Finding("disk speed", status, f"{speed:.0f} MB/s written through to {place}{tail}")]


def write_speed(folder: Path) -> float:
    """MB a second that reach the disk, fdatasync included."""
    chunk = os.urandom(_MB)
    with tempfile.TemporaryFile(dir=folder) as file:
        start = time.perf_counter()
        for _ in range(_WRITE_MB):
            file.write(chunk)
        file.flush()
        os.fdatasync(file.fileno())
        return _WRITE_MB / max(time.perf_counter() - start, 1e-6)


def battery(folder: Path = Path("/sys/class/power_supply")) -> Finding:
    """What is left."""
    found = health.battery(folder)
    if found is None:
        return Finding("battery", "ok", "none that this system knows of")
    left = f", {found.minutes:.0f} minutes at this load" if found.minutes is not None else ""
    low = found.percent < _LOW_BATTERY
    return Finding(
        "battery", "warn" if low else "ok", f"{found.percent:.0f} %{left}" + ("; charge it" if low else "")
    )


def temperature(folder: Path = Path("/sys/class/thermal")) -> Finding:
    """The hottest place, as the kernel knows it."""
    hottest = health.temperature_c(folder)
    if hottest is None:
        return Finding("temperature", "ok", "not told by this system")
    hot = hottest >= _HOT_C
    return Finding(
        "temperature", "warn" if hot else "ok", f"{hottest:.0f} C" + ("; let it cool" if hot else "")
    )


def clock(marker: Path = Path("/run/systemd/timesync/synchronized")) -> Finding:
    """Whether this computer's date can be believed; the rig's own time comes from the trigger board."""
    if time.time() < 1_700_000_000:  # November 2023: before this software
        return Finding(
            "clock", "warn", f"the date is {time.strftime('%Y-%m-%d')}; set it, recordings are named by it"
        )
    if marker.exists():
        return Finding("clock", "ok", "set by the network")
    return Finding("clock", "ok", f"{time.strftime('%Y-%m-%d %H:%M')}, not confirmed by a time server")


def model() -> Finding:
    """The network that questions would use."""
    from artemis_edge.errors import UserError
    from artemis_edge.segmentation.registry import Registry

    try:
        entry = Registry().find()
    except UserError as error:
        return Finding("model", "warn", str(error))
    if entry.problem:
        return Finding("model", "fail", entry.problem)
    only = (
        "; it knows virtual worlds only, register one of yours: artemis-edge models add"
        if entry.shipped
        else ""
    )
    return Finding("model", "warn" if entry.shipped else "ok", f"{entry.manifest.name}{only}")
