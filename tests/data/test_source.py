import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source, write_kitti_poses
from dvo.data.companions.depth_source import with_depth
from dvo.data.companions.right_source import with_right
from dvo.data.files.files import is_folder
from dvo.data.opening import nearby_calibration


def test_missing_source(tmp_path):
    with pytest.raises(DvoError, match="no such file or folder"):
        open_source(tmp_path / "nowhere.mp4")


@pytest.mark.parametrize("source, address", [
    ("rtmp://host/live", True), (" rtsp://host", True), ("rtsp:/host/a", True), ("webcam", True), ("webcam0", True),
    ("webcam.mp4", False), ("C:/clip.mp4", False), ("clip", False),
])  # fmt: skip
def test_an_address_of_another_scheme_says_which_are_read(source, address):
    with pytest.raises(DvoError, match="no such file or folder") as caught:
        open_source(source)
    assert ("rtsp://" in caught.value.remedy) is address


def test_no_images(tmp_path):
    with pytest.raises(DvoError, match="no images"):
        open_source(tmp_path, calib=Calibration(50, 50, 31, 23))


def test_a_folder_of_videos_names_them(make):
    video = make.video("my clip.mp4", "mp4v")
    with pytest.raises(DvoError, match="no images in it, but videos: my clip.mp4. Give a video"):
        open_source(video.parent, guess=True)


def test_no_image_that_decodes(make):
    folder = make.images("clip", ["0.png", "1.png"])
    for image in folder.iterdir():
        image.write_bytes(b"")
    with pytest.raises(DvoError, match="none of the 2 images decodes"):
        open_source(folder, calib=make.calib())


@pytest.mark.parametrize(("content", "what"), [
    (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "a pointer of Git LFS"),
    (b"\n<!DOCTYPE html>", "a web page"), (b"\0\0\0\x18ftypheic" + bytes(40), "HEIC, which is not read"),
    (b"\0\0\0\x18ftypavif" + bytes(40), "AVIF, which is not read"), (b"", "empty"),
])  # fmt: skip
def test_what_has_the_name_of_an_image_is_named(make, content, what):
    folder = make.images("clip", ["0.png", "1.png"])
    for image in folder.iterdir():
        image.write_bytes(content)
    with pytest.raises(DvoError, match=f"none of the 2 images decodes: 0.png is {what}"):
        open_source(folder, calib=make.calib())


def test_no_calibration_names_the_option_and_a_file_that_lies_near(make):
    folder = make.images("clip", ["0.png"])
    with pytest.raises(DvoError, match="no calibration.*--calib FILE: "):
        open_source(folder)
    nearby = make.calib()
    with pytest.raises(DvoError, match="--calib FILE") as caught:
        open_source(folder)
    assert str(nearby) in str(caught.value)


@pytest.mark.parametrize(("name", "text"), [
    ("seq/camera.txt", "Pinhole 50 50 31.5 23.5 0\n64 48\nnone\n64 48\n"),
    ("seq/rgb/cam_params.json", '{"camera": {"w": 64, "h": 48, "fx": 50, "fy": 50, "cx": 31, "cy": 23}}'),
    ("seq/sparse/0/cameras.txt", "1 PINHOLE 64 48 50 50 32 24\n"),
    ("seq/intrinsic/intrinsic_color.txt", "50 0 32 0\n0 50 24 0\n0 0 1 0\n0 0 0 1\n"),
])  # fmt: skip
def test_a_calibration_that_lies_near_is_named_if_it_fits(make, name, text):
    folder = make.images("seq/rgb", ["0.png", "1.png"])
    make.text(str(Path(name).with_name("camera_notes.txt")), "made by someone\n")
    make.text(str(Path(name).with_name("calib_of_another.yaml")), "{fx: 500, fy: 500, cx: 320, cy: 240}")
    make.text(str(Path(name).with_name("intrinsic_depth.txt")), "50 50 31 23\n")
    assert nearby_calibration(folder, 64, 48) is None
    file = make.text(name, text)
    assert nearby_calibration(folder, 64, 48) == file
    with pytest.raises(DvoError, match="is it .*?\\)"):
        open_source(folder)


def test_intrinsics_that_do_not_fit_name_the_file(make):
    folder = make.images("clip", ["0.png"])
    file = make.text("other.txt", "500 500 320 240")
    with pytest.raises(DvoError, match="outside the 64x48 image") as caught:
        open_source(folder, calib=file)
    assert caught.value.file == file
    file = make.text("folding.txt", "20 20 32 24 -5 0 0 0")
    with pytest.raises(DvoError, match="fold") as caught:
        open_source(folder, calib=file)
    assert caught.value.file == file


def test_a_calibration_of_doubtful_resolution_is_said_aloud(make):
    source = open_source(make.images("clip", ["0.png"]), calib=make.text("c.txt", "20 20 10 10"), fps=1)
    assert any("principal point" in warning for warning in source.warnings)


@pytest.mark.parametrize("option", ["calib", "times", "groundtruth"])
def test_missing_option_files(make, option):
    folder = make.images("clip", ["0.png"])
    options = {"calib": make.calib(), option: "nowhere.txt"}
    with pytest.raises(DvoError, match="no such file") as caught:
        open_source(folder, **options)
    assert caught.value.field == option


LONG = "x" * 3000  # longer than the name of a file may be


def test_names_that_are_too_long(make):
    folder, calib = make.images("clip", ["0.png"]), make.calib()
    for options in ({}, {"topic": "/camera/image_raw"}):
        with pytest.raises(DvoError, match="cannot be read"):
            dvo.open(LONG, calib=calib, **options)
    with pytest.raises(DvoError, match="no such file or folder"):
        dvo.open(f"none.bag:/{LONG}", calib=calib)
    for field in ("calib", "mask"):
        with pytest.raises(DvoError, match=f"{field}: no such file"):
            dvo.open(folder, **{"calib": calib, "fps": 10, field: LONG})
    for function, field in ((with_right, "right"), (with_depth, "depth")):
        with pytest.raises(DvoError, match=f"{field}: no such file"):
            function(dvo.open(folder, calib=calib, fps=10), LONG)
    with pytest.raises(DvoError, match="only bags have topics"):
        dvo.open(folder, calib=calib, topic=LONG)
    assert not is_folder(Path(LONG)) and not is_folder(folder / "0.png") and is_folder(folder)


def test_options_are_found_from_the_working_directory_then_from_the_source(make, monkeypatch):
    folder = make.images("clip", ["0.png", "1.png"])
    make.calib()
    make.text("t.txt", "0\n1\n")
    make.text("elsewhere/near.txt", "60 60 30 20")
    monkeypatch.chdir(make.root / "elsewhere")
    source = open_source(folder, calib="../calib.txt", times="../t.txt")
    assert source.camera.fx == 50 and len(list(source)) == 2
    assert open_source(folder, calib="near.txt").camera.fx == 60


def test_undistort_or_not(make):
    folder = make.images("clip", ["0.png"], 640, 480)
    calib = make.text("c.txt", "517.3 516.5 318.6 255.3 0.2624 -0.9531 -0.0054 0.0026 1.1633")
    source = open_source(folder, calib=calib)
    assert not source.camera.is_distorted and source.recorded_camera.is_distorted
    assert next(iter(source)).camera == source.camera
    raw = open_source(folder, calib=calib, undistort=False)
    assert raw.camera == raw.recorded_camera == source.recorded_camera
    straight, bent = next(iter(source)).image, next(iter(raw)).image
    assert straight.shape == bent.shape and np.abs(straight.astype(int) - bent).mean() > 1


def test_groundtruth_option(make):
    folder = make.images("clip", ["0.png", "1.png"])
    tum = make.text("gt.txt", "#\n0 1 2 3 0 0 0 1\n0.1 2 2 3 0 0 0 1.05\n")
    truth = open_source(folder, calib=make.calib(), groundtruth=tum, fps=10).groundtruth
    assert truth.timestamps.tolist() == [0, 0.1] and truth.poses_wc[1].tolist() == [2, 2, 3, 0, 0, 0, 1]
    poses = np.array([[0, 0, 0, 0, 0, 0, 1.0], [0, 0, 5, 0, 0, 0, 1]])
    write_kitti_poses(make.root / "kitti.txt", poses)
    truth = open_source(folder, calib=make.calib(), groundtruth="../kitti.txt", fps=10).groundtruth
    assert truth.timestamps.tolist() == [0, 0.1] and np.allclose(truth.poses_wc, poses)
    write_kitti_poses(make.root / "kitti.txt", poses[:1])
    with pytest.raises(DvoError, match="1 rows without times for 2 images"):
        open_source(folder, calib=make.calib(), groundtruth="../kitti.txt")
    with pytest.raises(DvoError, match="not a TUM row"):
        open_source(folder, calib=make.calib(), groundtruth=make.text("bad.txt", "1 2 3\n"))


def test_a_truth_with_a_row_for_each_image_has_their_times(make):
    """Unless something else has them: at an assumed rate poses would be compared with those of other images."""
    folder = make.images("clip", ["0.png", "1.png", "2.png"])
    tum = make.text("gt.txt", "".join(f"{0.1 * k} {k} 2 3 0 0 0 1\n" for k in range(3)))

    def times(source, **options):
        opened = open_source(source, calib=make.calib(), groundtruth=tum, **options)
        return [frame.timestamp for frame in opened], " ".join(opened.warnings)

    found, notes = times(folder)
    assert found == [0, 0.1, 0.2] and "taking those of gt.txt" in notes and "assuming" not in notes
    assert times(folder, fps=20)[0] == [0, 0.05, 0.1]
    assert times(folder, times=make.text("t.txt", "0\n0.2\n0.4\n"))[0] == [0, 0.2, 0.4]
    assert times(make.images("named/images", ["0.png", "1.png", "2.png"]).parent)[0] == [0, 0.1, 0.2]
    make.images("clip", ["3.png"])
    assert times(folder)[0] == pytest.approx([0, 1 / 30, 2 / 30, 0.1])


def test_importing_the_readers_is_light():
    code = "import sys, dvo.data; print([m for m in ('cv2', 'torch', 'yaml', 'scipy') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_what_undistortion_cuts_of_a_fisheye_is_said_once(make):
    lens = "{fx: 30, fy: 30, cx: 31.5, cy: 23.5, model: fisheye, coefficients: [0, 0, 0, 0]}"
    calib = make.text("fisheye.yaml", lens)
    source = open_source(make.images("clip", ["0.png", "1.png"]), calib=calib, fps=1)
    again = source.recalibrated(Calibration(30, 30, 31.5, 23.5, model="fisheye", coefficients=(0.0,) * 4))
    assert not again.calibrated
    for opened in (source, again):
        list(opened)
        (said,) = (warning for warning in opened.warnings if "fisheye" in warning)
        assert "of 122 x 92 degrees of view are kept" in said and "of the pixels are cut" in said
    undistorted = open_source(make.root / "clip", calib=calib, fps=1, undistort=False)
    assert not any("fisheye" in warning for warning in undistorted.warnings)
