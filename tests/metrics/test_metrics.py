"""dvo.metrics against closed forms, and against evo on real trajectories."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory, read_tum
from dvo.metrics import Alignment, align_trajectory, associate, evaluate, transform


def walk(seed: int = 0, count: int = 40) -> Trajectory:
    """A smooth random camera path, 10 Hz."""
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(0.1, 0.2, (count, 3)), axis=0)
    rotations = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.1, (count, 3)), axis=0))
    return Trajectory(np.arange(count) / 10, np.column_stack([positions, rotations.as_quat()]))


def moved(trajectory: Trajectory, scale: float, rotvec: np.ndarray, translation: np.ndarray) -> Trajectory:
    return transform(trajectory, scale, Rotation.from_rotvec(rotvec).as_matrix(), translation)


vectors = st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3).map(np.array)


@settings(max_examples=40, deadline=None)
@given(scale=st.floats(0.05, 20), rotvec=vectors, translation=vectors, seed=st.integers(0, 99))
def test_sim3_of_the_reference_has_no_error(scale, rotvec, translation, seed):
    reference = walk(seed)
    metrics = evaluate(moved(reference, scale, rotvec, translation), reference, "sim3", rpe_gap=3)
    assert metrics.scale == pytest.approx(1 / scale, rel=1e-9)
    assert metrics.ate_rmse < 1e-8 and metrics.rpe_trans_rmse < 1e-8 and metrics.rpe_rot_deg_rmse < 1e-5
    assert abs(metrics.scale_drift) < 1e-9
    assert metrics.completeness == 1 and metrics.reason is None


@settings(max_examples=20, deadline=None)
@given(rotvec=vectors, translation=vectors)
def test_transform_agrees_with_scipy(rotvec, translation):
    reference = walk()
    result = moved(reference, 2.0, rotvec, translation)
    rotation = Rotation.from_rotvec(rotvec)
    np.testing.assert_allclose(result.positions, 2 * rotation.apply(reference.positions) + translation, atol=1e-12)
    expected = rotation * Rotation.from_quat(reference.poses_wc[:, 3:])
    assert (expected.inv() * Rotation.from_quat(result.poses_wc[:, 3:])).magnitude().max() < 1e-7


def test_each_alignment_removes_only_what_it_fits():
    reference = walk()
    estimate = moved(reference, 0.5, np.array([0.0, 0.0, 0.3]), np.array([1.0, 2.0, 3.0]))
    ate = {mode: evaluate(estimate, reference, mode).ate_rmse for mode in ("none", "scale", "se3", "sim3")}
    assert ate["sim3"] < 1e-9 < ate["se3"] < ate["none"]
    assert ate["none"] == pytest.approx(
        np.sqrt(((estimate.positions - reference.positions) ** 2).sum(axis=1).mean()), rel=1e-12
    )
    assert ate["scale"] == pytest.approx(
        np.sqrt(((2 * estimate.positions - reference.positions) ** 2).sum(axis=1).mean()), rel=1e-9
    )
    assert evaluate(estimate, reference, "se3").scale == 1


def test_known_errors():
    """A path along x, 0.1 m a frame, 1 degree a frame; the estimate turns 10 % too much and sways by 5 mm."""
    count = 31
    x = np.column_stack([0.1 * np.arange(count), np.zeros((count, 2))])
    sway = np.zeros((count, 3))
    sway[:, 1] = 0.005 * np.where(np.arange(count) % 2, 1, -1)
    sway[-1] = 0
    turn = [Rotation.from_rotvec(np.outer(np.arange(count), [0, 0, math.radians(d)])).as_quat() for d in (1.0, 1.1)]
    times = np.arange(count) / 30
    metrics = evaluate(
        Trajectory(times, np.column_stack([x + sway, turn[1]])),
        Trajectory(times, np.column_stack([x, turn[0]])),
        "none",
        rpe_gap=2,
    )
    assert metrics.path_length == pytest.approx(3.0)
    assert metrics.ate_rmse == pytest.approx(0.005 * math.sqrt(30 / 31))
    assert metrics.ate_percent == pytest.approx(metrics.ate_rmse / 3 * 100)
    assert metrics.rpe_rot_deg == pytest.approx(0.2) and metrics.rpe_rot_deg_rmse == pytest.approx(0.2)
    assert metrics.rotation_error_ratio == pytest.approx(0.1)


def test_scale_drift_is_the_ratio_of_the_ends():
    reference = walk(count=90)
    steps = np.diff(reference.positions, axis=0, prepend=reference.positions[:1])
    factor = np.ones((90, 1))
    factor[45:] = 0.8
    poses = reference.poses_wc.copy()
    poses[:, :3] = np.cumsum(steps * factor, axis=0)
    drift = evaluate(Trajectory(reference.timestamps, poses), reference).scale_drift
    assert drift == pytest.approx(1 / 0.8 - 1, rel=1e-9)


def test_association_is_one_to_one_and_by_time():
    reference = walk()
    poses = reference.poses_wc[[3, 10, 10, 20, 25]]
    estimate = Trajectory(np.array([0.304, 1.003, 1.001, 2.02, 2.5]), poses)
    i, j = associate(estimate, reference, max_dt=0.01)
    assert i.tolist() == [0, 2, 4] and j.tolist() == [3, 10, 25]
    back = associate(reference, estimate, max_dt=0.01)
    assert back[0].tolist() == j.tolist() and back[1].tolist() == i.tolist()


def test_missing_frames_lower_completeness_not_accuracy():
    reference = walk()
    metrics = evaluate(Trajectory(reference.timestamps[5:25], reference.poses_wc[5:25]), reference)
    assert metrics.matched == 20 and metrics.completeness == 0.5 and metrics.ate_rmse < 1e-9


def still(count: int = 10) -> Trajectory:
    poses = np.tile([0.3, -1.0, 2.0, 0, 0, 0, 1.0], (count, 1))
    return Trajectory(np.arange(count) / 10, poses)


@pytest.mark.parametrize(
    ("estimate", "reference", "words"),
    [
        (Trajectory(np.zeros(0), np.zeros((0, 7))), walk(), "0 matched"),
        (walk(), Trajectory(np.zeros(0), np.zeros((0, 7))), "0 matched"),
        (Trajectory(walk().timestamps[:2], walk().poses_wc[:2]), walk(), "2 matched"),
        (Trajectory(walk().timestamps + 100, walk().poses_wc), walk(), "0 matched"),
        (still(), walk(), "estimate stands still"),
        (walk(), still(), "reference stands still"),
    ],
)
@pytest.mark.parametrize("align", ["scale", "se3", "sim3"])
def test_degenerate_inputs_give_nan_and_a_reason(estimate, reference, words, align):
    metrics = evaluate(estimate, reference, align)
    assert math.isnan(metrics.ate_rmse) and math.isnan(metrics.ate_percent)
    assert metrics.reason is not None and words in metrics.reason


def test_not_finite_poses_are_left_out_and_named():
    poses = walk().poses_wc.copy()
    poses[7, 1] = np.nan
    metrics = evaluate(Trajectory(walk().timestamps, poses), walk())
    assert metrics.matched == 39 and metrics.ate_rmse < 1e-9
    assert metrics.reason is not None and "1 poses are not finite" in metrics.reason


def test_rotation_of_a_still_camera_is_still_judged():
    metrics = evaluate(still(), still(), "sim3")
    assert metrics.rpe_rot_deg == 0 and math.isnan(metrics.rpe_trans)


def test_straight_line_can_be_aligned():
    """The null system: positions on one line leave the turn about it open, the error not."""
    reference = walk()
    line = np.column_stack([np.zeros((40, 2)), np.arange(40.0), np.zeros((40, 3)), np.ones(40)])
    metrics = evaluate(Trajectory(reference.timestamps, line), reference)
    assert 0 < metrics.ate_rmse < math.inf and metrics.reason is None
    assert metrics.rotation_error_ratio == pytest.approx(1)


def test_bad_options_are_errors():
    with pytest.raises(DvoError, match="sim4"):
        evaluate(walk(), walk(), "sim4")  # type: ignore[arg-type]
    with pytest.raises(DvoError, match="rpe_gap"):
        evaluate(walk(), walk(), rpe_gap=0)


def test_aligned_trajectory_lies_on_the_reference():
    reference = walk()
    result = align_trajectory(moved(reference, 3, np.array([0.1, 0.2, 0.3]), np.ones(3)), reference)
    np.testing.assert_allclose(result.positions, reference.positions, atol=1e-9)


# --- evo as oracle ---------------------------------------------------------------------------------------------------

ALIGNMENTS = {(False, False): "none", (True, False): "se3", (True, True): "sim3"}


def read_kitti(path: Path) -> Trajectory:
    matrices = np.loadtxt(path).reshape(-1, 3, 4)
    quaternions = Rotation.from_matrix(matrices[:, :, :3]).as_quat()
    return Trajectory(np.arange(len(matrices), dtype=float), np.column_stack([matrices[:, :, 3], quaternions]))


@pytest.mark.long
@pytest.mark.parametrize("index", range(18))
def test_agrees_with_the_stored_values_of_evo(data_root: Path, index: int):
    folder = data_root / "trajectories"
    case = json.loads((folder / "expected_metrics_evo.json").read_text())["cases"][index]
    read = read_kitti if case["name"].startswith("KITTI") else read_tum
    reference, estimate = (read(folder / "evo" / name) for name in case["name"].split(" vs "))
    alignment = ALIGNMENTS[case["align"], case["correct_scale"]]
    one, ten = (evaluate(estimate, reference, alignment, rpe_gap=gap) for gap in (1, 10))
    assert one.matched == case["n_pairs"]
    assert one.scale == pytest.approx(case.get("scale", 1.0), abs=1e-6)
    assert one.ate_rmse == pytest.approx(case["ape_trans"]["rmse"], abs=1e-6)
    for metrics, key in ((one, "delta1frames"), (ten, "delta10frames_allpairs")):
        trans, rot = case[f"rpe_trans_{key}"], case[f"rpe_rot_deg_{key}"]
        assert metrics.rpe_trans_rmse == pytest.approx(trans["rmse"], abs=1e-6)
        assert metrics.rpe_trans == pytest.approx(trans["median"], abs=1e-6)
        assert metrics.rpe_rot_deg_rmse == pytest.approx(rot["rmse"], abs=1e-6)
        assert metrics.rpe_rot_deg == pytest.approx(rot["median"], abs=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("name", ["rgbdslam", "ORB_kf_mono"])
@pytest.mark.parametrize("align", ["none", "scale", "se3", "sim3"])
def test_agrees_with_evo_run_now(data_root: Path, name: str, align: Alignment):
    pytest.importorskip("evo", reason="evo is in the extra 'eval'")
    from eval.scoring.metrics import evo_metrics

    folder = data_root / "trajectories/evo"
    estimate = read_tum(folder / f"freiburg1_xyz-{name}.txt")
    reference = read_tum(folder / "freiburg1_xyz-groundtruth.txt")
    ours, theirs = (judge(estimate, reference, align, rpe_gap=2) for judge in (evaluate, evo_metrics))
    for field in ("ate_rmse", "ate_percent", "rpe_trans", "rpe_rot_deg", "scale", "path_length"):
        assert getattr(ours, field) == pytest.approx(getattr(theirs, field), abs=1e-6), field
