"""Settings of a rig's devices and its calibration, from files of our own and of other tools."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from artemis_edge.devices import importers
from artemis_edge.devices.calibration import (
    Calibration,
    CameraCalibration,
    is_rigid,
    read_calibration,
    to_matrix,
    write_calibration,
)
from artemis_edge.devices.rig_file import load_rig, shipped_folder
from artemis_edge.errors import InputError
from artemis_edge.odometry import se3

CAMCHAIN = """
cam0:
  camera_model: pinhole
  intrinsics: [600.0, 601.0, 320.5, 240.5]
  distortion_model: radtan
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  resolution: [640, 480]
  timeshift_cam_imu: 0.004
  T_cam_imu: [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]]
cam1:
  camera_model: pinhole
  intrinsics: [700.0, 701.0, 310.5, 230.5]
  distortion_model: radtan
  distortion_coeffs: [0, 0, 0, 0]
  resolution: [640, 480]
  T_cn_cnm1: [[1, 0, 0, -0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""
AVIA = """
extrin_calib:
  extrinsic_T: [0.04165, 0.02326, -0.0284]
  extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1]
  Rcl: [0, -1, 0, 0, 0, -1, 1, 0, 0]
  Pcl: [0.01, 0.02, 0.03]
time_offset: {imu_time_offset: 0.002, img_time_offset: 0.1}
"""
PINHOLE = """%YAML:1.0
cam_model: Pinhole
cam_width: 1280
cam_height: 1024
scale: 0.5
cam_fx: 1293.5
cam_fy: 1293.3
cam_cx: 626.9
cam_cy: 522.8
cam_d0: -0.076
cam_d1: 0.12
cam_d2: 0.001
cam_d3: -0.002
"""


@pytest.mark.parametrize("name", sorted(p.stem for p in (shipped_folder() / "profiles").glob("*.toml")))
def test_every_profile_that_ships_is_valid(name: str) -> None:
    rig = load_rig(name)
    assert rig.lidars
    assert all(len(digest) == 64 for digest in rig.digests().values())
    assert f"profiles/{name}.toml" in rig.sources


@pytest.mark.parametrize("path", sorted(shipped_folder().glob("*/*.toml")), ids=lambda p: p.stem)
def test_every_device_file_that_ships_is_valid(path: Path, tmp_path: Path) -> None:
    kind = path.parent.name
    if kind == "profiles":
        pytest.skip("see above")
    value = f'["{path.stem}"]' if kind in ("lidar", "camera") else f'"{path.stem}"'
    profile = tmp_path / "p.toml"
    profile.write_text(f"{kind} = {value}\ncalibration = 'example'\n")
    assert f"{kind}/{path.name}" in load_rig(profile).sources


def test_a_users_profile_overrides_one_field(tmp_path: Path) -> None:
    profile = tmp_path / "mine.toml"
    profile.write_text('lidar = ["avia"]\ntrigger = "board"\n[override.trigger]\nrate_hz = 5.0\n')
    rig = load_rig(profile)
    assert rig.trigger is not None and rig.trigger.rate_hz == 5.0 and rig.trigger.channel == "can0"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("lidar = ['nothing']", "no file lidar/nothing.toml"),
        ("lidars = ['avia']", "lidars"),
        ("trigger = 'board'\n[override.trigger]\nrate_hz = 5000.0", "rate_hz"),
        ("[override.camera]\niso = 200", "names no device"),
        ("camera = ['ov9782']", "nothing on camera 'cam_0'"),
        ("lidar = ['avia', 'avia']", "two devices"),
        ("lidar = [", "not valid TOML"),
        ("calibration = 'nobody'", "rig/nobody/calibration.toml"),
    ],
)
def test_a_wrong_profile_is_named(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(InputError, match=says):
        load_rig(tmp_path / "p.toml")


def test_an_unknown_profile_lists_those_there_are() -> None:
    with pytest.raises(InputError, match="bench, field"):
        load_rig("nothing")


def test_a_calibration_comes_back(tmp_path: Path) -> None:
    T = se3.exp(np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6]))
    camera = CameraCalibration(640, 480, 600.5, 601.5, 320.0, 240.0, to_matrix(T), (0.1, 0, 0, 0, 0), -0.01)
    made = Calibration("A1", "2026-01-02", to_matrix(T), 0.003, {"cam_0": camera}, {"rms_px": 0.4})
    write_calibration(tmp_path / "c.toml", made)
    assert read_calibration(tmp_path / "c.toml") == made


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("serial", "seriel", "seriel"),
        ("fx = 1500.0", "fx = -1.0", "fx"),
        ("fx = 1500.0", "fx = nan", "fx"),
        ("[0, -1, 0, 0]", "[0, -1.1, 0, 0]", "T_cam_lidar is not a rotation"),
        ("[0, 0, 0, 1]]", "[0, 0, 0]]", "T_imu_lidar"),
    ],
)
def test_a_wrong_calibration_is_named(old: str, new: str, says: str, tmp_path: Path) -> None:
    text = (shipped_folder() / "rig" / "example" / "calibration.toml").read_text()
    (tmp_path / "c.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=says):
        read_calibration(tmp_path / "c.toml")


def test_mirrors_and_scales_are_no_mountings() -> None:
    assert is_rigid(np.eye(4))
    for wrong in (np.diag([1.0, 1, -1, 1]), np.diag([2.0, 2, 2, 1]), np.full((4, 4), np.nan), np.eye(4) * 2):
        assert not is_rigid(wrong)


def test_kalibr_chain_by_hand(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(CAMCHAIN)
    base = Calibration(
        T_imu_lidar=((1, 0, 0, 0.5), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)), imu_time_offset_s=0.001
    )
    found = importers.from_kalibr(tmp_path / "c.yaml", base)
    one, two = found.cameras["cam_0"], found.cameras["cam_1"]
    # the LiDAR's origin is at (0.5, 0, 0) of the IMU, which the camera sees at (0.1, 0.2, 0.8)
    np.testing.assert_allclose(np.array(one.T_cam_lidar)[:3, 3], (0.1, 0.2, 0.8))
    np.testing.assert_allclose(np.array(two.T_cam_lidar)[:3, 3], (-0.4, 0.2, 0.8))
    assert one.distortion == (-0.1, 0.02, 0.001, -0.002, 0.0)
    assert (one.width, one.height, one.fx, one.cy) == (640, 480, 600.0, 240.5)
    # an image stamped t was taken at t + 4 ms of the IMU, which is 5 ms later on the LiDAR's clock
    assert one.time_offset_s == pytest.approx(0.005)


def test_fast_livo2_by_hand(tmp_path: Path) -> None:
    (tmp_path / "avia.yaml").write_text(AVIA)
    (tmp_path / "camera_pinhole.yaml").write_text(PINHOLE)
    found = importers.from_fast_livo2(tmp_path / "avia.yaml", tmp_path / "camera_pinhole.yaml")
    camera = found.cameras["cam_0"]
    # 2 m ahead of the LiDAR is 2 m along the camera's z
    point = np.array(camera.T_cam_lidar) @ (2.0, 0.0, 0.0, 1.0)
    np.testing.assert_allclose(point[:3], (0.01, 0.02, 2.03))
    np.testing.assert_allclose(np.array(found.T_imu_lidar)[:3, 3], (0.04165, 0.02326, -0.0284))
    assert (camera.width, camera.fx, camera.cy) == (640, 646.75, 261.4)
    assert camera.time_offset_s == 0.1 and found.imu_time_offset_s == -0.002


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[1, 2", "not valid YAML"),
        ("- 1", "holds no calibration"),
        ("cam0: 3", "cam0 is missing or no mapping"),
        ("a: 1", "no cam0"),
        (CAMCHAIN.replace("radtan", "equidistant"), "pinhole-radtan"),
        (CAMCHAIN.replace("T_cam_imu", "T_cam_other"), "no T_cam_imu"),
        (CAMCHAIN.replace("[640, 480]", "[640]"), "resolution should be 2 numbers"),
        (CAMCHAIN.replace("[0, -1, 0, 0.1]", "[0, -2, 0, 0.1]"), "not a rotation"),
    ],
)
def test_wrong_yaml_is_named(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(InputError, match=says):
        importers.from_kalibr(tmp_path / "c.yaml", Calibration())


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(max_size=200))
@example(":")  # a mapping whose name is nothing
def test_any_text_is_refused_with_a_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "any"
    path.write_text(text, encoding="utf-8", errors="ignore")
    for read in (read_calibration, load_rig):
        try:
            read(path)
        except InputError as error:
            assert "\n" not in str(error) or read is not load_rig
    with pytest.raises(InputError):
        importers.from_kalibr(path, Calibration())


def test_rig_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from artemis_edge.cli import main

    assert main(["rig", "show", "field", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["trigger"]["rate_hz"] == 10.0 and "profiles/field.toml" in shown["sha256"]
    assert main(["rig", "show", "field"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["imu"]["kind"] == "xsens"
    for name, text in (("chain.yaml", CAMCHAIN), ("avia.yaml", AVIA), ("lens.yaml", PINHOLE)):
        (tmp_path / name).write_text(text)
    out = str(tmp_path / "c.toml")
    assert (
        main(
            [
                "rig",
                "import-fast-livo2",
                str(tmp_path / "avia.yaml"),
                str(tmp_path / "lens.yaml"),
                "--out",
                out,
            ]
        )
        == 0
    )
    assert main(["rig", "import-kalibr", str(tmp_path / "chain.yaml"), "--base", out, "--out", out]) == 0
    assert set(read_calibration(tmp_path / "c.toml").cameras) == {"cam_0", "cam_1"}
    assert main(["rig", "show", "nobody"]) == 2
    assert "no rig profile 'nobody'" in capsys.readouterr().err
