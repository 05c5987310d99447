"""The peers' wrappers; each runs in a process of its own, and is skipped where its package is not installed."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.files.output import PART
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.odometry.protocol import Result
from eval.systems.peers import colmap, orbslam3, svo
from eval.systems.peers.common import Pictures, Row, result
from eval.systems.registry import find_system

ROOT = Path(__file__).resolve().parents[4]
GPL = {"svo_cpp", "pyorbslam3"}
DRIVE = """
import sys, cv2, numpy as np
cv2.setNumThreads(1)
from dvo.metrics import evaluate
from dvo.synth.sequence import make_sequence
from eval.systems.registry import find_system
name, seed, frames, fps = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
film = make_sequence(seed, frames=frames, fps=fps, family="clutter", kind="handheld")
odometry = find_system(name).build(0, "cpu")
for frame in film:
    odometry.track(frame)
result = odometry.finish()
metrics = evaluate(result.trajectory, film.groundtruth)
print("MEASURED", metrics.completeness, metrics.ate_percent, metrics.rotation_error_ratio)
"""


def measure(name: str, seed: int, frames: int, fps: float) -> list[float]:
    """Completeness, ATE % and rotation error ratio of a system on a rendered sequence."""
    done = subprocess.run(
        [sys.executable, "-c", DRIVE, name, str(seed), str(frames), str(fps)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("MEASURED")]
    assert lines, done.stderr[-2000:]
    return [float(value) for value in lines[0].split()[1:]]


@pytest.mark.slow
def test_gpl_packages_are_imported_only_when_a_system_is_built():
    for file in sorted((ROOT / "eval").rglob("*.py")) + sorted((ROOT / "dvo").rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        inside = {
            id(n)
            for f in ast.walk(tree)
            if isinstance(f, ast.FunctionDef) and f.name == "__init__"
            for n in ast.walk(f)
        }
        for node in ast.walk(tree):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if GPL & {name.split(".")[0] for name in names}:
                assert file.parent.name == "peers" and id(node) in inside, file
    check = "import sys, eval.systems.registry as s; [x.missing() for x in s.list_systems()]; print(list(sys.modules))"
    done = subprocess.run([sys.executable, "-c", check], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not any(f"'{name}'" in done.stdout for name in GPL | {"pycolmap"})


def test_every_peer_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr("eval.systems.peers.common.find_spec", lambda name: None)
    for peer, package in ((colmap, "pycolmap"), (orbslam3, "pyorbslam3"), (svo, "svo-cpp")):
        assert f"{package} (" in (peer.missing() or "") and "pip install" in (peer.missing() or "")


def test_orbslam3_lacks_its_package_its_vocabulary_or_both(monkeypatch, tmp_path):
    there = tmp_path / "words.txt"
    there.write_text("10 6 0 0\n")
    for package in (True, False):
        monkeypatch.setattr("eval.systems.peers.common.find_spec", lambda name, package=package: package or None)
        monkeypatch.setenv(orbslam3.VOCABULARY, str(there))
        assert ("pyorbslam3" in (orbslam3.missing() or "")) is not package
        assert "vocabulary" not in (orbslam3.missing() or "")
        monkeypatch.setenv(orbslam3.VOCABULARY, str(tmp_path / "none.txt"))
        assert "no ORB vocabulary" in orbslam3.missing() and "python -m eval vocabulary" in orbslam3.missing()
        monkeypatch.delenv(orbslam3.VOCABULARY)
        monkeypatch.setenv("DVO_DATA", str(tmp_path / "nowhere"))  # without a data folder it is the same that lacks
        assert "no ORB vocabulary" in orbslam3.missing() and "data folder" not in orbslam3.missing()
        assert ("pyorbslam3 is" in orbslam3.missing()) is not package


def test_orbslam3_names_the_place_where_it_looked(monkeypatch, tmp_path):
    monkeypatch.delenv("DVO_ORB_VOCABULARY", raising=False)
    monkeypatch.setenv("DVO_DATA", str(tmp_path / "no_such_folder"))
    reason = orbslam3.missing() or ""
    assert str(tmp_path / "no_such_folder" / "orb_vocabulary" / "tiny_orb_vocabulary.txt") in reason
    assert "DVO_ORB_VOCABULARY is not set" in reason
    monkeypatch.setenv("DVO_ORB_VOCABULARY", str(tmp_path / "words.txt"))
    reason = orbslam3.missing() or ""
    assert f"{tmp_path / 'words.txt'}: $DVO_ORB_VOCABULARY: no ORB vocabulary" in reason


def test_settings_hold_the_camera(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text(orbslam3.settings(Camera(500.5, 501.5, 319.5, 239.5, 640, 480)))
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    assert storage.getNode("Camera1.fx").real() == 500.5 and storage.getNode("Camera.width").real() == 640
    assert storage.getNode("Camera1.cy").real() == 239.5 and storage.getNode("Camera.type").string() == "PinHole"


def test_settings_turn_the_recognition_of_places_off(tmp_path):
    camera = Camera(500.5, 501.5, 319.5, 239.5, 640, 480)
    for loops, expected in ((True, 1.0), (False, 0.0)):
        file = tmp_path / f"{loops}.yaml"
        file.write_text(orbslam3.settings(camera, loops))
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        assert storage.getNode("loopClosing").real() == expected
    assert orbslam3.settings(camera) == orbslam3.settings(camera, True)


@pytest.fixture
def package(monkeypatch, tmp_path) -> list[float]:
    """A stand-in for pyorbslam3 that is lost in its second frame and merges; the values of ``loopClosing`` it read."""
    read: list[float] = []

    class Slam:
        def __init__(self, vocabulary, file, sensor, use_viewer):
            storage = cv2.FileStorage(file, cv2.FILE_STORAGE_READ)
            read.append(storage.getNode("loopClosing").real())
            self._told, self._reads = iter(["OK", "recent", "first", "OK"]), count()
            self._changes = iter([False, True, False, False])

        def track_monocular(self, image, stamp):
            state = next(self._told)
            return SimpleNamespace(state=state, pose_valid=state == "OK", pose_wc=np.eye(4))

        def map_changed(self):
            return next(self._changes)

        def shutdown(self):
            pass

        def save_keyframe_trajectory_tum(self, file):
            last = next(self._reads) > 0
            Path(file).write_text("0 5 0 0 0 0 0 1\n3 7 0 0 0 0 0 1\n" if last else "0 3 0 0 0 0 0 1\n")

    named = {"NO_IMAGES_YET": "none", "NOT_INITIALIZED": "first", "RECENTLY_LOST": "recent", "LOST": "lost"}
    states = SimpleNamespace(OK="OK", OK_KLT="KLT", **named)
    module = SimpleNamespace(Slam=Slam, Sensor=SimpleNamespace(MONOCULAR=0), TrackingState=states)
    monkeypatch.setitem(sys.modules, "pyorbslam3", module)
    (tmp_path / "words.txt").write_text("10 6 0 0\n")
    monkeypatch.setenv(orbslam3.VOCABULARY, str(tmp_path / "words.txt"))
    return read


@pytest.fixture
def naps(monkeypatch) -> list[float]:
    """Seconds that ORB-SLAM3 waits for its frames; the clock stands still."""
    found: list[float] = []
    monkeypatch.setattr(orbslam3, "time", SimpleNamespace(perf_counter=lambda: 0.0, sleep=found.append))
    return found


def run_orbslam3(name: str) -> Result:
    frame = Frame(0, 0.0, np.zeros((48, 64, 3), np.uint8), Camera(60.0, 60.0, 31.5, 23.5, 64, 48))
    system = find_system(name).build(0, "cpu")
    for k in range(4):
        system.track(replace(frame, index=k, timestamp=float(k)))
    return system.finish()


def test_orbslam3_hands_its_setting_on(package, naps):
    for name, closes in (("orbslam3", True), ("orbslam3+loops=true", True), ("orbslam3+loops=false", False)):
        info = run_orbslam3(name).info
        assert package.pop() == closes and info["place_recognition"] is closes
        assert info["map_changes"] == [1.0] and info["maps_started"] == 2


def test_orbslam3_reads_its_keyframes_while_it_is_lost_and_at_the_end(package, naps):
    """The map at the end holds a keyframe of the lost one: it has taken it in."""
    result = run_orbslam3("orbslam3")
    assert result.trajectory.positions[:, 0].tolist() == [5, 7] and result.info["keyframes"] == 2
    assert [one.joined_to for one in result.segments] == [None, 0]


def test_orbslam3_is_fed_at_its_pace(package, naps):
    run_orbslam3("orbslam3")
    run_orbslam3("orbslam3+pace=0.5")
    assert naps == [0, 1, 1, 1, 0, 2, 2, 2]
    with pytest.raises(DvoError, match=r"pace.*above 0.*got 0"):
        find_system("orbslam3+pace=0").build(0, "cpu")


def test_small_pictures_are_doubled_with_their_camera():
    frame = Frame(0, 0.0, np.zeros((240, 320, 3), np.uint8), Camera(250.0, 250.0, 159.5, 119.5, 320, 240))
    pictures = Pictures()
    assert pictures(frame).shape == (480, 640)
    assert pictures.camera is not None and pictures.camera.intrinsics.tolist() == [500, 500, 319.5, 239.5]
    assert Pictures(smallest=0)(frame).shape == (240, 320)


def test_distorted_pictures_are_straightened():
    bent = Camera(250.0, 250.0, 159.5, 119.5, 320, 240, "radtan", (-0.3, 0.1, 0.0, 0.0))
    pictures = Pictures(smallest=0)
    pictures(Frame(0, 0.0, np.zeros((240, 320, 3), np.uint8), bent))
    assert pictures.camera is not None and not pictures.camera.is_distorted


def test_every_map_is_a_segment():
    rows = [Row(float(k), np.eye(4), part) for k, part in enumerate([0, 0, 2, 2, 2, 3])]
    found = result(rows, 9, {})
    assert [(len(one), one.start, one.end, one.joined_to) for one in found.segments] == [
        (2, 0, 1, None),
        (3, 2, 4, None),
        (1, 5, 5, None),
    ]
    assert found.trajectory.timestamps.tolist() == [2, 3, 4]
    assert (found.frames_tracked, found.frames_lost) == (6, 3)
    nothing = result([], 9, {})
    assert len(nothing.trajectory) == 0 and nothing.segments == () and nothing.frames_lost == 9


def test_merged_maps_share_a_world():
    rows = [Row(float(k), np.eye(4), part) for k, part in enumerate([0, 0, 1, 1, 1, 2, 2])]
    found = result(rows, 7, {}, worlds={0: 1, 1: 0, 2: 1})
    assert [one.joined_to for one in found.segments] == [None, None, 0]
    assert found.trajectory.timestamps.tolist() == [0, 1, 5, 6]
    assert [one.joined_to for one in result(rows, 7, {}, worlds={2: 0}).segments] == [None] * 3


def placed(maps: list[dict[float, float]], parts: list[int]) -> tuple[list[float], list[int], int, dict[int, int]]:
    """Place rows at 0, 1, ... seconds, all at the origin, by keyframes (stamp, x): x, part, keyframes and worlds."""
    rows = [Row(float(k), np.eye(4), part) for k, part in enumerate(parts)]
    ends = [
        Trajectory(np.array(list(one)), np.array([[x, 0, 0, 0, 0, 0, 1] for x in one.values()], float)) for one in maps
    ]
    moved, count, worlds = orbslam3.place_maps(rows, ends)
    return [row.T_wc[0, 3] for row in moved], [row.part for row in moved], count, worlds


def test_frames_follow_the_keyframes_of_their_own_map():
    assert placed([{3.0: 7.0}], [0, 0, 1, 1]) == ([0, 0, 7, 7], [0, 0, 1, 1], 1, {1: 0})
    assert placed([{1.0: 5.0}, {3.0: 7.0}], [0, 0, 1, 1]) == ([5, 5, 7, 7], [0, 0, 1, 1], 2, {0: 0, 1: 1})
    assert placed([], [0, 0]) == ([0, 0], [0, 0], 0, {})


def test_keyframes_of_a_merged_map_move_its_frames():
    """The last map has taken in the first one, whose keyframes had been read when it was lost."""
    maps = [{0.0: 3.0}, {2.0: 4.0}, {0.0: 5.0, 4.0: 7.0}]
    assert placed(maps, [0, 0, 1, 1, 2]) == ([5, 5, 4, 4, 7], [0, 0, 1, 1, 2], 3, {0: 2, 1: 1, 2: 2})


def test_frames_follow_their_keyframes():
    def at(x: float) -> np.ndarray:
        T = np.eye(4)
        T[0, 3] = x
        return T

    rows = [Row(float(k), at(k), 0) for k in range(6)]
    moved, count = orbslam3.follow_keyframes(rows, np.array([1.0, 4.0, 9.0]), np.array([at(1.5), at(3.0), at(0)]))
    assert count == 2
    assert [row.T_wc[0, 3] for row in moved] == pytest.approx([0.5, 1.5, 2.5, 3.5, 3.0, 4.0])


def test_colmap_takes_a_part_of_a_long_sequence_and_its_end(monkeypatch):
    frame = Frame(0, 0.0, np.zeros((48, 64, 3), np.uint8), Camera(60.0, 60.0, 31.5, 23.5, 64, 48))
    system = colmap.Colmap(most_images=4)
    package = MagicMock()
    package.incremental_mapping.return_value = {}
    monkeypatch.setitem(sys.modules, "pycolmap", package)
    for k in range(12):
        system.track(replace(frame, index=k, timestamp=0.1 * k))
    assert system.finish().info["stride"] == 3
    assert package.extract_features.call_args.kwargs["image_names"] == [f"{k:06d}.png" for k in (0, 3, 6, 9, 11)]


def test_colmap_of_none_and_one_frame(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    frame = Frame(0, 0.0, np.zeros((48, 64, 3), np.uint8), Camera(60.0, 60.0, 31.5, 23.5, 64, 48))
    nothing, one = colmap.Colmap(), colmap.Colmap()
    one.track(frame)
    assert all(folder.name.startswith(PART) for folder in tmp_path.iterdir()), "the next one removes them if need be"
    assert nothing.finish().frames_read == 0 and one.finish().frames_lost == 1 and not list(tmp_path.iterdir())


# The conventions (which way poses go, where pixel centres lie) show in rotation as well as in position.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed", "frames", "fps"),
    [("svo", 5004, 130, 30.0), ("orbslam3", 5005, 130, 30.0), ("colmap", 5005, 40, 15.0)],
)
def test_poses_agree_with_the_ground_truth(name, seed, frames, fps):
    reason = find_system(name).missing()
    if reason is not None:
        pytest.skip(reason)
    completeness, ate, rotation = measure(name, seed, frames, fps)
    assert completeness > 0.5 and ate < 2 and rotation < 0.3
