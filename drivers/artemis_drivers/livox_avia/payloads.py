"""Payloads of Livox SDK 1 control frames as bytes, both ways (source: livox_def.h of Livox SDK v2.3.0).

Decoders return None instead of raising: what arrives from the wire may be anything.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import struct
from typing import NamedTuple

from artemis_drivers.livox_avia.protocol import COMMAND_PORT


class Broadcast(NamedTuple):
    """What a device without a host announces once a second."""

    code: str
    device: int
    reserved: int = COMMAND_PORT

    def encode(self) -> bytes:
        """19 bytes."""
        return struct.pack("<16sBH", self.code.encode("ascii"), self.device, self.reserved)

    @classmethod
    def decode(cls, payload: bytes) -> Broadcast | None:
        """None when the payload is too short or its code is no text."""
        if len(payload) < 19:
            return None
        code, device, reserved = struct.unpack_from("<16sBH", payload)
        text = code.split(b"\0")[0]
        return cls(text.decode("ascii"), device, reserved) if text.isalnum() else None


class Handshake(NamedTuple):
    """Where the host wants answers, points and IMU samples. ``sensor_port`` None: the old form without IMU."""

    host_ip: str
    data_port: int
    cmd_port: int
    sensor_port: int | None

    def encode(self) -> bytes:
        """8 or 10 bytes."""
        ports = [self.data_port, self.cmd_port] + ([] if self.sensor_port is None else [self.sensor_port])
        return ipaddress.IPv4Address(self.host_ip).packed + struct.pack(f"<{len(ports)}H", *ports)

    @classmethod
    def decode(cls, payload: bytes) -> Handshake | None:
        """None when the payload is too short."""
        if len(payload) < 8:
            return None
        data_port, cmd_port = struct.unpack_from("<HH", payload, 4)
        sensor = int.from_bytes(payload[8:10], "little") if len(payload) >= 10 else None
        return cls(str(ipaddress.IPv4Address(payload[:4])), data_port, cmd_port, sensor)


class HeartbeatAck(NamedTuple):
    """Answer to a heartbeat. ``detail`` is the progress in percent while initialising, else the status code."""

    ret: int
    work_state: int
    feature: int
    detail: int

    def encode(self) -> bytes:
        """7 bytes."""
        return struct.pack("<BBBI", *self)

    @classmethod
    def decode(cls, payload: bytes) -> HeartbeatAck | None:
        """None when the payload is too short."""
        return cls(*struct.unpack_from("<BBBI", payload)) if len(payload) >= 7 else None


class Extrinsic(NamedTuple):
    """Mounting stored in the device: degrees and millimetres."""

    roll: float
    pitch: float
    yaw: float
    x: int
    y: int
    z: int

    def encode(self) -> bytes:
        """24 bytes."""
        return struct.pack("<fffiii", *self)

    @classmethod
    def decode(cls, payload: bytes) -> Extrinsic | None:
        """None when the payload is too short."""
        return cls(*struct.unpack_from("<fffiii", payload)) if len(payload) >= 24 else None


class IpConfig(NamedTuple):
    """How the device gets its address: DHCP or static."""

    static: bool
    address: str = "0.0.0.0"
    mask: str | None = None
    gateway: str | None = None

    def encode(self) -> bytes:
        """5 bytes, 13 with mask and gateway."""
        tail = [self.address] + [a for a in (self.mask, self.gateway) if a is not None]
        return bytes([self.static]) + b"".join(ipaddress.IPv4Address(a).packed for a in tail)

    @classmethod
    def decode(cls, payload: bytes) -> IpConfig | None:
        """None when the payload is too short."""
        if len(payload) < 5:
            return None
        ips = [str(ipaddress.IPv4Address(payload[i : i + 4])) for i in range(1, len(payload) - 3, 4)]
        return cls(payload[0] == 1, ips[0], *(ips[1:3] if len(ips) >= 3 else ()))


def encode_params(values: dict[int, bytes]) -> bytes:
    """Key-length-value list of parameters."""
    return b"".join(struct.pack("<HH", key, len(value)) + value for key, value in values.items())


def decode_params(payload: bytes) -> dict[int, bytes]:
    """Inverse of ``encode_params``; what is cut off at the end is left out."""
    values = {}
    at = 0
    while at + 4 <= len(payload):
        key, length = struct.unpack_from("<HH", payload, at)
        if at + 4 + length > len(payload):
            break
        values[key] = payload[at + 4 : at + 4 + length]
        at += 4 + length
    return values


def encode_keys(keys: list[int]) -> bytes:
    """Request of parameters by key."""
    return struct.pack(f"<B{len(keys)}H", len(keys), *keys)


def decode_keys(payload: bytes) -> list[int]:
    """Inverse of ``encode_keys``; never more keys than there are bytes for."""
    count = min(payload[0], (len(payload) - 1) // 2) if payload else 0
    return list(struct.unpack_from(f"<{count}H", payload, 1)) if count else []


class ParamsAck(NamedTuple):
    """Answer to setting or getting parameters: which key failed and why, and the values got."""

    ret: int
    error_key: int
    error_code: int
    values: dict[int, bytes]

    def encode(self) -> bytes:
        """4 bytes and the values."""
        return struct.pack("<BHB", self.ret, self.error_key, self.error_code) + encode_params(self.values)

    @classmethod
    def decode(cls, payload: bytes) -> ParamsAck | None:
        """None when the payload is empty. A device that only sends the first byte is understood too."""
        if not payload:
            return None
        if len(payload) < 4:
            return cls(payload[0], 0, 0, {})
        ret, error_key, error_code = struct.unpack_from("<BHB", payload)
        return cls(ret, error_key, error_code, decode_params(payload[4:]))


def encode_utc(unix_ns: int) -> bytes:
    """Name of a PPS edge for command UTC: year - 2000, month, day, hour, microseconds in the hour.

    Raises ValueError outside 2000..2255.
    """
    seconds, rest = divmod(unix_ns, 1_000_000_000)
    t = dt.datetime.fromtimestamp(seconds, dt.UTC)
    if not 2000 <= t.year <= 2255:
        raise ValueError(f"the year {t.year} cannot be sent to a Livox device")
    microseconds = (t.minute * 60 + t.second) * 1_000_000 + rest // 1000
    return struct.pack("<BBBBI", t.year - 2000, t.month, t.day, t.hour, microseconds)


def decode_utc(payload: bytes) -> int | None:
    """Nanoseconds since 1970; None when the payload is too short or no date."""
    if len(payload) < 8:
        return None
    year, month, day, hour = payload[:4]
    microseconds = int.from_bytes(payload[4:8], "little")
    try:
        whole = int(dt.datetime(2000 + year, month, day, hour, tzinfo=dt.UTC).timestamp())
    except ValueError:
        return None
    return whole * 1_000_000_000 + microseconds * 1000
