"""Requirements on every classical system, in small: determinism, and no crash where there is nothing to see."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dvo.data.frame import Frame
from dvo.metrics import evaluate
from dvo.odometry.classical.direct.system import DirectConfig, DirectOdometry
from dvo.odometry.classical.keyframe.config import KeyframeConfig
from dvo.odometry.classical.keyframe.system import KeyframeOdometry
from dvo.odometry.classical.klt_pnp import KltPnp, KltPnpConfig
from dvo.odometry.classical.monoslam import MonoSlam, MonoSlamConfig
from dvo.odometry.protocol import Odometry, Result
from eval.systems.registry import find_system

SMALL: dict[str, Callable[[], Odometry]] = {
    "klt-pnp": lambda: KltPnp(KltPnpConfig(corners=300)),
    "keyframe": lambda: KeyframeOdometry(KeyframeConfig(corners=300)),
    "direct": lambda: DirectOdometry(DirectConfig(pixels=19200)),
    "monoslam": lambda: MonoSlam(MonoSlamConfig(visible=35, capacity=50)),
}
every = pytest.mark.parametrize("name", list(SMALL))


def run(name: str, frames: list[Frame]) -> Result:
    odometry = SMALL[name]()
    for frame in frames:
        odometry.track(frame)
    return odometry.finish()


@every
def test_it_is_a_system(name):
    system = find_system(name)
    odometry = system.build(0, "cpu")
    assert isinstance(odometry, Odometry) and odometry.name == name and system.licence == "MIT"


@pytest.mark.long
@every
def test_same_seed_same_bytes(name, film, path):
    frames = film(path(40))[:11]
    first, second = (run(name, frames).trajectory.poses_wc.tobytes() for _ in range(2))
    assert first == second and len(first) > 0


@every
@pytest.mark.parametrize("value", [0, 120, 255])
def test_nothing_to_see(name, film, path, dark, value):
    result = run(name, dark(film(path(12)), 0, 12, value))
    assert result.frames_read == 12 and len(result.map.points) == 0
    assert result.frames_lost == 12 - len(result.trajectory) >= 11


@every
@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_frames(name, film, path, count):
    result = run(name, film(path(2))[:count])
    assert len(result.trajectory) == count and result.frames_lost == 0
    assert result.trajectory.poses_wc.tolist() == [[0, 0, 0, 0, 0, 0, 1]] * count


@pytest.mark.long
@pytest.mark.parametrize("name", ["klt-pnp", "keyframe", "direct"])  # a filter needs more frames a second
def test_rendered_sequence(name, rendered):
    frames, truth = rendered
    metrics = evaluate(run(name, frames).trajectory, truth)
    assert metrics.completeness == 1 and metrics.ate_percent < 3


@pytest.mark.long
@pytest.mark.parametrize(("name", "most"), [("klt-pnp", 0.05), ("keyframe", 0.05), ("direct", 0.1)])
def test_pure_rotation_turns_and_does_not_move(name, film, path, most):
    turning = path(30, translate=0.0)
    result = run(name, film(turning))
    metrics = evaluate(result.trajectory, turning)
    assert metrics.completeness == 1 and metrics.rotation_error_ratio < most
    assert result.info["maps_started"] == 0 and np.isnan(metrics.ate_rmse) and metrics.reason is not None
