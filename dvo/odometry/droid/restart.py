"""Another start for the window of the dense odometry, where the first one may have led to a wrong minimum.

Two views of a plane have two motions that explain their flow (Longuet-Higgins, "The reconstruction of a plane surface
from two perspective projections", Proc. R. Soc. B 1986), and over a short baseline any relief has nearly the flow of
the reversed one under another motion (Koenderink and van Doorn, JOSA A 1991). More views tell them apart, but the
iterations of bundle adjustment do not lead from one to the other, and the network measures a flow near the one that the
present solution predicts. So the other motion of every two neighbouring keyframes is sought, from the epipolar
residuals of their flow; the network measures anew from there, and the robust costs of both solutions are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from dvo.ba.layer.dense import pixel_grid
from dvo.ba.multistart import ABANDON, AS_THEY_ARE, OPTIONS, PRESENT, Start, clearly_lower, multistart, present
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.geometry import se3, so3
from dvo.odometry.droid.window import DenseWindow, FrameEdge
from dvo.odometry.two_frame.epipolar_refinement import RefinementOptions, refine_motion
from dvo.odometry.two_frame.two_view import parallax_of

_OPTIONS = replace(OPTIONS, solver=replace(OPTIONS.solver, max_iterations=20))
_EVERY = 3  # of the rows and columns of a map, one counts
_REFINEMENT = RefinementOptions(iterations=20, parallax=0.0)
_MAX_STEP = 2.0  # step between two keyframes, median depths
_OTHER = 0.02  # rotation between two motions from which on they are different solutions, radians
# Directions of the translation that motions are sought from: the axes, and those between them.
_DIRECTIONS = (
    (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1),
)  # fmt: skip


def better_solution(window: DenseWindow, measure: Callable[[], object], abandon: float = ABANDON) -> bool:
    """Solve the window from the other motions of its keyframes too, and keep the better solution.

    Args:
        window: with a solution and its measurements; changed in place.
        measure: takes updates of the window.
        abandon: factor of the cost of the present solution, on its own measurements, above which another one is not
            measured anew.

    Returns:
        True if the other solution was taken.
    """
    other = other_poses(window) if len(window) > 2 else None
    if other is None:
        return False
    poses = other

    def turned(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
        depths = torch.ones_like(problem.inverse_depths)
        return _with_depths(problem.with_values(poses_cw=poses, inverse_depths=depths), options)

    sampled = window_problem(window)
    found = {s.start: s for s in multistart(sampled, {PRESENT: present, "turned": turned}, _OPTIONS, abandon)}
    if "turned" not in found:
        return False
    kept = _Kept(window)
    take(window, found["turned"].problem)
    for edge in window.edges:
        edge.hidden, edge.positions, edge.confidence, edge.age = edge.source.hidden, None, None, 0
    window.held = []
    measure()
    again = window_problem(window)
    (after,) = multistart(again, {PRESENT: present}, _OPTIONS)
    turned_by = _turned(sampled.poses_cw, again.poses_cw)
    if clearly_lower(after.cost, found[PRESENT].cost) and turned_by > _OTHER:
        return True
    kept.restore(window)
    return False


def window_problem(window: DenseWindow) -> PatchProblem:
    """Bundle adjustment problem of some pixels of the keyframes.

    Args:
        window: with measurements.

    Returns:
        One patch for each chosen pixel, float64 on the CPU.
    """
    frames = window.keyframes
    edges = [edge for edge in (*window.edges, *window.held) if edge.positions is not None]
    place = {id(frame): k for k, frame in enumerate(frames)}
    ends = torch.tensor([(place[id(edge.source)], place[id(edge.target)]) for edge in edges])
    poses, intrinsics = (torch.stack(x).cpu().double() for x in
                         ([frame.pose_cw for frame in frames], [frame.intrinsics for frame in frames]))  # fmt: skip
    depths = _sampled([frame.inverse_depth for frame in frames])
    positions, weights = (_sampled(maps) for maps in
                          ([edge.positions for edge in edges], [edge.confidence for edge in edges]))  # fmt: skip
    return _problem(poses, depths, intrinsics, positions, weights, ends, frames[0].inverse_depth.shape)


def take(window: DenseWindow, problem: PatchProblem) -> None:
    """Give the keyframes a solution; depths of the other pixels are interpolated.

    Args:
        window: its poses and depths are replaced.
        problem: of :func:`window_problem`, at the solution.
    """
    frames = window.keyframes
    size = tuple(frames[0].inverse_depth.shape)
    grids = problem.inverse_depths.view(len(frames), 1, *(len(_chosen(length)) for length in size))
    depths = F.interpolate(grids, size, mode="bilinear", align_corners=False)[:, 0]
    for frame, pose, depth in zip(frames, problem.poses_cw, depths, strict=True):
        frame.pose_cw, frame.inverse_depth = pose.to(frame.pose_cw), depth.to(frame.inverse_depth)


def _problem(
    poses_cw: Tensor, depths: Tensor, intrinsics: Tensor, positions: Tensor, weights: Tensor, ends: Tensor,
    size: torch.Size,
) -> PatchProblem:  # fmt: skip
    """Problem of sampled maps: depths ``(N, h, w)``, positions and weights ``(E, h, w, 2)`` of edges ``(E, 2)``."""
    rows, columns = torch.meshgrid(*(_chosen(length) for length in size), indexing="ij")
    count, frames = rows.numel(), len(depths)
    grid = torch.stack([columns, rows], -1).double().reshape(-1, 2).repeat(frames, 1)
    patches = torch.cat([grid, depths.reshape(-1, 1)], 1)[..., None, None]
    source, target = (end.repeat_interleave(count) for end in ends.unbind(1))
    points = source * count + torch.arange(count).repeat(len(ends))
    measured = positions.reshape(-1, 2), weights.reshape(-1, 2)
    return PatchProblem(poses_cw, patches, intrinsics, *measured, source, target, points)


def _sampled(maps: Sequence[Tensor | None]) -> Tensor:
    """Chosen pixels of maps ``(h, w, ...)``, float64 on the CPU."""
    stacked = torch.stack([each for each in maps if each is not None]).cpu().double()
    rows, columns = torch.meshgrid(*(_chosen(length) for length in stacked.shape[1:3]), indexing="ij")
    return stacked[:, rows, columns]


def _with_depths(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
    """Depths that suit the poses, which stay."""
    return problem.with_values(patches=solve(problem, replace(options, move_poses=False)).patches)


class _Kept:
    """Solution of a window, to come back to it."""

    def __init__(self, window: DenseWindow) -> None:
        self._frames = [(frame.pose_cw, frame.inverse_depth, frame.confidence) for frame in window.keyframes]
        self._edges, self._held = [replace(edge) for edge in window.edges], list(window.held)

    def restore(self, window: DenseWindow) -> None:
        """Give the window its solution back."""
        for frame, (pose, depth, confidence) in zip(window.keyframes, self._frames, strict=True):
            frame.pose_cw, frame.inverse_depth, frame.confidence = pose, depth, confidence
        window.edges, window.held = self._edges, self._held


def _turned(a: Tensor, b: Tensor) -> float:
    """Largest rotation, in radians, between the motions of neighbours in two sets of poses ``(N, 7)``."""
    before, after = (se3.relative(poses[:-1], poses[1:])[:, 3:] for poses in (a, b))
    return float(so3.angle(so3.multiply(so3.conjugate(before), after)).max())


def other_poses(window: DenseWindow) -> Tensor | None:
    """Poses by the other motions of neighbouring keyframes, with steps in units of the median depth.

    Args:
        window: with a solution.

    Returns:
        ``(N, 7)`` world to camera, float64; None without an edge from each keyframe to the next one, or if no two
        neighbours have another motion.
    """
    between = {(id(edge.source), id(edge.target)): edge for edge in (*window.held, *window.edges)}
    poses, others = [window.keyframes[0].pose_cw.cpu().double()], 0
    for a, b in zip(window.keyframes[:-1], window.keyframes[1:], strict=True):
        edge = between.get((id(a), id(b)))
        if edge is None or edge.positions is None:
            return None
        pose_ab, is_other = _other_motion(edge)
        others += is_other
        poses.append(se3.compose(se3.inverse(pose_ab), poses[-1]))
    return torch.stack(poses) if others else None


def _other_motion(edge: FrameEdge) -> tuple[Tensor, bool]:
    """Best motion of the target, in the coordinates of the source, that is not the present one; or that, and False."""
    assert edge.positions is not None and edge.confidence is not None
    positions, weights = edge.positions.cpu().double(), edge.confidence.mean(-1).cpu().double()
    intrinsics = edge.source.intrinsics.cpu().double()
    flow = positions.permute(2, 0, 1) - pixel_grid(*positions.shape[:2])
    u, v = (flow.flatten(1).median(1).values / intrinsics[:2]).tolist()
    rotation = so3.exp(torch.tensor([v, -u, 0.0], dtype=torch.float64))  # it moves the image by the median flow
    starts = [torch.cat([torch.tensor(way, dtype=torch.float64), rotation]) for way in _DIRECTIONS]
    now = se3.relative(edge.target.pose_cw, edge.source.pose_cw).cpu().double()
    size = edge.source.inverse_depth.shape
    sampled = _sampled([edge.positions]), _sampled([edge.confidence])
    flat = torch.ones(1, *sampled[0].shape[1:3], dtype=torch.float64)
    two = _problem(
        se3.identity(2, dtype=torch.float64), flat, intrinsics.expand(2, 4), *sampled, torch.tensor([[0, 1]]), size
    )

    def along(start: Tensor) -> Start:
        pose_ab = refine_motion(flow, [start], intrinsics, _REFINEMENT, weights=weights)
        parallax = parallax_of(flow.numpy(), pose_ab.numpy(), intrinsics.numpy())
        side = 1.0 if (parallax.motion * parallax.direction).sum() >= 0 else -1.0
        pose_ab = torch.cat([pose_ab[:3] * side * parallax.step(_MAX_STEP), pose_ab[3:]])

        def at(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
            poses = torch.stack([problem.poses_cw[0], se3.inverse(pose_ab)])
            return _with_depths(problem.with_values(poses_cw=poses), options)

        return at

    ways = {PRESENT: along(now)} | {str(k): along(start) for k, start in enumerate(starts)}
    found = [(s, se3.inverse(s.problem.poses_cw[1])) for s in multistart(two, ways, AS_THEY_ARE, float("inf"))]
    here = next(pose_ab for solution, pose_ab in found if solution.start == PRESENT)
    others = [pose for _, pose in found if float(so3.angle(so3.multiply(so3.conjugate(here[3:]), pose[3:]))) > _OTHER]
    return others[0] if others else here, bool(others)


def _chosen(length: int) -> Tensor:
    """Rows or columns in the middle of equal parts."""
    return torch.arange(_EVERY // 2, length, _EVERY)
