"""``dvo run --export`` and ``dvo export`` of results and of maps."""

from __future__ import annotations

import os
import signal

import cv2
import numpy as np
import pytest

import dvo
from dvo.cli import main
from dvo.commands.export import export_images
from dvo.data.readers.euroc import read_state_groundtruth
from dvo.data.trajectory import Trajectory, read_kitti_poses, read_tum
from dvo.export.recorded import ImageChoice
from dvo.geometry.poses import pose_matrices
from dvo.odometry.protocol import Result, Segment, SparseMap, Status
from dvo.session.frame_table import FrameRow
from tests.support.colmap_models import read_text
from tests.support.command_line import arguments, errors, names, summary
from tests.support.fake_odometry import curve
from tests.support.tiny_tracker import frames, tracker

SOURCE = ["--export-images", "source"]


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


def test_export_to_several_formats(results, tmp_path, capsys):
    out = tmp_path / "both"
    assert main(["export", str(results), str(out), "--to", "kitti,tum"]) == 0
    assert names(out) == ["kitti", "tum"] and all(any((out / name).iterdir()) for name in names(out))
    assert main(["export", str(results), str(tmp_path / "none"), "--to", "kitti,nothing"]) == 2
    assert "'nothing'" in capsys.readouterr().err and not (tmp_path / "none").exists()


def test_the_only_segment_has_the_number_0(given, image_folder, tmp_path):
    given()
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    (tmp_path / "out" / "run.json").unlink()  # only says how many frames there were
    assert main(["export", str(tmp_path / "out"), str(tmp_path / "tum"), "--to", "tum", "--segment", "0"]) == 0
    assert (tmp_path / "tum" / "trajectory.txt").read_bytes() == (tmp_path / "out" / "trajectory.txt").read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--to", "obj"], "--to: no export format 'obj'. Use one or more of colmap, colmap-text, nerfstudio, tum, kitti"),
     (["--to", "tum", "--segment", "2"], "no segment 2"), (["--to", "tum", "--segment", "-1"], "must be 0 or more"),
     ([], "--to")],
)  # fmt: skip
def test_bad_input(options, message, results, tmp_path, capsys):
    assert main(["export", str(results), str(tmp_path / "new"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_no_results_folder_and_no_new_folder(results, tmp_path, capsys):
    assert main(["export", str(tmp_path / "none"), str(tmp_path / "new"), "--to", "tum"]) == 2
    (tmp_path / "images").mkdir()
    assert main(["export", str(tmp_path / "images"), str(tmp_path / "new"), "--to", "tum"]) == 2
    assert main(["export", str(results), str(results), "--to", "tum"]) == 2
    first, other, second = errors(capsys.readouterr().err)
    assert "not a results folder" in first and "images: not a results folder" in other
    assert "is not an empty folder" in second


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
    assert "18 images of 64x48 from the source, 10 points" in capsys.readouterr().out
    assert len(names(tmp_path / "colmap" / "images")) == 18
    camera = (tmp_path / "colmap" / "sparse" / "0" / "cameras.txt").read_text().splitlines()[-1].split()
    assert camera[2:4] == ["64", "48"] and [float(x) for x in camera[4:]] == [50, 50, 32, 24]
    assert main(["export", str(out), str(tmp_path / "nerf"), "--to", "nerfstudio"]) == 0
    capsys.readouterr()
    assert main(["export", str(out), str(tmp_path / "nerf"), "--to", "nerfstudio"]) == 2
    (line,) = errors(capsys.readouterr().err)  # before any image is read
    assert "is not an empty folder" in line
    image_folder.rename(image_folder.parent / "moved")
    assert main(["export", str(out), str(tmp_path / "again"), "--to", "colmap"]) == 2
    assert "the source of the run is not there" in capsys.readouterr().err and not (tmp_path / "again").exists()


def test_images_of_the_source_with_a_run(given, image_folder, tmp_path, capsys):
    """At the recorded size, not that of reading or tracking, with masks; of any odometry."""
    given(new_segment=(8,), lost=(7,))
    out, mask = tmp_path / "out", np.full((48, 64), 255, np.uint8)
    mask[40:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    options = ["--export", "tum,colmap-text,nerfstudio", "--export-images", "source", "--every", "4"]
    assert (
        main(arguments(image_folder, out, *options, "--mask", str(tmp_path / "mask.png"), "--max-pixels", "999")) == 0
    )
    printed = capsys.readouterr().out
    said = "3 images of 64x48 from the source, with masks, 10 points, without observations; "
    assert f"{out}/export/colmap-text: {said}left out: segment 0 with a world of its own" in printed
    assert f"{out}/export/nerfstudio: {said}" in printed
    places = [out / "export" / name for name in ("colmap-text", "nerfstudio")]
    camera = (places[0] / "sparse" / "0" / "cameras.txt").read_text().splitlines()[-1].split()
    assert camera[2:4] == ["64", "48"] and [float(x) for x in camera[4:]] == [50, 50, 32, 24]
    for place in places:
        images = names(place / "images")
        assert len(images) == 3 and names(place / "masks") == [f"{name}.png" for name in images]
        assert cv2.imread(str(place / "images" / images[0])).shape == (48, 64, 3)
        np.testing.assert_array_equal(cv2.imread(str(place / "masks" / f"{images[0]}.png"), -1), mask)
    assert names(out / "export" / "tum") == ["segment-0", "segment-1", "trajectory.txt"]


def test_all_segments_of_a_world_are_in_one(image_folder, tmp_path):
    source = dvo.open(image_folder, calib=image_folder.parent / "calib.txt", times=image_folder.parent / "times.txt")
    times = source.timestamps
    poses = np.array([curve(time) for time in times])
    cuts = (slice(0, 5), slice(5, 9), slice(10, 18), slice(18, 20))
    parts = [Trajectory(times[cut], poses[cut]) for cut in cuts]
    joined = (None, None, 0, None)
    segments = tuple(Segment(t, t.timestamps[0], t.timestamps[-1], j) for t, j in zip(parts, joined, strict=True))
    world = Trajectory(
        *(np.concatenate([getattr(parts[k], name) for k in (0, 2)]) for name in ("timestamps", "poses_wc"))
    )
    result = Result(world, SparseMap(np.zeros((3, 3), np.float32), np.zeros((3, 3), np.uint8)), 20, 1, {}, segments)
    rows = [FrameRow(times[k], Status.INERTIAL if k == 12 else Status.TRACKING) for k in range(20)]
    for segment, numbers, points, others in (
        (None, [*range(5), 10, 11, *range(13, 18)], 3, "segments 1, 3 with worlds of their own"),
        (1, [*range(5, 9)], 0, "segments 0, 2, 3 with"),
    ):
        place = tmp_path / str(segment)
        (said,) = export_images(source, result, rows, None, {"colmap-text": place}, ImageChoice(), segment)
        assert said.startswith(f"colmap-text: {len(numbers)} images of 64x48 from the source, {points} points")
        assert f"left out: {others}" in said
        found = read_text(place / "sparse" / "0")
        assert [int(image.name[:6]) for image in found.images.values()] == numbers
        for image in found.images.values():
            point = pose_matrices(poses[int(image.name[:6])])[:3] @ [0.5, -0.2, 2.0, 1.0]
            np.testing.assert_allclose(image.project(point, found.cameras[1][3]), [32 + 12.5, 24 - 5], atol=1e-6)


def test_a_signal_while_images_are_read_ends_the_run(given, image_folder, tmp_path, monkeypatch):
    """The results are there, a half of an export is not."""

    def signalled(image):
        os.kill(os.getpid(), signal.SIGTERM)
        return 0.0

    given()
    monkeypatch.setattr("dvo.export.recorded.sharpness", signalled)
    assert main(arguments(image_folder, tmp_path / "out", "--export", "colmap", *SOURCE, "--every", "4")) == 143
    assert summary(tmp_path / "out")["finished"] and not (tmp_path / "out" / "export").exists()


def test_every_or_count_after_the_run(given, image_folder, tmp_path, capsys):
    """Frames that the stride has left out have interpolated poses, and are no images."""
    given()
    out = tmp_path / "out"
    assert main(arguments(image_folder, out, "--stride", "2")) == 0
    assert main(["export", str(out), str(tmp_path / "all"), "--to", "nerfstudio"]) == 0
    numbers = [int(name[:6]) for name in names(tmp_path / "all" / "images")]
    assert numbers == [*range(0, 19, 2), 19], "the last frame is always tracked"
    for options, count in ((["--every", "3"], 4), (["--count", "5"], 5), (["--export-images", "source"], 11)):
        assert main(["export", str(out), str(tmp_path / options[0]), "--to", "colmap", *options]) == 0
        assert len(names(tmp_path / options[0] / "images")) == count
    assert main(["export", str(out), str(tmp_path / "both"), "--to", "tum,colmap", "--every", "3"]) == 0
    assert len(names(tmp_path / "both" / "colmap" / "images")) == 4 and names(tmp_path / "both" / "tum")
    capsys.readouterr()
    options = ["--to", "colmap", "--segment", "1"]
    assert main(["export", str(out), str(tmp_path / "new"), *options]) == 2
    assert "no segment 1" in capsys.readouterr().err and not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--export", "colmap", "--every", "3"], "--every: chooses images of the source. Add --export-images source"),
     (["--export", "colmap", "--export-images", "keyframes", "--count", "3"], "--count: chooses images of the source"),
     (SOURCE, "there are images in exported maps alone. Use --export colmap or nerfstudio"),
     (["--export", "kitti", *SOURCE], "there are images in exported maps alone"),
     (["--export", "colmap", *SOURCE, "--every", "2", "--count", "3"], "not allowed with"),
     (["--export", "colmap", *SOURCE, "--every", "0"], "--every")],
)  # fmt: skip
def test_options_of_images_that_mean_nothing(options, message, given, image_folder, tmp_path, capsys):
    odometry = given()
    assert main(arguments(image_folder, tmp_path / "out", *options)) == 2
    assert message in capsys.readouterr().err
    assert odometry.asked == {} and not (tmp_path / "out").exists()


def test_images_of_a_stream_are_refused(given, tmp_path, capsys):
    given()
    assert main(["run", "webcam:0", "--out", str(tmp_path / "out"), "--export", "colmap", *SOURCE]) == 2
    (line,) = errors(capsys.readouterr().err)
    assert "--export-images: a stream cannot be read again" in line and not (tmp_path / "out").exists()


def test_options_of_images_that_mean_nothing_after_the_run(given, image_folder, tmp_path, capsys):
    given()
    out, new = tmp_path / "out", str(tmp_path / "new")
    assert main(arguments(image_folder, out)) == 0
    (tmp_path / "a.dvo").write_bytes(b"a map")
    capsys.readouterr()
    for source, options, message in (
        (out, ["--to", "kitti", "--count", "3"], "--count: there are images in exported maps alone. Use --to colmap"),
        (out, ["--to", "colmap", "--export-images", "keyframes"], "the run has saved no map file"),
        (out, ["--to", "colmap", "--export-images", "keyframes", "--every", "2"], "--every: chooses images of"),
        (tmp_path / "a.dvo", ["--to", "colmap", *SOURCE], "a map file does not know its source"),
    ):
        assert main(["export", str(source), new, *options]) == 2
        (line,) = errors(capsys.readouterr().err)
        assert message in line and not (tmp_path / "new").exists()
