"""The feed to a viewer, the growing mesh it makes, the gate and the colours; the browser itself: tests/viewer."""

import socket
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from artemis_edge.errors import InputError
from artemis_edge.export.mesh import bare_mesh
from artemis_edge.frames import MeshDelta
from artemis_edge.view import feed as feeds
from artemis_edge.view.feed import LiveFeed, Patch, Update, decode, encode, patches, receive
from artemis_edge.view.gate import Gate, answer
from artemis_edge.view.kinds import KINDS, coloured
from artemis_edge.view.live_mesh import LiveMesh, region_of
from tests.textured import square_room


def delta_of(blocks: dict[tuple[int, int, int], Patch], index: int = 0) -> MeshDelta:
    """A delta that holds these blocks."""
    parts = list(blocks.values())

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    return MeshDelta(
        index,
        np.array(list(blocks), np.int32),
        np.cumsum([0, *(len(part.vertex_id) for part in parts)]),
        np.cumsum([0, *(len(part.triangles) for part in parts)]),
        joined("vertex_id"), joined("position"), joined("position"), joined("colour"), joined("label"),
        joined("confidence"), joined("triangles"),
    )  # fmt: skip


def patch(ids: list[int], triangles: list[list[int]], seed: int = 0) -> Patch:
    rng = np.random.default_rng([seed, *ids])
    n = len(ids)
    return Patch(
        np.array(ids, np.int64),
        rng.normal(size=(n, 3)).astype(np.float32),
        rng.integers(0, 255, (n, 3), dtype=np.uint8),
        rng.integers(0, 5, n, dtype=np.uint8),
        rng.random(n, dtype=np.float32),
        np.array(triangles, np.int64).reshape(-1, 3),
    )


def assert_same(a: Patch, b: Patch) -> None:
    for name in ("vertex_id", "position", "colour", "label", "confidence", "triangles"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert getattr(a, name).dtype == getattr(b, name).dtype


BLOCKS = {
    (0, 0, 0): patch([5, 7, 9], [[5, 7, 9], [7, 9, 20]]),  # 20 lives next door
    (1, 0, 0): patch([20, 21, 22], [[20, 21, 22]]),
    (-9, 3, 2): patch([], []),
}


def test_updates_survive_the_wire() -> None:
    path = np.arange(6, dtype=np.float32).reshape(2, 3)
    message = encode(Update(path, BLOCKS))
    size = feeds._HEADER.size
    back = decode(message[:size], message[size:])
    np.testing.assert_array_equal(back.path, path)
    assert list(back.blocks) == list(BLOCKS)
    for key, part in BLOCKS.items():
        assert_same(back.blocks[key], part)
    empty = encode(Update(path[:0], {}))
    assert decode(empty[:size], empty[size:]).blocks == {}


def test_a_delta_is_taken_apart_into_its_blocks() -> None:
    found = dict(patches(delta_of(BLOCKS)))
    assert set(found) == set(BLOCKS)
    for key, part in BLOCKS.items():
        assert_same(found[key], part)


class Viewer:
    """Receives in a thread what a feed sends."""

    def __init__(self, path: Path) -> None:
        self.updates: list[Update] = []
        self.thread = threading.Thread(target=self._run, args=(path,), daemon=True)
        self.thread.start()

    def _run(self, path: Path) -> None:
        for update in receive(path):
            self.updates.append(update)


def until(done: object, what: str) -> None:
    end = time.monotonic() + 20
    while not done():  # type: ignore[operator]
        assert time.monotonic() < end, what
        time.sleep(0.01)


@pytest.fixture
def feed(tmp_path: Path) -> object:
    made = LiveFeed(tmp_path / "deep" / "view.sock", most_hz=50.0)
    yield made
    made.close()


def test_a_viewer_sees_the_newest_state_of_every_block(feed: LiveFeed) -> None:
    feed.publish(delta_of(BLOCKS))
    assert feed.waiting == 0 and not feed.attached  # nobody looks: nothing is kept
    viewer = Viewer(feed.path)
    nothing = delta_of({(0, 0, 0): BLOCKS[0, 0, 0]})
    until(lambda: (feed.publish(nothing), feed.attached)[1], "the viewer attaches")
    for index in range(30):
        newest = {(0, 0, 0): patch([5, 7, 9], [[5, 7, 9]], seed=index), (1, 0, 0): BLOCKS[1, 0, 0]}
        pose = np.eye(4)
        pose[0, 3] = index
        feed.publish(delta_of(newest, index), pose)
    until(lambda: (feed.pump(), feed.waiting == 0)[1], "everything is sent")
    feed.close()
    viewer.thread.join(20)
    seen: dict[tuple[int, int, int], Patch] = {}
    for update in viewer.updates:
        seen |= update.blocks
    assert_same(seen[0, 0, 0], newest[0, 0, 0])
    assert_same(seen[1, 0, 0], BLOCKS[1, 0, 0])
    path = np.concatenate([update.path for update in viewer.updates])
    np.testing.assert_array_equal(path[:, 0], np.arange(30))
    assert len(viewer.updates) < 30  # rate-capped


def test_a_viewer_that_does_not_read_neither_blocks_nor_fills_memory(
    feed: LiveFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feeds, "_MOST_PENDING", 3 << 20)
    monkeypatch.setattr(feeds, "_SEND_BUFFER", 1 << 14)
    with socket.socket(socket.AF_UNIX) as asleep:
        asleep.connect(str(feed.path))
        for index in range(100):
            many = patch(list(range(index * 5000, index * 5000 + 5000)), [])
            feed.publish(delta_of({(index, 0, 0): many}))
            if feed.let_go:
                break
        assert feed.let_go == 1 and feed.waiting == 0
    feed.publish(delta_of(BLOCKS))


def test_a_new_viewer_takes_the_place_of_the_old(feed: LiveFeed) -> None:
    first = Viewer(feed.path)
    until(lambda: (feed.publish(delta_of(BLOCKS)), feed.attached)[1], "the first")
    feed.attached = False
    second = Viewer(feed.path)
    until(lambda: (feed.publish(delta_of(BLOCKS)), feed.attached)[1], "the second")
    first.thread.join(20)
    assert not first.thread.is_alive()
    until(lambda: (feed.publish(delta_of(BLOCKS)), second.updates)[1], "an update")


def test_sockets_that_are_none_are_told(tmp_path: Path, feed: LiveFeed) -> None:
    with pytest.raises(InputError, match="no map is growing"):
        next(receive(tmp_path / "none"))
    with pytest.raises(InputError, match="choose another"):
        LiveFeed(feed.path)  # another run has it
    (tmp_path / "left").touch()
    with pytest.raises(InputError, match="choose another"):
        LiveFeed(tmp_path / "left")
    stale = socket.socket(socket.AF_UNIX)
    stale.bind(str(tmp_path / "stale"))
    stale.close()
    LiveFeed(tmp_path / "stale").close()


def test_regions_join_blocks_by_the_names_of_vertices() -> None:
    mesh = LiveMesh()
    mesh.apply(Update(np.zeros((1, 3), np.float32), {(0, 0, 0): BLOCKS[0, 0, 0]}))
    assert mesh.take_dirty(9) == [(0, 0, 0)]
    assert len(mesh.region_mesh((0, 0, 0)).faces) == 1  # the neighbour's vertex is not known yet
    mesh.apply(
        Update(np.zeros((1, 3), np.float32), {(1, 0, 0): BLOCKS[1, 0, 0], (8, 0, 0): BLOCKS[-9, 3, 2]})
    )
    assert mesh.take_dirty(1) == [(0, 0, 0)] and mesh.take_dirty(9) == [(2, 0, 0)]
    joined = mesh.region_mesh((0, 0, 0))
    corners = {tuple(sorted(map(tuple, joined.vertices[face].tolist()))) for face in joined.faces}
    places = {}
    for part in BLOCKS.values():
        places |= dict(zip(part.vertex_id.tolist(), part.position.tolist(), strict=True))
    expected = {
        tuple(sorted(tuple(places[v]) for v in triangle))
        for part in BLOCKS.values()
        for triangle in part.triangles.tolist()
    }
    assert corners == expected and len(joined.vertices) == 6
    assert len(mesh.region_mesh((2, 0, 0)).faces) == 0 and len(mesh.region_mesh((5, 5, 5)).faces) == 0
    assert region_of((-1, 4, 3)) == (-1, 1, 0)
    mesh.apply(Update(np.empty((0, 3), np.float32), {(1, 0, 0): patch([], [])}))  # and it may vanish again
    assert len(mesh.region_mesh((0, 0, 0)).faces) == 1


def test_colours_of_every_kind() -> None:
    mesh, atlas = square_room()
    mesh.labels[:4] = 1
    mesh.confidence[:4] = 0.0
    assert coloured(mesh, "texture") is mesh
    for kind in KINDS[1:]:
        other = coloured(mesh, kind, atlas)
        assert other.colours.dtype == np.uint8 and (other.vertices == mesh.vertices).all()
    assert (coloured(mesh, "label").colours[0] != coloured(mesh, "label").colours[5]).any()
    green, orange = (coloured(mesh, "coverage", atlas).colours[k].astype(int) for k in (0, 17))
    assert green[1] > green[0] and orange[0] > orange[1]
    grey = bare_mesh(mesh.vertices, mesh.faces)
    assert (np.ptp(coloured(grey, "coverage").colours, axis=1) > 100).all()


@pytest.mark.parametrize(
    ("head", "status"),
    [
        ("GET / HTTP/1.1\r\n\r\n", "403"),
        ("GET /?token=wrong HTTP/1.1\r\n\r\n", "403"),
        ("GET /?token=secret HTTP/1.1\r\n\r\n", "302"),
        ("GET / HTTP/1.1\r\nCookie: artemis_view=wrong\r\n\r\n", "403"),
        ("GET / HTTP/1.1\r\ncookie: a=b; artemis_view=secret\r\n\r\n", None),
        ("GET / HTTP/1.1\r\nCookie: artemis_view=\r\n\r\n", "403"),
        ("GET / HTTP/1.1\r\nCookie: ;;=\xff\r\n\r\n", "403"),
        ("hello\r\n\r\n", "400"),
    ],
)
def test_the_gate_asks_for_the_token(head: str, status: str | None) -> None:
    told = answer(head.encode("latin-1"), "secret")
    assert (None if told is None else told.decode().split()[1]) == status


def test_the_gate_passes_on_whoever_knows_the_token(tmp_path: Path) -> None:
    from tests.viewer.browser import serving

    (tmp_path / "index.html").write_text("inside")
    with serving(tmp_path) as inner:
        gate = Gate("127.0.0.1", 0, int(inner.rpartition(":")[2]))
        try:
            outside = f"http://127.0.0.1:{gate.port}/"
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(outside, timeout=20)
            cookies = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
            with cookies.open(f"{outside}?token={gate.token}", timeout=20) as page:
                assert page.read() == b"inside"
            with cookies.open(outside, timeout=20) as page:
                assert page.read() == b"inside"
        finally:
            gate.close()
