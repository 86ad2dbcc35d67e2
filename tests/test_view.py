"""The feed to a viewer, the growing mesh it makes, the gate and the colours; the browser itself: tests/viewer."""

import os
import socket
import time
import urllib.error
import urllib.request
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from artemis_edge.config import ViewConfig
from artemis_edge.errors import InputError
from artemis_edge.export.mesh import bare_mesh
from artemis_edge.frames import MeshDelta
from artemis_edge.service.map_feed import MapReader
from artemis_edge.status import QueryStatus
from artemis_edge.telling import telling
from artemis_edge.view import browser
from artemis_edge.view.gate import Gate, answer
from artemis_edge.view.kinds import KINDS, coloured
from artemis_edge.view.live import lighted, map_socket, sentence
from artemis_edge.view.live_mesh import LiveMesh, Patch, patches, region_of
from tests.listening import listening
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
        joined("confidence"), joined("triangles"), joined("probability"),
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
        rng.integers(0, 255, n, dtype=np.uint8),
    )


def assert_same(a: Patch, b: Patch) -> None:
    for name in ("vertex_id", "position", "colour", "label", "confidence", "triangles", "probability"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert getattr(a, name).dtype == getattr(b, name).dtype


BLOCKS = {
    (0, 0, 0): patch([5, 7, 9], [[5, 7, 9], [7, 9, 20]]),  # 20 lives next door
    (1, 0, 0): patch([20, 21, 22], [[20, 21, 22]]),
    (-9, 3, 2): patch([], []),
}


def test_a_delta_is_taken_apart_into_its_blocks() -> None:
    found = dict(patches(delta_of(BLOCKS)))
    assert set(found) == set(BLOCKS)
    for key, part in BLOCKS.items():
        assert_same(found[key], part)


def test_a_run_tells_viewers_and_never_waits_for_them(tmp_path: Path) -> None:
    class Mapped:
        told_everything = 0

        def tell_everything(self) -> None:
            self.told_everything += 1

    mapper, path = Mapped(), tmp_path / "deep" / "view.sock"
    with telling(ViewConfig(socket=str(path))) as live:
        publish = live.watching(mapper)  # type: ignore[arg-type]
        publish(delta_of(BLOCKS))
        assert mapper.told_everything == 0 and path.stat().st_mode & 0o777 == 0o600
        reader, seen = MapReader(path), {}
        asleep = socket.socket(socket.AF_UNIX)
        asleep.connect(str(path))
        reader.take()
        big = patch(list(range(200_000)), [])  # more than a socket takes at once
        start = time.monotonic()
        for index in range(20):
            newest = {(0, 0, 0): patch([5, 7, 9], [[5, 7, 9]], seed=index), (9, 9, 9): big}
            publish(delta_of(newest, index))
        assert time.monotonic() - start < 5.0 and mapper.told_everything == 1
        asleep.close()
        end = time.monotonic() + 20.0
        while (0, 0, 0) not in seen or not (seen[0, 0, 0].position == newest[0, 0, 0].position).all():
            assert time.monotonic() < end
            publish(delta_of({(1, 0, 0): BLOCKS[1, 0, 0]}))
            for delta in reader.take():
                seen |= dict(patches(delta))
        reader.close()
    assert not path.exists()
    assert_same(seen[0, 0, 0], newest[0, 0, 0])


def test_sockets_that_are_none_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no map is growing"):
        map_socket(tmp_path / "none")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="no socket"), telling(ViewConfig(socket=str(tmp_path / "file"))):
        pass
    with (
        pytest.raises(InputError, match="cannot make"),
        telling(ViewConfig(socket=f"{tmp_path}/{'x' * 200}")),
    ):
        pass
    with telling(ViewConfig()) as live:
        live.watching(None)(delta_of(BLOCKS))  # type: ignore[arg-type]


@pytest.mark.parametrize(("host", "wide"), [("127.0.0.1", False), ("localhost", False), ("127.0.0.2", True)])
def test_the_server_itself_is_never_open_to_others(
    host: str, wide: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other machines reach a gate that asks for a token; what is behind it listens on this one."""
    viser = MagicMock()
    viser.ViserServer.return_value.get_port.return_value = 9
    monkeypatch.setattr(browser, "_viser", lambda: viser)
    shown = browser.Browser(host, 0, lambda kind: None)
    try:
        assert viser.ViserServer.call_args.kwargs["host"] == "127.0.0.1"
        assert (
            (f"http://{host}:" in shown.url and "token=" in shown.url) if wide else "token" not in shown.url
        )
        mine = listening(os.getpid())
        assert sum(address.startswith("0200007F") for address in mine) == wide
        assert not any(address.startswith("00000000:") for address in mine)
    finally:
        shown.close()


def test_regions_join_blocks_by_the_names_of_vertices() -> None:
    mesh = LiveMesh()
    mesh.apply(delta_of({(0, 0, 0): BLOCKS[0, 0, 0]}))
    assert mesh.take_dirty(9) == [(0, 0, 0)]
    assert len(mesh.region_mesh((0, 0, 0)).faces) == 1  # the neighbour's vertex is not known yet
    mesh.apply(delta_of({(1, 0, 0): BLOCKS[1, 0, 0], (8, 0, 0): BLOCKS[-9, 3, 2]}))
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
    mesh.apply(delta_of({(1, 0, 0): patch([], [])}))  # and it may vanish again
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


def test_what_is_asked_for_lights_up() -> None:
    mesh = bare_mesh(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32),
        np.array([[0, 1, 2]]),
        labels=np.array([0, 3, 3], np.uint8),
    )
    asked = QueryStatus("car", "matched", 2, 0.9, (0, 200, 0), labels=[3])
    colours = lighted(mesh, [asked]).colours
    assert (colours[0] == mesh.colours[0]).all() and (colours[1, 1] > 150 > colours[1, 0]).all()
    assert sentence(asked) == "car: 2 found, best 0.90"
    assert sentence(QueryStatus("dog", "unsupported", note="no model")) == "dog: unsupported (no model)"


def test_where_an_answer_changes_is_drawn_again() -> None:
    live = LiveMesh()
    live.apply(delta_of({(0, 0, 0): patch([5, 7], []), (9, 0, 0): patch([50], [])}))
    live.take_dirty(10)
    live.redraw([])
    assert live.take_dirty(10) == []
    live.redraw([int(live.blocks[9, 0, 0].label[0])])
    assert (2, 0, 0) in live.take_dirty(10)
