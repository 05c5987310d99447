"""Poses to start a pose graph from: composed along a spanning tree, or from a linear relaxation.

Both begin at the poses that stay. A part of the graph without any begins at its first pose.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.ba.sparse.block_matrix import BlockMatrix, BlockPattern, LinearSolver, make_pattern, solve_blocks
from dvo.geometry import se3, sim3, so3

SINGULAR = 1e-9
"""Of the mean information of an edge, added before it is inverted: directions without any are costly, not infinite."""
PRIOR = 1e-8
"""Weight of the tree in the relaxation, of the mean weight of an edge."""


@dataclass(frozen=True)
class Tree:
    """Spanning tree, or forest.

    Attributes:
        poses: ``(N, 7)`` or ``(N, 8)`` composed along it.
        roots: ``(N,)`` bool, poses that it begins at.
    """

    poses: Tensor
    roots: Tensor


def spanning_tree(
    poses_cw: Tensor, ii: Tensor, jj: Tensor, measurements: Tensor, information: Tensor | None, fixed: Tensor
) -> Tree:
    """Poses along the paths of least variance from a root (Dijkstra 1959).

    Args:
        poses_cw, ii, jj, measurements: as of :func:`dvo.ba.pose_graph.optimise_pose_graph`.
        information: ``(E, D, D)`` or None; the trace of its inverse is the length of an edge. An edge without any
            information is not used.
        fixed: ``(N,)`` bool, the poses that stay.
    """
    count = len(poses_cw)
    length = [1.0] * len(ii) if information is None else _variance(information).tolist()
    around: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for edge, (i, j, each) in enumerate(zip(ii.tolist(), jj.tolist(), length, strict=True)):
        if i != j and each < float("inf"):
            around[i].append((j, edge))
            around[j].append((i, edge))
    parent, by = list(range(count)), [-1] * count
    far = [float("inf")] * count
    done = [False] * count
    roots = fixed.tolist()
    queue = [(0.0, at) for at in range(count) if roots[at]]
    for begin in range(-1, count):  # of what the poses that stay do not reach
        if begin >= 0 and not done[begin]:
            roots[begin] = True
            queue = [(0.0, begin)]
        while queue:
            distance, at = heapq.heappop(queue)
            if done[at]:
                continue
            done[at] = True
            for other, edge in around[at]:
                reached = distance + length[edge]
                if not done[other] and not roots[other] and reached < far[other]:
                    far[other], parent[other], by[other] = reached, at, edge
                    heapq.heappush(queue, (reached, other))
    device = poses_cw.device
    group = se3 if poses_cw.shape[-1] == 7 else sim3
    above, edges = torch.tensor(parent, device=device), torch.tensor(by, device=device)
    root = edges < 0
    motion = measurements[edges.clamp(min=0)] if len(ii) else poses_cw
    against = (ii[edges.clamp(min=0)] != above) if len(ii) else root
    motion = torch.where(against[:, None], group.inverse(motion), motion)
    # Each pose times that of its root; the paths double in each round.
    motion = torch.where(root[:, None], group.identity(count, dtype=poses_cw.dtype, device=device), motion)
    while not bool((above == above[above]).all()):
        motion = group.normalise(group.compose(motion, motion[above]))
        above = above[above]
    poses = group.normalise(group.compose(motion, poses_cw[above]))
    return Tree(torch.where(root[:, None], poses_cw, poses), torch.tensor(roots, device=device))


def relaxation(
    tree: Tree, ii: Tensor, jj: Tensor, measurements: Tensor, information: Tensor | None, solver: LinearSolver,
    pattern: BlockPattern | None = None,
) -> Tensor:  # fmt: skip
    """Poses from three linear problems: rotations as any matrices, brought back to rotations; scales; centres.

    Martinec and Pajdla, "Robust rotation and translation estimation in multiview reconstruction", 2007; Carlone et al.,
    "Initialization techniques for 3D SLAM", 2015 (chordal relaxation).

    Args:
        tree: its roots stay.
        ii, jj, measurements, information: as of :func:`spanning_tree`; the weights are means of the diagonal of the
            information.
        solver: of the linear systems.
        pattern: of the blocks, if it is there.

    Returns:
        ``(N, 7)`` or ``(N, 8)``; not finite where a system could not be solved.
    """
    poses = tree.poses
    if information is None:
        by_place = by_turn = poses.new_ones(len(ii))
    else:
        diagonal = information.diagonal(dim1=-2, dim2=-1).to(poses)
        by_place, by_turn = diagonal[:, :3].mean(-1), diagonal[:, 3:6].mean(-1)
    moving = ~tree.roots
    slot = torch.where(moving, moving.cumsum(0) - 1, -1)
    a, b = slot[ii], slot[jj]
    graph = _Linear(pattern or make_pattern(int(moving.sum()), a, b), moving, ii, jj, a, b, solver)
    eye = torch.eye(3, dtype=poses.dtype, device=poses.device).expand(len(ii), 3, 3)
    turned = graph.solve(so3.matrix(measurements[:, 3:7]), torch.zeros_like(eye), by_turn, so3.matrix(poses[:, 3:7]))
    if not bool(torch.isfinite(turned).all()):
        return torch.full_like(poses, torch.nan)
    left, _, right = torch.linalg.svd(turned)
    side = torch.ones_like(poses[:, :3])
    side[:, 2] = torch.linalg.det(left @ right)
    q = torch.where(moving[:, None], so3.from_matrix(left * side[:, None] @ right), poses[:, 3:7])
    scale = torch.ones_like(poses[:, :1])
    if poses.shape[-1] == 8:
        pad = (0, 0, 0, 2)
        offset, guess = (torch.nn.functional.pad(x[:, 7:, None].log(), pad) for x in (measurements, poses))
        scale = graph.solve(eye, offset, by_turn, guess)[:, :1, 0].exp()
    back = so3.conjugate(q)
    offset = -so3.rotate(back[jj], measurements[:, :3]) / scale[jj]
    centres = graph.solve(
        eye, offset[..., None], by_place, -so3.rotate(back, poses[:, :3])[..., None] / scale[..., None]
    )
    found = torch.cat((-scale * so3.rotate(q, centres[..., 0]), q, scale), -1)[:, : poses.shape[-1]]
    return torch.where(moving[:, None], found, poses)


@dataclass(frozen=True)
class _Linear:
    """Linear problem on the edges of a graph, of which some poses are known; ``a`` and ``b`` are -1 for those."""

    pattern: BlockPattern
    moving: Tensor
    ii: Tensor
    jj: Tensor
    a: Tensor
    b: Tensor
    solver: LinearSolver

    def solve(self, factor: Tensor, offset: Tensor, weight: Tensor, guess: Tensor) -> Tensor:
        """``x (N, 3, C)`` that minimises ``sum w |x_j - F x_i - o|^2``, for rotations ``F``.

        Args:
            factor: ``F (E, 3, 3)``.
            offset: ``o (E, 3, C)``.
            weight: ``w (E,)``.
            guess: ``(N, 3, C)``, the values of the poses that are known, and a weak prior for the others.
        """
        a, b, free = self.a, self.b, self.pattern.size
        mean = float(weight.mean()) if len(weight) else 0.0
        prior = PRIOR * mean if mean > 0 else 1.0
        known = torch.where(self.moving[:, None, None], 0.0, guess)
        diagonal, rhs = guess.new_full((free,), prior), prior * guess[self.moving]
        for end, value in (
            (b, offset + factor @ known[self.ii]),
            (a, factor.mT @ (known[self.jj] - offset)),
        ):
            used = (end >= 0) & (a != b)
            diagonal.index_add_(0, end[used], weight[used])
            rhs.index_add_(0, end[used], weight[used, None, None] * value[used])
        both = (a >= 0) & (b >= 0) & (a != b)
        a, b, blocks = a[both], b[both], guess.new_zeros(self.pattern.count, 3, 3)
        product = -weight[both, None, None] * factor[both]
        product = torch.where((b > a)[:, None, None], product, product.mT)
        blocks.index_add_(0, self.pattern.find(torch.maximum(a, b), torch.minimum(a, b)), product)
        blocks[self.pattern.diagonal] = torch.diag_embed(diagonal[:, None].expand(free, 3))
        x = guess.clone()
        x[self.moving] = solve_blocks(BlockMatrix(self.pattern, blocks), rhs, self.solver)
        return x


def _variance(information: Tensor) -> Tensor:
    """Trace ``(E,)`` of the inverse; infinite without any information."""
    mean = information.diagonal(dim1=-2, dim2=-1).mean(-1)
    eye = torch.eye(information.shape[-1], dtype=information.dtype, device=information.device)
    there = mean > 0
    safe = torch.where(there[:, None, None], information + SINGULAR * mean[:, None, None] * eye, eye)
    inverse, _ = torch.linalg.inv_ex(safe)
    trace = inverse.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.where(there & (trace > 0), trace, torch.inf)
