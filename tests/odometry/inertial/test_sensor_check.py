"""Faults of inertial samples, each of which the check names."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.geometry.poses import invert_poses, rotation_vector, so3_exp, split
from dvo.odometry.inertial.findings import Level, SensorReport
from dvo.odometry.inertial.sensor_check import check_sensor
from dvo.odometry.inertial.vision_checks import clock_line
from tests.support.hand_motion import CAMERA_IMU, frames, hand_motion, samples
from tests.support.visual_inertial import record

SECONDS = 16.0
HARMLESS = {"no rest"}


@cache
def good() -> tuple[InertialSamples, np.ndarray, np.ndarray]:
    path = hand_motion(21)
    imu = samples(path, SECONDS, rate=100.0, noise=NOISE_PRESETS["euroc"], seed=21)
    return imu, *frames(path, SECONDS, rate=20.0, seed=21)


def checked(**changes: np.ndarray | None) -> SensorReport:
    imu, times, rotations = good()
    return check_sensor(replace(imu, **changes), times, rotations)


def names(report: SensorReport) -> set[str]:
    return {finding.name for finding in report.findings} - HARMLESS


def test_good_samples_have_no_findings() -> None:
    report = checked()
    assert names(report) == set() and report.is_usable
    assert report.values["rate, Hz"] == pytest.approx(100)
    assert abs(report.values["time offset, ms"]) < 1
    assert report.values["from the stated rotation, degrees"] < 0.3
    assert report.values["gravity against vision, m/s^2"] == pytest.approx(9.81, abs=0.3)
    assert abs(report.values["clock drift, ppm"]) < 200


@pytest.mark.long
@pytest.mark.parametrize("is_seen", [True, False])
def test_wrong_units(is_seen: bool) -> None:
    imu, times, rotations = good()
    seen = (times, rotations) if is_seen else ()
    in_g = check_sensor(replace(imu, accel=imu.accel / 9.80665), *seen)
    finding = in_g.named("accelerometer unit")
    assert finding is not None and "in g" in finding.text and "9.80665" in finding.remedy and not in_g.is_usable
    in_degrees = check_sensor(replace(imu, gyro=np.degrees(imu.gyro)), *seen)
    finding = in_degrees.named("gyroscope unit")
    assert finding is not None and "deg/s" in finding.text and not in_degrees.is_usable
    if is_seen:  # the rest is checked in the right units
        assert abs(in_degrees.values["time offset, ms"]) < 1 and names(in_degrees) == {"gyroscope unit"}
    without = check_sensor(replace(imu, accel=imu.accel - imu.accel.mean(0)), *seen)
    assert without.named("no gravity") is not None and not without.is_usable


def test_gyroscope_in_degrees_is_seen_without_gravity() -> None:
    imu = good()[0]
    report = checked(gyro=np.degrees(imu.gyro), accel=np.zeros_like(imu.accel) + 9.8)
    assert "gyroscope unit" in names(report)


@pytest.mark.parametrize(
    ("order", "signs", "words"),
    [
        ((1, 2, 0), (1, 1, 1), "(z, x, y)"),
        ((0, 1, 2), (-1, -1, 1), "(-x, -y, z)"),
        ((1, 0, 2), (1, 1, 1), "(y, x, z)"),
        ((0, 1, 2), (1, 1, -1), "(x, y, -z)"),
    ],
)
def test_swapped_and_mirrored_axes(order: tuple[int, ...], signs: tuple[int, ...], words: str) -> None:
    imu = good()[0]
    finding = checked(gyro=imu.gyro[:, order] * signs, accel=imu.accel[:, order] * signs).named("axes")
    assert finding is not None and finding.level == Level.UNUSABLE and words in finding.remedy


def test_axes_of_one_sensor_alone() -> None:
    imu = good()[0]
    report = checked(accel=imu.accel[:, [1, 2, 0]])
    finding = report.named("accelerometer axes")
    assert finding is not None and "(z, x, y)" in finding.remedy and names(report) == {"accelerometer axes"}


@pytest.mark.parametrize("is_stated", [True, False])
@pytest.mark.parametrize("options", [{}, {"grade": "phone", "walk": 2e-3}, {"reach": 0.025}], ids=["", "phone", "slow"])
def test_all_three_signs_of_the_accelerometer(options: dict[str, object], is_stated: bool) -> None:
    seen = record(7, seconds=16.0, **options)  # type: ignore[arg-type]
    samples = seen.samples if is_stated else replace(seen.samples, T_camera_imu=None)
    right = check_sensor(samples, seen.times, seen.rotation, seen.position)
    assert right.named("accelerometer axes") is None and right.values["correlation of accelerations"] > 0.5
    wrong = replace(samples, accel=-samples.accel)
    report = check_sensor(wrong, seen.times, seen.rotation, seen.position)
    finding = report.named("accelerometer axes")
    assert finding is not None and "(-x, -y, -z)" in finding.remedy and not report.is_usable
    assert check_sensor(wrong, seen.times, seen.rotation).named("accelerometer axes") is None, "places tell it"


@pytest.mark.long
def test_extrinsics_inverse_off_and_missing() -> None:
    T = good()[0].T_camera_imu
    assert T is not None
    inverse = checked(T_camera_imu=invert_poses(T)).named("axes")
    assert inverse is not None and "inverse" in inverse.remedy
    tilted = T.copy()
    tilted[3:] = checked(T_camera_imu=None).values["rotation imu to camera, qx qy qz qw"]
    assert names(checked(T_camera_imu=tilted)) == set()
    missing = checked(T_camera_imu=None)
    finding = missing.named("no extrinsics")
    assert finding is not None and "T_camera_imu: [" in finding.remedy and missing.is_usable


@pytest.mark.long
@pytest.mark.parametrize("offset", [0.1, -0.1, 0.02, 1.3])
def test_constant_time_offset(offset: float) -> None:
    report = checked(timestamps=good()[0].timestamps + offset)
    finding = report.named("time offset")
    assert finding is not None and names(report) == {"time offset"}
    assert report.alignment is not None and report.alignment.time_offset == pytest.approx(offset, abs=1e-3)
    assert f"time_offset: {report.alignment.time_offset:.4f}" in finding.remedy
    assert report.is_usable == (abs(offset) < 0.05)


@pytest.mark.long
@pytest.mark.parametrize("drift", [5e-4, -3e-3, 1e-2])
def test_clock_that_drifts(drift: float) -> None:
    report = checked(timestamps=good()[0].timestamps * (1 + drift))
    finding = report.named("clock drift")
    assert finding is not None and report.is_usable == (abs(drift) < 1e-3)
    assert report.values["clock drift, ppm"] == pytest.approx(1e6 * drift, abs=150)
    assert names(report) <= {"clock drift", "time offset"}


def test_missing_samples_and_gaps() -> None:
    imu = good()[0]
    there = np.random.default_rng(0).random(len(imu)) > 0.1
    report = check_sensor(
        replace(imu, timestamps=imu.timestamps[there], gyro=imu.gyro[there], accel=imu.accel[there]), *good()[1:]
    )
    assert report.values["missing share"] == pytest.approx(0.1, abs=0.02)
    assert names(report) == {"missing samples"} and report.is_usable
    there = (imu.timestamps < 8) | (imu.timestamps > 8.4)
    report = check_sensor(replace(imu, timestamps=imu.timestamps[there], gyro=imu.gyro[there], accel=imu.accel[there]))
    assert report.values["gaps"] == 1 and report.values["longest gap, s"] == pytest.approx(0.4, abs=0.02)
    assert "gaps" in names(report)


def test_bias_of_a_dropped_sensor() -> None:
    imu = good()[0]
    report = checked(gyro=imu.gyro + np.array([0.3, -0.3, 0.1]), accel=imu.accel + np.array([0.0, 1.5, -1.5]))
    assert names(report) == {"gyroscope bias", "accelerometer bias"} and not report.is_usable
    assert np.allclose(report.values["accelerometer bias, m/s^2"], [0, 1.5, -1.5], atol=0.5)


def moving(
    seed: int, twist: tuple[float, ...], grade: str = "euroc"
) -> tuple[InertialSamples, np.ndarray, np.ndarray, np.ndarray]:
    """Samples, and what a camera that shakes about a constant twist sees in a unit of its own."""
    path = replace(hand_motion(seed, (0.15, 0.15, 0.15)), twist=np.array(twist))
    imu = samples(path, 20.0, rate=100.0, noise=replace(NOISE_PRESETS[grade], accel_bias=0.05), seed=seed)
    times, rotations = frames(path, 20.0, rate=20.0, seed=seed)
    return imu, times, rotations, 2.5 * split(path.poses_wc(times))[1]


@pytest.mark.parametrize(
    ("twist", "grade"),
    [((0, 0, 1.2, 0, 0.8, 0), "euroc"), ((0, 0, 1.2, 0, 0.8, 0), "phone"), ((-0.9, 0, 0, 0, 0.9, 0), "phone")],
    ids=["circle", "circle, phone", "arm"],
)
def test_motion_is_no_bias_of_the_accelerometer(twist: tuple[float, ...], grade: str) -> None:
    """A camera on a circle feels a force that turns with it, as a bias does."""
    imu, *seen = moving(25, twist, grade)
    for views in (seen, seen[:2]):
        assert check_sensor(imu, *views).named("accelerometer bias") is None
    bias = np.array([0.3, -0.4, 0.35])
    for factor, level in ((1, Level.WARNING), (4, Level.UNUSABLE)):
        report = check_sensor(replace(imu, accel=imu.accel + factor * bias), *seen)
        finding = report.named("accelerometer bias")
        assert finding is not None and finding.level == level
        assert np.allclose(report.values["accelerometer bias, m/s^2"], factor * bias, atol=0.3)


@pytest.mark.parametrize("grade", ["euroc", "phone"])
@pytest.mark.parametrize(("seconds", "options"), [(12.0, {}), (24.0, {"drift": 0.02, "walk": 2e-3})])
def test_small_bias_in_the_motion_of_a_hand(grade: str, seconds: float, options: dict[str, float]) -> None:
    seen = record(3, seconds=seconds, grade=grade, **options)  # type: ignore[arg-type]
    views = seen.times, seen.rotation, seen.position
    right = check_sensor(seen.samples, *views)
    assert right.named("accelerometer bias") is None
    own = np.array(right.values["accelerometer bias, m/s^2"])
    for bias in np.array([[0.0, 0.6, 0.0], [-1.5, 0.0, 2.0]]) - own:
        report = check_sensor(replace(seen.samples, accel=seen.samples.accel + bias), *views)
        finding = report.named("accelerometer bias")
        assert finding is not None and report.is_usable == (np.linalg.norm(bias + own) < 2)


def test_graver_finding_of_one_name_is_told() -> None:
    """At rest gravity tells a part of a bias, motion the whole of it."""
    seen = record(1, still=6.0, turning=False, seconds=20.0)
    bias = np.linalg.norm(seen.samples.accel[:600].mean(0)) * np.array([0.25, 0.1, 0.0])
    report = check_sensor(
        replace(seen.samples, accel=seen.samples.accel + bias), seen.times, seen.rotation, seen.position
    )  # fmt: skip
    finding = report.named("accelerometer bias")
    assert finding is not None and "against vision" in finding.text and not report.is_usable


def test_a_lift_that_sets_out_is_no_bias() -> None:
    """For a second and a half its acceleration is as steady as rest."""
    rng, times = np.random.default_rng(0), np.arange(1200) / 100
    sets_out = (times > 4) & (times < 5.5)
    shaken = np.where(sets_out, 0.0, 0.2 * np.sin(30 * times))
    accel = rng.normal(0, 0.02, (1200, 3)) + np.array([0, 0, 9.81]) + np.outer(sets_out, [0, 0, 1.0])
    report = check_sensor(InertialSamples(times, rng.normal(0, 1e-3, (1200, 3)) + shaken[:, None], accel))
    assert report.values["gravity at rest, m/s^2"] == pytest.approx(10.81, abs=0.02)
    assert report.named("accelerometer bias") is None


def test_a_slow_turn_is_no_bias() -> None:
    angle = 0.03 * np.arange(6000) / 100
    accel = 9.81 * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1)
    report = check_sensor(InertialSamples(np.arange(6000) / 100, np.tile([0.0, -0.03, 0.0], (6000, 1)), accel))
    assert report.values["at rest, s"] > 50 and report.named("accelerometer bias") is None


def test_bias_noise_and_gravity_at_rest() -> None:
    rng, noise = np.random.default_rng(0), NOISE_PRESETS["phone"]
    times = np.arange(1200) / 200
    white = rng.normal(0, np.sqrt(200), (2, 1200, 3))
    gyro = noise.gyro * white[0] + np.array([0.2, 0.0, 0.0])
    accel = noise.accel * white[1] + np.array([0.0, -9.2, 0.0])
    report = check_sensor(InertialSamples(times, gyro, accel, None, NOISE_PRESETS["euroc"]))
    assert {"gyroscope bias", "accelerometer bias", "noise"} <= names(report)
    assert report.values["gyro noise, rad/s/sqrt(Hz)"] == pytest.approx(noise.gyro, rel=0.3)
    assert report.values["accel noise, m/s^2/sqrt(Hz)"] == pytest.approx(noise.accel, rel=0.3)
    assert report.values["gravity at rest, m/s^2"] == pytest.approx(9.2, abs=0.02)


def test_stamps_that_repeat_and_go_back() -> None:
    stamps = good()[0].timestamps.copy()
    stamps[100:104] = stamps[100]
    stamps[[500, 501]] = stamps[[501, 500]]
    report = checked(timestamps=stamps)
    assert names(report) == {"duplicate stamps", "unordered stamps"} and report.is_usable
    assert report.values["duplicate stamps"] == 3 and report.values["unordered stamps"] == 1
    assert checked(timestamps=np.full(len(stamps), 1.0)).named("too few samples") is not None


def test_saturation_and_held_samples() -> None:
    imu = good()[0]
    clipped = 4 * imu.gyro
    report = check_sensor(replace(imu, gyro=clipped.clip(-2.2, 2.2)))
    finding = report.named("saturation")
    assert finding is not None and "2.2 rad/s" in finding.text
    assert check_sensor(replace(imu, gyro=clipped)).named("saturation") is None
    heavily = check_sensor(replace(imu, gyro=(6 * imu.gyro).clip(-2.2, 2.2))).named("saturation")
    assert heavily is not None and "gyroscope stand at 2.2 rad/s" in heavily.text
    held = np.arange(len(imu)) // 2 * 2
    for sensor in ("gyro", "accel"):
        finding = check_sensor(replace(imu, **{sensor: getattr(imu, sensor)[held]})).named("repeated samples")
        assert finding is not None and f"of the {sensor}" in finding.text


def test_sensors_that_are_off() -> None:
    imu = good()[0]
    for sensor, value in (("gyro", 0.0), ("accel", 5.7)):
        report = check_sensor(replace(imu, **{sensor: np.full_like(imu.gyro, value)}))
        finding = report.named("repeated samples")
        assert finding is not None and f"{value:g} " in finding.text and f"the {sensor}" in finding.text
        assert not report.is_usable
        finding = check_sensor(replace(imu, **{sensor: getattr(imu, sensor) * [1, 0, 1]})).named("constant axis")
        assert finding is not None and f"y of the {sensor}" in finding.text


@pytest.mark.parametrize(
    ("count", "is_usable"), [(0, False), (1, False), (2, False), (5, False), (50, False), (400, True)]
)
def test_short_recordings(count: int, is_usable: bool) -> None:
    imu = good()[0]
    report = check_sensor(
        replace(imu, timestamps=imu.timestamps[:count], gyro=imu.gyro[:count], accel=imu.accel[:count])
    )  # fmt: skip
    finding = report.named("short recording") or report.named("too few samples")
    assert finding is not None and report.is_usable == (count == 400)


@pytest.mark.parametrize("rate", [1.0, 9.6, 25.0])
def test_low_rates(rate: float) -> None:
    report = check_sensor(samples(hand_motion(21), 30, rate=rate))
    finding = report.named("low rate")
    assert finding is not None and f"{rate:.3g} samples a second" in finding.text and "100 to 400 Hz" in finding.remedy
    assert report.is_usable == (rate > 20)


def test_rates_of_another_unit() -> None:
    imu, times, rotations = good()
    slow = check_sensor(replace(imu, timestamps=imu.timestamps * 1e3)).named("low rate")
    assert slow is not None and "0.1 samples a second" in slow.text and "unit of the times" in slow.remedy
    fast = check_sensor(replace(imu, timestamps=imu.timestamps / 1e3), times, rotations)
    finding = fast.named("high rate")
    assert finding is not None and "unit of the times" in finding.remedy and not fast.is_usable


def test_counts_of_a_gyroscope() -> None:
    report = checked(gyro=np.rint(np.degrees(good()[0].gyro) * 131))
    finding = report.named("gyroscope unit")
    assert finding is not None and "counts" in finding.remedy and not report.is_usable


@pytest.mark.parametrize("jump", [1e5, 1.7e9])
def test_a_clock_that_jumps_costs_no_memory(jump: float) -> None:
    imu, times, rotations = good()
    stamps = np.where(np.arange(len(imu)) < 50, imu.timestamps - jump, imu.timestamps)
    report = check_sensor(replace(imu, timestamps=stamps), times, rotations)
    assert report.named("gaps") is not None and abs(report.values["time offset, ms"]) < 1
    stamps = np.where(np.arange(len(imu)) < 50, imu.timestamps, imu.timestamps + jump)
    assert check_sensor(replace(imu, timestamps=stamps), times, rotations).named("not told") is not None


def test_samples_in_bursts() -> None:
    imu = good()[0]
    stamps = np.arange(len(imu)) // 10 * 0.1 + np.arange(len(imu)) % 10 * 1e-5
    report = check_sensor(replace(imu, timestamps=stamps))
    finding = report.named("bursts")
    assert finding is not None and "10 samples at a time" in finding.text and report.named("missing samples") is None
    assert report.values["rate, Hz"] == pytest.approx(100, rel=0.05)


def test_numbers_out_of_bounds() -> None:
    imu = good()[0]
    gyro = imu.gyro.copy()
    gyro[5], gyro[9] = 1e300, np.nan
    finding = check_sensor(replace(imu, gyro=gyro)).named("not finite")
    assert finding is not None and finding.text.startswith("2 of")


@pytest.mark.parametrize(
    ("gyro", "accel", "words"),
    [
        ([1, 0, 2], [0, 1, 2], "gyroscope taken as (y, x, z)"),
        ([0, 1, 2], [1, 2, 0], "accelerometer as (z, x, y)"),
    ],
)
def test_axes_of_one_sensor_without_a_camera(gyro: list[int], accel: list[int], words: str) -> None:
    imu = good()[0]
    finding = check_sensor(replace(imu, gyro=imu.gyro[:, gyro], accel=imu.accel[:, accel])).named("accelerometer axes")
    assert finding is not None and words in f"{finding.text}; {finding.remedy}"


def test_left_handed_axes_without_a_camera() -> None:
    imu, signs = good()[0], np.array([1, 1, -1])
    finding = check_sensor(replace(imu, gyro=imu.gyro * signs, accel=imu.accel * signs)).named("accelerometer axes")
    assert finding is not None and finding.level == Level.UNUSABLE and "left-handed" in finding.text


@pytest.mark.parametrize("seed", range(4))
def test_an_arm_that_swings_has_no_wrong_axes(seed: int) -> None:
    """Accelerations of a lever of half a metre that turn as fast as gravity does."""
    rng, times, step = np.random.default_rng(seed), np.arange(3000) / 100, 1e-3
    fast, size, phase = rng.uniform(0.2, 2.5, 3), rng.uniform(0.1, 0.6, 3), rng.uniform(0, 6, 3)
    before, turn, after = (
        so3_exp(size * np.sin(2 * np.pi * fast * (times[:, None] + late) + phase)) for late in (-step, 0, step)
    )
    lever = rng.normal(0, 0.3, 3)
    force = (after @ lever - 2 * (turn @ lever) + before @ lever) / step**2 + np.array([0, 0, 9.81])
    gyro = rotation_vector(np.swapaxes(before, -1, -2) @ after) / (2 * step)
    report = check_sensor(InertialSamples(times, gyro, np.einsum("nji,nj->ni", turn, force)))
    assert report.named("accelerometer axes") is None


def test_motion_that_does_not_tell() -> None:
    path = hand_motion(22, (0.0, 0.3, 0.0))
    imu = samples(path, SECONDS, rate=100.0, noise=NOISE_PRESETS["euroc"])
    report = check_sensor(imu, *frames(path, SECONDS, rate=20.0))
    finding = report.named("not told")
    assert finding is not None and "one axis" in finding.text and report.is_usable
    other = check_sensor(imu, *frames(hand_motion(23), SECONDS, rate=20.0)).named("not told")
    assert other is not None and other.level == Level.WARNING
    elsewhere = check_sensor(replace(imu, timestamps=imu.timestamps + 1000), *frames(path, SECONDS, rate=20.0))
    assert elsewhere.named("other times") is not None and not elsewhere.is_usable


def test_line_of_offsets_with_its_deviation() -> None:
    imu, times, rotations = good()
    line = clock_line(times, rotations, 0.03 + imu.timestamps * 1.001, imu.gyro, CAMERA_IMU @ so3_exp(np.full(3, 2e-3)))
    assert line is not None and line.is_drifting
    assert line.drift == pytest.approx(1e-3, abs=4 * line.sigma_drift)
    assert np.allclose(line.corrected(0.03 + times * 1.001), times, atol=2e-3)
    assert clock_line(times[:100], rotations[:100], imu.timestamps, imu.gyro, CAMERA_IMU) is None
