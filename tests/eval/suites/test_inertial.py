"""Suites with inertial samples: what a stream holds, the truth about it, its faults, and the entries of the suites."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.core.yaml_files import read_yaml
from dvo.data.inertial import NOISE_PRESETS
from dvo.geometry.poses import compose_poses, quaternion_to_matrix, so3_exp
from dvo.synth import HELD_OUT, SyntheticSequence, make_sequence
from dvo.synth.motion.natural import DEGENERATE, NATURAL_KINDS
from eval.suites.axes import Axes, read_axes
from eval.suites.inertial import FAULTS, FILE, InertialTruth, read_stream, write_exact
from eval.suites.suite import SUITES as CONFIGS
from eval.suites.suite import inertial_truth, open_sequence, read_suites

SUITES = ("inertial", "inertial_dark", "inertial_degenerate", "inertial_fast", "inertial_poisoned", "inertial_stereo")
NOWHERE = Path("there/are/no/recordings")


def table_of(group: str) -> Axes:
    file = CONFIGS / f"{group}.yaml"
    return read_axes(read_yaml(file), file)


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    return make_sequence(3, frames=100, fps=20.0, width=32, height=24, family="room", kind="hand", shake=1.0)


@pytest.fixture(scope="module")
def folder(sequence: SyntheticSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("clip")
    write_exact(place, sequence, "hand", 5.0)
    return place


def test_exact_samples_lead_from_one_end_of_the_path_to_the_other(sequence: SyntheticSequence, folder: Path) -> None:
    with np.load(folder / FILE) as arrays:
        exact = {name: arrays[name] for name in arrays.files}
    bodies = compose_poses(sequence.groundtruth.poses_wc, exact["T_camera_imu"])
    first = int(np.argmin(np.abs(exact["timestamps"])))
    last = int(np.argmin(np.abs(exact["timestamps"] - sequence.time(99))))
    rotation = quaternion_to_matrix(bodies[0, 3:])
    position, velocity = bodies[0, :3].copy(), exact["velocity_w"][0].copy()
    for k in range(first, last):  # the mean of two samples over the step between them
        step = exact["timestamps"][k + 1] - exact["timestamps"][k]
        gyro, accel = ((exact[name][k] + exact[name][k + 1]) / 2 for name in ("gyro", "accel"))
        force = rotation @ so3_exp(gyro * step / 2) @ accel + [0, 0, -9.81]
        position += velocity * step + force * step**2 / 2
        velocity += force * step
        rotation = rotation @ so3_exp(gyro * step)
    np.testing.assert_allclose(position, bodies[-1, :3], atol=2e-3)
    np.testing.assert_allclose(velocity, exact["velocity_w"][-1], atol=2e-3)
    np.testing.assert_allclose(rotation, quaternion_to_matrix(bodies[-1, 3:]), atol=1e-4)
    lever = np.linalg.norm(exact["T_camera_imu"][:3])
    assert 0.005 < lever < 0.2 and not np.allclose(np.abs(quaternion_to_matrix(exact["T_camera_imu"][3:])), np.eye(3))


def test_noise_and_offset_are_those_of_the_options(folder: Path) -> None:
    with np.load(folder / FILE) as arrays:
        exact = {name: arrays[name] for name in arrays.files}
    samples, truth = read_stream(folder, {"noise": "phone", "offset": 0.02, "seed": 5})
    np.testing.assert_allclose(samples.timestamps - exact["timestamps"], 0.02)
    assert samples.timestamps[0] < -0.2 and samples.noise == NOISE_PRESETS["phone"] and truth.offset == 0.02
    bias = np.stack([np.interp(exact["timestamps"], truth.timestamps, column) for column in truth.accel_bias.T], -1)
    inside = (exact["timestamps"] > 0) & (exact["timestamps"] < 4.9)
    white = (samples.accel - exact["accel"] - bias)[inside]
    assert white.std() == pytest.approx(NOISE_PRESETS["phone"].accel * np.sqrt(200), rel=0.1)
    assert np.abs(white.mean(0)).max() < 0.05 < np.abs(truth.accel_bias).max()
    assert np.abs(truth.gyro_bias).max() > 1e-3 and len(truth.stretches) == 0
    again, _ = read_stream(folder, {"noise": "phone", "offset": 0.02, "seed": 5})
    other, _ = read_stream(folder, {"noise": "phone", "offset": 0.02, "seed": 6})
    assert np.array_equal(samples.gyro, again.gyro) and not np.array_equal(samples.gyro, other.gyro)


def test_the_truth_is_read_as_it_was_written(folder: Path, tmp_path: Path) -> None:
    _, truth = read_stream(folder, {"offset": -0.01})
    truth.write(tmp_path / "truth.npz")
    again = InertialTruth.read(tmp_path / "truth.npz")
    assert again.offset == -0.01
    np.testing.assert_array_equal(again.velocity_w, truth.velocity_w)


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_what_they_are_called(folder: Path, fault: str) -> None:
    good, _ = read_stream(folder, {"seed": 1})
    bad, _ = read_stream(folder, {"seed": 1, "fault": fault})
    count = len(good)
    if fault == "units":
        np.testing.assert_allclose(np.linalg.norm(bad.accel.mean(0)), 1.0, atol=0.15)
        np.testing.assert_allclose(bad.gyro, np.degrees(good.gyro))
    elif fault == "axes":
        np.testing.assert_allclose(np.linalg.norm(bad.accel, axis=1), np.linalg.norm(good.accel, axis=1))
        assert np.abs(bad.accel.mean(0) - good.accel.mean(0)).max() > 1
    elif fault == "late":
        np.testing.assert_allclose(bad.timestamps - good.timestamps, 0.1)
    elif fault == "missing":
        assert 0.85 * count < len(bad) < 0.92 * count and (np.diff(bad.timestamps) > 0).all()
    elif fault == "dropped":
        gyro, accel = bad.gyro - good.gyro, bad.accel - good.accel
        assert (gyro[: int(0.4 * count)] == 0).all() and np.linalg.norm(gyro[-1]) == pytest.approx(0.2)
        assert np.linalg.norm(accel[-1]) == pytest.approx(2.0)
    else:
        assert bad.timestamps[-1] - good.timestamps[-1] == pytest.approx(0.003 * 5.55, rel=0.02)


@pytest.mark.parametrize(("option", "value"), [("noise", "gold"), ("fault", "rust"), ("offset", 3.0), ("colour", 1)])
def test_wrong_options_are_named(folder: Path, option: str, value: object) -> None:
    with pytest.raises(DvoError, match=option):
        read_stream(folder, {option: value})


def test_a_rendering_without_samples_is_told(tmp_path: Path) -> None:
    with pytest.raises(DvoError, match="no inertial samples"):
        read_stream(tmp_path, {})


@pytest.mark.long
def test_suites_share_no_scene_between_splits_and_last_long_enough() -> None:
    seeds: dict[str, set[int]] = {"validation": set(), "test": set()}
    firsts = {axis.seed for group in ("axes", "memory", "world") for axis in table_of(group).axes.values()}
    assert not firsts & {axis.seed for axis in table_of("inertial").axes.values()}
    names, count = [], 0
    for split, known in seeds.items():
        for tier in ("mini", "large"):
            for name in SUITES:
                (suite,) = read_suites(f"{name}/{split}/{tier}")
                assert suite.alignment == "se3" and suite.label.startswith(f"rendered, {split}")
                names += [one.name for one in suite.sequences]
                for one in suite.sequences:
                    options = dict(one.rendered or ())
                    assert options["frames"] / options["fps"] >= 30 and options["fps"] >= 20 and options["apart"]
                    assert options["family"] in HELD_OUT and options["kind"] in NATURAL_KINDS and one.inertial
                    known.add(options["seed"])
                    count += one.clip == ""
    assert not seeds["validation"] & seeds["test"]
    assert sum(map(len, seeds.values())) == count and len(set(names)) == len(names)


def test_suites_hold_what_their_names_say() -> None:
    suites = {name: read_suites(name)[0].sequences for name in SUITES}
    options = {name: [dict(one.rendered or ()) for one in suites[name]] for name in SUITES}
    streams = {name: [dict(one.inertial or ()) for one in suites[name]] for name in SUITES}
    assert {one["kind"] for one in options["inertial"]} == {"hand", "quadrotor"}
    assert {one["noise"] for one in streams["inertial"]} == {"euroc", "phone"}
    assert max(one["offset"] for one in streams["inertial"]) == 0.02
    assert any(one.get("rolling_shutter") for one in options["inertial"])
    assert {one["blackout"] for one in options["inertial_dark"]} == {2.0, 4.0, 8.0}
    assert {one["kind"] for one in options["inertial_degenerate"]} == set(DEGENERATE)
    assert {one["fault"] for one in streams["inertial_poisoned"]} == set(FAULTS)
    own = {one.name: one.rendering for one in suites["inertial"]}
    assert all(one.rendering == own[one.clip] for one in suites["inertial_poisoned"]), "rendered a second time"
    assert [suite.name for suite in read_suites("inertial")] == ["inertial"]


@pytest.mark.long
def test_frames_carry_the_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DVO_CACHE", str(tmp_path))
    poisoned = next(one for one in read_suites("inertial_poisoned")[0].sequences if "late" in one.name)
    small = {**dict(poisoned.rendered or ()), "width": 48, "height": 36, "frames": 12, "family": "room"}
    poisoned = replace(poisoned, rendered=tuple(small.items()))
    whole = replace(poisoned, name=poisoned.clip, clip="", inertial=(("noise", "euroc"), ("seed", 1)))
    frames, late = (list(open_sequence(one, NOWHERE, 1)[0]) for one in (whole, poisoned))
    assert len(list((tmp_path / "suites").iterdir())) == 1, "one rendering serves both"
    assert len(frames) == 12 and len(frames[0].inertial) == 0
    assert {len(frame.inertial) for frame in frames[2:]} <= {9, 10, 11}  # a sample and a frame have the same time
    assert np.linalg.norm(frames[5].inertial.accel.mean(0)) == pytest.approx(9.81, abs=4)
    gap = late[5].inertial.timestamps[-1] - frames[5].inertial.timestamps[-1]
    assert abs(gap) < 0.006, "the samples up to the time of the frame, whatever they show"
    truth = inertial_truth(whole)
    assert truth is not None and len(truth.timestamps) == 12
    assert inertial_truth(replace(whole, inertial=None)) is None
    np.testing.assert_allclose(frames[1].inertial.T_camera_imu, truth.T_camera_imu)
