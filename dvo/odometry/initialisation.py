"""Initialisation of the tracker: test for motion, the first joint optimisation, and its revision after some frames."""

from __future__ import annotations

from dvo.ba.cold_start import damping_at
from dvo.ba.multistart import AS_THEY_ARE, COLD_STARTS, PRESENT, RESTARTS, Solution, multistart, preferred, present
from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.graph.window import Window
from dvo.models.step import Revision, StepOptions
from dvo.odometry.config import TrackerConfig
from dvo.odometry.depth_factor import MOST, match_window, measured_share
from dvo.odometry.evidence import NO_MATCH, last_unrelated, measured, related_share, window_inliers
from dvo.odometry.motion import parallax
from dvo.odometry.uncertainty import has_second_solution
from dvo.odometry.window_step import WindowStep

RESTART_AGES = frozenset({4, 8, 16, 32})
"""Numbers of frames after the initialisation at which its solution is compared with others."""
AGAIN = 8
"""Frames from one comparison to the next as long as another solution is nearly as good."""


def median_revision(revision: Revision, window: Window) -> float:
    """Median revision of the flow from the last keyframe to the newest frame, at equal poses.

    Args:
        revision: output of the network for the edges of the window.
        window: keyframes, the newest frame last.

    Returns:
        Feature pixels.
    """
    n = len(window)
    edges = measured(window, revision.weights[0], (window.ii == n - 2) & (window.jj == n - 1))
    return float(revision.delta[0][edges].norm(dim=-1).median()) if bool(edges.any()) else 0.0


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


def first_motion(revision: Revision, window: Window, config: TrackerConfig) -> bool:
    """Find out if the newest frame of a window that is not initialised yet has moved.

    Args:
        revision: output of the network for the edges of the window.
        window: keyframes, the newest frame last.
        config: settings of the tracker.

    Returns:
        False for a confident frame with too little motion to initialise.
    """
    confident = newest_confidence(revision, window) >= config.lost_confidence
    return not confident or median_revision(revision, window) >= config.initial_motion


def initialise(window: Window, step: WindowStep, config: TrackerConfig) -> bool:
    """Optimise the first window.

    After half of the updates the window is also solved from identity poses with the current flow, and the better of the
    solutions is kept (:data:`dvo.ba.multistart.COLD_STARTS`). With measured depths of most patches there is
    no other solution to look for, and no parallax is needed.

    Args:
        window: the first keyframes; changed in place.
        step: step of the model on the window.
        config: settings of the tracker.

    Returns:
        True if the parallax is sufficient for tracking.
    """
    measured = measured_share(window.measured) >= MOST
    for age in range(config.initial_updates):
        step(StepOptions(fixed=1, damping=damping_at(age)))
        if age == config.initial_updates // 2 and not measured:
            _solve_again(window, step)
            match_window(window)
    n = len(window)
    if measured:
        return True
    seen = parallax(window, 0, n - 1)
    if n > config.initial_frames:
        seen = max(seen, parallax(window, n // 2, n - 1))
    return seen >= config.initial_parallax


def _solve_again(window: Window, step: WindowStep) -> None:
    """Replace poses and depths by a solution from one pose for all frames, if it suits the current flow better."""
    revision = step.revise()
    problem = window.problem().with_values(targets=revision.targets[0], weights=revision.weights[0])
    # Not solved further: a narrow kernel would fit the first, coarse flow.
    best = preferred(multistart(problem, {PRESENT: present, **COLD_STARTS}, AS_THEY_ARE))
    if best.start != PRESENT:
        _take(window, best)


def _take(window: Window, solution: Solution) -> None:
    """Give a window the poses and depths of a solution."""
    problem = solution.problem
    window.poses_cw, window.patches = problem.poses_cw.to(window.poses_cw), problem.patches.to(window.patches)


def initialise_related(graph: KeyframeGraph, step: WindowStep, config: TrackerConfig) -> bool:
    """Optimise the first window without the frames that do not show the scene of the newest ones.

    Where frames are removed, the others begin anew: poses and depths that were fitted to another scene, or to noise,
    may be a minimum that they do not leave, and the test for motion needs equal poses.

    Args:
        graph: of the sequence; its window is changed in place.
        step: step of the model on the window.
        config: settings of the tracker.

    Returns:
        True if the frames are as many as an initialisation needs, and the parallax is sufficient for tracking.
    """
    enough = initialise(graph.window, step, config)
    if drop_unrelated(graph, step, config):
        graph.window.reset()
        enough = len(graph.window) >= config.initial_frames and initialise(graph.window, step, config)
    return enough and len(graph.window) >= config.initial_frames


def drop_unrelated(graph: KeyframeGraph, step: WindowStep, config: TrackerConfig) -> bool:
    """Remove the frames of the first window that do not show the scene of the newest ones.

    They are a segment of their own, with the keyframes that have left the window, if they are as many as an
    initialisation needs and agree with each other; otherwise they are lost.

    Args:
        graph: of the sequence; the window is not initialised yet.
        step: of the model on the window, after some steps.
        config: settings of the tracker.

    Returns:
        True if frames were removed.
    """
    window, count = graph.window, last_unrelated(step, config)
    if not count:
        return False
    first = window.frames[count].identifier
    earlier = (window.ii < count) & (window.jj < count)
    rows = len(graph.log.rows(graph.segment, last=first - 1))
    if rows >= config.initial_frames and related_share(step, earlier) >= config.min_inliers:
        window.keep(earlier | ((window.ii >= count) & (window.jj >= count)))
        for _ in range(count):
            graph.archive_oldest()
    else:
        for _ in range(count):
            graph.log.lose(graph.discard(0).identifier, NO_MATCH)
    if graph.log.rows(graph.segment, last=first - 1):
        graph.split_segment(first)
    return True


def settle_first_window(graph: KeyframeGraph, step: WindowStep, config: TrackerConfig, last: bool) -> bool:
    """Optimise the window of a segment that was never initialised and ends, and decide if its frames are kept.

    Args:
        graph: of the sequence; its window is changed in place.
        step: of the model on the window.
        config: settings of the tracker.
        last: no frame will follow.

    Returns:
        True if they agree with each other, and are as many as an initialisation needs or the only ones of the sequence.
    """
    if len(graph.window) > 1:
        for age in range(config.initial_updates):
            step(StepOptions(fixed=1, damping=damping_at(age)))
        drop_unrelated(graph, step, config)
    if not len(graph.window):
        return False
    records = graph.log.frames
    rows = sum(not record.lost and record.segment == graph.segment for record in records)
    only = last and graph.segment == 0 and not any(record.reason == NO_MATCH for record in records)
    agree = len(graph.window) == 1 or window_inliers(step) >= config.min_inliers
    return agree and (only or rows >= config.initial_frames)


def restart_due(age: int, ambiguous: bool) -> bool:
    """Tell if a second solution is looked for after a frame (:func:`leave_minimum`).

    The first frames have too little parallax to tell a relief from the reversed one; later frames have more.

    Args:
        age: number of frames since the initialisation.
        ambiguous: another solution was nearly as good the last time.

    Returns:
        True at :data:`RESTART_AGES`, and each :data:`AGAIN` frames as long as the window is ambiguous.
    """
    return age in RESTART_AGES or (ambiguous and age % AGAIN == 0)


def leave_minimum(step: WindowStep, config: TrackerConfig) -> bool:
    """Start the window anew if that leads to a better solution (:mod:`dvo.ba.multistart`).

    Args:
        step: of the model on the window of an initialised tracker; its poses and inverse depths are changed in place.
        config: scale of the covariance.

    Returns:
        True if another solution is nearly as good as the one that is left (:mod:`dvo.odometry.second_solution`).
    """
    window = step.window
    if measured_share(window.measured) >= MOST:
        return False
    found = multistart(window.problem(), RESTARTS)
    best = preferred(found)
    if best.start != PRESENT:
        _take(window, best)
        match_window(window)
    return has_second_solution(step, config, [best, *(other for other in found if other is not best)])
