"""The ring of messages: what is read is what was published, or it is said to be gone."""

from __future__ import annotations

import os
import threading
from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.service.outlet import Outlet
from artemis_edge.session.message_ring import MessageRing, OverwrittenError, RingReader

ROOM_MB = 0.066  # the smallest ring


def test_messages_come_back_as_they_were() -> None:
    ring = MessageRing.create(1)
    for k in range(50):
        assert ring.publish(f"/topic{k % 3}", "a/msg/B", k, k - 7, bytes([k]) * k) == k
    reader = RingReader(ring)
    for k in range(50):
        sent = reader.read()
        assert sent is not None
        assert (sent.number, sent.topic, sent.ros_type) == (k, f"/topic{k % 3}", "a/msg/B")
        assert (sent.log_ns, sent.stamp_ns, sent.data) == (k, k - 7, bytes([k]) * k)
    assert reader.read() is None and reader.lost == 0 and reader.fill() == 0.0


def test_a_second_view_of_the_memory_sees_the_same() -> None:
    ring = MessageRing.create(ROOM_MB)
    ring.publish("/a", "t", 1, 2, b"hello")
    other = MessageRing(os.dup(ring.descriptor))
    assert other.read(0) == ring.read(0)
    ring.publish("/b", "t", 3, 4, b"world")
    sent = other.read(1)
    assert sent is not None and sent.data == b"world"


def test_a_slow_reader_is_told_what_it_missed() -> None:
    ring = MessageRing.create(ROOM_MB)
    reader = RingReader(ring)
    for k in range(100):
        ring.publish("/a", "t", k, k, bytes(5000))
    assert 0 < ring.oldest < 100
    with pytest.raises(OverwrittenError) as gone:
        ring.read(0)
    assert gone.value.oldest == ring.oldest
    assert reader.fill() == 1.0
    sent = reader.read()
    assert sent is not None and sent.number == reader.lost == ring.oldest


def test_a_message_that_can_never_fit_is_refused() -> None:
    ring = MessageRing.create(ROOM_MB)
    with pytest.raises(ValueError, match="too large"):
        ring.publish("/a", "t", 0, 0, bytes(60_000))
    assert ring.published == 0


@given(st.lists(st.tuples(st.integers(0, 30_000), st.booleans()), max_size=60))
@settings(deadline=None, max_examples=60)
def test_it_behaves_as_a_list_that_forgets(steps: list[tuple[int, bool]]) -> None:
    """Against the obvious twin: a deque of everything; the reader sees each message once or counts it lost."""
    ring = MessageRing.create(ROOM_MB)
    reader, everything = RingReader(ring), deque[bytes]()
    seen: list[int] = []
    for size, read in steps:
        data = size.to_bytes(4, "little") * (size // 4)
        ring.publish("/a", "t", 0, 0, data)
        everything.append(data)
        while read and (sent := reader.read()) is not None:
            assert sent.data == everything[sent.number]
            seen.append(sent.number)
    assert seen == sorted(set(seen))
    assert len(seen) + reader.lost == reader.next
    kept = range(ring.oldest, ring.published)
    assert all(ring.read(k).data == everything[k] for k in kept)  # type: ignore[union-attr]
    assert sum(len(everything[k]) for k in kept) <= ROOM_MB * 1e6


def test_a_reader_never_takes_half_a_message() -> None:
    """A publisher in another thread that overwrites all the time."""
    ring = MessageRing.create(ROOM_MB)
    ended = threading.Event()

    def publish() -> None:
        for k in range(3000):
            ring.publish("/a", "t", k, k, bytes([k % 251]) * (500 + k % 700))
        ended.set()

    thread = threading.Thread(target=publish)
    thread.start()
    reader, taken = RingReader(ring), 0
    while not ended.is_set() or reader.waiting():
        sent = reader.read()
        if sent is not None:
            k = sent.number
            assert sent.log_ns == k and sent.data == bytes([k % 251]) * (500 + k % 700)
            taken += 1
    thread.join()
    assert taken + reader.lost == 3000 and taken > 0


def test_what_can_never_fit_is_counted_and_told() -> None:
    outlet = Outlet(MessageRing.create(ROOM_MB))
    outlet.is_open = True
    outlet.send_encoded("/a", "t", bytes(1_000_000), 0)
    outlet.send_encoded("/a", "t", b"small", 0)
    assert outlet.lost == {"messages_too_large": 1} and outlet.sent == {"/a": 1}
