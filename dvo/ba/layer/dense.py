"""Dense bundle adjustment: every pixel of a feature map is a patch of size one with an inverse depth of its own.

The layer is that of :func:`dvo.ba.layer.layer.bundle_adjust`. Edges join whole frames here, hence the layout of the
sums is known without sorting: a group for each pair of frames, all of them full. (Teed and Deng, "DROID-SLAM", 2021.)
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dvo.ba.edges import EdgePlan, edge_numbers
from dvo.ba.factors import DepthDamping
from dvo.ba.options import BAOptions
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.solve import solve
from dvo.core.errors import DvoError

_DEFAULT = BAOptions()
_HELP = "see the help of dense_bundle_adjust"


def dense_plan(ii: Int[Tensor, " E"], jj: Int[Tensor, " E"], frames: int, pixels: int) -> EdgePlan:
    """Layout of the pixels of edges between frames, equal in its sums to :func:`dvo.ba.edges.plan_edges`.

    Args:
        ii, jj: source and target frame of each edge; a pair may occur more than once.
        frames: number of frames.
        pixels: of a feature map.

    Returns:
        Plan of ``E`` groups of ``pixels`` places.
    """
    edges, device = len(ii), ii.device
    each = torch.arange(edges, device=device)
    kk = (ii[:, None] * pixels + torch.arange(pixels, device=device)).flatten()
    filled = torch.ones(edges, pixels, dtype=torch.bool, device=device)
    order = torch.arange(edges * pixels, device=device)
    source, target = ii.repeat_interleave(pixels), jj.repeat_interleave(pixels)
    numbers = edge_numbers(source, target, kk, frames, frames * pixels)
    return EdgePlan(frames, frames * pixels, ii, jj, each, order, filled, kk, numbers)


def pixel_grid(height: int, width: int, device: torch.device | str | None = None) -> Float[Tensor, "2 h w"]:
    """Coordinates ``x, y`` of the pixels of a map.

    Args:
        height, width: of the map.
        device: of the result.

    Returns:
        float32.
    """
    y, x = torch.meshgrid(torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij")
    return torch.stack((x, y)).float()


def dense_patches(inverse_depth: Float[Tensor, "B N h w"]) -> Float[Tensor, "B N 3 h w"]:
    """Maps as one patch a frame, for :func:`dvo.geometry.projection.reproject`.

    Args:
        inverse_depth: of each pixel.

    Returns:
        Rows ``x, y`` (pixels of the map) and inverse depth.
    """
    b, n, h, w = inverse_depth.shape
    grid = pixel_grid(h, w, inverse_depth.device).to(inverse_depth.dtype).expand(b, n, 2, h, w)
    return torch.cat((grid, inverse_depth[:, :, None]), 2)


def dense_bundle_adjust(
    poses_cw: Float[Tensor, "B N 7"],
    inverse_depth: Float[Tensor, "B N h w"],
    intrinsics: Float[Tensor, "B N 4"],
    targets: Float[Tensor, "B E h w 2"],
    weights: Float[Tensor, "B E h w 2"],
    ii: Int[Tensor, " E"],
    jj: Int[Tensor, " E"],
    options: BAOptions = _DEFAULT,
    *,
    damping: Float[Tensor, "B N h w"] | None = None,
    plan: EdgePlan | None = None,
) -> tuple[Float[Tensor, "B N 7"], Float[Tensor, "B N h w"]]:
    """Refine poses and inverse depth maps so that pixels project onto their targets.

    Args:
        poses_cw: world to camera.
        inverse_depth: of each pixel of each frame.
        intrinsics: ``fx fy cx cy`` in pixels of the map.
        targets: measured positions, in the target frame, of the pixels of the source frame.
        weights: inverse variances, pixels^-2.
        ii, jj: source and target frame of each edge.
        options: see :class:`dvo.ba.options.BAOptions`.
        damping: of each inverse depth, not negative, with gradient (:class:`dvo.ba.factors.DepthDamping`); it is added
            to the constant one of the options.
        plan: of :func:`dense_plan`, to save doing it again.

    Returns:
        New poses and inverse depths, differentiable by every floating-point argument.

    Raises:
        DvoError: shapes that do not belong together; a negative weight or an index out of range, as
            :func:`dvo.ba.layer.layer.bundle_adjust` raises them.

    Example:
        >>> poses_cw, inverse_depth = dense_bundle_adjust(
        ...     poses_cw, inverse_depth, intrinsics, targets, weights, ii, jj, damping=eta)
    """
    b, n, h, w = _checked(inverse_depth, targets, weights, ii, jj, damping)
    if plan is None:
        plan = dense_plan(ii, jj, n, h * w)
    patches = dense_patches(inverse_depth).permute(0, 1, 3, 4, 2).reshape(b, n * h * w, 3, 1, 1)
    factors = () if damping is None else (DepthDamping(damping.reshape(b, -1)),)
    source, target = (end[:, None].expand(-1, h * w).reshape(-1) for end in (ii, jj))
    measured = targets.reshape(b, -1, 2), weights.reshape(b, -1, 2), source, target, plan.kk
    solved = solve(PatchProblem(poses_cw, patches, intrinsics, *measured, factors=factors, plan=plan), options)
    return solved.poses_cw, solved.patches[:, :, 2, 0, 0].view(b, n, h, w)


def _checked(
    inverse_depth: Tensor, targets: Tensor, weights: Tensor, ii: Tensor, jj: Tensor, damping: Tensor | None
) -> tuple[int, int, int, int]:
    """Shape of the maps, once those of the others belong to it; the layer checks the rest."""
    given = {"inverse_depth": inverse_depth, "targets": targets, "weights": weights, "ii": ii, "jj": jj}
    for name, x in (given if damping is None else given | {"damping": damping}).items():
        if not isinstance(x, Tensor):
            raise DvoError(f"is {type(x).__name__}, not a tensor", field=name, remedy="give a torch.Tensor")
    if inverse_depth.dim() != 4 or ii.dim() != 1:
        name, x = ("ii", ii) if inverse_depth.dim() == 4 else ("inverse_depth", inverse_depth)
        raise DvoError(f"has shape {tuple(x.shape)}", field=name, remedy=_HELP)
    b, n, h, w = inverse_depth.shape
    rows = (b, len(ii), h, w, 2)
    wanted = {"targets": rows, "weights": rows, "jj": (len(ii),), "damping": (b, n, h, w)}
    for name, shape in wanted.items():
        found = damping if name == "damping" else given[name]
        if found is not None and found.shape != shape:
            raise DvoError(f"has shape {tuple(found.shape)}, not {shape}", field=name, remedy=_HELP)
    return b, n, h, w
