"""``dvo run --export`` and ``dvo export`` of results and of maps."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.cli import main
from dvo.data.frame import Frame
from dvo.data.readers.euroc import read_state_groundtruth
from dvo.data.trajectory import Trajectory, read_kitti_poses, read_tum
from dvo.export.recorded import reconstruct_recorded
from dvo.geometry.camera import Camera
from dvo.geometry.poses import pose_matrices
from dvo.odometry.protocol import SparseMap
from tests.support.command_line import arguments, errors, names, summary
from tests.support.tiny_tracker import frames, tracker


def same(found, expected):
    np.testing.assert_allclose(pose_matrices(found), pose_matrices(expected), atol=1e-6)


def test_run_exports_beside_the_results(given, image_folder, tmp_path, capsys):
    given(lost=(4, 5))
    out = tmp_path / "out"
    assert main(arguments(image_folder, out, "--export", "kitti,euroc,kitti")) == 0
    assert names(out / "export") == ["euroc", "kitti"]
    trajectory = read_tum(out / "trajectory.txt")
    same(read_kitti_poses(out / "export" / "kitti" / "poses.txt"), trajectory.poses_wc)
    same(read_state_groundtruth(out / "export" / "euroc" / "trajectory.csv").poses_wc, trajectory.poses_wc)
    printed = capsys.readouterr().out
    assert f"exported to {out}/export/kitti: 18 poses; 2 of 20 frames have no pose in it and no row" in printed
    assert summary(out)["finished"] is True


def test_the_next_run_removes_exports(given, image_folder, tmp_path):
    given()
    out = tmp_path / "out"
    assert main(arguments(image_folder, out, "--export", "kitti")) == 0
    given()
    assert main(arguments(image_folder, out, "--overwrite")) == 0
    assert "export" not in names(out)


def test_a_map_of_an_odometry_without_one_is_refused_before_tracking(given, image_folder, tmp_path, capsys):
    odometry = given()
    assert main(arguments(image_folder, tmp_path / "out", "--export", "kitti,colmap")) == 2
    (line,) = errors(capsys.readouterr().err)
    assert "keeps no keyframe graph" in line and "tum, kitti, euroc" in line
    assert odometry.frames == [] and not (tmp_path / "out").exists()


@pytest.mark.parametrize("value", ["obj", "kitti,,tum", ""])
def test_wrong_names(value, given, image_folder, tmp_path, capsys):
    odometry = given()
    assert main(arguments(image_folder, tmp_path / "out", "--export", value)) == 2
    assert "export" in capsys.readouterr().err
    assert odometry.asked == {} and not (tmp_path / "out").exists()


def test_nothing_tracked_exports_nothing(given, image_folder, tmp_path, capsys):
    given(lost=tuple(range(20)))
    assert main(arguments(image_folder, tmp_path / "out", "--export", "tum")) == 1
    assert "nothing to export" in capsys.readouterr().err


@pytest.fixture
def results(given, image_folder, tmp_path, capsys):
    """Results folder of a run with two segments, of 7 and 12 frames, and one lost frame."""
    given(new_segment=(8,), lost=(7,))
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    capsys.readouterr()
    return tmp_path / "out"


def test_export_of_a_results_folder(results, tmp_path, capsys):
    assert main(["export", str(results), "--to", "kitti", str(tmp_path / "kitti")]) == 0
    same(read_kitti_poses(tmp_path / "kitti" / "poses.txt"), read_tum(results / "trajectory.txt").poses_wc)
    assert "12 poses; 8 of 20 frames have no pose in it" in capsys.readouterr().out
    assert main(["export", str(results), str(tmp_path / "first"), "--to", "euroc", "--segment", "0"]) == 0
    first = read_state_groundtruth(tmp_path / "first" / "trajectory.csv")
    same(first.poses_wc, read_tum(results / "trajectory-0.txt").poses_wc)
    assert len(first) == 7


def test_the_only_segment_has_the_number_0(given, image_folder, tmp_path):
    given()
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    (tmp_path / "out" / "run.json").unlink()  # only says how many frames there were
    assert main(["export", str(tmp_path / "out"), str(tmp_path / "tum"), "--to", "tum", "--segment", "0"]) == 0
    assert (tmp_path / "tum" / "trajectory.txt").read_bytes() == (tmp_path / "out" / "trajectory.txt").read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--to", "obj"], "no trajectory format 'obj'. Use one of tum, kitti, euroc"),
     (["--to", "tum", "--segment", "2"], "no segment 2"), (["--to", "tum", "--segment", "-1"], "must be 0 or more"),
     ([], "--to")],
)  # fmt: skip
def test_bad_input(options, message, results, tmp_path, capsys):
    assert main(["export", str(results), str(tmp_path / "new"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_no_results_folder_and_no_new_folder(results, tmp_path, capsys):
    assert main(["export", str(tmp_path / "none"), str(tmp_path / "new"), "--to", "tum"]) == 2
    assert main(["export", str(results), str(results), "--to", "tum"]) == 2
    first, second = errors(capsys.readouterr().err)
    assert "not a results folder" in first and "is not an empty folder" in second


def test_export_of_a_map_file(tmp_path, capsys):
    odometry, file = tracker(), tmp_path / "a.dvo"
    for frame in frames(12):
        odometry.track(frame)
    odometry.save(file)
    assert main(["export", str(file), str(tmp_path / "early"), "--to", "kitti"]) == 0
    result = odometry.finish()
    odometry.save(file)
    assert main(["export", str(file), str(tmp_path / "kitti"), "--to", "kitti"]) == 0
    same(read_kitti_poses(tmp_path / "kitti" / "poses.txt"), result.trajectory.poses_wc)
    assert main(["export", str(file), str(tmp_path / "colmap"), "--to", "colmap-text", "--segment", "0"]) == 0
    assert (tmp_path / "colmap" / "sparse" / "0" / "points3D.txt").is_file()
    out = capsys.readouterr().out
    assert f"exported to {tmp_path / 'kitti'}: {len(result.trajectory)} poses" in out and " images, " in out
    wrong = (["--to", "kitti", "--segment", "3"], "no segment 3"), (["--to", "obj"], "no export format 'obj'")
    for options, match in wrong:
        assert main(["export", str(file), str(tmp_path / "new"), *options]) == 2
        assert match in capsys.readouterr().err and not (tmp_path / "new").exists()


def test_a_map_after_the_run(given, image_folder, tmp_path, capsys):
    """Poses and images are there: images of the source, points of the map without observations."""
    given(lost=(4, 5))
    out = tmp_path / "out"
    assert main(arguments(image_folder, out)) == 0
    assert main(["export", str(out), str(tmp_path / "colmap"), "--to", "colmap-text"]) == 0
    assert "18 images of the source, 10 points" in capsys.readouterr().out
    assert len(names(tmp_path / "colmap" / "images")) == 18
    camera = (tmp_path / "colmap" / "sparse" / "0" / "cameras.txt").read_text().splitlines()[-1].split()
    assert camera[2:4] == ["64", "48"] and [float(x) for x in camera[4:]] == [50, 50, 32, 24]
    assert main(["export", str(out), str(tmp_path / "nerf"), "--to", "nerfstudio"]) == 0
    assert main(["export", str(out), str(tmp_path / "nerf"), "--to", "nerfstudio"]) == 2, "not empty"
    image_folder.rename(image_folder.parent / "moved")
    capsys.readouterr()
    assert main(["export", str(out), str(tmp_path / "again"), "--to", "colmap"]) == 2
    assert "the source of the run is not there" in capsys.readouterr().err and not (tmp_path / "again").exists()


def test_the_sharpest_image_of_each_stretch():
    draw, camera = np.random.default_rng(0), Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
    noise, sharp = draw.integers(0, 255, (48, 64, 3), np.uint8), (2, 5, 8)
    clip = [Frame(k, 0.1 * k, noise if k in sharp else noise // 4, camera) for k in range(9)]
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (9, 1))
    poses[:, 0] = np.arange(9)
    found = reconstruct_recorded(clip, Trajectory(0.1 * np.arange(9), poses), SparseMap(), most=3)
    assert found.identifiers.tolist() == list(sharp) and found.T_cw[:, 0, 3].tolist() == [-2.0, -5.0, -8.0]
