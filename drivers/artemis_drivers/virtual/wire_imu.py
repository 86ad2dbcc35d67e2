"""An Xsens MTi on a pseudo terminal: configuration and MTData2 stream as on the real wire, with faults."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from artemis_drivers.imu_serial import mtdata2
from artemis_drivers.imu_serial.configure import decode_outputs, encode_outputs
from artemis_drivers.imu_serial.mtdata2 import EVERY_PACKET, Item, Message, Mid, Type
from artemis_drivers.imu_serial.settings import XSENS_BAUD_IDS
from artemis_drivers.imu_serial.stream import FrameSplitter
from artemis_drivers.virtual.wire_device import WireDevice

TICKS_PER_SECOND = 10_000
_SECOND_NS = 1_000_000_000
_BAUD_OF_ID = {number: baud for baud, number in XSENS_BAUD_IDS.items()}
_PARAMETER_INVALID = 0x21
_IDLE_S = 0.02
_HIGHEST_RATE_HZ = 400  # of the MTi-300's calibrated outputs

#: Rate of turn (rad/s) and specific force (m/s2) in the IMU's axes at a truth time in ns.
Motion = Callable[[int], tuple[Sequence[float], Sequence[float]]]


@dataclass(frozen=True, slots=True)
class MtiFaults:
    """Switches. ``skew_ppm`` of the device's clock; a constant ``latency_ns`` and uniform ``jitter_ns`` until
    bytes are sent; shares 0..1 of samples dropped, corrupted, sent twice, or preceded by noise.
    """

    skew_ppm: float = 0.0
    latency_ns: int = 0
    jitter_ns: int = 0
    drop: float = 0.0
    corrupt: float = 0.0
    duplicate: float = 0.0
    noise: float = 0.0
    first_counter: int = 0
    first_tick: int = 0


class MtiDevice:
    """What the device does, without wire and without time of its own."""

    def __init__(self, device_id: int = 0x03800123, baud: int = 115_200) -> None:
        self.device_id = device_id
        self.baud = baud
        self.measuring = False
        self.outputs: tuple[tuple[int, int], ...] = (
            (Type.PACKET_COUNTER, EVERY_PACKET),
            (Type.QUATERNION, 100),
        )
        self.sync = b""
        self._next_baud = baud

    @property
    def rate_hz(self) -> int:
        """Packets a second."""
        rates = [rate for _, rate in self.outputs if rate != EVERY_PACKET]
        return max(rates, default=100)

    def answer(self, request: Message) -> list[Message]:
        """Acknowledgements of a request; nothing for one that the present mode does not allow."""
        if request.mid == Mid.GOTO_CONFIG:
            self.measuring = False
            return [Message(Mid.GOTO_CONFIG + 1)]
        if self.measuring:
            return []
        if request.mid == Mid.GOTO_MEASUREMENT:
            self.measuring = True
            return [Message(Mid.GOTO_MEASUREMENT + 1)]
        if request.mid == Mid.REQ_DID:
            return [Message(Mid.DEVICE_ID, self.device_id.to_bytes(4, "big"))]
        if request.mid == Mid.SET_OUTPUT_CONFIGURATION:
            return [self._set_outputs(request.data)]
        if request.mid == Mid.SET_SYNC_SETTINGS:
            self.sync = request.data or self.sync
            return [Message(Mid.SET_SYNC_SETTINGS + 1, self.sync)]
        if request.mid == Mid.SET_BAUDRATE:
            return [self._set_baud(request.data)]
        if request.mid == Mid.RESET:
            self.baud = self._next_baud
            return [Message(Mid.RESET + 1)]
        return [Message(Mid.ERROR, bytes([_PARAMETER_INVALID]))]

    def packet(self, index: int, first: MtiFaults, gyro: Sequence[float], accel: Sequence[float]) -> Message:
        """The MTData2 message of sample ``index``."""
        ticks = first.first_tick + index * TICKS_PER_SECOND // self.rate_hz
        known: dict[int, tuple[float, ...]] = {
            Type.PACKET_COUNTER: ((first.first_counter + index) % 2**16,),
            Type.SAMPLE_TIME_FINE: (ticks % 2**32,),
            Type.QUATERNION: (1.0, 0.0, 0.0, 0.0),
            Type.ACCELERATION: tuple(accel),
            Type.RATE_OF_TURN: tuple(gyro),
            Type.STATUS_WORD: (0x00000003,),
        }
        items = [Item(data_id, known[Item(data_id).type]) for data_id, _ in self.outputs]
        return Message(Mid.MTDATA2, mtdata2.encode_items(items))

    def _set_outputs(self, data: bytes) -> Message:
        supported = (
            Type.PACKET_COUNTER,
            Type.SAMPLE_TIME_FINE,
            Type.QUATERNION,
            Type.ACCELERATION,
            Type.RATE_OF_TURN,
            Type.STATUS_WORD,
        )
        wanted = decode_outputs(data)
        if any(Item(data_id).type not in supported for data_id, _ in wanted):
            return Message(Mid.ERROR, bytes([_PARAMETER_INVALID]))
        if wanted:
            self.outputs = tuple(
                (i, rate if rate == EVERY_PACKET else min(rate, _HIGHEST_RATE_HZ)) for i, rate in wanted
            )
        return Message(Mid.SET_OUTPUT_CONFIGURATION + 1, encode_outputs(self.outputs))

    def _set_baud(self, data: bytes) -> Message:
        if len(data) != 1 or data[0] not in _BAUD_OF_ID:
            return Message(Mid.ERROR, bytes([_PARAMETER_INVALID]))
        self._next_baud = _BAUD_OF_ID[data[0]]
        return Message(Mid.SET_BAUDRATE + 1)


class WireMti(WireDevice):
    """The device on a pseudo terminal at ``path``, driven by the truth clock ``now`` (ns)."""

    def __init__(
        self,
        path: Path,
        motion: Motion,
        faults: MtiFaults | None = None,
        device: MtiDevice | None = None,
        now: Callable[[], int] = time.monotonic_ns,
        seed: int = 0,
    ) -> None:
        super().__init__(path, "virtual MTi")
        self.device = device or MtiDevice()
        self.sent = 0
        self.dropped = 0
        self._motion, self._faults, self._now = motion, faults or MtiFaults(), now
        self._random = random.Random(seed)
        self._splitter = FrameSplitter(mtdata2.XbusFraming())
        self._start_ns = 0
        self._index = 0
        self._was_measuring = False

    def _unplugged(self) -> None:
        """Its power, and with it the measurement."""
        self.device.measuring = self._was_measuring = False

    def truth_ns(self, index: int) -> int:
        """When sample ``index`` of the present measurement was taken, by the truth clock."""
        period = _SECOND_NS / self.device.rate_hz / (1 + self._faults.skew_ppm * 1e-6)
        return self._start_ns + round(index * period)

    def _turn(self) -> float:
        """Answer what was asked, send what is due; returns how long there is nothing to do."""
        if not self.port.plugged:
            return _IDLE_S
        if self.port.baud() != self.device.baud:
            self.port.read(0.0)  # noise to us
            return _IDLE_S
        for frame in self._splitter.feed(self.port.read(0.0)):
            for message in self.device.answer(mtdata2.decode(frame)):
                self.port.write(mtdata2.encode(message))
        if not self.device.measuring:
            self._was_measuring = False
            return _IDLE_S / 4
        if not self._was_measuring:
            self._was_measuring, self._start_ns, self._index = True, self._now(), 0
        delay = self._faults.latency_ns + self._random.randrange(self._faults.jitter_ns + 1)
        while (due := self.truth_ns(self._index) + delay) <= self._now():
            self._send(self._index)
            self._index += 1
        return min(_IDLE_S, max(0, due - self._now()) / _SECOND_NS)

    def _send(self, index: int) -> None:
        faults, chance = self._faults, self._random.random
        if chance() < faults.drop:
            self.dropped += 1
            return
        gyro, accel = self._motion(self.truth_ns(index))
        data = mtdata2.encode(self.device.packet(index, faults, gyro, accel))
        if chance() < faults.corrupt:
            broken = bytearray(data)
            broken[self._random.randrange(1, len(data))] ^= 1 << self._random.randrange(8)
            data = bytes(broken)
            self.dropped += 1
        elif chance() < faults.duplicate:
            data += data
        if chance() < faults.noise:
            data = self._random.randbytes(self._random.randrange(1, 64)) + data
        self.sent += 1
        self.port.write(data)
