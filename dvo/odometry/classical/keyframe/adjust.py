"""Local bundle adjustment of the map, by the point solver of :mod:`dvo.ba`."""

from __future__ import annotations

import numpy as np
import torch

from dvo.ba.bal import PointProblem
from dvo.ba.points import solve_points
from dvo.geometry.poses import pose_matrices, poses_from_matrices
from dvo.odometry.classical.keyframe.map import Keyframe, Map


def neighbourhood(world: Map, newest: Keyframe, adjusted: int, anchors: int) -> tuple[list[Keyframe], list[Keyframe]]:
    """Keyframes around the newest: those to adjust and those that hold them in place.

    Args:
        adjusted: how many to adjust at most, the newest and those that share most of its landmarks.
        anchors: how many more to hold. At least the oldest of the adjusted is held instead where there are no others,
            and from four on two, or else the scale would be free.

    Returns:
        Both in order of time, so that ties and rounding are the same in every run.
    """
    shared = world.shared(newest)
    order = [i for i in np.argsort(-shared, kind="stable") if shared[i] > 0 and world.keyframes[i] is not newest]
    free, held = sorted(order[: adjusted - 1]), sorted(order[adjusted - 1 : adjusted - 1 + anchors])
    keyframes, fixed = [world.keyframes[i] for i in free] + [newest], [world.keyframes[i] for i in held]
    missing = max((2 if len(keyframes) >= 4 else 1) - len(fixed), 0)
    return keyframes[missing:], fixed + keyframes[:missing]


def adjust(
    world: Map, free: list[Keyframe], held: list[Keyframe], intrinsics: np.ndarray, iterations: int, threshold: float
) -> None:
    """Move keyframes and the landmarks that they see to the least squared reprojection error; drop what then is off.

    The solver has no robust loss; observations enter it as inliers of a pose, and are dropped here as soon as they
    leave the threshold (pixels).

    Args:
        world: map; changed in place.
        free, held: keyframes that move, and that do not.
        intrinsics: ``(4,)`` fx fy cx cy, pixels.
        iterations: most steps of the solver.
        threshold: largest reprojection error of an observation that stays, pixels.
    """
    if not free:
        return
    keyframes = held + free
    count = np.zeros(len(world.xyz), int)
    for keyframe in keyframes:
        count[keyframe.ids] += 1
    used = np.flatnonzero((count >= 2) & ~np.isnan(world.xyz[:, 0]))
    if len(used) < 8:
        return
    row = np.full(len(world.xyz), -1)
    row[used] = np.arange(len(used))
    seen = [row[keyframe.ids] for keyframe in keyframes]
    camera = np.concatenate([np.full((rows >= 0).sum(), k) for k, rows in enumerate(seen)])
    pixels = np.concatenate([k.uv[rows >= 0] for k, rows in zip(keyframes, seen, strict=True)])
    problem = PointProblem(
        poses_cw=torch.from_numpy(poses_from_matrices(np.array([k.T_cw for k in keyframes]))),
        intrinsics=torch.from_numpy(np.tile(intrinsics, (len(keyframes), 1))),
        radial=torch.zeros(len(keyframes), 2, dtype=torch.float64),
        points=torch.from_numpy(world.xyz[used]),
        camera=torch.from_numpy(camera),
        point=torch.from_numpy(np.concatenate([rows[rows >= 0] for rows in seen])),
        pixels=torch.from_numpy(pixels.astype(np.float64)),
    )
    solved = solve_points(problem, fixed=len(held), max_iterations=iterations, tolerance=1e-4)
    if not np.isfinite(solved.cost):
        return
    for keyframe, T in zip(free, pose_matrices(solved.problem.poses_cw.numpy()[len(held) :]), strict=True):
        keyframe.T_cw = T
    world.xyz[used] = solved.problem.points.numpy()
    world.cull_observations(keyframes, intrinsics, threshold)
