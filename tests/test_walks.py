"""Three users from their first command to what they came for, each with the commands that the documentation gives.

An owner of a phone with a video and nothing else; a roboticist with a bag, a mask and a mounted camera; a researcher
with a data set of her own. The scenes are rendered and small; files, processes, network and weights are the real ones.
"""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import dvo
from dvo.data.trajectory import read_tum, write_tum
from dvo.models.weights import load_weights
from dvo.synth.sequence import SyntheticSequence, make_sequence
from tests.support.command_line import names, summary
from tests.support.recorded_walk import COUNT, SHORT, error_of_both, room
from tests.support.rosbags import Bag
from tests.support.summary_page import data_of, floats
from tests.support.terminal import Terminal

RESULTS = ["frames.csv", "map.ply", "run.json", "summary.html", "trajectory.png", "trajectory.txt"]
FOCAL = re.compile(r"^focal length (\d+) \+- (\d+) px \(self-calibrated from (\d+) frames\)$", re.MULTILINE)


@pytest.fixture
def shell(tmp_path: Path) -> Terminal:
    """Terminal in an empty folder."""
    return Terminal.at(tmp_path)


def bgr(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[..., ::-1])


# --- owner of a phone ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def filmed() -> SyntheticSequence:
    """Hand-held portrait clip of a room; it turns enough to tell the focal length."""
    return make_sequence(77, frames=24, height=160, width=120, fps=8.0, family="room", kind="handheld", apart=True)


@pytest.mark.slow
def test_owner_of_a_phone(shell, filmed):
    """A video alone: the focal length is found, used for the next run, and the results go to a viewer and to COLMAP."""
    writer = cv2.VideoWriter(str(shell.folder / "video.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 8.0, (120, 160))
    for frame in filmed:
        writer.write(bgr(frame.image))
    writer.release()

    said = shell.type("dvo run video.mp4")
    assert "note: no calibration: looking for the focal length in the images" in said.err
    (found,) = FOCAL.finditer(said.out)
    focal, deviation = int(found[1]), int(found[2])
    assert focal == pytest.approx(filmed.camera.fx, rel=0.08) and 1 <= deviation <= 0.1 * focal
    assert "tracked 24 of 24 frames" in said.out
    (first,) = (shell.folder / "runs").glob("video-*")
    assert f"results in {first.relative_to(shell.folder)}/" in said.out and names(first) == ["calib.txt", *RESULTS]
    assert "run.json, calib.txt\n" in said.out
    assert str(focal) in (first / "calib.txt").read_text()

    (shell.folder / "calib.txt").write_bytes((first / "calib.txt").read_bytes())
    said = shell.type("dvo run video.mp4 --calib calib.txt --out again --export colmap --overlay again.mp4")
    again = shell.folder / "again"
    assert "run.json\n" in said.out and "overlay in again.mp4" in said.out
    assert "focal length" not in said.out + said.err and names(again) == ["export", *RESULTS]
    written = summary(again)
    assert written["self_calibration"] is None and written["camera"]["fx"] == pytest.approx(focal, abs=0.5)
    assert written["warnings"] == [] and written["finished"] and written["frames"]["tracked"] == 24
    errors = dvo.evaluate(read_tum(again / "trajectory.txt"), filmed.groundtruth)
    assert errors.ate_percent < 3
    sparse = again / "export" / "colmap" / "sparse" / "0"
    assert all((sparse / f"{name}.bin").stat().st_size >= 64 for name in ("cameras", "images", "points3D"))
    assert names(again / "export" / "colmap" / "images")
    video = cv2.VideoCapture(str(shell.folder / "again.mp4"))
    shown = [picture for there, picture in iter(video.read, (False, None)) if there]
    assert len(shown) == 24 and shown[0].std() > 5

    (again / "summary.html").unlink()
    said = shell.type("dvo summary again")
    (world,) = data_of(again / "summary.html")["worlds"]
    (track,) = world["tracks"]
    poses = floats(track["poses"]).reshape(-1, 7)
    np.testing.assert_allclose(poses, read_tum(again / "trajectory.txt").poses_wc, atol=1e-4)
    assert len(floats(world["points"])) > 100

    shell.type("dvo export again --to tum again-tum")
    assert (shell.folder / "again-tum" / "trajectory.txt").read_bytes() == (again / "trajectory.txt").read_bytes()


@pytest.mark.long
def test_owner_of_a_phone_who_mistypes(shell):
    """One line each, and no folder is left."""
    said = shell.type("dvo run vidoe.mp4", code=2)
    assert said.err.startswith("dvo: error: vidoe.mp4: ") and len(said.err.splitlines()) == 1
    (shell.folder / "video.mp4").write_bytes(b"not a video")
    said = shell.type("dvo run video.mp4", code=2)
    assert said.err.splitlines()[-1].startswith("dvo: error: ") and "video.mp4" in said.err
    assert names(shell.folder) == ["configs", "video.mp4"]


@pytest.fixture
def desk(data_root: Path) -> Path:
    """Images of a real phone that goes round a desk and back to its start."""
    images = data_root / "phone_desk_198" / "images"
    if not images.is_dir():
        pytest.skip(f"no {images}")
    return images


@pytest.mark.slow
def test_owner_of_a_real_phone(shell, desk):
    """A desk, 45 frames, without a calibration or a ground truth."""
    said = shell.type(f"dvo run '{desk}' --fps 9.4 --end 45f --out desk")
    written = summary(shell.folder / "desk")
    assert written["frames"]["fed"] == 45 and written["frames"]["tracked"] >= 30 and written["map_points"] > 100
    told = written["self_calibration"]
    assert f"{told['focal']:.0f} +- {told['deviation']:.0f} px" in said.out
    if FOCAL.search(said.out):
        assert 1200 < told["focal"] < 1800, "1471 +- 38 px of the whole clip, docs/calibration.md"
        assert (shell.folder / "desk" / "calib.txt").is_file()


@pytest.mark.slow
def test_a_phone_that_comes_back_to_its_start(shell, desk):
    """The whole clip, without a calibration and without loops: from the last pose to the first, of the path."""
    shares = []
    for seed in range(3):
        said = shell.type(f"dvo run '{desk}' --fps 9.4 --no-loops --seed {seed} --out desk{seed}")
        assert FOCAL.search(said.out) and len(summary(shell.folder / f"desk{seed}")["segments"]) == 1
        positions = read_tum(shell.folder / f"desk{seed}" / "trajectory.txt").positions
        assert len(positions) == 198
        path = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
        shares.append(np.linalg.norm(positions[-1] - positions[0]) / path)
    assert np.median(shares) < 0.015


# --- roboticist ------------------------------------------------------------------------------------------------------

CAMERA_INFO = """image_width: 160
image_height: 120
camera_name: front
camera_matrix: {{rows: 3, cols: 3, data: [{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
"""
BUMPER = 10  # rows of the image that show the robot itself
START, END = 3, 36
COMMON = "--calib camera_info.yaml --mask mask.png"


@pytest.fixture
def robot(shell: Terminal) -> tuple[Terminal, list, np.ndarray]:
    """Terminal beside what a robot brings home: bag, calibration, mask, mounting, settings; frames and true poses."""
    pytest.importorskip("rosbags")
    frames, truth = room()
    bumper = np.random.default_rng(1).integers(0, 256, (BUMPER, 160, 3), dtype=np.uint8)
    images = [np.concatenate([frame.image[:-BUMPER], bumper]) for frame in frames]
    with Bag(shell.folder / "monday", "mcap") as bag:
        for frame, image in zip(frames, images, strict=True):
            bag.image("/front/image_raw", image, frame.timestamp)
    mask = np.full((120, 160), 255, np.uint8)
    mask[-BUMPER:] = 0
    cv2.imwrite(str(shell.folder / "mask.png"), mask)
    camera = {name: float(getattr(frames[0].camera, name)) for name in ("fx", "fy", "cx", "cy")}
    (shell.folder / "camera_info.yaml").write_text(CAMERA_INFO.format(**camera))
    # Camera axes (right, down, forward) in those of the robot (forward, left, up), 0.3 m ahead and 0.5 m up.
    mounting = [[0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]]
    (shell.folder / "T.yaml").write_text(yaml.safe_dump({"T_base_camera": mounting}))
    (shell.folder / "small_computer.yaml").write_text(yaml.safe_dump(SHORT))
    return shell, images, truth


@pytest.mark.slow
def test_roboticist(robot):
    """A bag is tracked in the frame of the robot and becomes a map; a live recording is recognised in it; and the same
    in Python, twice with one odometry."""
    shell, images, truth = robot
    said = shell.type(
        f"dvo run monday {COMMON} --extrinsics T.yaml --config small_computer.yaml --start {START}f --end {END}f "
        "--save-map office.dvo --out monday-results"
    )
    out = shell.folder / "monday-results"
    assert names(out) == sorted([*RESULTS, "trajectory_base.txt"])
    assert f"tracked {END - START} of {END - START} frames" in said.out
    assert "scale" in said.err and "trajectory_base.txt" in said.err, "metres of the mounting, no metres of the poses"
    written, trajectory = summary(out), read_tum(out / "trajectory.txt")
    assert written["kind"] == "rosbag" and written["map_file"] == str((shell.folder / "office.dvo").resolve())
    np.testing.assert_allclose(trajectory.timestamps, 100 + np.arange(START, END) / 15, atol=1e-5)
    base = read_tum(out / "trajectory_base.txt")
    mounting = np.array(yaml.safe_load((shell.folder / "T.yaml").read_text())["T_base_camera"])
    np.testing.assert_allclose(base.poses_wc, dvo.base_trajectory(trajectory, mounting).poses_wc, atol=1e-5)
    np.testing.assert_allclose(base.poses_wc[0], [0, 0, 0, 0, 0, 0, 1], atol=1e-6)

    # On Tuesday the robot drives back; its images come through a pipe, as ffmpeg writes them.
    pipe = b"".join(cv2.imencode(".png", bgr(image))[1].tobytes() for image in reversed(images))
    said = shell.type(f"dvo run - --fps 15 {COMMON} --map office.dvo --out tuesday", stdin=pipe)
    assert f"received {COUNT} frames, dropped 0 of them" in said.out
    assert re.search(r"^localised at \d\.\d\d s \(\d\d % of \d+ measurements are inliers\) in the world of the map$",
                     said.out, re.MULTILINE), said.out  # fmt: skip
    back = read_tum(shell.folder / "tuesday" / "trajectory.txt")
    assert summary(shell.folder / "tuesday")["segments"][0]["in_map"] and len(back) >= COUNT - 6
    assert error_of_both(trajectory, back, truth) < 2

    odometry = dvo.load("small", device="cpu", seed=0, **SHORT)
    given = {"calib": shell.folder / "camera_info.yaml", "mask": shell.folder / "mask.png"}
    source = dvo.open(shell.folder / "monday", **given, start=f"{START}f", end=f"{END}f")
    first = dvo.run(odometry, source).result.trajectory
    odometry.reset()
    second = dvo.run(odometry, source).result.trajectory
    assert first.poses_wc.tobytes() == second.poses_wc.tobytes()
    np.testing.assert_allclose(first.poses_wc, trajectory.poses_wc, atol=1e-5)


# --- researcher with a data set of her own ---------------------------------------------------------------------------


@pytest.fixture
def dataset(shell: Terminal) -> Terminal:
    """Terminal beside ``campus/``: images, calibration, times and ground truth of one sequence."""
    walk = make_sequence(77, frames=20, height=96, width=128, fps=8.0, family="room", kind="handheld", apart=True)
    place = shell.folder / "campus" / "walk_01"
    (place / "images").mkdir(parents=True)
    for frame in walk:
        cv2.imwrite(str(place / "images" / f"{frame.index:06d}.png"), bgr(frame.image))
    (place / "calib.txt").write_text(" ".join(map(str, walk.camera.intrinsics)) + "\n")
    np.savetxt(place / "times.txt", walk.groundtruth.timestamps, fmt="%.6f")
    write_tum(place / "groundtruth_tum.txt", walk.groundtruth)
    return shell


@pytest.mark.slow
def test_researcher(dataset):
    """Her sequence is tracked and compared with the truth, evaluated beside baselines, and trained on."""
    shell, place = dataset, "campus/walk_01"
    given = f"--calib {place}/calib.txt --times {place}/times.txt --groundtruth {place}/groundtruth_tum.txt"
    said = shell.type(f"dvo run {place}/images {given} --out first")
    written = summary(shell.folder / "first")
    assert written["frames"]["tracked"] == 20 and written["metrics"]["ate_percent"] < 5
    assert re.search(rf"ATE .*{written['metrics']['ate_percent']:.2f}", said.out), said.out

    suite = {"name": "campus", "label": "walks on the campus", "sequences": [{"name": "walk_01", "path": "walk_01"}]}
    suite["sequences"][0] |= {"times": "times.txt"}
    (shell.folder / "campus.yaml").write_text(yaml.safe_dump(suite))
    shell.type(
        "python -m eval run --suite campus.yaml --data campus --systems dvo-small,klt-pnp,null --seeds 1 --threads 1 "
        "--out results"
    )
    with open(shell.folder / "results" / "results.csv", newline="") as file:
        rows = {row["system"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"dvo-small", "klt-pnp", "null"} and {row["sequence"] for row in rows.values()} == {"walk_01"}
    assert float(rows["dvo-small"]["ate_percent"]) < float(rows["null"]["ate_percent"])
    assert "walks on the campus" in (shell.folder / "results" / "report.html").read_text()

    # The command of the README, with fewer steps on smaller clips, and the renderings left out.
    shell.type(
        "python -m train fit --config configs/train/small.yaml --name tuned --from small --steps 2 "
        f"--model.learning_rate 2e-5 --data.real.folders {place} --data.workers=0 --data.sizes=[[48,64]] "
        "--data.frames=4 --trainer.log_every_n_steps=1"
    )
    shell.type("python -m train export runs/train/tuned/last.ckpt tuned.safetensors")
    card = load_weights(str(shell.folder / "tuned.safetensors")).info.card
    assert card["recordings"] == ["walk_01"] and card["recorded_clips"] == 2 and card["steps"] == 2
    assert "walk_01" in shell.type("dvo weights info tuned.safetensors").out

    shell.type(f"dvo run {place}/images {given} --weights tuned.safetensors --out second")
    tuned = summary(shell.folder / "second")
    assert json.dumps(tuned["weights"]).count("tuned") and tuned["frames"]["tracked"] == 20
    first, second = (read_tum(shell.folder / name / "trajectory.txt").poses_wc for name in ("first", "second"))
    assert not np.array_equal(first, second) and tuned["metrics"]["ate_percent"] < 5
