"""Many datagrams with one call, against one call for each."""

import socket
import time

import numpy as np
import pytest
from artemis_drivers.datagrams import Datagrams
from artemis_drivers.ring import Ring, RingReader
from artemis_drivers.udp import PACKET, PACKET_BYTES, PacketReceiver, open_udp


@pytest.fixture
def pair() -> tuple[socket.socket, socket.socket]:
    """A receiving socket and one that is connected to it."""
    there = open_udp(0, "127.0.0.1", receive_buffer=1 << 20)
    here = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    here.connect(there.getsockname())
    return there, here


def naive(sock: socket.socket, most: int) -> list[bytes]:
    """One after the other."""
    found = []
    for _ in range(most):
        try:
            found.append(sock.recv(PACKET_BYTES))
        except BlockingIOError:
            break
    return found


def test_it_receives_what_single_calls_receive(pair: tuple[socket.socket, socket.socket]) -> None:
    there, here = pair
    sent = [bytes([k]) * size for k, size in enumerate([1, 1362, 0, 700, 1500, 3, 64])]
    rows = np.zeros((5, PACKET_BYTES), np.uint8)
    datagrams = Datagrams(rows, 4)
    with there, here:
        assert datagrams.receive(there, 0, 4) == 0, "nothing waits"
        for data in sent:
            here.send(data)
        assert naive(there, 1) == sent[:1]
        before = time.time_ns()
        assert datagrams.receive(there, 3, 4) == 4
        assert datagrams.sizes(4).tolist() == [len(data) for data in sent[1:5]]
        for row, data in zip((3, 4, 0, 1), sent[1:5], strict=True):  # they go on with the first row
            assert rows[row, : len(data)].tobytes() == data
        assert (datagrams.senders(4) == [127, 0, 0, 1]).all() and not datagrams.truncated(4).any()
        assert (np.abs(datagrams.stamps_ns(4) - before) < 10**9).all() and datagrams.drops(4) == 0
        assert datagrams.receive(there, 0, 2) == 2, "no more than asked for"


def test_what_is_too_long_or_from_elsewhere_is_counted_and_left_out(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    there, here = pair
    ring = Ring(PACKET, 8)
    reader, receiver = RingReader(ring), PacketReceiver(there, ring)
    with there, here, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.2", 0))
        receiver.sender = "127.0.0.1"
        for turn in range(5):  # once around the ring
            here.send(b"one")
            stranger.sendto(b"other", there.getsockname())
            here.send(b"long" * 400)
            here.send(b"two" * turn)
            assert receiver.drain(8) == 2
        _, rows = reader.read()
    assert (receiver.truncated, receiver.foreign, receiver.kernel_drops, receiver.clock_set) == (5, 5, 0, 0)
    sizes, data = rows["size"].tolist(), rows["data"]
    assert sizes == [3, 0, 3, 3, 3, 6, 3, 9, 3, 12][-len(sizes) :] and len(sizes) >= 6
    assert data[-1, :12].tobytes() == b"twotwotwotwo" and data[-2, :3].tobytes() == b"one"
    assert (np.diff(rows["rx_ns"]) >= 0).all() and rows["rx_ns"][-1] <= time.monotonic_ns()


def test_rows_must_lie_together() -> None:
    with pytest.raises(ValueError, match="contiguous"):
        Datagrams(np.zeros((4, 20), np.uint8)[:, ::2], 4)


def test_a_closed_socket_is_an_error(pair: tuple[socket.socket, socket.socket]) -> None:
    there, here = pair
    here.close()
    there.close()
    with pytest.raises(OSError, match="descriptor"):
        Datagrams(np.zeros((4, 20), np.uint8), 4).receive(there, 0, 4)
