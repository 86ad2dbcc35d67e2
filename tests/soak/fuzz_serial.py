"""Fuzz: random and mutated bytes through every parser of the serial IMUs and of the trigger board.

    .venv/bin/python tests/soak/fuzz_serial.py [--inputs 1000000] [--seed 0] [--only NAME]

Half of the inputs are true frames with a few bytes changed, cut, repeated or inserted, half of these with
their check made right again, so that the layers behind it are reached. Nothing but the refusals that are
documented may be raised, no buffer may outgrow its longest frame, and no input may take more than a second.
Exit code 1 otherwise.
"""

import argparse
import binascii
import random
import sys
import time
from collections import Counter
from collections.abc import Callable

from artemis_drivers.imu_serial import mtdata2, vectornav
from artemis_drivers.imu_serial.configure import VECTORNAV_FIELDS, decode_outputs
from artemis_drivers.imu_serial.driver import SerialImu
from artemis_drivers.imu_serial.mtdata2 import Item, MalformedError, Message, Mid, Type
from artemis_drivers.imu_serial.samples import IMU_SAMPLE, mti_sample, vectornav_sample
from artemis_drivers.imu_serial.settings import MtiSettings, VectorNavSettings
from artemis_drivers.imu_serial.stream import FrameSplitter, Framing
from artemis_drivers.ring import Ring
from artemis_drivers.trigger import sdo
from artemis_drivers.trigger.board import TriggerBoard
from artemis_drivers.trigger.events import TRIGGER_EVENT
from artemis_drivers.trigger.messages import SdoRequest, SdoResponse
from artemis_drivers.trigger.settings import TriggerSettings

SLOWEST_S = 1.0
Parser = Callable[[bytes], str]


def xbus_sample(number: int) -> bytes:
    items = [
        Item(Type.PACKET_COUNTER, (number % 2**16,)),
        Item(Type.SAMPLE_TIME_FINE, (number * 25 % 2**32,)),
        Item(Type.ACCELERATION | 2, (0.5, -1.25, 9.75)),
        Item(Type.RATE_OF_TURN | 3, (0.1, 0.2, 0.3)),
        Item(Type.UTC, (5, 2025, 1, 2, 3, 4, 5, 7)),
        Item(Type.STATUS_WORD, (3,)),
    ]
    return mtdata2.encode(Message(Mid.MTDATA2, mtdata2.encode_items(items)))


def vectornav_frame(number: int) -> bytes:
    fields = {
        "common.time_startup_ns": (number * 2_500_000,),
        "common.time_sync_in_ns": (10**6,),
        "common.angular_rate": (1.0, 2.0, 3.0),
        "common.acceleration": (4.0, 5.0, 6.0),
        "common.sync_in_count": (7,),
    }
    return vectornav.encode(vectornav.BinaryMessage((VECTORNAV_FIELDS, 0, 0), fields))


def right_sum(frame: bytes) -> bytes:
    """An Xbus frame with its length and checksum made right."""
    body = bytearray(frame[1:-1] if len(frame) > 6 else b"\xff\x36\x00")
    body[0], body[2] = 0xFF, min(len(body) - 3, 254)
    del body[3 + body[2] :]
    return b"\xfa" + bytes(body) + bytes([-sum(body) & 0xFF])


def right_crc(frame: bytes) -> bytes:
    body = frame[1:-2]
    return b"\xfa" + body + binascii.crc_hqx(body, 0).to_bytes(2, "big")


def stream(framing: Framing, decode: Callable[[bytes], object]) -> Parser:
    """One splitter for all inputs, as on a line that never gets better."""
    splitter = FrameSplitter(framing)

    def parse(data: bytes) -> str:
        frames = splitter.feed(data)
        if len(splitter._buffer) > framing.longest:
            raise AssertionError(f"{len(splitter._buffer)} bytes are held")
        for frame in frames:
            decode(frame)
        return f"{min(len(frames), 1)} frame"

    return parse


def refusing(parse: Callable[[bytes], object], *refusals: type[Exception]) -> Parser:
    def run(data: bytes) -> str:
        try:
            parse(data)
        except refusals as refusal:
            return type(refusal).__name__
        return "accepted"

    return run


def imu(settings: MtiSettings | VectorNavSettings) -> Parser:
    driver = SerialImu(settings, Ring(IMU_SAMPLE, 64))
    return lambda data: f"{driver.take(data, 0)} samples"


def board() -> Parser:
    driver = TriggerBoard(TriggerSettings(), Ring(TRIGGER_EVENT, 64))
    ids = [0x190, 0x290, 0x390, 0x490, 0x710, 0x090, 0x590, 0x610, 0x210, 0x000]

    def parse(data: bytes) -> str:
        frame_id = ids[data[0] % len(ids)] if data and data[0] < 250 else len(data)
        return type(driver.take(frame_id, data[1:9], len(data))).__name__

    return parse


def sdo_both(data: bytes) -> object:
    numbers = [
        int.from_bytes(data[a:b].ljust(b - a, b"\0"), "little") for a, b in ((0, 1), (1, 3), (3, 4), (4, 8))
    ]
    response = sdo.serve(SdoRequest(*numbers), lambda index, sub: (index, 1 + sub % 4), lambda *args: None)
    assert response.sdo_index == numbers[1]
    return sdo.value_of(SdoResponse(*numbers), signed=bool(numbers[0] & 1))


def line(data: bytes) -> object:
    return vectornav.line_text(b"$" + data)


def can_frame(number: int) -> bytes:
    return (
        bytes(1)
        + (number % 2**24).to_bytes(3, "little")
        + b"\1"
        + (number * 100_000 % 2**32).to_bytes(4, "little")
    )


def parsers() -> dict[str, tuple[Parser, Callable[[int], bytes], Callable[[bytes], bytes]]]:
    """Name: parser, the n-th true input, and what makes its check right again."""
    xbus, vn, can = xbus_sample, vectornav_frame, can_frame
    malformed = refusing(lambda data: mtdata2.decode_items(data[4:-1]), MalformedError)
    return {
        "xbus stream": (
            stream(mtdata2.XbusFraming(), refusing(mti_sample, MalformedError)),
            xbus,
            right_sum,
        ),
        "xbus message": (refusing(mtdata2.decode, MalformedError), xbus, right_sum),
        "mtdata2 items": (malformed, xbus, right_sum),
        "mti outputs": (refusing(decode_outputs), xbus, right_sum),
        "mti driver": (imu(MtiSettings("x")), xbus, right_sum),
        "vectornav stream": (
            stream(vectornav.VectorNavFraming(), refusing(vectornav_sample, MalformedError)),
            vn,
            right_crc,
        ),
        "vectornav message": (refusing(vectornav.decode, MalformedError), vn, right_crc),
        "vectornav line": (
            refusing(line, MalformedError),
            lambda number: vectornav.line(f"VNRRG,75,1,{number}"),
            bytes,
        ),
        "vectornav driver": (imu(VectorNavSettings("x")), vn, right_crc),
        "trigger board": (board(), can, bytes),
        "sdo": (
            refusing(sdo_both, sdo.SdoError),
            lambda number: bytes.fromhex("43002000") + number.to_bytes(4, "little"),
            bytes,
        ),
    }


def mutate(rng: random.Random, true: bytes, repair: Callable[[bytes], bytes]) -> bytes:
    if rng.random() < 0.5:
        return rng.randbytes(rng.randrange(64))
    data = bytearray(true)
    for _ in range(rng.randrange(4)):
        at = rng.randrange(len(data) + 1)
        match rng.randrange(4):
            case 0 if at < len(data):
                data[at] = rng.randrange(256)
            case 1:
                del data[at : at + rng.randrange(8)]
            case 2:
                data[at:at] = rng.randbytes(rng.randrange(8))
            case _:
                data[at:at] = data[: rng.randrange(len(data) + 1)]
    return repair(bytes(data)) if rng.random() < 0.5 else bytes(data)


def fuzz(name: str, inputs: int, seed: int) -> bool:
    parse, true, repair = parsers()[name]
    rng, outcomes, slowest = random.Random(seed), Counter[str](), 0.0
    start = time.process_time()
    for number in range(inputs):
        data = mutate(rng, true(number), repair)
        before = time.thread_time()
        try:
            outcomes[parse(data)] += 1
        except Exception as fault:
            print(f"{name}: input {number}, {data.hex()}: {type(fault).__name__}: {fault}")
            return False
        slowest = max(slowest, time.thread_time() - before)
    cpu = time.process_time() - start
    kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(outcomes.items()))
    print(f"{name:<18} {inputs} inputs, {cpu:.0f} s, slowest {slowest * 1e3:.1f} ms: {kinds}", flush=True)
    return slowest < SLOWEST_S


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--inputs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=list(parsers()))
    options = parser.parse_args()
    good = [
        fuzz(name, options.inputs, options.seed) for name in ([options.only] if options.only else parsers())
    ]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
