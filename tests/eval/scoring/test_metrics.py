"""Metrics against closed forms, against evo's commands, and against KITTI's tool."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dvo.data.trajectory import Trajectory, read_kitti_poses, read_tum
from dvo.metrics import fit_alignment, transform
from eval.scoring.metrics import Aligned, absolute_rmse, align_pair, evo_metrics, metrics_of, path_errors
from eval.scoring.protocols import AUC_DEGREES, kitti_errors, per_frame_scale, relative_pose_auc

pytest.importorskip("evo", reason="evo is in the extra 'eval'")
MODES = ("none", "scale", "se3", "sim3")
FLAGS = {"none": [], "scale": ["-s"], "se3": ["-a"], "sim3": ["-a", "-s"]}


def curve(count: int = 120, rate: float = 20.0) -> Trajectory:
    """A winding walk that turns."""
    s = np.linspace(0, 6, count)
    positions = np.column_stack([3 * np.sin(s), 0.3 * np.sin(3 * s), 2 * s])
    quaternions = Rotation.from_euler("yxz", np.column_stack([0.5 * s, 0.1 * np.sin(s), 0.1 * s])).as_quat()
    return Trajectory(np.arange(count) / rate, np.column_stack([positions, quaternions]))


def aligned(estimate: Trajectory, truth: Trajectory, mode, gap: int = 1) -> Aligned:
    pair = align_pair(estimate, truth, mode, rpe_gap=gap)
    assert isinstance(pair, Aligned)
    return pair


def angle(estimate: Trajectory, truth: Trajectory, mode) -> float:
    return absolute_rmse(aligned(estimate, truth, mode), angle=True)


def yaw(degrees: np.ndarray) -> np.ndarray:
    """``(N, 4)`` quaternions."""
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * [0, 1, 0]).as_quat()


def straight(count: int, step: float = 1.0) -> Trajectory:
    """Along z, a step a frame, with a small sideways wave so that an alignment is fixed."""
    poses = np.zeros((count, 7))
    poses[:, 2], poses[:, 6] = step * np.arange(count), 1
    poses[:, 0] = 0.01 * np.sin(np.arange(count) / 7)
    return Trajectory(np.arange(count, dtype=float), poses)


# --- closed forms -----------------------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(
    st.floats(0.05, 20),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-50, 50)] * 3),
)
def test_known_sim3_is_undone(scale, rotvec, shift):
    truth = curve(40)
    estimate = transform(truth, scale, Rotation.from_rotvec(rotvec).as_matrix(), np.array(shift))
    metrics = evo_metrics(estimate, truth, "sim3")
    assert metrics.ate_rmse < 1e-7 and metrics.scale == pytest.approx(1 / scale)
    assert angle(estimate, truth, "sim3") < 1e-4
    assert per_frame_scale(estimate, truth).path_length == pytest.approx(truth.path_length)
    assert relative_pose_auc(estimate, truth)[1.0] == pytest.approx(1, abs=1e-4)


def test_known_shift_without_alignment():
    truth = curve()
    moved = transform(truth, 1.0, np.eye(3), np.array([3.0, 4.0, 0.0]))
    assert evo_metrics(moved, truth, "none").ate_rmse == pytest.approx(5)
    assert evo_metrics(moved, truth, "se3").ate_rmse == pytest.approx(0, abs=1e-9)
    assert angle(moved, truth, "none") == pytest.approx(0, abs=1e-5)


def test_known_turn_shows_in_the_rotation_error():
    truth = curve()
    tilt = Rotation.from_rotvec([0, np.radians(7), 0])
    poses = truth.poses_wc.copy()
    poses[:, 3:] = (Rotation.from_quat(poses[:, 3:]) * tilt).as_quat()  # the camera looks aside by seven degrees
    aside = Trajectory(truth.timestamps, poses)
    assert angle(aside, truth, "sim3") == pytest.approx(7)
    assert evo_metrics(aside, truth, "sim3").ate_rmse < 1e-9


def test_known_drift_over_distance():
    """A scale that is ten percent off without scale alignment is ten percent of any distance."""
    truth = straight(301)
    longer = transform(truth, 1.1, np.eye(3), np.zeros(3))
    errors = path_errors(aligned(longer, truth, "none"))
    assert errors.distance_m == pytest.approx(30, abs=0.01)
    assert errors.trans_percent == pytest.approx(10, abs=0.01) and errors.rot_deg == pytest.approx(0, abs=1e-6)
    assert path_errors(aligned(longer, truth, "sim3")).trans_percent == pytest.approx(0, abs=1e-6)
    assert path_errors(aligned(longer, truth, "none"), distance_m=17.0).trans_percent == pytest.approx(10, abs=0.01)
    assert np.isnan(path_errors(aligned(longer, truth, "none"), distance_m=5000.0).trans_percent)


def test_known_drift_over_kitti_segments():
    truth = straight(1201)
    longer = transform(truth, 1.03, np.eye(3), np.zeros(3))
    errors = kitti_errors(longer, truth)
    # The path is a little longer than the way along z: 100 m of it end at frame 100, and 3 % of them are missed.
    assert errors.t_rel == pytest.approx(3, abs=1e-3) and errors.r_rel == pytest.approx(0, abs=1e-4)
    assert errors.longest_m == 800
    assert kitti_errors(longer, truth, scale=1 / 1.03).t_rel == pytest.approx(0, abs=1e-9)


def test_known_turning_over_kitti_segments():
    """A yaw drift of 0.02 degrees a metre is 2 degrees per 100 m, for every length."""
    truth = straight(401)
    poses = truth.poses_wc.copy()
    poses[:, 3:] = yaw(0.02 * np.arange(401))
    errors = kitti_errors(Trajectory(truth.timestamps, poses), truth)
    assert errors.r_rel == pytest.approx(2, rel=1e-3) and errors.longest_m == 400


def test_short_paths_have_no_kitti_errors():
    errors = kitti_errors(straight(90), straight(90))
    assert np.isnan(errors.t_rel) and np.isnan(errors.r_rel) and np.isnan(errors.longest_m)


def test_known_angle_in_the_relative_pose_auc():
    """A camera that takes a step of yaw too much in every pair: rotation and direction are off by known angles."""
    truth = straight(60)
    poses = truth.poses_wc.copy()
    poses[:, 3:] = yaw(4.0 * np.arange(60))
    auc = relative_pose_auc(Trajectory(truth.timestamps, poses), truth)
    # Direction in the first camera of pair i is off by 4 i degrees (modulo a turn), rotation by 4: only the first few.
    errors = np.maximum(4, [abs((4 * i + 180) % 360 - 180) for i in range(59)])
    for limit in AUC_DEGREES:
        assert auc[limit] == pytest.approx(np.maximum(0, 1 - errors / limit).mean(), abs=2e-3)


def test_missing_poses_and_standing_still_in_the_relative_pose_auc():
    truth = straight(41)
    half = Trajectory(truth.timestamps[:21], truth.poses_wc[:21])
    assert relative_pose_auc(half, truth)[10.0] == pytest.approx(0.5)
    still = Trajectory(truth.timestamps, np.tile([0, 0, 0, 0, 0, 0, 1.0], (41, 1)))
    assert relative_pose_auc(still, still)[1.0] == 1  # no motion, no direction
    assert relative_pose_auc(still, truth)[10.0] == 0  # 90 degrees where there is one to find
    assert np.isnan(relative_pose_auc(truth, still, gap=50)[5.0])


def test_per_frame_scale_forgives_scale_drift_alone():
    truth = curve(60)
    growing = np.exp(np.linspace(0, 2, 59))[:, None] * np.diff(truth.positions, axis=0)
    positions = np.concatenate([truth.positions[:1], truth.positions[0] + np.cumsum(growing, axis=0)])
    drifting = Trajectory(truth.timestamps, np.column_stack([positions, truth.poses_wc[:, 3:]]))
    again = per_frame_scale(drifting, truth)
    assert evo_metrics(drifting, truth, "sim3").ate_rmse > 0.3
    assert evo_metrics(again, truth, "sim3").ate_rmse < 1e-6
    assert np.allclose(again.poses_wc[:, 3:], truth.poses_wc[:, 3:])


# --- blackouts --------------------------------------------------------------------------------------------------------


# --- oracles ----------------------------------------------------------------------------------------------------------


RUNNER = """
import json, sys
from importlib.metadata import entry_points
for name, arguments in json.load(open(sys.argv[1])):
    sys.argv = ["evo_" + name, *arguments]
    (program,) = entry_points(group="console_scripts", name="evo_" + name)
    assert not program.load()()
"""


def evo_commands(calls: list[tuple[str, list[str]]], folder: Path) -> list[dict[str, float]]:
    """Statistics that the programs ``evo_ape`` and ``evo_rpe`` store for each list of arguments.

    The programs run in a process of their own, one after the other, so that their imports are paid for once.
    """
    calls = [(name, [*args, "--save_results", str(folder / f"{i}.zip")]) for i, (name, args) in enumerate(calls)]
    (folder / "calls.json").write_text(json.dumps(calls))
    done = subprocess.run(
        [sys.executable, "-c", RUNNER, str(folder / "calls.json")],
        env={**os.environ, "HOME": str(folder)},  # evo keeps settings there
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr + done.stdout
    found = []
    for i in range(len(calls)):
        with zipfile.ZipFile(folder / f"{i}.zip") as archive:
            found.append(json.loads(archive.read("stats.json")))
    return found


@pytest.fixture(scope="module")
def trajectories(data_root) -> Path:
    folder = data_root / "trajectories"
    if not folder.is_dir():
        pytest.skip(f"no trajectories at {folder}")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt"),
        ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-ORB_kf_mono.txt"),
        pytest.param(("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam_drift.txt"), marks=pytest.mark.slow),
        pytest.param(("fr2_desk_groundtruth.txt", "fr2_desk_ORB.txt"), marks=pytest.mark.slow),
    ],
)
def test_agrees_with_evos_commands(trajectories, tmp_path, names):
    """Every alignment: ATE, its angle, RPE over frames (both parts) and over a distance, to 1e-6."""
    files = [str(trajectories / "evo" / name) for name in names]
    truth, track = read_tum(files[0]), read_tum(files[1])
    frames = ["--delta", "3", "--delta_unit", "f", "--all_pairs"]
    metres = ["--delta", "0.5", "--delta_unit", "m", "--all_pairs", "--pairs_from_reference"]
    calls = []
    for mode in MODES:
        both = ["tum", *files, *FLAGS[mode]]
        calls += [("ape", both), ("ape", [*both, "-r", "angle_deg"])]
        calls += [("rpe", [*both, *frames]), ("rpe", [*both, *frames, "-r", "angle_deg"]), ("rpe", [*both, *metres])]
    stats = iter(evo_commands(calls, tmp_path))
    for mode in MODES:
        pair = aligned(track, truth, mode, gap=3)
        metrics = metrics_of(pair)
        assert metrics.ate_rmse == pytest.approx(next(stats)["rmse"], abs=1e-6)
        assert absolute_rmse(pair, angle=True) == pytest.approx(next(stats)["rmse"], abs=1e-6)
        rpe = next(stats)
        assert metrics.rpe_trans == pytest.approx(rpe["median"], abs=1e-6)
        assert metrics.rpe_trans_rmse == pytest.approx(rpe["rmse"], abs=1e-6)
        rpe = next(stats)
        assert metrics.rpe_rot_deg == pytest.approx(rpe["median"], abs=1e-6)
        assert metrics.rpe_rot_deg_rmse == pytest.approx(rpe["rmse"], abs=1e-6)
        assert path_errors(pair, distance_m=0.5).trans_percent / 200 == pytest.approx(next(stats)["median"], abs=1e-6)


@pytest.mark.slow
def test_agrees_with_stored_values_of_evo(trajectories):
    """Six pairs, three alignments, from evo as a library (KITTI files have no times: frames in turn)."""
    stored = json.loads((trajectories / "expected_metrics_evo.json").read_text())
    checked = 0
    for case in stored["cases"]:
        mode = {(False, False): "none", (True, False): "se3", (True, True): "sim3"}[
            case["align"], case["correct_scale"]
        ]
        pair = [trajectories / "evo" / name.strip() for name in case["name"].split(" vs ")]
        if "KITTI" in case["name"]:
            truth, track = (_numbered(read_kitti_poses(file)) for file in pair)
        else:
            truth, track = (read_tum(file) for file in pair)
        pair = aligned(track, truth, mode, gap=10)
        metrics = metrics_of(pair)
        assert metrics.matched == case["n_pairs"]
        assert metrics.ate_rmse == pytest.approx(case["ape_trans"]["rmse"], abs=1e-6)
        assert metrics.rpe_trans == pytest.approx(case["rpe_trans_delta10frames_allpairs"]["median"], abs=1e-6)
        assert metrics.rpe_rot_deg == pytest.approx(case["rpe_rot_deg_delta10frames_allpairs"]["median"], abs=1e-6)
        assert absolute_rmse(pair, angle=True) == pytest.approx(case["ape_rot_deg"]["rmse"], abs=1e-6)
        checked += 1
    assert checked == 18


def _numbered(poses: np.ndarray) -> Trajectory:
    return Trajectory(np.arange(len(poses), dtype=float), poses)


def _rows(path: Path) -> Trajectory:
    """``[number] 3x4`` rows."""
    table = np.loadtxt(path)
    numbers = table[:, 0] if table.shape[1] == 13 else np.arange(len(table), dtype=float)
    matrices = np.tile(np.eye(4), (len(table), 1, 1))
    matrices[:, :3] = table[:, -12:].reshape(-1, 3, 4)
    quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    return Trajectory(numbers, np.column_stack([matrices[:, :3, 3], quaternions]))


@pytest.mark.parametrize("sequence", ["09", "10"])
@pytest.mark.parametrize("example", ["example_0", "example_1"])
def test_agrees_with_kittis_tool(trajectories, example, sequence):
    """t_rel and r_rel of kitti-odom-eval, unaligned and after Sim(3), to the digits that its text files leave."""
    stored = json.loads((trajectories / "expected_metrics_kitti_odom_eval.json").read_text())
    folder = trajectories / "kitti_odom_eval"
    truth, track = _rows(folder / "gt" / f"{sequence}.txt"), _rows(folder / example / f"{sequence}.txt")
    rows = np.searchsorted(truth.timestamps, track.timestamps)
    for mode, name in (("none", "None"), ("sim3", "7dof")):
        expected = stored[f"{example}|{name}"][sequence]
        scale = 1.0 if mode == "none" else fit_alignment(track.positions, truth.positions[rows], "sim3")[0]
        found = kitti_errors(track, truth, scale)
        assert found.t_rel == pytest.approx(expected["trans_err_percent"], rel=1e-4)
        assert found.r_rel == pytest.approx(expected["rot_err_deg_per_100m"], rel=1e-4)


def test_line_is_scored_although_evo_refuses_to_align_it():
    path = np.column_stack([np.sin(np.arange(30) / 5), np.zeros(30), np.arange(30) / 5, np.zeros((30, 3)), np.ones(30)])
    line = path.copy()
    line[:, 0] = 0
    stamps = np.arange(30.0)
    metrics = evo_metrics(Trajectory(stamps, line), Trajectory(stamps, path), "sim3")
    assert 0 < metrics.ate_rmse < 1 and metrics.reason is None
