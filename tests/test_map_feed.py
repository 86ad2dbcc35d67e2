"""The mesh for viewers: what arrives, that nobody waits, and bytes that are no mesh."""

import os
import socket
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.service.map_feed import MapFeed, MapReader, from_bytes, to_bytes
from tests.fake_remote import delta


def test_a_delta_comes_back() -> None:
    sent = delta((1, -2, 3), np.random.default_rng(1).normal(size=(7, 3)), 4, index=9)
    back = from_bytes(to_bytes(sent))
    assert back.index == 9
    for name in ("block", "vertex_id", "position", "colour", "label", "triangles"):
        a, b = getattr(sent, name), getattr(back, name)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300))
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises((ValueError, KeyError, TypeError)):
        from_bytes(data)


def test_a_message_cut_off_is_refused() -> None:
    message = to_bytes(delta((0, 0, 0), np.zeros((5, 3))))
    for end in (0, 10, len(message) - 1):
        with pytest.raises((ValueError, KeyError)):
            from_bytes(message[:end])


def test_viewers_come_and_go_and_are_told_when_new(tmp_path: Path) -> None:
    feed = MapFeed(tmp_path / "map.sock", 0o600)
    assert (tmp_path / "map.sock").stat().st_mode & 0o777 == 0o600
    assert feed.turn() is False
    one, two = MapReader(feed.path), MapReader(feed.path)
    assert one.take() == [] and two.take() == []
    assert feed.turn() is True and len(feed) == 2
    feed.add(delta((0, 0, 0), np.zeros((4, 3)), index=5))
    assert feed.turn() is False
    assert [d.index for d in one.take()] == [5] and [d.index for d in two.take()] == [5]
    one.close()
    for _ in range(3):
        feed.add(delta((0, 0, 0), np.zeros((4, 3)), index=6))
        feed.turn()
    assert len(feed) == 1
    feed.close()
    two.take()
    assert two.take() == [], "the service has gone"
    again = MapFeed(tmp_path / "map.sock", 0o600)
    two.take()
    assert again.turn() is True, "it has connected again"
    again.close()
    two.close()


def test_a_viewer_that_does_not_read_costs_one_map(tmp_path: Path) -> None:
    feed = MapFeed(tmp_path / "map.sock", 0o600)
    reader = MapReader(feed.path)
    reader.take()
    feed.turn()
    for index in range(200):  # far more than a socket holds
        feed.add(delta((index % 5, 0, 0), np.full((3000, 3), float(index)), index=index))
        feed.turn()
    newest: dict[tuple[int, ...], float] = {}
    for _ in range(50):
        for found in reader.take():
            for k, block in enumerate(found.block.tolist()):
                newest[tuple(block)] = float(found.position[found.vertex_start[k], 0])
        feed.turn()
    assert newest == {(k, 0, 0): 195.0 + k for k in range(5)}
    feed.close()
    reader.close()


def test_strangers_are_let_go(tmp_path: Path) -> None:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(tmp_path / "map.sock"))
    listener.listen()
    reader = MapReader(tmp_path / "map.sock")
    reader.take()
    connection, _ = listener.accept()
    connection.sendall(b"\xff" * 100)
    assert reader.take() == []
    assert reader._socket is None
    connection.close()
    listener.close()


@pytest.mark.skipif(os.getuid() != 0, reason="becomes another user")
def test_only_its_owner_may_watch(tmp_path: Path) -> None:
    for folder in (tmp_path, *tmp_path.parents[:2]):
        folder.chmod(0o755)  # what keeps strangers out is to be the socket's mode
    feed = MapFeed(tmp_path / "map.sock", 0o660)
    pid = os.fork()
    if pid == 0:
        os.setgroups([])
        os.setgid(65534)
        os.setuid(65534)
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stranger:
                stranger.connect(str(feed.path))
        except PermissionError:
            os._exit(7)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7
    assert feed.turn() is False
    feed.close()
