"""Another start for the window of the dense odometry, where the first one may have led to a wrong minimum.

Two views of a plane have two motions that explain their flow (Longuet-Higgins, "The reconstruction of a plane surface
from two perspective projections", Proc. R. Soc. B 1986), and over a short baseline any relief has nearly the flow of
the reversed one under another motion (Koenderink and van Doorn, JOSA A 1991). More views tell them apart, but the
iterations of bundle adjustment do not lead from one to the other, and the network measures a flow near the one that the
present solution predicts. So the other motion of every two neighbouring keyframes is sought, from the epipolar
residuals of their flow; the network measures anew from there, and the robust costs of both solutions are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from dvo.ba.dense import pixel_grid
from dvo.ba.global_adjust import GlobalBAOptions, GlobalBAResult, global_bundle_adjust
from dvo.ba.kernels import Kernel
from dvo.ba.levenberg import LMOptions
from dvo.geometry import se3, so3
from dvo.odometry.dense_window import DenseWindow, FrameEdge
from dvo.odometry.epipolar_refinement import RefinementOptions, motion_candidates
from dvo.odometry.two_view import parallax_of

_EVERY = 3  # of the rows and columns of a map, one counts
_REFINEMENT = RefinementOptions(iterations=20, parallax=0.0)
_LONGEST = 2.0  # step between two keyframes, median depths
_OTHER = 0.02  # rotation between two motions from which on they are different solutions, radians
# Directions of the translation that motions are sought from: the axes, and those between them.
_DIRECTIONS = (
    (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1),
)  # fmt: skip


@dataclass(frozen=True)
class DenseRestartOptions:
    """Options of :func:`better_solution`.

    Attributes:
        kernel: robust kernel of the costs.
        max_residual: feature pixels; a longer residual has a constant cost.
        iterations: of bundle adjustment of the other solution, and of the present one, before their costs are compared.
        promising: factor of the cost of the present solution, on its own measurements, below which another one is
            worth being measured anew.
        margin: factor of the cost of the present solution below which another one is taken; further updates alone lower
            the cost a little.
    """

    kernel: Kernel = Kernel("cauchy", 0.1)
    max_residual: float = 32.0
    iterations: int = 20
    promising: float = 1.5
    margin: float = 0.75


def better_solution(
    window: DenseWindow,
    measure: Callable[[], object],
    options: DenseRestartOptions = DenseRestartOptions(),  # noqa: B008 (frozen)
) -> bool:
    """Solve the window from the other motions of its keyframes too, and keep the better solution.

    Args:
        window: with a solution and its measurements; changed in place.
        measure: takes updates of the window.
        options: kernels and limits.

    Returns:
        True if the other solution was taken.
    """
    other = _other_poses(window) if len(window) > 2 else None
    if other is None:
        return False
    problem = _Problem(window, options)
    present = problem.solve(problem.poses(), problem.depths())
    flat = torch.ones_like(problem.depths())
    depths = problem.solve(other, flat, move_poses=False).patches[:, 2, 0, 0]
    found = problem.solve(other, depths)
    if not found.cost < options.promising * present.cost:
        return False
    kept, first = _Kept(window), problem.poses()
    before = problem.relative_cost(present)
    problem.take(found)
    for edge in window.edges:
        edge.hidden, edge.positions, edge.confidence, edge.age = edge.source.hidden, None, None, 0
    window.held = []
    measure()
    problem = _Problem(window, options)
    after = problem.relative_cost(problem.solve(problem.poses(), problem.depths()))
    if after < options.margin * before and _turned(first, problem.poses()) > _OTHER:
        return True
    kept.restore(window)
    return False


class _Problem:
    """Bundle adjustment of some pixels of the keyframes, in double precision on the CPU.

    Args:
        window: the keyframes, with measurements.
        options: kernel.
    """

    def __init__(self, window: DenseWindow, options: DenseRestartOptions) -> None:
        self.frames, self.options = window.keyframes, options
        edges = [edge for edge in (*window.edges, *window.held) if edge.positions is not None]
        place = {id(frame): k for k, frame in enumerate(self.frames)}
        self.size = self.frames[0].inverse_depth.shape
        self.rows, self.columns = torch.meshgrid(*(_chosen(length) for length in self.size), indexing="ij")
        count = self.rows.numel()
        ends = torch.tensor([(place[id(edge.source)], place[id(edge.target)]) for edge in edges])
        source, target = (end.repeat_interleave(count) for end in ends.unbind(1))
        points = source * count + torch.arange(count).repeat(len(edges))
        positions = self._sampled([edge.positions for edge in edges]).reshape(-1, 2)
        weights = self._sampled([edge.confidence for edge in edges]).reshape(-1, 2)
        intrinsics = torch.stack([frame.intrinsics for frame in self.frames]).cpu().double()
        self.measured = (intrinsics, positions, weights, source, target, points)

    def _sampled(self, maps: list[Tensor | None]) -> Tensor:
        stacked = torch.stack([each for each in maps if each is not None]).cpu().double()
        return stacked[:, self.rows, self.columns]

    def poses(self) -> Tensor:
        """``(N, 7)`` world to camera."""
        return torch.stack([frame.pose_cw for frame in self.frames]).cpu().double()

    def depths(self) -> Tensor:
        """``(K,)`` inverse depths of the pixels."""
        return self._sampled([frame.inverse_depth for frame in self.frames]).flatten()

    def solve(self, poses_cw: Tensor, depths: Tensor, move_poses: bool = True) -> GlobalBAResult:
        """Adjust poses (or none) and inverse depths."""
        grid = torch.stack([self.columns, self.rows], -1).double().reshape(-1, 2).repeat(len(self.frames), 1)
        patches = torch.cat([grid, depths[:, None]], 1)[..., None, None]
        settings = GlobalBAOptions(
            fixed=1, kernel=self.options.kernel, max_residual=self.options.max_residual, move_poses=move_poses,
            solver=LMOptions(max_iterations=self.options.iterations, tolerance=1e-3),
        )  # fmt: skip
        return global_bundle_adjust(poses_cw, patches, *self.measured, settings)

    def relative_cost(self, solution: GlobalBAResult) -> float:
        """Cost over the sum of the weights, so that solutions with other measurements compare."""
        return solution.cost / max(float(self.measured[2].sum()), 1e-12)

    def take(self, solution: GlobalBAResult) -> None:
        """Give the keyframes a solution; depths of the other pixels are interpolated."""
        grids = solution.patches[:, 2].reshape(len(self.frames), 1, *self.rows.shape)
        depths = F.interpolate(grids, tuple(self.size), mode="bilinear", align_corners=False)[:, 0]
        for frame, pose, depth in zip(self.frames, se3.normalise(solution.poses_cw), depths, strict=True):
            frame.pose_cw, frame.inverse_depth = pose.to(frame.pose_cw), depth.to(frame.inverse_depth)


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


def _other_poses(window: DenseWindow) -> Tensor | None:
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
    found = motion_candidates(flow, [now, *starts], intrinsics, _REFINEMENT, weights=weights)
    present = found[0][1]
    others = [
        (cost, pose)
        for cost, pose in found[1:]
        if float(so3.angle(so3.multiply(so3.conjugate(present[3:]), pose[3:]))) > _OTHER
    ]
    pose_ab = min(others, key=lambda item: item[0])[1] if others else present
    parallax = parallax_of(flow.numpy(), pose_ab.numpy(), intrinsics.numpy())
    side = 1.0 if (parallax.motion * parallax.direction).sum() >= 0 else -1.0
    return torch.cat([pose_ab[:3] * side * parallax.step(_LONGEST), pose_ab[3:]]), bool(others)


def _chosen(length: int) -> Tensor:
    """Rows or columns in the middle of equal parts."""
    return torch.arange(_EVERY // 2, length, _EVERY)
