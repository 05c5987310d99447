"""Loop closure of the keyframe system: exact maps with drift, verification on images, the whole."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry import sim3
from dvo.geometry.poses import poses_from_matrices
from dvo.map.keyframe_log import KeyframeLog
from dvo.odometry.classical import two_view
from dvo.odometry.classical.keyframe import loops
from dvo.odometry.classical.keyframe.config import KeyframeConfig
from dvo.odometry.classical.keyframe.loops import Loop, LoopCloser, agree, median_depth, move, verify
from dvo.odometry.classical.keyframe.map import Keyframe, Map
from dvo.odometry.classical.keyframe.pose import centre
from dvo.odometry.classical.keyframe.system import KeyframeOdometry
from dvo.odometry.classical.klt import detect
from eval.systems.registry import find_system

INTRINSICS = np.array([300.0, 300.0, 160.0, 120.0])
GREY = np.zeros((240, 320), np.uint8)


def pose(angle: float, radius: float = 3.0) -> np.ndarray:
    """Camera on a circle that looks outward."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", -angle).as_matrix()
    T[:3, 3] = -T[:3, :3] @ (radius * np.array([np.sin(angle), 0, np.cos(angle)]))
    return T


def ring(count: int) -> tuple[Map, KeyframeLog]:
    """Keyframes on a circle, forty points of its own for each, and a frame between every two."""
    world, log = Map(), KeyframeLog()
    rng = np.random.default_rng(3)
    for k in range(count):
        T = pose(2 * np.pi * k / count)
        points = rng.uniform([-1, -0.8, 3], [1, 0.8, 5], (40, 3))
        ids = world.add(np.zeros((40, 3), np.uint8))
        world.xyz[ids] = (points - T[:3, 3]) @ T[:3, :3]
        uv = two_view.project(world.xyz[ids], T, INTRINSICS)[0].astype(np.float32)
        world.keyframes.append(Keyframe(2 * k, T, ids, uv, GREY))
        log.add(2.0 * k)
        log.add(2.0 * k + 1)
        log.set_pose(2 * k, T)
        log.place(2 * k, 2 * k, T)
        log.place(2 * k + 1, 2 * k, pose(2 * np.pi * (k + 0.5) / count))
    return world, log


def reprojection(world: Map) -> float:
    worst = [np.abs(two_view.project(world.xyz[k.ids], k.T_cw, INTRINSICS)[0] - k.uv).max() for k in world.keyframes]
    return float(max(worst))


def test_moving_a_map_keeps_what_its_cameras_see() -> None:
    world, log = ring(8)
    gone = world.keyframes.pop(3)
    log.reanchor(gone.frame, world.keyframes[2].frame)
    world.xyz[gone.ids] = np.nan
    steps = {frame: log.pose(frame + 1) @ np.linalg.inv(log.pose(frame)) for frame in (4, 6)}
    twice = torch.tensor([[0.3, -0.1, 0.2, 0, np.sin(0.2), 0, np.cos(0.2), 0.5]]).double()
    before = sim3.from_se3(torch.from_numpy(poses_from_matrices(np.array([k.T_cw for k in world.keyframes]))))
    move(world, log, sim3.compose(before, twice.expand(7, 8)))
    assert reprojection(world) < 1e-3
    assert centre(world.keyframes[1].T_cw) == pytest.approx(centre(log.pose(2)))
    for frame, step in steps.items():  # lengths in front of a camera double as its scale becomes one half
        now = log.pose(frame + 1) @ np.linalg.inv(log.pose(frame))
        assert np.allclose(now[:3, :3], step[:3, :3], atol=1e-9)
        assert np.allclose(now[:3, 3], 2 * step[:3, 3], atol=1e-9), frame


def test_a_loop_takes_the_drift_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second round of a circuit has drifted in scale and direction; one loop brings it back."""
    world, log = ring(24)
    truth = [k.T_cw.copy() for k in world.keyframes]
    for row, keyframe in enumerate(world.keyframes):  # each step is 1 % longer and turns by another 0.1 degrees
        if row:
            step = truth[row] @ np.linalg.inv(truth[row - 1])
            step[:3, 3] *= 1.01**row
            step[:3, :3] = Rotation.from_euler("y", 0.1, degrees=True).as_matrix() @ step[:3, :3]
            T = step @ world.keyframes[row - 1].T_cw
            local = world.xyz[keyframe.ids] @ truth[row][:3, :3].T + truth[row][:3, 3]
            world.xyz[keyframe.ids] = (1.01**row * local - T[:3, 3]) @ T[:3, :3]
            keyframe.T_cw = T
            log.set_pose(keyframe.frame, T)
    drifted = [centre(k.T_cw) for k in world.keyframes]
    closer = LoopCloser(KeyframeConfig(loops=True))
    unit = 1.01**23
    relative = truth[23] @ np.linalg.inv(truth[0])
    exact = sim3.from_se3(torch.from_numpy(poses_from_matrices(relative)).double(), unit)
    exact = torch.cat([exact[:3] * unit, exact[3:]])
    found, searches = Loop(0, 46, exact, 0.8, 60), []
    monkeypatch.setattr(loops, "verify", lambda *_: searches.append(1))
    monkeypatch.setattr(loops, "feature", lambda *_: np.eye(1, 1200)[0])
    for keyframe in world.keyframes[:23]:
        assert closer.visit(world, keyframe, log, INTRINSICS) is None
    monkeypatch.setattr(loops, "verify", lambda *_: found)
    assert closer.visit(world, world.keyframes[-1], log, INTRINSICS) is None and not closer.loops  # not confirmed
    scale = closer.visit(world, world.keyframes[-1], log, INTRINSICS)
    assert scale == pytest.approx(unit, rel=0.03) and reprojection(world) < 1e-2
    errors = [
        np.mean([np.linalg.norm(c - centre(T)) for c, T in zip(centres, truth, strict=True)])
        for centres in (drifted, [centre(k.T_cw) for k in world.keyframes])
    ]
    assert errors[1] < 0.25 * errors[0]
    told = closer.information(log)["loops"]
    assert [(one["from"], one["to"], one["inliers"]) for one in told] == [(46.0, 0.0, 0.8)] * 2
    searches.clear()
    monkeypatch.setattr(loops, "verify", lambda *_: searches.append(1))
    for number in range(1, KeyframeConfig().loop_every + 1):
        assert closer.visit(world, world.keyframes[-1], log, INTRINSICS) is None
        assert bool(searches) == (number == KeyframeConfig().loop_every)


def test_loops_agree_about_the_same_correction() -> None:
    world, _ = ring(12)
    similarities = [sim3.from_se3(torch.from_numpy(poses_from_matrices(k.T_cw)).double()) for k in world.keyframes]
    wrong = sim3.from_se3(torch.tensor([0.5, 0.2, 0, 0, np.sin(0.1), 0, np.cos(0.1)]).double(), 1.3)

    def loop(old: int, new: int, moved: torch.Tensor) -> Loop:
        """Loop by which the later visits have to be moved in the world."""
        there = sim3.compose(similarities[new], moved)
        return Loop(2 * old, 2 * new, sim3.compose(there, sim3.inverse(similarities[old])), 0.9, 50)

    same = sim3.identity(dtype=torch.float64)
    assert agree(world, loop(0, 9, wrong), loop(1, 10, wrong)) and agree(world, loop(0, 9, same), loop(1, 10, same))
    assert not agree(world, loop(0, 9, wrong), loop(1, 10, same))
    assert not agree(world, loop(0, 9, same), Loop(1, 99, similarities[0], 0.9, 50))  # a keyframe that is gone


@pytest.fixture(scope="module")
def views(film) -> list[Frame]:
    """A camera that moves to the right, goes back, and ends where it began."""
    s = np.concatenate([np.linspace(0, 1, 25), np.linspace(1, 0, 25)])
    rows = np.column_stack([1.6 * s, 0.1 * np.sin(5 * s), 0.5 * s, *np.zeros((3, 50)), np.ones(50)])
    return film(Trajectory(np.arange(50) / 20, rows))


def test_verification_finds_motion_and_scale(views: list[Frame]) -> None:
    """The later keyframe has a unit of its own: its points are half as far away."""
    camera = views[0].camera
    world, keyframes = Map(), []
    for k, (frame, unit) in enumerate(((views[0], 1.0), (views[6], 0.5), (views[24], 1.0))):
        grey = np.ascontiguousarray(frame.image[..., 1])
        uv = detect(grey, np.zeros((0, 2)), 500, quality=0.001, spacing=4)
        ids = world.add(np.zeros((len(uv), 3), np.uint8))
        x, z = (1.6 * k * 6 / 24, 0.5 * k * 6 / 24) if k < 2 else (1.6, 0.5)
        T = np.eye(4)
        T[:3, 3] = -unit * np.array([x, 0.1 * np.sin(5 * x / 1.6), z])
        # The wall is at 5 m, the board, from x = -0.4 to 0.85 m, at 2.5 m.
        rays = two_view.rays(uv, camera.intrinsics)
        near = x + rays[:, 0] * (2.5 - z)
        depth = np.where((near > -0.4) & (near < 0.85), 2.5 - z, 5.0 - z)
        world.xyz[ids] = unit * depth[:, None] * rays - T[:3, 3]
        keyframes.append(Keyframe(k, T, ids, uv, grey))
    world.keyframes = keyframes
    config = KeyframeConfig()
    loop = verify(world, keyframes[0], keyframes[1], camera.intrinsics, config, 0)
    assert loop is not None and loop.count >= config.loop_points
    t, scale = loop.measurement[:3].numpy(), float(loop.measurement[7])
    assert scale == pytest.approx(0.5, rel=0.05)
    assert t == pytest.approx(keyframes[1].T_cw[:3, 3], abs=0.03)
    blank = Keyframe(9, np.eye(4), keyframes[0].ids, keyframes[0].uv, np.full((240, 320), 90, np.uint8))
    assert verify(world, keyframes[0], blank, camera.intrinsics, config, 0) is None
    assert median_depth(world, keyframes[0]) == pytest.approx(5.0, abs=2.5)


@pytest.mark.long
def test_without_loops_nothing_changes(views: list[Frame]) -> None:
    def tracked(**settings: object) -> tuple[np.ndarray, dict]:
        odometry = KeyframeOdometry(corners=300, **settings)
        for frame in views:
            odometry.track(frame)
        result = odometry.finish()
        return result.trajectory.poses_wc, result.info

    plain, told = tracked()
    waiting, other = tracked(loops=True, loop_seconds=1e6)  # it searches, and is never allowed to find
    assert np.array_equal(plain, waiting) and "loops" not in told and other["loops"] == []
    assert len(plain) == 50


def test_systems_by_name() -> None:
    closed, plain = find_system("keyframe-loops"), find_system("keyframe")
    assert closed.identity() == find_system("keyframe+loops=true").identity()
    assert dict(plain.settings) == {} and closed.target == plain.target
    assert closed.build(0, "cpu").config.loops and not plain.build(0, "cpu").config.loops
