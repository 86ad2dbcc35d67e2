"""Maps in the coordinates of a country: control points, their fit, what is refused, and exports read back."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from artemis_edge import topics
from artemis_edge.cli import main
from artemis_edge.errors import InputError
from artemis_edge.export.ply import bare_mesh, read_mesh, write_ply
from artemis_edge.frames import F64, Trajectory
from artemis_edge.geo.control_points import mark_stamps, places, read_control_points
from artemis_edge.geo.fit import fit, rigid
from artemis_edge.geo.grid import Grid
from artemis_edge.geo.place import Placed, georeference, read_georeference
from artemis_edge.kept_points import PointSpool
from artemis_edge.session.messages import Text
from artemis_edge.session.writer import SessionWriter
from artemis_edge.trajectory import matrix_from_quaternion, write_tum

pytest.importorskip("pyproj")

EPSG = 25832
ORIGIN = np.array([691_607.9, 5_334_760.4, 515.2])  # in UTM zone 32
WORLD = np.array([[0.0, 0, 0], [40, 3, 0.5], [35, 30, 1.0], [-4, 25, 0.2], [12, 14, 6.0]])
YAW = np.radians(37.0)


def _truth() -> F64:
    """T_enu_world at ORIGIN: turned, levelled but for half a degree."""
    turn = np.array([0.003, -0.004, np.sin(YAW / 2), np.cos(YAW / 2)])
    return matrix_from_quaternion(np.zeros(3), turn / np.linalg.norm(turn))


def _surveyed(world: F64) -> F64:
    """East, north, up of places of the map, by a way of their own: the ellipsoid's normal at ORIGIN."""
    import pyproj

    to_globe = pyproj.Transformer.from_crs(EPSG, 4258, always_xy=True)
    lon, lat = np.radians(to_globe.transform(ORIGIN[0], ORIGIN[1]))
    a, f = 6378137.0, 1 / 298.257222101
    e2 = f * (2 - f)
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    centre = np.array([*((n + ORIGIN[2]) * up[:2]), (n * (1 - e2) + ORIGIN[2]) * up[2]])
    ecef = (world @ _truth()[:3, :3].T) @ np.array([east, np.cross(up, east), up]) + centre
    geocentric = pyproj.Transformer.from_crs("EPSG:4936", pyproj.CRS.from_epsg(EPSG).to_3d(), always_xy=True)
    return np.stack(geocentric.transform(*ecef.T), axis=1)


def _csv(path: Path, given: F64, world: F64 = WORLD, names: Sequence[str] = "ABCDE") -> Path:
    rows = [
        f"{name}; {g[0]:.4f}; {g[1]:.4f}; {g[2]:.4f}; {w[0]}; {w[1]}; {w[2]}"
        for name, g, w in zip(names, given, world, strict=False)
    ]
    path.write_text(
        "\n".join(["\ufeffPoint; Easting; Northing; Height; X; Y; Z", "# surveyed", *rows]) + "\n"
    )
    return path


@pytest.fixture
def a_map(tmp_path: Path) -> Path:
    """A map of two triangles with points, poses and a report."""
    out = tmp_path / "out"
    (out / "map").mkdir(parents=True)
    mesh = bare_mesh(WORLD.astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    write_ply(out / "mesh.ply", mesh)
    spool = PointSpool(tmp_path / "spool", 100)
    spool.add(WORLD.astype(np.float32), 10**9, np.zeros(5, np.float32), None)
    spool.save(out / "map")
    write_tum(out / "trajectory.tum", Trajectory(np.array([10**9]), np.eye(4)[None]))
    (out / "report.json").write_text('{"frames": 1}')
    (out / "report.html").write_text("<html><body><p>a</p></body></html>")
    return out


def test_a_map_is_placed_to_the_millimetre(a_map: Path, tmp_path: Path) -> None:
    given = _surveyed(WORLD)
    made = georeference(a_map, _csv(tmp_path / "gcp.csv", given), EPSG, 0.01)
    assert made.rms_m < 2e-4 and made.left_out_rms_m is not None and made.left_out_rms_m < 1e-3
    far = np.array([[800.0, -300.0, 20.0]])
    placed = Placed.of(made)
    np.testing.assert_allclose(placed.to_crs(WORLD), given, atol=1e-3)
    np.testing.assert_allclose(placed.to_crs(far), _surveyed(far), atol=0.01)
    assert abs(np.linalg.norm(placed.to_crs(far) - placed.to_crs(WORLD[:1])) - np.linalg.norm(far)) > 0.02, (
        "the grid's scale is in it"
    )
    assert read_georeference(a_map / "map") == made
    assert made.tilt_deg == pytest.approx(np.degrees(2 * 0.005), abs=0.02)


def test_longitude_and_latitude_are_taken_too(a_map: Path, tmp_path: Path) -> None:
    import pyproj

    given = _surveyed(WORLD)
    to_globe = pyproj.Transformer.from_crs(EPSG, 4326, always_xy=True)
    lon, lat = to_globe.transform(given[:, 0], given[:, 1])
    rows = [f"{o},{a},{g[2]},{w[0]},{w[1]},{w[2]}" for o, a, g, w in zip(lon, lat, given, WORLD, strict=True)]
    (tmp_path / "g.csv").write_text("\n".join(["lon,lat,height,x,y,z", *rows]))
    made = georeference(a_map, tmp_path / "g.csv", EPSG, 0.05)
    np.testing.assert_allclose(Placed.of(made).to_crs(WORLD), given, atol=0.01)


def test_the_command_writes_report_and_exports(
    a_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    laspy = pytest.importorskip("laspy")
    given = _surveyed(WORLD)
    words = [
        "georeference",
        str(a_map),
        "--points",
        str(_csv(tmp_path / "g.csv", given)),
        "--epsg",
        str(EPSG),
    ]
    for _ in range(2):
        assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    report = json.loads((a_map / "report.json").read_text())
    assert report["frames"] == 1 and report["georeference"] == told and told["epsg"] == EPSG
    page = (a_map / "report.html").read_text()
    ElementTree.fromstring(page)
    assert page.count("Control points") == 1 and "<p>a</p>" in page and "691" in page

    out = tmp_path / "exported"
    out.mkdir()
    for name in ("ply", "glb", "obj", "laz"):
        assert main(["export", str(a_map), "--format", name, "--out", str(out / f"m.{name}")]) == 0
    las = laspy.read(out / "m.laz")
    np.testing.assert_allclose(las.xyz, given, atol=2e-3)
    assert las.header.parse_crs().to_epsg() == EPSG and las.header.global_encoding.wkt
    offset = np.array(told["offset"])
    assert offset[2] == 0 and (offset[:2] % 100 == 0).all()
    np.testing.assert_allclose(read_mesh(out / "m.ply").vertices + offset, given, atol=2e-3)
    east, north = (f"{value:.0f}" for value in offset[:2])
    assert f"comment offset {east} {north} 0".encode() in (out / "m.ply").read_bytes()[:400]
    assert (out / "m.obj").read_text().startswith(f"# crs EPSG:{EPSG}\n# offset {east}")
    glb = (out / "m.glb").read_bytes()
    document = json.loads(glb[20 : 20 + struct.unpack_from("<I", glb, 12)[0]])
    assert document["asset"]["extras"]["crs"] == f"EPSG:{EPSG}"
    assert (
        main(["export", str(a_map), "--format", "ply", "--out", str(out / "w.ply"), "--no-georeferenced"])
        == 0
    )
    assert (out / "w.ply").read_bytes() == (a_map / "mesh.ply").read_bytes()


def test_a_map_without_a_report_stays_as_it_was(a_map: Path, tmp_path: Path) -> None:
    (a_map / "report.html").unlink()
    control = _csv(tmp_path / "g.csv", _surveyed(WORLD))
    assert main(["georeference", str(a_map), "--points", str(control), "--epsg", str(EPSG)]) == 2
    assert read_georeference(a_map / "map") is None
    assert json.loads((a_map / "report.json").read_text()) == {"frames": 1}


def test_normals_turn_with_the_map(a_map: Path, tmp_path: Path) -> None:
    placed = Placed.of(georeference(a_map, _csv(tmp_path / "g.csv", _surveyed(WORLD)), EPSG, 0.05))
    a, b = placed.to_crs(np.array([[10.0, 10, 0], [11.0, 10, 0]]))
    turned = placed.turned(np.array([[1.0, 0, 0]], np.float32), WORLD[0].astype(np.float32))
    np.testing.assert_allclose(turned[0], (b - a) / np.linalg.norm(b - a), atol=1e-3)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda g: g[:2], "give 3 or more"),
        (lambda g: g * [1 / 0.3048, 1 / 0.3048, 1], "outside of the area|nowhere"),
        (lambda g: g[:, [1, 0, 2]], "outside of the area|nowhere"),
        (lambda g: g + np.eye(5, 3) * [[3.0, 0, 0]], "do not fit.*A is .* off.*without it"),
        (lambda g: ORIGIN + 0.3048 * (g - ORIGIN), "0.30[45] times.*feet"),
        (lambda g: ORIGIN + 1.1 * (g - ORIGIN), "1.100 times.*names"),
        (lambda g: ORIGIN + (g - ORIGIN) * [1, -1, 1], "turn the map over by 1[78]"),
    ],
)
def test_nonsense_is_refused(a_map: Path, tmp_path: Path, change, says: str) -> None:  # type: ignore[no-untyped-def]
    given = change(_surveyed(WORLD))
    with pytest.raises(InputError, match=says):
        georeference(a_map, _csv(tmp_path / "g.csv", given), EPSG, 0.3)
    assert read_georeference(a_map / "map") is None


@pytest.mark.parametrize(
    ("epsg", "says"),
    [(4326, "no east and north in metres"), (2263, "in metres"), (999_999, "no CRS"), (5773, "in metres")],
)
def test_codes_that_will_not_do(epsg: int, says: str) -> None:
    with pytest.raises(InputError, match=says):
        Grid(epsg)


def test_points_in_a_line_leave_a_turn_open() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0.001], [5, 0, 0]])
    with pytest.raises(InputError, match="in a line"):
        fit("abcd", line, line, 1.0)
    with pytest.raises(InputError, match="in a line"):
        fit("abc", np.zeros((3, 3)), np.zeros((3, 3)), 1.0)


def test_the_rigid_motion_is_the_best_one() -> None:
    rng = np.random.default_rng(5)
    world = rng.normal(0, 20, (8, 3))
    T = _truth()
    local = world @ T[:3, :3].T + [1, 2, 3] + rng.normal(0, 0.05, (8, 3))
    best = rigid(world, local)

    def cost(T: F64) -> float:
        return float(((local - world @ T[:3, :3].T - T[:3, 3]) ** 2).sum())

    for axis in range(6):
        for sign in (-1, 1):
            other = best.copy()
            if axis < 3:
                other[axis, 3] += sign * 1e-3
            else:
                turn = np.zeros(4)
                turn[axis - 3], turn[3] = sign * 1e-5, 1.0
                other = matrix_from_quaternion(np.zeros(3), turn) @ best
            assert cost(other) > cost(best)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "must name the columns"),
        ("name,x,y\na,1,2\n", "must name the columns"),
        ("e,n,h,x,y,z\n1,2,3,4,5\n", "line 2 has 5 columns, the first row 6"),
        ("e,n,h,x,y,z\n1,2,3,4,5,6\n1,2,3,4,five,6\n", "line 3: 'five' for y is no number"),
        ("e,n,h,x,y,z\n1,nan,3,4,5,6\n", "'nan' for north is no number"),
        ("name,e,n,h,x,y,z\na,1,2,3,4,5,6\na,1,2,3,4,5,6\n", "two control points are named a"),
        ("e,n,h,mark\n1,2,3,first\n", "neither x, y, z nor the number of a mark"),
    ],
)
def test_damaged_files_are_told(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "g.csv").write_text(text)
    with pytest.raises(InputError, match=says):
        read_control_points(tmp_path / "g.csv")


def test_marks_of_the_recording_are_control_points(tmp_path: Path) -> None:
    start = 5 * 10**9
    with SessionWriter(tmp_path / "s.mcap") as out:
        for k in range(20):
            stamp = start + k * 10**8
            out.write_imu(stamp, np.zeros(3), np.array([0, 0, 9.8]))
            if k in (4, 15):
                text = json.dumps({"kind": "mark", "number": 1 + (k > 4), "text": "peg"})
                out.write(topics.EVENTS.name, Text(text), stamp, None)
    assert mark_stamps(tmp_path / "s.mcap") == {1: start + 4 * 10**8, 2: start + 15 * 10**8}
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 10.0
    path = Trajectory(np.array([start, start + 10**9]), T)
    (tmp_path / "g.csv").write_text("name,e,n,h,mark,above\npeg,1,2,3,1,1.5\n")
    points, on_globe = read_control_points(tmp_path / "g.csv")
    assert not on_globe
    np.testing.assert_allclose(places(points, path, tmp_path / "s.mcap"), [[4.0, 0.0, -1.5]])
    with pytest.raises(InputError, match="say with --session"):
        places(points, path, None)
    (tmp_path / "g.csv").write_text("e,n,h,mark\n1,2,3,2\n1,2,3,7\n")
    points, _ = read_control_points(tmp_path / "g.csv")
    with pytest.raises(InputError, match="a time that the map does not cover"):
        places(points, path, tmp_path / "s.mcap")
    with pytest.raises(InputError, match="no mark 7; it has 1, 2"):
        places(points[1:], path, tmp_path / "s.mcap")
