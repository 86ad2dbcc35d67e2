"""What receiving a LiDAR costs: decoding alone, and the whole driver against a virtual Avia in its own process.

    .venv/bin/python tests/bench/bench_livox.py [--seconds S] [--mode strongest|dual|triple]

CPU time is that of the driver's process (all threads, user and system) while the data flow. Packets are made
before they are sent, so that the sender keeps up; it sends in bursts every 2 ms, harder on the receiver than the
even spacing of a device. Exit code 1 if a packet was lost.
"""

import argparse
import json
import multiprocessing
import socket
import statistics
import sys
import time
from multiprocessing.synchronize import Event

import numpy as np
from artemis_drivers.base import State
from artemis_drivers.livox import livox_driver
from artemis_drivers.livox_avia import encode
from artemis_drivers.livox_avia.points import SHOTS, Decoder
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.livox_slots import IMU_SLOT, POINT_SLOT, collect
from artemis_drivers.ring import Ring, RingReader
from artemis_drivers.udp import PACKET
from artemis_drivers.virtual.wire_avia import VirtualAvia

from artemis_edge.session.writer import POINT

_TYPE = {"strongest": 2, "dual": 4, "triple": 7}
_BURST_S = 0.002


def packets(data_type: int, count: int) -> list[bytes]:
    """Consecutive packets of random points, stamped from 0."""
    rng = np.random.default_rng(0)
    period = int(SHOTS[data_type] * 1e9) // 240_000
    body = rng.bytes(1400)[: int(SHOTS[data_type]) * encode.SHOT[data_type].itemsize]
    return [encode.header(0, 0, data_type, k * period) + body for k in range(count)]


def decode_ms(data_type: int) -> tuple[float, float]:
    """Median CPU ms to decode, and to collect, 100 ms of shots (24,000 points in single return)."""
    count = 24_000 // int(SHOTS[data_type])
    ring = Ring(PACKET, 1024)
    decoder = Decoder(ring, Ring(POINT_SLOT, 1024), Ring(IMU_SLOT, 64))
    made = packets(data_type, count * 30)
    decoding, collecting = [], []
    for frame in range(30):
        first = ring.claim(count)
        for k, data in enumerate(made[frame * count : (frame + 1) * count]):
            row = (first + k) % ring.slots
            ring.field["data"][row, : len(data)] = np.frombuffer(data, np.uint8)
            ring.field["size"][row], ring.field["rx_ns"][row] = len(data), frame * 100_000_000 + k
        ring.publish(count)
        reader = RingReader(decoder.points)
        began = time.process_time()
        decoder.decode(first, count)
        decoding.append(time.process_time() - began)
        began = time.process_time()
        slots = reader.read()[1]
        cloud = collect([(slots, 0)], frame * 100_000_000, (frame + 1) * 100_000_000, POINT)
        collecting.append(time.process_time() - began)
        assert len(cloud) >= 24_000
    return statistics.median(decoding[3:]) * 1e3, statistics.median(collecting[3:]) * 1e3


def device(data_type: int, seconds: float, ready: Event, go: Event, done: Event) -> None:
    """The other process: session by VirtualAvia, data from memory."""
    rate = 240_000 / SHOTS[data_type]
    made = packets(data_type, round(rate * seconds))
    with VirtualAvia(announce_every_s=0.1), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 << 20)
        ready.set()
        go.wait()
        start, sent = time.monotonic(), 0
        while sent < len(made):
            upto = min(len(made), int((time.monotonic() - start) * rate))
            for data in made[sent:upto]:
                out.sendto(data, ("127.0.0.1", 56001))
            sent = max(sent, upto)
            time.sleep(_BURST_S)
        done.wait()


def receive(mode: str, seconds: float) -> dict[str, float]:
    """Losses and CPU share of the driver's process."""
    context = multiprocessing.get_context("spawn")
    ready, go, done = context.Event(), context.Event(), context.Event()
    other = context.Process(target=device, args=(_TYPE[mode], seconds, ready, go, done))
    other.start()
    driver = livox_driver([AviaConfig(return_mode=mode)])  # type: ignore[arg-type]
    ready.wait()
    driver.start()
    while driver.health()[0].state not in (State.RUNNING, State.SILENT):
        time.sleep(0.01)
    cpu, wall = time.process_time(), time.monotonic()
    go.set()
    expected = round(240_000 / SHOTS[_TYPE[mode]] * seconds)
    while time.monotonic() - wall < seconds + 0.5:
        time.sleep(0.1)
    cpu = time.process_time() - cpu
    health = driver.health()[0]
    done.set()
    driver.stop()
    other.join()
    names = ("points_packets", "points_lost", "points_gaps", "kernel_drops")
    return {
        "sent": expected,
        **{name: health.counters[name] for name in names},
        "seconds": seconds,
        "cpu_percent_of_a_core": round(100 * cpu / seconds, 2),
    }


def main() -> int:
    """Measure."""
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--seconds", type=float, default=10.0)
    args.add_argument("--mode", choices=_TYPE, default="strongest")
    opts = args.parse_args()
    decoding, collecting = decode_ms(_TYPE[opts.mode])
    report = {"mode": opts.mode, "decode_ms": round(decoding, 3), "collect_ms": round(collecting, 3)}
    received = receive(opts.mode, opts.seconds)
    print(json.dumps(report | received, indent=1))
    return 1 if received["points_packets"] != received["sent"] or received["kernel_drops"] else 0


if __name__ == "__main__":
    sys.exit(main())
