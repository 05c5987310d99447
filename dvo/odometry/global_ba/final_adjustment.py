"""Final adjustment of a tracker: bundle adjustment of all frames of a segment, once the segment is complete.

While it runs, the tracker estimates a frame from the frames before it, and fixes the pose of a redundant keyframe when
the keyframe is dropped, although depths and scale of the window still change afterwards. The final adjustment solves
for all keyframes, dropped ones included, and all inverse depths at once, from every archived measurement and with a
robust kernel that takes the influence from moving bodies and wrong matches. Long segments are solved in blocks with the
frames before each held, which bounds the memory, and the time per frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.ba.limits import depth_range_of
from dvo.ba.multistart import DEPTH_STARTS, PRESENT, RESTARTS, multistart, preferred, present
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.ba.sparse.levenberg import LMOptions
from dvo.core.errors import DvoError
from dvo.core.settings import check_settings
from dvo.geometry import se3
from dvo.map.correction import rescale
from dvo.map.map import Map
from dvo.map.measurements import measured_depths
from dvo.map.recordings import count_earlier, increasing_times
from dvo.odometry.depth.depth_factor import MEASURED_SHARE, far_scale, measured_share, to_measured
from dvo.odometry.global_ba.rolling_shutter import PoseTrack, Shutter, as_global_shutter

_RANGES = {
    "max_residual": (0, 1e6),
    "iterations": (1, 1000),
    "tolerance": (0, 1),
    "block": (3, 10**6),
    "loop_block": (3, 10**6),
    "overlap": (1, 10**6),
    "shutter_rounds": (0, 100),
    "restart_frames": (0, 10**6),
}


@dataclass(frozen=True)
class AdjustmentOptions:
    """Options of :func:`adjust_segment`.

    Attributes:
        kernels: robust kernels of the weighted residuals, one after the other; their width is in feature pixels times
            the root of the weight. The first is wide, for poses that are far off; the last decides.
        max_residual: feature pixels; a longer residual has no influence.
        iterations: Levenberg-Marquardt steps of a block with each kernel, at most.
        tolerance: relative decrease of the cost by a step below which a solution has converged.
        block: largest number of frames that are solved for at once.
        loop_block: the same for a graph with loops, which one solution has to close.
        overlap: frames at the end of a block that the next block solves for again.
        shutter_rounds: solutions with measurements corrected for a rolling shutter, each from the motion of the last.
            They take the last kernel, and the solution before them the others.
        restart_frames: frames at the beginning that decide whether the solution is started anew.

    Raises:
        DvoError: a value of another type or out of range, or no kernel.
    """

    kernels: tuple[Kernel, ...] = (Kernel("huber", 0.5), Kernel("cauchy", 0.1))
    max_residual: float = 32.0
    iterations: int = 10
    tolerance: float = 1e-3
    block: int = 600
    loop_block: int = 3000
    overlap: int = 60
    shutter_rounds: int = 2
    restart_frames: int = 60

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)
        if not self.kernels:
            raise DvoError("no kernel", field="kernels", remedy="give one or more; Kernel() has no influence")


_MOTION_ITERATIONS = 5  # of a solution that the motion during the readout is taken from, at most
_MOST = 1.5  # change of an inverse depth that is extrapolated
_RESTART_ITERATIONS = 20  # of the first frames from each start, at most
_LOOK_FRAMES = 20  # of the first frames that tell if another start may be better


@dataclass(frozen=True)
class _Change:
    """Similarity from the poses before the adjustment to those of the frames that are solved already.

    Attributes:
        before, after: ``(7,)`` world to camera of the newest frame that is solved.
        scale: of lengths, after over before.
    """

    before: Tensor
    after: Tensor
    scale: float

    def __call__(self, poses_cw: Tensor) -> Tensor:
        """Move poses ``(N, 7)`` along with the newest frame that is solved."""
        relative = se3.relative(self.before.expand_as(poses_cw), poses_cw)
        scaled = torch.cat([relative[:, :3] * self.scale, relative[:, 3:]], 1)
        return se3.compose(scaled, self.after.expand_as(poses_cw))


def adjust_segment(
    graph: Map,
    segment: int,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008 (frozen)
    shutter: Shutter | None = None,
    since: int = 0,
) -> int:
    """Solve for the archived keyframes and inverse depths of a segment, in place.

    Args:
        graph: the whole segment is archived; its poses and inverse depths are replaced. Those of earlier recordings in
            the same world stay.
        segment: its number.
        options: kernels, iterations and size of the blocks.
        shutter: timing of the rows; None, or a readout time of 0, for a global shutter.
        since: identifier; keyframes before it stay.

    Returns:
        Number of keyframes with patches, dropped ones included. Those whose measurements have been released to save
        memory keep their poses.

    Example:
        >>> run = dvo.run(odometry, dvo.open("video.mp4", calib="calib.txt"))
        >>> adjust_segment(odometry.graph, segment=0)
    """
    frames = graph.members(segment)
    identifiers = np.array([frame.identifier for frame in frames])
    if len(identifiers) < 3:
        return 0
    times, map_size = increasing_times(graph, frames), count_earlier(graph, identifiers)
    if not map_size and (far := far_scale(frames)) != 1:
        rescale(graph, segment, far)
    old = graph.poses_cw(identifiers)
    now = old.clone()
    # Frames whose measurements have been released to save memory stay; with some more they hold the scale of the rest.
    edges = graph.archive.edges()
    linked = np.isin(identifiers, np.concatenate([edges.source, edges.target]))[map_size:]
    if not linked.any():
        return 0
    held = min(map_size + int(linked.argmax()) + options.overlap, len(identifiers) - 1)
    held = held if not linked[0] else max(map_size, 1)
    later = int(np.searchsorted(identifiers, since))
    held = max(held, min(later, len(identifiers) - 1))
    start = solved = held
    block = options.loop_block if graph.loops else options.block
    change = _Change(old[held - 1], old[held - 1], 1.0)
    rolling = shutter if shutter is not None and shutter.readout > 0 else None
    # The last kernel is for corrected measurements, if they are corrected; there may be no other one.
    first = options.kernels if rolling is None else options.kernels[:-1]
    last = replace(options, kernels=options.kernels[-1:])
    while solved < len(identifiers):
        end = min(max(start + block, solved + 1), len(identifiers))
        # Held frames that share no edge with the block are left out, but not those that hold the first one.
        whole = start == held and not (map_size or later)
        part = graph.problem(
            True, segment, 0 if whole else int(identifiers[start]), int(identifiers[end - 1])
        ).planned()
        rows = torch.from_numpy(np.searchsorted(identifiers, part.identifiers.numpy()))
        fixed, new = rows < start, rows >= solved
        now[solved:end] = change(old[solved:end])
        depths = part.patches[:, 2, 0, 0].reshape(len(rows), -1).clone()
        depths[new] /= change.scale
        poses, found = now[rows], depths
        if first:
            poses, found, _ = solve_part(part, poses, found, fixed, replace(options, kernels=first))
        if start == 1 and not map_size and measured_share(measured_depths(part)) < MEASURED_SHARE:
            kept = torch.tensor([graph.archive[int(k)].anchor is None for k in part.identifiers])
            poses, found = _leave_minimum(part, poses, found, fixed, kept, options)
        rounds = options.shutter_rounds if rolling is not None else 0
        for number in range(rounds):
            assert rolling is not None
            # All but the last find the motion only.
            few = last if number == rounds - 1 else replace(last, iterations=min(_MOTION_ITERATIONS, last.iterations))
            now[rows] = poses
            track = PoseTrack.through(times[:end], now[:end], rolling)
            corrected = as_global_shutter(part, poses, found, rows, track, rolling)
            poses, found, _ = solve_part(corrected, poses, found, fixed, few)
        now[rows] = poses
        measured = torch.zeros(len(part.patches), dtype=torch.bool)
        measured[part.kk] = True
        told = new[:, None] & measured.view_as(depths)
        told = told if bool(told.any()) else new[:, None].expand_as(depths)
        change = _Change(old[end - 1], now[end - 1], change.scale * float((depths[told] / found[told]).median()))
        for row in (~fixed).nonzero()[:, 0].tolist():
            graph.correct(int(part.identifiers[row]), poses[row].numpy(), found[row].numpy())
        solved, start = end, max(end - options.overlap, start + 1)
    return len(identifiers)


def _leave_minimum(
    part: PatchProblem, poses_cw: Tensor, depths: Tensor, fixed: Tensor, kept: Tensor, options: AdjustmentOptions
) -> tuple[Tensor, Tensor]:
    """Start the first block anew if that is better for its first frames; see :mod:`dvo.ba.multistart`.

    Args:
        part, poses_cw, depths, fixed: block with its solution.
        kept: ``(N,)`` bool, keyframes that were not dropped.
        options: kernels and iterations.

    Returns:
        Poses ``(N, 7)`` and inverse depths ``(N, M)`` of the better solution.
    """
    n, m = min(options.restart_frames, len(depths)), depths.shape[1]
    whole = part.with_values(poses_cw=poses_cw, inverse_depths=depths.flatten())
    first = torch.arange(len(poses_cw)) < n
    solver = LMOptions(max_iterations=_RESTART_ITERATIONS, tolerance=options.tolerance)
    settings = GlobalBAOptions(fixed[:n], options.kernels[-1], options.max_residual, solver=solver)
    # Half of the patches tell two solutions apart as well, and measured depths have no part in it.
    half = whole.with_values(factors=()).edges(part.kk % 2 == 0)
    # Few frames are solved for in a fraction of the time; only if they prefer another start, all of them are.
    few = torch.zeros_like(first)
    few[:n] = thinned(kept[:n], _LOOK_FRAMES)
    look = half.select(few)
    if not len(look.kk) or preferred(multistart(look, RESTARTS, replace(settings, fixed=fixed[few]))).start == PRESENT:
        return poses_cw, depths
    early = half.select(first)
    better = preferred(multistart(early, RESTARTS, settings))
    if better.start == PRESENT:
        return poses_cw, depths

    def extended(problem: PatchProblem, _: GlobalBAOptions) -> PatchProblem:
        solved = better.problem.inverse_depths.view(n, m)[:, ::2]
        poses, found = extend_solution(poses_cw, depths, better.problem.poses_cw, solved)
        return problem.with_values(poses_cw=poses, inverse_depths=found.flatten())

    def restarted(problem: PatchProblem, settings: GlobalBAOptions) -> PatchProblem:
        images = problem.with_values(factors=())  # measured depths hold a solution at the scale of the old one
        (found,) = multistart(images, {better.start: DEPTH_STARTS[better.start]}, settings)
        scaled = to_measured(found.problem.poses_cw, found.problem.inverse_depths, measured_depths(problem))
        return problem.with_values(poses_cw=scaled[0], inverse_depths=scaled[1])

    # The whole may be in another minimum than its beginning: both the better beginning, extended, and the better start.
    settings = replace(settings, fixed=fixed, solver=replace(solver, max_iterations=3 * options.iterations))
    found = multistart(whole, {PRESENT: present, "extended": extended, better.start: restarted}, settings)[0].problem
    return found.poses_cw, found.inverse_depths.reshape_as(depths)


def thinned(kept: Tensor, count: int) -> Tensor:
    """Choose frames of a problem: those that are kept and others, or some of those that are kept, evenly.

    Args:
        kept: ``(N,)`` bool.
        count: of the frames that are chosen, if there are as many.

    Returns:
        ``(N,)`` bool.
    """
    missing = count - int(kept.sum())
    chosen, among = (kept.clone(), ~kept) if missing >= 0 else (torch.zeros_like(kept), kept)
    others = among.nonzero()[:, 0]
    number = min(missing if missing >= 0 else count, len(others))
    chosen[others[torch.linspace(0, len(others) - 1, number).round().long()]] = True
    return chosen


def extend_solution(poses_cw: Tensor, depths: Tensor, first_cw: Tensor, solved: Tensor) -> tuple[Tensor, Tensor]:
    """Start of all frames from another solution of the first ones.

    Later frames keep their motion; their patches, whose relief belongs to the old solution, get equal depths.

    Args:
        poses_cw, depths: ``(N, 7)`` and ``(N, M)`` of the old solution.
        first_cw: ``(n, 7)`` of the new one.
        solved: ``(n, M / 2)`` inverse depths of the new one, of every second patch.

    Returns:
        Poses ``(N, 7)`` and inverse depths ``(N, M)``.
    """
    n = len(first_cw)
    scale = float((depths[:n, ::2].median(1).values / solved.median(1).values).median())
    change = _Change(poses_cw[n - 1], first_cw[-1], scale)
    depths = (depths.median(1, keepdim=True).values / scale).expand_as(depths).clone()
    depths[:n] = solved.median(1, keepdim=True).values
    depths[:n, ::2] = solved
    return torch.cat([first_cw, change(poses_cw[n:])]), depths


def extrapolated(
    poses_cw: Tensor, depths: Tensor, earlier_cw: Tensor, earlier_depths: Tensor, ratio: float
) -> tuple[Tensor, Tensor]:
    """Start of a solution from two that belong to other values of a parameter, along which they lie on a line.

    Args:
        poses_cw, depths: ``(N, 7)`` and ``(N, M)`` inverse depths of the nearer one.
        earlier_cw, earlier_depths: of the other one.
        ratio: way from the nearer one to the wanted value over that from the other one to the nearer one.

    Returns:
        Poses ``(N, 7)`` and inverse depths ``(N, M)``.
    """
    step = ratio * se3.log(se3.relative(earlier_cw, poses_cw))
    factor = (depths / earlier_depths).clamp(1 / _MOST, _MOST) ** ratio
    return se3.normalise(se3.compose(se3.exp(step), poses_cw)), depths * factor


def solve_part(
    part: PatchProblem, poses_cw: Tensor, depths: Tensor, fixed: Tensor, options: AdjustmentOptions
) -> tuple[Tensor, Tensor, float]:
    """Solve for poses and inverse depths of a part of a segment.

    Args:
        part: measurements; its poses and depths are not used.
        poses_cw: ``(N, 7)`` to start from.
        depths: ``(N, M)`` inverse depths to start from.
        fixed: ``(N,)`` bool, poses that stay.
        options: kernels and iterations.

    Returns:
        Poses ``(N, 7)``, inverse depths ``(N, M)``, and the cost with the last kernel (0 without measurements).
    """
    cost = 0.0
    if not len(part.kk) or fixed.all():
        return poses_cw, depths, cost
    part = part.with_values(poses_cw=poses_cw, inverse_depths=depths.flatten())
    solver = LMOptions(max_iterations=options.iterations, tolerance=options.tolerance)
    limits = depth_range_of(float(depths.median(1).values.max()))  # of the keyframe of the nearest scene
    for kernel in options.kernels:
        found = solve(part, GlobalBAOptions(fixed, kernel, options.max_residual, limits, solver=solver))
        part, cost = part.with_values(poses_cw=se3.normalise(found.poses_cw), patches=found.patches), found.cost
    return part.poses_cw, part.inverse_depths.reshape_as(depths), cost
