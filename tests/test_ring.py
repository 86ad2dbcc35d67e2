"""Ring of fixed slots against a list that remembers everything."""

import threading
from multiprocessing import shared_memory

import numpy as np
import pytest
from artemis_drivers.ring import Ring, RingReader
from hypothesis import given, settings
from hypothesis import strategies as st

SLOT = np.dtype([("number", "i8"), ("xyz", "f4", (3, 2)), ("tag", "u1")])


def _put(ring: Ring, count: int) -> None:
    first = ring.claim(count)
    for n in range(first, first + count):
        ring.field["number"][n % ring.slots] = n
        ring.field["xyz"][n % ring.slots] = n
        ring.field["tag"][n % ring.slots] = n % 251
    ring.publish(count)


@given(st.integers(1, 9), st.lists(st.tuples(st.integers(0, 9), st.none() | st.integers(0, 7)), max_size=20))
@settings(max_examples=200, deadline=None)
def test_reader_sees_each_slot_once_or_counts_it(slots: int, steps: list[tuple[int, int | None]]) -> None:
    ring = Ring(SLOT, slots)
    reader = RingReader(ring)
    seen: list[int] = []
    written = 0
    for put, limit in steps:
        _put(ring, min(put, slots))
        written += min(put, slots)
        first, got = reader.read(limit)
        numbers = got["number"].tolist()
        assert numbers == list(range(first, first + len(numbers)))
        assert (got["xyz"] == got["number"][:, None, None]).all() and (
            got["tag"] == got["number"] % 251
        ).all()
        assert limit is None or len(numbers) <= limit
        seen += numbers
    assert seen == sorted(set(seen))
    assert len(seen) + reader.lost + min(reader.waiting(), written) == written
    assert reader.waiting() == written - reader.next


def test_two_readers_and_one_that_comes_late() -> None:
    ring = Ring(SLOT, 4)
    early = RingReader(ring)
    _put(ring, 3)
    late, old = RingReader(ring), RingReader(ring, from_oldest=True)
    _put(ring, 2)
    assert early.read()[1]["number"].tolist() == [1, 2, 3, 4] and early.lost == 1
    assert late.read()[1]["number"].tolist() == [3, 4] and late.lost == 0
    assert old.read()[1]["number"].tolist() == [1, 2, 3, 4] and old.lost == 1
    assert early.read()[1]["number"].tolist() == []


def test_slots_claimed_while_reading_are_discarded() -> None:
    ring = Ring(SLOT, 4)
    reader = RingReader(ring)
    _put(ring, 4)
    ring.claim(2)  # the producer is overwriting slots 0 and 1 just now
    first, got = reader.read()
    assert (first, got["number"].tolist(), reader.lost) == (2, [2, 3], 2)


def test_lapsed_claims_cost_no_slot_but_touched_ones_do() -> None:
    for touched, expected in ((0, [1, 2, 3, 4]), (2, [2, 3, 4]), (9, [3, 4])):
        ring = Ring(SLOT, 4)
        _put(ring, 4)
        ring.claim(3)
        ring.field["number"][0] = 4
        ring.publish(1, touched=touched)
        reader = RingReader(ring, from_oldest=True)
        assert reader.read()[1]["number"].tolist() == expected and reader.lost == 0
        assert ring.claim(0) == 5 and RingReader(ring, from_oldest=True).next == expected[0]


def test_unused_claims_are_given_back() -> None:
    ring = Ring(SLOT, 4)
    assert ring.claim(3) == 0
    ring.publish(1)
    assert ring.published == 1 and ring.claim(4) == 1
    with pytest.raises(ValueError, match="not claimed"):
        ring.publish(5)
    with pytest.raises(ValueError, match="cannot claim"):
        ring.claim(5)


def test_append_and_shared_memory() -> None:
    memory = shared_memory.SharedMemory(create=True, size=Ring.nbytes(SLOT, 5))
    try:
        writer, other = Ring(SLOT, 5, memory.buf), Ring(SLOT, 5, memory.buf)
        reader = RingReader(other)
        writer.append({"number": 7, "xyz": np.ones((3, 2)), "tag": 9})
        got = reader.read()[1]
        assert got["number"].tolist() == [7] and got["xyz"].sum() == 6 and got["tag"].tolist() == [9]
        del writer, other, reader, got
    finally:
        memory.close()
        memory.unlink()


def test_too_small_a_buffer_is_refused() -> None:
    with pytest.raises(ValueError, match="bytes"):
        Ring(SLOT, 5, memoryview(bytearray(100)))
    with pytest.raises(ValueError, match="slot"):
        Ring(SLOT, 0)


def test_concurrent_producer_never_tears_a_slot() -> None:
    ring = Ring(SLOT, 64)
    reader = RingReader(ring)
    total = 20_000

    def produce() -> None:
        for start in range(0, total, 10):
            first = ring.claim(10)
            rows = np.arange(first, first + 10) % ring.slots
            ring.field["number"][rows] = np.arange(start, start + 10)
            ring.field["xyz"][rows] = np.arange(start, start + 10)[:, None, None]
            ring.publish(10)

    thread = threading.Thread(target=produce)
    thread.start()
    seen = 0
    while thread.is_alive() or reader.waiting():
        first, got = reader.read()
        n = len(got["number"])
        assert got["number"].tolist() == list(range(first, first + n))
        assert (got["xyz"] == got["number"][:, None, None]).all()
        seen += n
    thread.join()
    assert seen + reader.lost == total


@given(st.integers(1, 6), st.lists(st.integers(0, 15), max_size=8))
@settings(max_examples=100, deadline=None)
def test_extending_is_appending_many_times(slots: int, counts: list[int]) -> None:
    many, one = Ring(SLOT, slots), Ring(SLOT, slots)
    number = 0
    for count in counts:
        rows = [(number + k, np.full((3, 2), number + k), (number + k) % 251) for k in range(count)]
        many.extend(rows)
        for row in rows:
            one.append(dict(zip(SLOT.names or (), row, strict=True)))
        number += count
    assert many.published == one.published == number and many.oldest() == one.oldest()
    for name in SLOT.names or ():
        np.testing.assert_array_equal(many.field[name], one.field[name])
