"""A million inputs for each Livox parser: no exception, no hang, no memory that grows.

    .venv/bin/python tests/soak/fuzz_livox.py [--count N] [--seed S]

Inputs are random bytes, valid frames with random damage (bits, cuts, insertions, repeats), and random bytes under
a valid header. Prints a JSON report of what was run.
"""

import argparse
import itertools
import json
import resource
import sys
import time
from collections.abc import Callable

import numpy as np
from artemis_drivers.livox_avia import encode as encode1
from artemis_drivers.livox_avia import payloads
from artemis_drivers.livox_avia import points as points1
from artemis_drivers.livox_avia import protocol as sdk1
from artemis_drivers.livox_decoder import LivoxDecoder
from artemis_drivers.livox_mid360 import encode as encode2
from artemis_drivers.livox_mid360 import points as points2
from artemis_drivers.livox_mid360 import protocol as sdk2
from artemis_drivers.livox_slots import IMU_SLOT, POINT_SLOT
from artemis_drivers.ring import Ring
from artemis_drivers.udp import PACKET, PACKET_BYTES

_BATCH = 256
_SLOWEST_S = 1.0  # one input of at most 1500 bytes must never take longer
_GROWTH_KIB = 64 * 1024


def damaged(rng: np.random.Generator, seeds: list[bytes]) -> bytes:
    """One input."""
    how = rng.integers(0, 6)
    if how == 0:
        return rng.bytes(int(rng.integers(0, PACKET_BYTES)))
    data = bytearray(seeds[rng.integers(0, len(seeds))])
    if how == 1:
        return bytes(data)
    if how == 2:
        for _ in range(int(rng.integers(1, 9))):
            data[rng.integers(0, len(data))] ^= 1 << int(rng.integers(0, 8))
    elif how == 3:
        del data[rng.integers(0, len(data)) :]
    elif how == 4:
        at = int(rng.integers(0, len(data) + 1))
        data[at:at] = rng.bytes(int(rng.integers(1, 40)))
    else:
        keep = int(rng.integers(1, len(data) + 1))
        data[keep:] = rng.bytes(len(data) - keep)
    return bytes(data[:PACKET_BYTES])


def control1(rng: np.random.Generator) -> list[bytes]:
    """Valid SDK 1 frames of all commands, some in pairs."""
    frames = [
        sdk1.encode(
            sdk1.Frame(int(k % 3), int(rng.integers(0, 65536)), c, i, rng.bytes(int(rng.integers(0, 60))))
        )
        for k, (c, i) in enumerate((c, i) for c in (0, 1) for i in range(16))
    ]
    return frames + [a + b for a, b in itertools.pairwise(frames)]


def control2(rng: np.random.Generator) -> list[bytes]:
    """Valid SDK 2 frames."""
    commands = [*sdk2.Cmd] * 4
    return [
        sdk2.encode(sdk2.Frame(k, c, bool(k & 1), bool(k & 2), rng.bytes(int(rng.integers(0, 80)))))
        for k, c in enumerate(commands)
    ]


def data1(rng: np.random.Generator) -> list[bytes]:
    """Valid SDK 1 data packets of all types and clocks."""
    return [
        encode1.header(int(rng.integers(0, 2**32)), clock, kind, 10**18 + 1000 * int(rng.integers(0, 10**12)))
        + rng.bytes(int(points1.SHOTS[kind] * points1.SHOT_BYTES[kind]))
        for kind in (2, 3, 4, 5, 6, 7, 8)
        for clock in (0, 1, 3, 4)
    ]


def data2(rng: np.random.Generator) -> list[bytes]:
    """Valid SDK 2 data packets."""
    made = [
        encode2.imu_packet(int(rng.integers(0, 2**62)), rng.normal(size=3), rng.normal(size=3))
        for _ in range(4)
    ]
    for kind, dtype in encode2.POINT.items():
        points = np.frombuffer(rng.bytes(96 * dtype.itemsize), dtype)
        made.append(encode2.packet(kind, points, time_ns=int(rng.integers(0, 2**62)), duration_ns=480_000))
    return made


def parse_each(parse: Callable[[bytes], object]) -> Callable[[list[bytes]], float]:
    """Longest CPU time a single input took."""

    def run(batch: list[bytes]) -> float:
        slowest = 0.0
        for data in batch:
            began = time.thread_time()
            parse(data)
            slowest = max(slowest, time.thread_time() - began)
        return slowest

    return run


def decode_batches(decoder: LivoxDecoder) -> Callable[[list[bytes]], float]:
    """Feed a decoder; every packet must be counted as refused, repeated, or published."""

    def run(batch: list[bytes]) -> float:
        first = decoder.packets.claim(len(batch))
        for k, data in enumerate(batch):
            row = (first + k) % decoder.packets.slots
            decoder.packets.field["data"][row, : len(data)] = np.frombuffer(data, np.uint8)
            decoder.packets.field["size"][row], decoder.packets.field["rx_ns"][row] = len(data), first + k
        decoder.packets.publish(len(batch))
        began = time.thread_time()
        decoder.decode(first, len(batch))
        taken = time.thread_time() - began
        c = decoder.counters()
        refused = sum(v for k, v in c.items() if k.startswith("bad_") or k.endswith("_duplicates"))
        assert refused + c["points_packets"] + c["imu_packets"] == decoder.packets.published
        assert decoder.points.published == c["points_packets"] and decoder.imu.published == c["imu_packets"]
        return taken / len(batch)

    return run


def all_payloads(data: bytes) -> None:
    """Every payload decoder of both protocols."""
    for reader in (
        *(payloads.Broadcast.decode, payloads.Handshake.decode, payloads.HeartbeatAck.decode),
        *(payloads.Extrinsic.decode, payloads.IpConfig.decode, payloads.ParamsAck.decode),
        *(payloads.decode_params, payloads.decode_keys, payloads.decode_utc),
        *(sdk2.decode_values, sdk2.decode_got, sdk2.decode_keys, sdk2.HostAddress.decode, sdk2.Found.decode),
    ):
        reader(data)


def fuzz(run: Callable[[list[bytes]], float], seeds: list[bytes], count: int, seed: int) -> dict[str, float]:
    """Run one parser; memory is compared between the first tenth and the end."""
    rng = np.random.default_rng(seed)
    slowest, began, early = 0.0, time.process_time(), 0
    for done in range(0, count, _BATCH):
        slowest = max(slowest, run([damaged(rng, seeds) for _ in range(min(_BATCH, count - done))]))
        if done >= count // 10 and not early:
            early = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - early
    assert slowest < _SLOWEST_S, f"an input took {slowest:.2f} s"
    assert growth < _GROWTH_KIB, f"memory grew by {growth} KiB"
    return {
        "inputs": count,
        "cpu_s": round(time.process_time() - began, 1),
        "slowest_ms": round(slowest * 1e3, 3),
        "growth_kib": growth,
    }


def rings() -> tuple[Ring, Ring, Ring]:
    """Rings of a decoder."""
    return Ring(PACKET, 1024), Ring(POINT_SLOT, 1024), Ring(IMU_SLOT, 1024)


def main() -> int:
    """Fuzz all parsers."""
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--count", type=int, default=1_000_000)
    args.add_argument("--seed", type=int, default=1)
    opts = args.parse_args()
    rng = np.random.default_rng(opts.seed)
    work = {
        "sdk1_control": (parse_each(sdk1.decode), control1(rng)),
        "sdk2_control": (parse_each(sdk2.decode), control2(rng)),
        "payloads": (parse_each(all_payloads), [f[11:-4] or b"\0" for f in control1(rng)]),
        "sdk1_data": (decode_batches(points1.Decoder(*rings())), data1(rng)),
        "sdk2_data": (decode_batches(points2.Decoder(*rings())), data2(rng)),
    }
    report = {name: fuzz(run, seeds, opts.count, opts.seed) for name, (run, seeds) in work.items()}
    print(json.dumps({"seed": opts.seed, "parsers": report}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
