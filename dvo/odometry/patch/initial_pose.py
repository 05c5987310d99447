"""First pose of a new frame, before its edges have been measured."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from dvo.ba.kernels import Kernel
from dvo.ba.multistart import PRESENT, Start, multistart, preferred
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.ba.sparse.levenberg import LMOptions
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.map.window import Window
from dvo.models.step import recent_depth
from dvo.odometry.frames.front_end import Observation
from dvo.odometry.patch.config import InitialPose, TrackerConfig

AGREEMENT = 2.0
"""Distance of a match from its reprojection up to which it agrees with a pose, feature pixels."""

_DEPTH_FRAMES = 3  # number of newest frames whose median depth initialises a new frame
_WIDTHS = (8.0, 4.0, 2.0)  # of the kernels, feature pixels: wide ones first, since the pose may be far off
_ITERATIONS = 4  # with each of them
_MIN_MATCHES = 8  # matches that must agree with a pose; six unknowns leave two of them to contradict it
_MIN_SHARE = 1 / 3  # and their share of all
_ACCURACY = 1.0  # of a match, feature pixels; a prediction that is as close is as good


def first_pose(window: Window, seen: Observation, time: float, config: TrackerConfig, initialised: bool) -> Tensor:
    """First pose of a new frame: that of the motion model or, once the tracker is initialised, of the method chosen.

    Args:
        window: keyframes without the frame, possibly none.
        seen: the frame.
        time: of the frame, seconds.
        config: settings of the tracker.
        initialised: the tracker is.

    Returns:
        ``(7,)`` ``T_cw``.
    """
    own = min(window.guests, max(0, len(window) - 1))  # guests are of another time
    times = [frame.timestamp for frame in window.frames[own:]]
    predicted = predict_pose(window.poses_cw[own:], times, time, config.motion_damping)
    return initial_pose(window, seen, predicted, config.initial_pose) if initialised else predicted


def predict_pose(poses_cw: Tensor, times: list[float], time: float, damping: float) -> Tensor:
    """Damped constant velocity: ``Exp(damping * dt / dt_last * Log(P1 P2^-1)) P1`` (motion model of DPVO).

    Args:
        poses_cw: ``(n, 7)`` poses ``T_cw`` of the window, the newest last.
        times: their timestamps, seconds.
        time: timestamp of the new frame, seconds.
        damping: factor of the velocity, in [0, 1].

    Returns:
        ``(7,)`` predicted ``T_cw``: the identity without poses, the last pose with one.
    """
    if len(times) == 0:
        return se3.identity(device=poses_cw.device)
    if len(times) == 1:
        return poses_cw[-1]
    # Bounded, because a dropped keyframe or a gap in the video would extrapolate too far.
    ratio = min(2.0, max(0.0, (time - times[-1]) / (times[-1] - times[-2])))
    step = se3.log(se3.relative(poses_cw[-2], poses_cw[-1]))
    return se3.retract(poses_cw[-1], damping * ratio * step)


def first_depth(window: Window, config: TrackerConfig, initialised: bool, measured: Tensor | None = None) -> Tensor:
    """Inverse depth that the patches of a new frame begin with: measured, or the median of the newest frames, before
    these are initialised 1.

    Args:
        window: keyframes without the frame, possibly none.
        config: settings of the tracker.
        initialised: the tracker is.
        measured: ``(M, 2)`` of the frame, see :func:`dvo.map.measurements.depth_factors`.

    Returns:
        ``(1, M)``.
    """
    depth = torch.ones(1, config.patches, device=window.patches.device)
    depth = depth * recent_depth(window.patches[None], config.patches, _DEPTH_FRAMES) if initialised else depth
    known = None if measured is None else measured[:, 1] > 0
    if measured is None or known is None or not known.any():
        return depth
    depth = depth if initialised else torch.full_like(depth, float(measured[known, 0].median()))
    return torch.where(known, measured[:, 0], depth)


def initial_pose(window: Window, seen: Observation, predicted: Tensor, method: InitialPose) -> Tensor:
    """First pose of a new frame.

    Args:
        window: keyframes of an initialised tracker, without the frame.
        seen: the frame.
        predicted: ``(7,)`` pose ``T_cw`` of the motion model.
        method: ``motion``: the prediction; ``nearest``: see :func:`pose_from_nearest`.

    Returns:
        ``(7,)`` ``T_cw``.
    """
    return predicted if method == "motion" else pose_from_nearest(window, seen, predicted)


def pose_from_nearest(window: Window, seen: Observation, predicted: Tensor) -> Tensor:
    """Pose of a frame from matches with the newest keyframe, the nearest one (MambaVO, geometric initialisation).

    Each patch of the keyframe is matched with the place of the frame where its matching features correlate most,
    anywhere in the image. The pose follows from the matches by bundle adjustment that moves it alone, under robust
    kernels, from the predicted pose and from that of the keyframe. MambaVO matches detected points and solves
    perspective-n-point; here the patches have inverse depths.

    Args:
        window: keyframes, with inverse depths.
        seen: the frame.
        predicted: ``(7,)`` pose ``T_cw`` of the motion model.

    Returns:
        ``(7,)`` ``T_cw`` of the preferred solution; the prediction if that is as close to the matches as they are
        accurate, or if too few matches agree with the other.
    """
    nearest, m = len(window) - 1, window.per_frame
    found = best_matches(window.frames[nearest].matching, seen.maps[0, 0])
    intrinsics = torch.stack([window.frames[nearest].intrinsics, seen.intrinsics])
    kk = torch.arange(m, device=found.device)
    edges = torch.zeros_like(kk), torch.ones_like(kk), kk
    poses = torch.stack([window.poses_cw[nearest], predicted])
    problem = PatchProblem(poses, window.patches[nearest * m :], intrinsics, found, torch.ones_like(found), *edges)
    if float(_distance(problem).median()) <= _ACCURACY:
        return predicted
    options = GlobalBAOptions(
        kernel=Kernel("cauchy", _WIDTHS[-1]), move_depths=False, solver=LMOptions(max_iterations=_ITERATIONS)
    )
    starts = {PRESENT: _at(poses[1]), "nearest": _at(poses[0])}
    best = preferred(multistart(problem, starts, options, abandon=float("inf"))).problem
    agree = int((_distance(best) < AGREEMENT).sum())
    return best.poses_cw[1].to(predicted) if agree >= max(_MIN_MATCHES, _MIN_SHARE * m) else predicted


def _at(pose_cw: Tensor) -> Start:
    """Start from a pose of the frame, which wide kernels bring near the matches."""

    def start(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
        first = problem.poses_cw[0]
        problem = problem.with_values(poses_cw=torch.stack([first, pose_cw.to(first)]))
        for width in _WIDTHS[:-1]:
            found = solve(problem, replace(options, kernel=Kernel("cauchy", width)))
            problem = problem.with_values(poses_cw=found.poses_cw)
        return problem

    return start


def best_matches(features: Float[Tensor, "M C p p"], maps: Float[Tensor, "C h w"]) -> Float[Tensor, "M 2"]:
    """Find the places of a feature map where patches correlate most.

    Args:
        features: matching features of the patches.
        maps: matching features of a frame.

    Returns:
        ``x, y`` of the patch centres, feature pixels; between pixels by a parabola through the neighbours.
    """
    products = F.conv2d(maps[None].float(), features.float(), padding=features.shape[-1] // 2)[0]
    height, width = products.shape[-2:]
    place = products.flatten(1).argmax(1)
    x, y = place % width, place // width
    patch = torch.arange(len(products), device=place.device)
    found = []
    for at, size, step in ((x, width, 1), (y, height, width)):
        before, after = ((place + side * step).clamp(0, height * width - 1) for side in (-1, 1))
        low, top, high = (products.flatten(1)[patch, index] for index in (before, place, after))
        offset = 0.5 * (low - high) / (low - 2 * top + high).clamp(max=-1e-6)
        inside = (at > 0) & (at < size - 1)
        found.append(at + torch.where(inside, offset, torch.zeros_like(offset)))
    return torch.stack(found, -1).to(maps.dtype)


def _distance(problem: PatchProblem) -> Tensor:
    """Distance of the reprojections from the matches, ``(M,)`` feature pixels."""
    p = problem.batched()
    coords = reproject(p.poses_cw, p.patches, p.intrinsics, p.ii, p.jj, p.kk).coords
    centre = coords.shape[2] // 2
    return (coords[0, :, centre, centre] - problem.targets).norm(dim=-1)
