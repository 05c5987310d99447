"""Right cameras from calibration files of KITTI, EuRoC and Kalibr, and right images whose baseline they state."""

from dataclasses import replace

import numpy as np
import pytest

from dvo.cli import main
from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source, read_calibration
from dvo.data.calibration.stereo import right_camera
from dvo.data.companions.right_source import with_right
from dvo.geometry.poses import invert_poses, poses_from_matrices
from tests.support.command_line import errors

ROW = "P{}: 50 0 31 {} 0 51 23 0 0 0 1 0\n"
KITTI = "".join(ROW.format(k, -50 * x) for k, x in enumerate((0.0, 0.54, -0.06, 0.47)))
ANGLE = 0.02
TURN = [np.cos(ANGLE), np.sin(ANGLE)]
T_RIGHT_LEFT = np.array([[TURN[0], 0, TURN[1], -0.11], [0, 1, 0, 0.002], [-TURN[1], 0, TURN[0], 0], [0, 0, 0, 1]])
T_LEFT_BODY = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]])
LEFT, RIGHT = "intrinsics: [50, 51, 31, 23]", "intrinsics: [52, 53, 30, 24]"


def expected():
    return invert_poses(poses_from_matrices(T_RIGHT_LEFT))


def kalibr(make, chain=True, right=RIGHT):
    """A camchain with the pose between the cameras, or the poses of both in an inertial sensor."""
    if chain:
        poses = ["", f"T_cn_cnm1: {T_RIGHT_LEFT.tolist()}"]
    else:
        poses = [f"T_cam_imu: {T.tolist()}" for T in (T_LEFT_BODY, T_RIGHT_LEFT @ T_LEFT_BODY)]
    rows = [
        f"cam{k}:\n  {values}\n  {pose}\n" for k, (values, pose) in enumerate(zip((LEFT, right), poses, strict=True))
    ]
    return make.text("chain.yaml", "".join(rows))


def euroc(make, right=True):
    """Both files of a rig whose left camera has the pose ``T_LEFT_BODY^-1`` on the body."""
    matrices = np.linalg.inv(T_LEFT_BODY), np.linalg.inv(T_RIGHT_LEFT @ T_LEFT_BODY)
    for name, values, matrix in zip(("cam0", "cam1"), (LEFT, RIGHT), matrices, strict=True):
        known = f"T_BS: {{rows: 4, cols: 4, data: {matrix.ravel().tolist()}}}" if right or name == "cam0" else ""
        make.text(f"rig/{name}/sensor.yaml", f"{values}\n{known}\n")
    return make.root / "rig" / "cam0" / "sensor.yaml"


@pytest.mark.parametrize("kind", ["chain", "imu", "euroc"])
def test_right_camera_of_a_rig(make, kind):
    file = euroc(make) if kind == "euroc" else kalibr(make, kind == "chain")
    left = read_calibration(file)
    rig = right_camera(left, "left")
    assert left.fx == 50 and (rig.calibration.fx, rig.calibration.cy) == (52, 24)
    np.testing.assert_allclose(rig.T_left_right, expected(), atol=1e-12)


def test_right_cameras_of_kitti(make):
    left = read_calibration(make.text("calib.txt", KITTI))
    assert (left.fx, left.fy, left.cx, left.cy) == (50, 51, 31, 23)
    found = {name: right_camera(left, name) for name in ("left", "image_0", "image_2", "image_3")}
    shifts = [None if rig is None else rig.T_left_right.tolist() for rig in found.values()]
    assert shifts[0] == shifts[1] == [pytest.approx(0.54), 0, 0, 0, 0, 0, 1] and shifts[3] is None
    assert shifts[2] == [pytest.approx(0.53), 0, 0, 0, 0, 0, 1]
    only = read_calibration(make.text("two.txt", ROW.format(2, 0)))
    assert only.fx == 50 and right_camera(only, "left") is None
    with pytest.raises(DvoError, match="several cameras.*Open the KITTI sequence folder"):
        read_calibration(make.text("raw.txt", KITTI + "P3: 60 0 31 0 0 61 23 0 0 0 1 0"))


def test_files_that_state_no_right_camera(make):
    for text in (LEFT, f"cam0: {{{LEFT}}}", f"cam0: {{{LEFT}}}\ncam1: {{{RIGHT}}}", "50 51 31 23"):
        assert right_camera(read_calibration(make.text("one.yaml" if ":" in text else "c.txt", text)), "left") is None
    assert right_camera(read_calibration(euroc(make, right=False)), "left") is None
    assert right_camera(Calibration(50, 51, 31, 23), "left") is None
    assert right_camera(replace(read_calibration(kalibr(make)), file=make.root / "gone.yaml"), "left") is None
    torn = make.text("torn.yaml", f"cam0: {{{LEFT}}}\ncam1: {{{RIGHT}, T_cn_cnm1: {(2 * T_RIGHT_LEFT).tolist()}}}")
    with pytest.raises(DvoError, match="cam1.T_cn_cnm1: the upper left 3x3 block is no rotation.*rigid"):
        right_camera(read_calibration(torn), "left")


def pair(make):
    names = ["1.png", "2.png"]
    return make.images("clip/a", names), make.images("clip/b", names)


@pytest.mark.parametrize("kind", ["kitti", "chain", "euroc", "baseline"])
def test_the_baseline_comes_from_the_calibration_of_the_user(make, kind):
    left, right = pair(make)
    text = {"kitti": lambda: make.text("calib.txt", KITTI), "chain": lambda: kalibr(make), "euroc": lambda: euroc(make),
            "baseline": lambda: make.text("c.yaml", "{fx: 50, fy: 51, cx: 31, cy: 23, baseline: 0.12}")}  # fmt: skip
    source = open_source(left, calib=text[kind](), fps=10)
    first = next(iter(with_right(source, right))).right
    known = {"kitti": 0.54, "baseline": 0.12}.get(kind, float(np.linalg.norm(T_RIGHT_LEFT[:3, 3])))
    assert first.baseline == pytest.approx(known)
    assert first.camera.fx == (52 if kind in ("chain", "euroc") else 50)
    assert next(iter(with_right(source, right, 0.3))).right.baseline == 0.3, "the option wins"
    moved = source.recalibrated(Calibration(40, 40, 31, 23))
    with pytest.raises(DvoError, match="--baseline: is not known"):
        with_right(moved, right)


def test_a_calibration_without_a_right_camera_is_named(make, tmp_path, capsys):
    left, right = pair(make)
    calib = str(make.calib())
    assert (
        main(["run", str(left), "--fps", "10", "--calib", calib, "--right", str(right), "--out", str(tmp_path / "o")])
        == 2
    )
    (line,) = errors(capsys.readouterr().err)
    assert f"{calib}: --baseline: is not known from a calibration. Give the distance" in line and "Kalibr" in line


def test_a_kitti_sequence_whose_right_images_lie_elsewhere(make):
    make.images("seq/image_0", ["000000.png", "000001.png"])
    make.text("seq/calib.txt", KITTI)
    make.text("seq/times.txt", "0\n0.1\n")
    right = make.images("other", ["000000.png", "000001.png"])
    source = open_source(make.root / "seq")
    assert source.kind == "kitti" and next(iter(with_right(source, right))).right.baseline == pytest.approx(0.54)
