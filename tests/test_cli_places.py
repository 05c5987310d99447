"""Outputs of commands: nothing of the user's is replaced, and runs do not write over each other."""

from __future__ import annotations

import json
import os
import shutil
import stat
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.cli import main
from dvo.commands.places import check_outputs
from dvo.core.errors import DvoError
from dvo.data.files.output import only_writer
from tests.support.command_line import arguments, errors, names, summary


def content(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.fixture
def video(tmp_path):
    """``walk.mp4`` with ``calib.txt`` and ``truth.txt`` in a folder of its own."""
    folder = tmp_path / "videos"
    folder.mkdir()
    writer = cv2.VideoWriter(str(folder / "walk.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for image in np.random.default_rng(0).integers(0, 255, (20, 48, 64, 3), dtype=np.uint8):
        writer.write(image)
    writer.release()
    (folder / "calib.txt").write_text("50 50 31.5 23.5\n")
    (folder / "truth.txt").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    return folder / "walk.mp4"


# -- outputs and inputs --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("link", ["same", "relative", "symbolic", "hard", "folder"])
@pytest.mark.parametrize(
    ("option", "target"),
    [("--save-map", "walk.mp4"), ("--save-map", "calib.txt"), ("--overlay", "walk.mp4"), ("--save-map", "truth.txt")],
)
def test_no_output_of_a_run_is_its_input(given, video, tmp_path, capsys, monkeypatch, option, target, link):
    odometry = given()
    before, file = content(video.parent), video.parent / target
    place = file
    if link == "relative":
        monkeypatch.chdir(tmp_path)
        place = Path("videos/../videos") / target
    elif link in ("symbolic", "hard"):
        place = tmp_path / f"linked{file.suffix}"
        place.symlink_to(file) if link == "symbolic" else place.hardlink_to(file)
    elif link == "folder":
        (tmp_path / "other").symlink_to(video.parent)
        place = tmp_path / "other" / target
    line = ["run", str(video), "--calib", "calib.txt", "--groundtruth", "truth.txt", "--device", "cpu"]
    assert main([*line, "--out", str(tmp_path / "out"), option, str(place)]) == 2
    (line,) = errors(capsys.readouterr().err)[-1:]
    assert option in line and "would replace" in line
    assert content(video.parent) == before and not odometry.frames and not (tmp_path / "out").exists()


def test_a_map_is_not_written_over_the_images_of_a_folder(given, image_folder, tmp_path, capsys):
    given()
    before = content(image_folder)
    assert main(arguments(image_folder, tmp_path / "out", "--save-map", str(image_folder / "0003.png"))) == 2
    assert "is the source" in capsys.readouterr().err and content(image_folder) == before


def test_the_map_that_is_tracked_in_stays(image_folder, tmp_path, capsys):
    (tmp_path / "a.dvo").write_bytes(b"a map")
    more = ("--map", str(tmp_path / "a.dvo"), "--save-map", str(tmp_path / "." / "a.dvo"))
    assert main(arguments(image_folder, tmp_path / "out", *more)) == 2
    assert "the file of --map" in capsys.readouterr().err and (tmp_path / "a.dvo").read_bytes() == b"a map"
    for place in ("a.dvo", "b.dvo"):
        assert main(["merge", str(tmp_path / "a.dvo"), str(tmp_path / "b.dvo"), "--out", str(tmp_path / place)]) == 2
        assert (tmp_path / "a.dvo").read_bytes() == b"a map"


def test_two_outputs_have_two_places(tmp_path):
    with pytest.raises(DvoError, match="--overlay"):
        check_outputs({"--save-map": tmp_path / "a.mp4", "--overlay": f"{tmp_path}/./a.mp4"}, {})
    with pytest.raises(DvoError, match="file of the results"):
        check_outputs({"--save-map": tmp_path / "run.json"}, {}, folder=tmp_path)
    check_outputs({"--save-map": tmp_path / "a.dvo", "--overlay": tmp_path / "a.mp4"}, {"--calib": None}, tmp_path)


def test_results_that_are_inputs_of_the_next_run_stay(given, image_folder, tmp_path, capsys):
    """The trajectory of a run as ground truth of the next one in the same folder, and images of its export."""
    given()
    out = tmp_path / "out"
    assert main(arguments(image_folder, out)) == 0
    more = ("--overwrite", "--groundtruth", str(out / "trajectory.txt"))
    before = content(out)
    assert main(arguments(image_folder, out, *more)) == 2
    assert "--groundtruth" in capsys.readouterr().err and content(out) == before
    images = out / "export" / "colmap" / "images"
    shutil.copytree(image_folder, images)
    assert main(["run", str(images), "--out", str(out), "--overwrite", "--device", "cpu"]) == 2
    assert len(names(images)) == 20
    (out / "export" / "colmap" / "calib.txt").write_text("50 50 31.5 23.5\n")
    more = ["--calib", str(out / "export" / "colmap" / "calib.txt"), "--overwrite"]
    assert main(["run", str(image_folder), *more, "--out", str(out), "--device", "cpu"]) == 2
    assert "the file of --calib" in capsys.readouterr().err


def test_the_page_of_a_run_is_not_written_over_its_other_files(given, image_folder, tmp_path, capsys):
    given()
    out = tmp_path / "out"
    assert main(arguments(image_folder, out)) == 0
    before = content(out)
    for name in ("run.json", "trajectory.txt", "frames.csv"):
        assert main(["summary", str(out), "--out", str(out / name)]) == 2
        assert "would replace" in capsys.readouterr().err
    truth = image_folder.parent / "truth.txt"
    assert main(["summary", str(out), "--groundtruth", str(truth), "--out", str(truth)]) == 2
    assert content(out) == before and truth.read_text().startswith("#")


def test_no_picture_is_drawn_over_a_trajectory(tmp_path, capsys, monkeypatch):
    """Whatever the name that it has: a link, or a trajectory that is named as a picture."""
    rows = "".join(f"{k} {k} {k * k} 0 0 0 0 1\n" for k in range(9))
    for name in ("truth.txt", "estimate.png", "folder/trajectory.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(rows)
    (tmp_path / "link.png").symlink_to("truth.txt")
    (tmp_path / "run.png").symlink_to("folder/trajectory.txt")
    monkeypatch.chdir(tmp_path)
    before = content(tmp_path)
    for out in ("link.png", "./estimate.png", "run.png"):
        assert main(["evaluate", "truth.txt", "estimate.png", "folder", "--out", out]) == 2
        assert "would replace" in errors(capsys.readouterr().err)[-1]
    assert content(tmp_path) == before
    (tmp_path / "free.png").symlink_to("picture")  # the name of the link says what kind of file it is
    assert main(["evaluate", "truth.txt", "estimate.png", "--out", "free.png"]) == 0
    assert (tmp_path / "picture").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["samples.csv", "imu.yaml", "noise.yaml", "calib.txt", "times.txt", "walk.csv"])
def test_findings_of_inertial_samples_are_not_written_over_what_is_read(video, capsys, monkeypatch, name):
    monkeypatch.chdir(video.parent)
    rows = ["#time [s],gyro x,gyro y,gyro z,acc x,acc y,acc z"]
    rows += [f"{k / 100},0.0{k % 7},0,0,0,0.0{k % 5},9.81" for k in range(400)]
    for file in ("samples.csv", "walk.csv"):
        Path(file).write_text("\n".join(rows))
    Path("imu.yaml").write_text("update_rate: 100\n")
    Path("noise.yaml").write_text("gyroscope_noise_density: 0.001\n")
    Path("times.txt").write_text("".join(f"{k / 10}\n" for k in range(20)))
    before = content(video.parent)
    line = ["imu", "check", "walk.mp4", "--no-vision", "--json", name]
    if name != "walk.csv":  # which is found beside the video
        line += ["--imu", "samples.csv", "--imu-calib", "imu.yaml,noise.yaml", "--calib", "calib.txt"]
        line += ["--times", "times.txt"]
    assert main(line) == 2
    assert "would replace" in errors(capsys.readouterr().err)[-1] and content(video.parent) == before


def test_a_sheet_of_a_mesh_is_not_drawn_over_its_texture(tmp_path, capsys):
    pytest.importorskip("trimesh")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
    faces = "f 1/1 2/2 3/3\nf 2/1 3/2 4/3\nf 1/1 2/2 4/3\nf 1/1 3/2 4/3\n"
    (tmp_path / "room.obj").write_text(f"mtllib room.mtl\nusemtl wall\n{corners}{faces}")
    (tmp_path / "room.mtl").write_text("newmtl wall\nmap_Kd room.png\n")
    cv2.imwrite(str(tmp_path / "room.png"), np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8))
    before = content(tmp_path)
    line = ["synth", "preview", str(tmp_path / "room.obj"), "--rows", "1", "--size", "32x32", "--out"]
    assert main([*line, str(tmp_path / "room.png")]) == 2
    assert "would replace" in errors(capsys.readouterr().err)[-1] and content(tmp_path) == before


def test_a_link_with_the_name_of_a_video_to_an_image_of_the_source(given, image_folder, tmp_path, capsys):
    odometry = given()
    (tmp_path / "view.mp4").symlink_to(image_folder / "0003.png")
    before = content(image_folder)
    assert main(arguments(image_folder, tmp_path / "out", "--overlay", str(tmp_path / "view.mp4"))) == 2
    assert "is the source" in capsys.readouterr().err and content(image_folder) == before and not odometry.frames


@pytest.mark.parametrize("name", ["calib.txt", ".dvo.lock", "export", "export/tum", "export/tum/a.dvo"])
def test_no_map_takes_the_place_of_what_the_run_writes(given, image_folder, tmp_path, capsys, name):
    odometry = given()
    assert main(arguments(image_folder, tmp_path / "out", "--save-map", str(tmp_path / "out" / name))) == 2
    assert "file of the results" in errors(capsys.readouterr().err)[-1] and not odometry.frames


# -- folders that hold something -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["trajectory.txt", "mesh.ply", "run.json", "trajectory-3.txt", "summary.html", "export/tum"]
)
def test_files_that_no_run_has_written_stay(given, image_folder, tmp_path, capsys, name):
    odometry = given()
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text('{"mine": 1}')
    for more in ((), ("--overwrite",)):
        assert main(arguments(image_folder, out, "--export", "tum", *more)) == 2
        (line,) = errors(capsys.readouterr().err)[-1:]
        assert name in line and "new folder" in line
    assert content(out) == {name: b'{"mine": 1}'} and not odometry.frames


def test_results_are_replaced_on_request_and_nothing_else(given, image_folder, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.md").write_text("mine")
    (out / ".part-notes").write_text("mine too")
    given(new_segment=(6, 12))
    assert main(arguments(image_folder, out, "--export", "tum,kitti")) == 0
    assert {"trajectory-2.txt", "run.json"} <= set(summary(out)["files"])
    before = content(out)
    given()
    assert main(arguments(image_folder, out)) == 2
    assert "--overwrite" in errors(capsys.readouterr().err)[-1] and content(out) == before
    (out / "mesh.ply").write_text("mine, of another program")
    assert main(arguments(image_folder, out, "--overwrite")) == 2
    assert "mesh.ply" in errors(capsys.readouterr().err)[-1]
    (out / "mesh.ply").unlink()
    assert main(arguments(image_folder, out, "--overwrite", "--export", "kitti")) == 0
    assert not [name for name in names(out) if name.startswith("trajectory-")]
    assert names(out / "export") == ["kitti"] and {"notes.md", ".part-notes"} <= set(names(out))


def test_results_of_a_run_that_was_killed_can_be_replaced(given, image_folder, tmp_path):
    """Its run.json may not list what it wrote last."""
    out = tmp_path / "out"
    given(new_segment=(6,))
    assert main(arguments(image_folder, out)) == 0
    facts = summary(out) | {"finished": False, "files": ["run.json"]}
    (out / "run.json").write_text(json.dumps(facts))
    given()
    assert main(arguments(image_folder, out, "--overwrite")) == 0 and "trajectory-0.txt" not in names(out)


def test_a_list_of_files_leads_nowhere_else(given, image_folder, tmp_path):
    """run.json is a file that anybody may have written."""
    out, other = tmp_path / "out", tmp_path / "other"
    given()
    assert main(arguments(image_folder, out)) == 0
    other.mkdir()
    (other / "a.txt").write_text("mine")
    (out / "notes.md").write_text("mine")
    listed = ["../other", "export/../../other", str(other), "../other/a.txt", "notes.md", 3, None, "run.json"]
    (out / "run.json").write_text(json.dumps(summary(out) | {"files": [*summary(out)["files"], *listed]}))
    assert main(arguments(image_folder, out, "--overwrite")) == 0
    assert (other / "a.txt").read_text() == "mine" and (out / "notes.md").exists()


def test_a_second_run_into_a_folder_is_refused(given, image_folder, tmp_path, capsys):
    given()
    out = tmp_path / "out"
    out.mkdir()
    with only_writer(out, "--out"):
        assert main(arguments(image_folder, out)) == 2
    (line,) = errors(capsys.readouterr().err)
    assert "another run is writing" in line and names(out) == []
    assert main(arguments(image_folder, out)) == 0 and ".dvo.lock" not in names(out)


def test_a_calibration_is_replaced_on_request_only(tmp_path, capsys):
    """Also one that dvo has not written stays."""
    board = tmp_path / "board"
    board.mkdir()
    cv2.imwrite(str(board / "0.png"), np.zeros((48, 64, 3), np.uint8))
    for name, text in (("calib.txt", "1 2 3 4\n"), ("calibration.json", "{}"), ("calibration.png", "mine")):
        out = tmp_path / name.replace(".", "")
        out.mkdir()
        (out / name).write_text(text)
        for more in ((), ("--overwrite",)):
            assert main(["calibrate", str(board), "--board", "5x4", "--out", str(out), *more]) == 2
            assert name in errors(capsys.readouterr().err)[-1]
        assert (out / name).read_text() == text
    out = tmp_path / "ours"
    out.mkdir()
    (out / "calib.txt").write_text("# dvo calibrate, 64x48 images\n1 2 3 4\n")
    assert main(["calibrate", str(board), "--board", "5x4", "--out", str(out)]) == 2
    assert "--overwrite" in errors(capsys.readouterr().err)[-1]


# -- places that are no regular file -------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["--save-map", "--overlay"])
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_device_stays_a_device(given, image_folder, tmp_path, capsys, option, kind):
    odometry = given()
    place = tmp_path / "null.mp4"
    if kind == "pipe":
        os.mkfifo(place)
    elif os.geteuid() == 0:
        os.mknod(place, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    else:
        pytest.skip("only root makes devices")
    mode = place.stat().st_mode
    assert main(arguments(image_folder, tmp_path / "out", option, str(place))) == 2
    assert "not a regular file" in errors(capsys.readouterr().err)[-1] and not odometry.frames
    assert main(arguments(image_folder, tmp_path / "run")) == 0
    assert main(["summary", str(tmp_path / "run"), "--out", str(place)]) == 2
    assert place.stat().st_mode == mode


@pytest.mark.long
@pytest.mark.parametrize("name", ["run.json", "batch.csv", "logs/walk.log", "walk/run.json", "calib.txt"])
def test_a_pipe_of_the_name_of_a_result_ends_no_command_waiting(given, video, tmp_path, capsys, name):
    given()
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    os.mkfifo(out / name)
    command = {"run.json": "run", "calib.txt": "calibrate"}.get(name, "batch")
    line = [command, str(video), "--out", str(out), "--overwrite", "--device", "cpu"]
    line += ["--board", "5x4"] if command == "calibrate" else ["--calib", str(video.parent / "calib.txt")]
    assert main(line) in ((1, 2) if name.startswith("walk/") else (2,))
    assert Path(name).name in "".join(capsys.readouterr()) and stat.S_ISFIFO((out / name).stat().st_mode)


def test_results_with_a_pipe_in_place_of_a_file(given, image_folder, tmp_path, capsys):
    given()
    out = tmp_path / "out"
    assert main(arguments(image_folder, out)) == 0
    for name, more in (("summary.html", ["--out", str(tmp_path / "new.html")]), ("run.json", [])):
        (out / name).unlink()
        os.mkfifo(out / name)
        assert main(["summary", str(out), *more]) == (2 if name == "run.json" else 0)
    assert "run.json: not a regular file" in errors(capsys.readouterr().err)[-1]
