"""Initialisation of the tracker: test for motion, the first joint optimisation, and its revision after some frames."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dvo.ba.multistart import (
    AS_THEY_ARE,
    COLD_STARTS,
    PRESENT,
    RESTARTS,
    Beside,
    Solution,
    multistart,
    preferred,
    present,
)
from dvo.ba.options import COLD_UPDATES, damping_at
from dvo.geometry.projection import reproject
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.window import Window
from dvo.models.step import Revision
from dvo.odometry.depth.depth_factor import MEASURED_SHARE, match_window, measured_share
from dvo.odometry.frames.content import NO_MATCH
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.initial_pose import predict_pose
from dvo.odometry.uncertainty.uncertainty import has_second_solution
from dvo.odometry.window.patch_window import PatchWindow
from dvo.odometry.window.pose_validation import CONFIDENT, last_unrelated, measured, parallax, support_of

MOVED_SHARE = 0.2
"""Share of the patches that have to move: the others may be far away, or fixed to the camera."""
SLOW_START = (0.3, 0.6)
"""Shares of the motion and of the parallax that a slow start needs."""
SLOW_AFTER = (4, 10)
"""Frames without a start between which what is needed goes down to :data:`SLOW_START`."""
SETTLED, CALM = 0.02, 2
"""Motion of nine tenths of the reprojections in an update, feature pixels, below which a first window has settled, and
updates in a row that say so. The updates that are left out would move them by less than 0.08 in all."""
NOT_INITIALISED = "not initialised: too little motion"
"""Cause of the loss of the frames of a segment that was never initialised."""


def needed(waited: int) -> tuple[float, float]:
    """Shares of ``initial_motion`` and ``initial_parallax`` that a start needs.

    Little motion over a long time is as sure as much over a short one: its measurements are better.

    Args:
        waited: frames with content since the segment has begun.

    Returns:
        From 1 to :data:`SLOW_START`.
    """
    slow = min(max((waited - SLOW_AFTER[0]) / (SLOW_AFTER[1] - SLOW_AFTER[0]), 0.0), 1.0)
    return 1 - slow * (1 - SLOW_START[0]), 1 - slow * (1 - SLOW_START[1])


def flow_revision(revision: Revision, window: Window) -> float:
    """Revision of the flow from the last keyframe to the newest frame, at equal poses, that :data:`MOVED_SHARE` exceed.

    The median would stay at zero for ever where most of the picture is far, or fixed to the camera.

    Args:
        revision: output of the network for the edges of the window.
        window: keyframes, the newest frame last.

    Returns:
        Feature pixels.
    """
    n = len(window)
    edges = measured(window, revision.weights[0], (window.ii == n - 2) & (window.jj == n - 1))
    return float(revision.delta[0][edges].norm(dim=-1).quantile(1 - MOVED_SHARE)) if bool(edges.any()) else 0.0


def newest_confidence(revision: Revision, window: Window) -> float:
    """Mean confidence of the flow from the last keyframe to the newest frame.

    Args:
        revision: output of the network for the edges of the window.
        window: keyframes, the newest frame last.

    Returns:
        In [0, 1].
    """
    n = len(window)
    edges = measured(window, revision.weights[0], (window.ii == n - 2) & (window.jj == n - 1))
    return float(revision.weights[0][edges].mean()) if bool(edges.any()) else 0.0


def first_motion(revision: Revision, window: Window, config: TrackerConfig, waited: int) -> bool:
    """Find out if the newest frame of a window that is not initialised yet has moved.

    Args:
        revision: output of the network for the edges of the window.
        window: keyframes, the newest frame last.
        config: settings of the tracker.
        waited: frames since the segment has begun, see :func:`needed`.

    Returns:
        False for a confident frame with too little motion to initialise.
    """
    confident = newest_confidence(revision, window) >= config.lost_confidence
    return not confident or flow_revision(revision, window) >= needed(waited)[0] * config.initial_motion


def initialise(patch_window: PatchWindow, config: TrackerConfig, waited: int, beside: Beside | None = None) -> bool:
    """Optimise the first window until it has settled.

    When it has, or after half of the updates, the window is also solved from identity poses with the current flow, and
    the better of the solutions is kept (:data:`dvo.ba.multistart.COLD_STARTS`). With measured depths of most patches
    there is no other solution to look for, and no parallax is needed.

    Args:
        patch_window: the first keyframes; changed in place.
        config: settings of the tracker.
        waited: frames since the segment has begun, see :func:`needed`.
        beside: see :func:`dvo.ba.multistart.multistart`.

    Returns:
        True if the parallax is sufficient for tracking.
    """
    window = patch_window.window
    measured = measured_share(window.measured) >= MEASURED_SHARE
    calm, tried, places = 0, measured, _reprojections(window)
    for age in range(config.initial_updates):
        patch_window.step(1, damping_at(age))
        before, places = places, _reprojections(window)
        calm = calm + 1 if age >= COLD_UPDATES and _moved(window, before, places) < SETTLED else 0
        if not tried and (calm == CALM or age == config.initial_updates // 2):
            tried = True
            if _solve_again(patch_window, beside):
                calm, places = 0, _reprojections(window)
            match_window(window)
        if tried and calm >= CALM:
            break
    n = len(window)
    if measured:
        return True
    seen = parallax(window, 0, n - 1, MOVED_SHARE)
    if n > config.initial_frames:
        seen = max(seen, parallax(window, n // 2, n - 1, MOVED_SHARE))
    return seen >= needed(waited)[1] * config.initial_parallax


def _reprojections(window: Window) -> Tensor:
    """Where the centres of the patches of the edges are seen ``(E, 2)``, feature pixels."""
    middle = window.patches.shape[-1] // 2
    values = window.poses_cw[None], window.patches[None], window.intrinsics[None], window.ii, window.jj, window.kk
    return reproject(*values).coords[0, :, middle, middle]


def _moved(window: Window, before: Tensor, after: Tensor) -> float:
    """Motion of nine tenths of the reprojections ``(E, 2)`` of confident measurements, feature pixels."""
    sure = window.confidence.mean(-1) > CONFIDENT
    return float((after - before)[sure].norm(dim=-1).quantile(0.9)) if bool(sure.any()) else math.inf


def _solve_again(patch_window: PatchWindow, beside: Beside | None) -> bool:
    """Replace poses and depths by a solution from one pose for all frames if it suits the flow better; if they were."""
    # The flow that the window was solved for suits its solution: what the network says of it now tells others apart.
    window, revision = patch_window.window, patch_window.revise()
    problem = window.problem().with_values(targets=revision.targets[0], weights=revision.weights[0])
    # Not solved further: a narrow kernel would fit the first, coarse flow.
    best = preferred(multistart(problem, {PRESENT: present, **COLD_STARTS}, AS_THEY_ARE, beside=beside))
    if best.start != PRESENT:
        _take(window, best)
    return best.start != PRESENT


def _take(window: Window, solution: Solution) -> None:
    """Give a window the poses and depths of a solution."""
    problem = solution.problem
    window.poses_cw, window.patches = problem.poses_cw.to(window.poses_cw), problem.patches.to(window.patches)


def initialise_related(
    graph: KeyframeGraph, patch_window: PatchWindow, config: TrackerConfig, waited: int, beside: Beside | None = None
) -> bool:
    """Optimise the first window without the frames that do not show the scene of the newest ones.

    Frames that the first solution hardly finds begin once more where the motion of those before them leads them.

    Where frames are removed, the others begin anew: poses and depths that were fitted to another scene, or to noise,
    may be a minimum that they do not leave, and the test for motion needs equal poses.

    Args:
        graph: of the sequence; its window is changed in place.
        patch_window: the window.
        config: settings of the tracker.
        waited: frames since the segment has begun, see :func:`needed`.
        beside: see :func:`dvo.ba.multistart.multistart`.

    Returns:
        True if the frames are as many as an initialisation needs, and the parallax is sufficient for tracking.
    """
    enough = initialise(patch_window, config, waited, beside)
    if drop_unrelated(graph, patch_window, config):
        graph.window.reset()
        enough = len(graph.window) >= config.initial_frames and initialise(patch_window, config, waited, beside)
    elif (found := unsupported(graph.window, config)) and found[0] > 1:
        before = graph.window.snapshot()
        _continue_motion(graph.window, found[0])
        again = initialise(patch_window, config, waited, beside)
        if len(unsupported(graph.window, config)) < len(found):
            enough = again
        else:
            graph.window.restore(before)
    return enough and len(graph.window) >= config.initial_frames


def unsupported(window: Window, config: TrackerConfig) -> list[int]:
    """Positions of the frames after the first that are hardly found in those before them: their poses are any.

    Nothing speaks against a frame whose edges have left the window since.

    Args:
        window: after some steps.
        config: least support, that of tracked frames.
    """
    least = config.lost_confidence, config.min_inliers
    found = set(window.jj[window.ii < window.jj].tolist())
    return [k for k in range(1, len(window)) if k in found and not support_of(window, k).reaches(*least)]


def lose_unsupported(graph: KeyframeGraph, config: TrackerConfig) -> None:
    """Remove the frames of the first window that are hardly found in those before them; they are lost.

    Args:
        graph: of the sequence; its window has just been initialised.
        config: settings of the tracker.
    """
    for position in reversed(unsupported(graph.window, config)):
        graph.log.lose(graph.discard(position).identifier, NO_MATCH)


def _continue_motion(window: Window, first: int) -> None:
    """Begin the frames from a position on anew, where the motion of those before it leads them.

    In a fast turn they are too far from the equal poses that a first window begins with.
    """
    times = [frame.timestamp for frame in window.frames]
    poses_cw = window.poses_cw.clone()
    for k in range(first, len(window)):
        poses_cw[k] = predict_pose(poses_cw[:k], times[:k], times[k], 1.0)
    own = torch.arange(len(window.patches), device=poses_cw.device) // window.per_frame >= first
    patches, touched = window.patches.clone(), (window.ii >= first) | (window.jj >= first)
    patches[own, 2] = patches[~own, 2].median()
    window.poses_cw, window.patches = poses_cw, patches
    edges = window.hidden, window.targets, window.weights, window.confidence
    window.hidden, window.targets, window.weights, window.confidence = (
        torch.where(touched.view(-1, *[1] * (x.dim() - 1)), 0, x) for x in edges
    )


def drop_unrelated(graph: KeyframeGraph, patch_window: PatchWindow, config: TrackerConfig) -> bool:
    """Remove the frames of the first window that do not show the scene of the newest ones.

    They are lost: nothing is known of the motion between them.

    Args:
        graph: of the sequence; the window is not initialised yet.
        patch_window: after some steps.
        config: settings of the tracker.

    Returns:
        True if frames were removed.
    """
    count = last_unrelated(graph.window, config.lost_confidence, config.initial_inliers)
    if count:
        graph.reject(graph.window.frames[count].identifier, NO_MATCH)
    return count > 0


def leave_minimum(patch_window: PatchWindow, config: TrackerConfig, beside: Beside | None = None) -> bool:
    """Start the window anew if that leads to a better solution (:mod:`dvo.ba.multistart`).

    Args:
        patch_window: of an initialised tracker; its poses and inverse depths are changed in place.
        config: scale of the covariance.
        beside: see :func:`dvo.ba.multistart.multistart`.

    Returns:
        True if another solution is nearly as good as the one that is left
        (:mod:`dvo.odometry.uncertainty.second_solution`).
    """
    window = patch_window.window
    if measured_share(window.measured) >= MEASURED_SHARE:
        return False
    found = multistart(window.problem(), RESTARTS, beside=beside)
    best = preferred(found)
    if best.start != PRESENT:
        _take(window, best)
        match_window(window)
    return has_second_solution(patch_window, config.variance, [best, *(other for other in found if other is not best)])
