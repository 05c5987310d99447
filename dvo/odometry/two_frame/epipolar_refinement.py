"""Refinement of the motion between two views by the epipolar residuals of the flow between them.

Robust least squares over the rotation and the direction of the translation, with Sampson distances (Hartley and
Zisserman, "Multiple View Geometry in Computer Vision", section 11.4.3; Tron and Daniilidis, "On the quotient
representation for the essential manifold", CVPR 2014, for the parameters). No depth is needed: a flow lies on the
epipolar line of its pixel, wherever on it.

Rotations and sideways translations of a flat scene look alike, and a camera that only turns has no epipolar lines. So
the flow that the rotation leaves over counts too, with a small weight: of motions that explain the flow as well, the
one with the least parallax is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dvo.core.settings import check_settings
from dvo.geometry import so3

_RANGES = {
    "iterations": (1, 1000), "points": (10, 2**24), "scale": (1e-6, 1e6), "parallax": (0, 1e3), "damping": (0, 1e3),
}  # fmt: skip
_SETTLED = 1e-5  # relative decrease of the cost below which the steps end
_COARSE = 3.0  # factor of the scale at first: a wide one, whose cost has fewer minima
_STRONGEST = 10.0  # damping beyond which no step helps
_EPSILON = 1e-12
_LEAST_AHEAD = 0.1  # cosine of the largest angle from the axis at which a turned ray counts


@dataclass(frozen=True)
class RefinementOptions:
    """Settings of :func:`refine_motion`.

    Attributes:
        iterations: steps from each start at three times the scale, and at the scale from the best of what they find.
        scale: distance at which a residual counts half, feature pixels (Cauchy).
        points: largest number of pixels that count; of a larger map, every second, third, ... row and column.
        parallax: weight of the flow that the rotation leaves over, beside distances from epipolar lines.
        damping: least one; added to the diagonal of the normal equations, relative to it.

    Raises:
        DvoError: a value of another type or out of range.
    """

    iterations: int = 6
    points: int = 800
    scale: float = 0.2
    parallax: float = 0.003
    damping: float = 1e-6

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)


@dataclass(frozen=True)
class Rays:
    """Both ends of each flow on the planes ``z = 1``, float64.

    Attributes:
        start, end: ``(M, 3)`` of camera ``a`` and of camera ``b``.
        weights: ``(M,)``.
        focal: mean focal length, pixels of the map.
    """

    start: Tensor
    end: Tensor
    weights: Tensor
    focal: float


def refine_motion(
    flow: Tensor,
    starts: Sequence[Tensor],
    intrinsics: Tensor,
    options: RefinementOptions | None = None,
    *,
    weights: Tensor | None = None,
) -> Tensor:
    """Refine the motion between two views.

    Args:
        flow: ``(2, h, w)`` from image ``a`` to image ``b``, pixels of the map.
        starts: poses ``T_ab`` ``(7,)`` of camera ``b`` in the coordinates of camera ``a`` to begin from; the lengths of
            their translations do not count.
        intrinsics: ``(4,)`` ``fx fy cx cy``, pixels of the map.
        options: settings; None for the defaults.
        weights: ``(h, w)`` of the pixels, such as :func:`dvo.odometry.two_frame.flow_reliability.flow_weights`; None
            for equal ones.

    Returns:
        The pose found from the start that led to the least cost at the wider scale, ``(7,)`` float64; the translation
        is of length one and to the same side as that of the first start, since the residuals do not tell a motion from
        its opposite. The first start where the flow says nothing.

    Example:
        >>> pose_ab = refine_motion(flow, [motion.poses_ab()[0]], intrinsics / model.STRIDE)
    """
    options = options or RefinementOptions()
    rays = flow_rays(flow.double(), intrinsics.double(), options.points, weights)
    _, rotation, direction = min((_wide(rays, start, options) for start in starts), key=lambda item: item[0])
    _, rotation, direction = _descend(rays, rotation, direction, options)
    return torch.cat([-direction if direction @ starts[0][:3].double() < 0 else direction, rotation])


def _wide(rays: Rays, start: Tensor, options: RefinementOptions) -> tuple[float, Tensor, Tensor]:
    """Descend at the wider scale."""
    rotation, direction = so3.normalise(start[3:].double()), _unit(start[:3].double())
    return _descend(rays, rotation, direction, replace(options, scale=_COARSE * options.scale))


def _descend(
    rays: Rays, rotation: Tensor, direction: Tensor, options: RefinementOptions
) -> tuple[float, Tensor, Tensor]:
    """Levenberg-Marquardt steps until the cost settles; gives cost, rotation and direction."""
    cost, damping = motion_cost(rays, rotation, direction, options), options.damping
    for _ in range(options.iterations):
        next_rotation, next_direction = refinement_step(rays, rotation, direction, options, damping)
        next_cost = motion_cost(rays, next_rotation, next_direction, options)
        if next_cost < cost:
            settled = next_cost > cost * (1 - _SETTLED)
            rotation, direction, cost = next_rotation, next_direction, next_cost
            damping = max(options.damping, 0.1 * damping)
            if settled:
                break
        elif damping > _STRONGEST:
            break
        else:
            damping = max(1e-3, 10 * damping)
    return cost, rotation, direction


def epipolar_residuals(
    start: Tensor, end: Tensor, rotation: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Sampson distances, and the flow that the rotation leaves over.

    Args:
        start, end: ``(M, 3)`` rays with ``z = 1`` of the two cameras.
        rotation: ``(4,)`` of camera ``b`` in the coordinates of camera ``a``.
        direction: ``(3,)`` of the translation, of length one.

    Returns:
        Distances ``(M,)`` and ``(M, 2)`` remaining flow, on the plane ``z = 1``; and ``(M,)`` bool, rays that the
        rotation leaves in front of the camera.
    """
    turned, epipolar, _, spread = _normals(start, end, so3.matrix(rotation), so3.hat(direction))
    left = turned[:, :2] / turned[:, 2:].clamp(min=_LEAST_AHEAD) - start[:, :2]
    return (start * epipolar).sum(-1) / spread, left, turned[:, 2] > _LEAST_AHEAD


def _normals(start: Tensor, end: Tensor, matrix: Tensor, skew: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Turned rays ``b = R q``, normals ``b x d`` and ``R^T (d x a)`` of the epipolar planes, divisor of distances."""
    turned = end @ matrix.mT
    epipolar, of_end = turned @ skew, start @ (-skew @ matrix)
    spread = (epipolar[:, :2].square().sum(-1) + of_end[:, :2].square().sum(-1)).clamp(min=_EPSILON).sqrt()
    return turned, epipolar, of_end, spread


def flow_rays(flow: Tensor, intrinsics: Tensor, points: int, weights: Tensor | None = None) -> Rays:
    """Rays of the pixels that count.

    Args:
        flow, intrinsics, weights: see :func:`refine_motion`; the flow gives the precision.
        points: largest number of pixels, of which those without a finite flow are left out.

    Returns:
        The rays.
    """
    _, h, w = flow.shape
    every = max(1, math.ceil(math.sqrt(h * w / points)))
    fx, fy, cx, cy = intrinsics.tolist()
    y, x = torch.meshgrid(
        torch.arange(h, dtype=flow.dtype, device=flow.device), torch.arange(w, dtype=flow.dtype, device=flow.device),
        indexing="ij",
    )  # fmt: skip
    one = torch.ones_like(x)
    start = torch.stack([(x - cx) / fx, (y - cy) / fy, one], -1)[::every, ::every].flatten(0, 1)
    end = torch.stack([(x + flow[0] - cx) / fx, (y + flow[1] - cy) / fy, one], -1)[::every, ::every].flatten(0, 1)
    counts = torch.isfinite(end).all(-1)
    weights = torch.ones_like(x) if weights is None else weights.to(x)
    return Rays(start[counts], end[counts], weights[::every, ::every].flatten()[counts], (fx + fy) / 2)


def motion_cost(rays: Rays, rotation: Tensor, direction: Tensor, options: RefinementOptions) -> float:
    """Weighted sum of the Cauchy costs of both kinds of residuals.

    Args:
        rays: of the pixels that count.
        rotation, direction: ``(4,)`` and ``(3,)``, see :func:`epipolar_residuals`.
        options: scale, and weight of the parallax.

    Returns:
        The cost.
    """
    distance, left, ahead = epipolar_residuals(rays.start, rays.end, rotation, direction)
    scaled = (distance * (rays.focal / options.scale)).square()
    parallax = left.square().sum(-1) * (rays.focal * options.parallax / options.scale) ** 2
    return float((rays.weights * torch.where(ahead, scaled.log1p() + parallax.log1p(), 100.0)).sum())


def refinement_step(
    rays: Rays, rotation: Tensor, direction: Tensor, options: RefinementOptions, damping: float
) -> tuple[Tensor, Tensor]:
    """One Gauss-Newton step over a rotation vector on the left of the rotation and two angles of the direction.

    Args:
        rays: of the pixels that count.
        rotation, direction: ``(4,)`` and ``(3,)``, see :func:`epipolar_residuals`.
        options: scale, and weight of the parallax.
        damping: added to the diagonal of the normal equations, relative to it.

    Returns:
        Rotation ``(4,)`` and direction ``(3,)`` after the step, of length one.
    """
    start, matrix, skew = rays.start, so3.matrix(rotation), so3.hat(direction)
    turned, epipolar, of_end, spread = _normals(start, rays.end, matrix, skew)
    distance, ahead = (start * epipolar).sum(-1) / spread, turned[:, 2] > _LEAST_AHEAD
    basis = _tangents(direction)
    # Derivatives of both normals, (M, 5, 3), for R <- exp(w) R and for the direction: products with constant vectors.
    axes, sides = so3.hat(torch.eye(3).to(start)), so3.hat(basis)
    by_epipolar = (turned @ torch.cat([*(-axes @ skew), *sides], 1)).unflatten(1, (5, 3))
    by_end = (start @ torch.cat([*(-skew @ axes @ matrix), *(-sides @ matrix)], 1)).unflatten(1, (5, 3))
    by_spread = (by_epipolar[..., :2] * epipolar[:, None, :2]).sum(-1) + (by_end[..., :2] * of_end[:, None, :2]).sum(-1)
    by_error = (by_epipolar * start[:, None]).sum(-1)
    pixels = rays.focal / options.scale
    jacobian = (by_error - distance[:, None] / spread[:, None] * by_spread) / spread[:, None] * pixels
    residual = distance * pixels
    counted = rays.weights * ahead
    weight = counted / (1 + residual.square())
    hessian = (jacobian * weight[:, None]).mT @ jacobian
    gradient = (jacobian * weight[:, None]).mT @ residual
    if options.parallax:
        factor = rays.focal * options.parallax / options.scale
        x, y, z = turned.unbind(-1)
        z = z.clamp(min=_LEAST_AHEAD)
        u, v, zero = x / z, y / z, torch.zeros_like(x)
        left = torch.stack([u, v], -1) - start[:, :2]
        # The projection of b + w x b, and no change by the direction of the translation.
        rows = torch.stack(
            [torch.stack([-u * y / z, (z + u * x) / z, -y / z, zero, zero], -1),
             torch.stack([-(z + v * y) / z, v * x / z, x / z, zero, zero], -1)], 1,
        )  # fmt: skip
        share = (counted / (1 + left.square().sum(-1) * factor**2))[:, None, None] * factor**2
        hessian = hessian + torch.einsum("mki,mkj->ij", rows * share, rows)
        gradient = gradient + torch.einsum("mki,mk->i", rows * share, left)
    diagonal = hessian.diagonal()
    hessian = hessian + torch.diag(damping * diagonal + _EPSILON * (1 + diagonal.max()))
    change = -torch.linalg.solve_ex(hessian, gradient)[0]  # what overflowed ends in a cost that is refused
    return so3.normalise(so3.multiply(so3.exp(change[:3]), rotation)), _unit(direction + change[3:] @ basis)


def _tangents(direction: Tensor) -> Tensor:
    """Two unit vectors ``(2, 3)`` perpendicular to a direction and to each other."""
    axis = torch.zeros_like(direction)
    axis[direction.abs().argmin()] = 1.0
    first = _unit(torch.linalg.cross(direction, axis))
    return torch.stack([first, torch.linalg.cross(direction, first)])


def _unit(vector: Tensor) -> Tensor:
    length = vector.norm()
    return vector / length if length > _EPSILON else torch.tensor([0.0, 0.0, 1.0]).to(vector)
