"""Motions of hands and quadrotors: their spectrum, how fast they are, and that they stay where there is room."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.geometry.poses import quaternion_to_matrix
from dvo.synth import Scene, long_path, measure_imu, random_scene
from dvo.synth.motion.motion import SplinePath
from dvo.synth.motion.natural import (
    DEGENERATE,
    LEAD,
    NATURAL_KINDS,
    RATE,
    band_limited,
    bursts,
    natural_path,
    stretches,
)
from dvo.synth.sensors.imu import Imu
from dvo.synth.textures.texture import texture_pool

SECONDS = 20.0
STEP = 0.01
TIMES = np.arange(0, SECONDS, STEP)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(2, "hall", pool=texture_pool(11, count=24, size=64))


@pytest.fixture(scope="module")
def motions(scene: Scene) -> dict[str, tuple[SplinePath, Imu]]:
    paths = {kind: natural_path(scene, 3, kind, SECONDS) for kind in NATURAL_KINDS}
    return {kind: (path, measure_imu(path, TIMES)) for kind, path in paths.items()}


def acceleration(path: SplinePath, imu: Imu) -> np.ndarray:
    """In the world, from the measured specific force."""
    rotation = quaternion_to_matrix(path.poses_wc(imu.timestamps)[:, 3:])
    return (rotation @ imu.accel[..., None])[..., 0] + imu.gravity


def lines(values: np.ndarray) -> int:
    """Frequencies that hold nine tenths of the power: one for each sine that a signal is a sum of, and its leakage."""
    window = np.hanning(len(values))[:, None]
    power = (np.abs(np.fft.rfft((values - values.mean(0)) * window, axis=0)) ** 2).sum(1)
    share = np.cumsum(np.sort(power)[::-1]) / power.sum()
    return int(np.searchsorted(share, 0.9)) + 1


@pytest.mark.parametrize(("band", "slope"), [((0.5, 8.0), 3.0), ((0.05, 0.5), 1.0), ((1.5, 2.1), 0.0)])
def test_a_process_has_its_band_and_slope(band: tuple[float, float], slope: float) -> None:
    times = np.arange(40_000) / RATE
    values = band_limited(np.random.default_rng(1), times, band, slope, 3)
    assert values.std() == pytest.approx(1.0, rel=0.1)
    power = (np.abs(np.fft.rfft(values * np.hanning(len(times))[:, None], axis=0)) ** 2).sum(1)
    frequency = np.fft.rfftfreq(len(times), 1 / RATE)
    inside = (frequency >= 0.98 * band[0]) & (frequency <= 1.02 * band[1])
    assert power[inside].sum() > 0.995 * power.sum()
    edges = np.geomspace(*band, 9)
    means = [power[(frequency >= a) & (frequency < b)].mean() for a, b in zip(edges[:-1], edges[1:], strict=True)]
    fitted = np.polyfit(np.log(np.sqrt(edges[1:] * edges[:-1])), np.log(means), 1)[0]
    assert fitted == pytest.approx(-slope, abs=0.35)


@pytest.mark.long
def test_acceleration_of_a_hand_is_no_sum_of_a_few_sines(motions, scene: Scene) -> None:
    path, imu = motions["hand"]
    found = acceleration(path, imu)
    power = (np.abs(np.fft.rfft(found * np.hanning(len(TIMES))[:, None], axis=0)) ** 2).sum(1)
    frequency = np.fft.rfftfreq(len(TIMES), STEP)
    tremor = power[(frequency > 2.5) & (frequency < 8.5)].sum() / power.sum()
    assert 0.05 < tremor < 0.8 and power[frequency > 12].sum() < 0.01 * power.sum()
    sines = long_path(scene, 3, "handheld", SECONDS)
    assert lines(found) > 60 > 3 * lines(acceleration(sines, measure_imu(sines, TIMES)))


@pytest.mark.long
@pytest.mark.parametrize("kind", NATURAL_KINDS)
def test_motions_are_as_fast_as_people_and_drones_and_touch_nothing(motions, scene: Scene, kind: str) -> None:
    path, imu = motions[kind]
    position = path.poses_wc(TIMES)[:, :3]
    assert scene.clearance(position[::20]).min() > 0.1
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / STEP
    turning = np.degrees(np.linalg.norm(imu.gyro, axis=1))
    assert np.quantile(speed, 0.99) < (4.0 if kind == "hand_fast" else 2.0)
    assert np.quantile(speed, 0.95) > 0.3
    if kind == "hand_fast":
        hasty = np.any([(a <= TIMES) & (b >= TIMES) for a, b in bursts(kind, SECONDS)], axis=0)
        assert turning[hasty].max() > 200 and np.median(turning[hasty]) > 2 * np.median(turning[~hasty])
    else:
        assert 40 < np.quantile(turning, 0.98) < 200


@pytest.mark.long
@pytest.mark.parametrize("kind", ["hand", "quadrotor"])
def test_accelerations_are_continuous_and_those_of_the_path(motions, kind: str) -> None:
    path, imu = motions[kind]
    step = 0.05 / RATE  # twenty times within an interval of the spline
    times = 3.0 + np.arange(500) * step
    position = path.poses_wc(times)[:, :3]
    differentiated = np.diff(position, 2, axis=0) / step**2
    jumps = np.linalg.norm(np.diff(differentiated, axis=0), axis=1)
    assert jumps.max() < 500 * step, "m/s^3: a jump of the acceleration does not shrink with the step"
    measured = measure_imu(path, times)
    np.testing.assert_allclose(acceleration(path, measured)[1:-1], differentiated, atol=0.02)


@pytest.mark.long
def test_a_motion_goes_on_beyond_its_frames(motions) -> None:
    path, _ = motions["hand"]
    edges = np.array([-LEAD, -LEAD + 0.01, SECONDS + LEAD - 0.01, SECONDS + LEAD - 0.001])
    first, second, third, fourth = path.poses_wc(edges)[:, :3]
    assert not np.array_equal(first, second) and not np.array_equal(third, fourth)


@pytest.mark.long
@pytest.mark.parametrize("kind", DEGENERATE)
def test_stretches_tell_less_than_what_follows(motions, kind: str) -> None:
    path, imu = motions[kind]
    world = acceleration(path, imu)
    velocity = np.diff(path.poses_wc(TIMES)[:, :3], axis=0) / STEP
    (begin, end), later = stretches(kind, SECONDS)
    assert begin == 0 and later[0] > end + 4 and later[1] < SECONDS - 3
    for first, last in ((begin, end), later):
        inside = (first <= TIMES[1:]) & (last > TIMES[1:])
        after = (last + 1 < TIMES) & (last + 4 > TIMES)
        moves, turns = world[1:][inside], np.degrees(np.linalg.norm(imu.gyro[1:][inside], axis=1))
        assert np.linalg.norm(world[after].std(0)) > 0.4, "what follows excites the accelerometer"
        if kind == "one_axis":
            extent = np.linalg.svd(moves - moves.mean(0), compute_uv=False)
            assert extent[1] < 1e-3 * extent[0] and extent[0] > 10 and turns.max() < 1e-6
            continue
        assert np.abs(moves).max() < 1e-3
        speeds = np.linalg.norm(velocity[inside], axis=1)
        if kind == "turning":
            assert np.quantile(turns, 0.9) > 15 and speeds.max() < 1e-9
        else:
            assert turns.max() < 1e-6
            assert speeds.min() > 0.1 if kind == "constant" else speeds.max() < 1e-9


@pytest.mark.long
def test_a_quadrotor_tilts_by_its_acceleration(motions) -> None:
    path, imu = motions["quadrotor"]
    world = acceleration(path, imu)
    rotation = quaternion_to_matrix(path.poses_wc(TIMES)[:, 3:])
    aside = rotation[:, :, 0] * [1, 1, 0]
    needed = (world * aside).sum(1)
    rolled = -rotation[:, 2, 0]  # the x axis of the camera falls as it rolls to the right
    slow = np.ones(100) / 100  # seconds of jitter are averaged
    needed, rolled = np.convolve(needed, slow, "valid"), np.convolve(rolled, slow, "valid")
    assert np.corrcoef(needed, rolled)[0, 1] > 0.7


@pytest.mark.long
def test_a_motion_is_drawn_from_its_seed(scene: Scene) -> None:
    times = np.linspace(0, 3, 7)
    one, again, other = (natural_path(scene, seed, "hand", 3.0).poses_wc(times) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, again)
    assert not np.allclose(one, other)
    with pytest.raises(DvoError, match="no motion 'swim'"):
        natural_path(scene, 0, "swim", 3.0)
