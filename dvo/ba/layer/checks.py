"""Checks of a batch at the door of the layer: of types and shapes always; of values in a few reductions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES
from dvo.ba.checks import REAL, WHOLE, check_tensor
from dvo.ba.edges import EdgePlan, edge_numbers
from dvo.ba.factors import DepthDamping, DepthPrior, PosePrior, RelativePose
from dvo.ba.limits import LARGEST, SHORTEST_FOCAL
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import check_further
from dvo.core.errors import DvoError
from dvo.core.settings import shown

FLOATS = ("poses_cw", "patches", "intrinsics", "targets", "weights")
INDICES = ("ii", "jj", "kk")
_HELP = "see the help of bundle_adjust"


def check_structure(given: PatchProblem) -> None:
    """Check types, devices and shapes of a batch. Nothing is read from a device.

    Raises:
        DvoError: something that does not belong together.
    """
    _check_tensors(given)
    _check_shapes(given)
    _check_further(given)


def _check_tensors(given: PatchProblem) -> None:
    kinds: list[tuple[str, Any, tuple[torch.dtype, ...]]] = [(name, getattr(given, name), REAL) for name in FLOATS]
    kinds += [(name, getattr(given, name), WHOLE) for name in INDICES]
    sensors = given.sensors
    if sensors is not None:
        kinds += [("sensors.from_body", sensors.from_body, REAL)]
        kinds += [("sensors.source", sensors.source, WHOLE), ("sensors.target", sensors.target, WHOLE)]
    device = getattr(given.poses_cw, "device", None)
    for name, tensor, dtypes in kinds:
        check_tensor(tensor, name, dtypes, device)


def _check_shapes(given: PatchProblem) -> None:
    poses_cw, patches, sensors = given.poses_cw, given.patches, given.sensors
    b, n = poses_cw.shape[:2] if poses_cw.dim() == 3 else (-1, -1)
    count = given.ii.shape[0] if given.ii.dim() == 1 else -1
    wanted: dict[str, tuple[Tensor, tuple[int, ...]]] = {"poses_cw": (poses_cw, (b, n, 7))}
    if sensors is None:
        wanted["intrinsics"] = (given.intrinsics, (b, n, 4))
    else:
        extrinsics = sensors.from_body
        cameras = extrinsics.shape[-2] if extrinsics.dim() in (2, 3) else -1
        alone = extrinsics.dim() == 2 or len(extrinsics) == 1
        leading = () if extrinsics.dim() == 2 else (1,) if alone else (b,)
        wanted["sensors.from_body"] = (extrinsics, (*leading, cameras, 7))
        wanted["intrinsics"] = (given.intrinsics, (b, cameras, 4))
        wanted |= {"sensors.source": (sensors.source, (count,)), "sensors.target": (sensors.target, (count,))}
    wanted |= {name: (getattr(given, name), (count,)) for name in INDICES}
    wanted |= {"targets": (given.targets, (b, count, 2)), "weights": (given.weights, (b, count, 2))}
    side = patches.shape[-1] if patches.dim() == 5 else -1
    wanted["patches"] = (patches, (b, patches.shape[1] if patches.dim() == 5 else -1, 3, side, side))
    for name, (tensor, shape) in wanted.items():
        if tensor.shape != shape:
            raise DvoError(f"has shape {tuple(tensor.shape)}, not {_written(shape)}", field=name, remedy=_HELP)
    for name, size, what in (("poses_cw", b, "problem"), ("poses_cw", n, "frame"), ("patches", side, "pixel")):
        if size == 0:
            raise DvoError(f"without a {what}", field=name, remedy=f"give at least one {what}")


def _written(shape: tuple[int, ...]) -> str:
    return f"({', '.join('any' if x < 0 else str(x) for x in shape)}{',' * (len(shape) == 1)})"


def _check_further(given: PatchProblem) -> None:
    """Factors, further blocks and the layout of the edges."""
    device, b = given.poses_cw.device, len(given.poses_cw)
    check_further(given.factors, given.blocks)
    for name, block in given.blocks.items():
        field = f"blocks[{name!r}]"
        if name in (POSES, INVERSE_DEPTHS, INTRINSICS) or block.eliminated:
            raise DvoError("stands for a block of its own", field=field, remedy="give another name and no elimination")
        if block.value.dtype not in REAL or block.value.device != device:
            raise DvoError(f"is {block.value.dtype} on {block.value.device}", field=field, remedy="give real numbers")
        if block.value.dim() < 2 or len(block.value) != b:
            raise DvoError(f"has shape {tuple(block.value.shape)}, of a batch of {b}", field=field, remedy=_HELP)
    plan, frames, patches = given.plan, given.poses_cw.shape[1], given.patches.shape[1]
    if plan is None:
        return
    if not isinstance(plan, EdgePlan):
        raise DvoError(f"is {shown(plan)}", field="plan", remedy="give a layout of plan_edges")
    if (plan.frames, plan.patches, len(plan.numbers)) != (frames, patches, len(given.ii)):
        what = f"is of {plan.frames} frames, {plan.patches} patches and {len(plan.numbers)} edges"
        raise DvoError(what, field="plan", remedy="make it of these edges")
    if plan.order.device != device:
        raise DvoError(f"is on {plan.order.device}", field="plan", remedy="make it of these edges")


def check_values(given: PatchProblem) -> None:
    """Check the values of a batch whose structure is right.

    Raises:
        DvoError: a number that is not finite or too large, a quaternion that is not a unit one, a focal length that is
            not positive, a negative weight, an index out of range, a layout of other edges.
    """
    with torch.no_grad():
        _check_indices(given)
        limits = [x for x in (*_limits(given), *_further_limits(given)) if x.tensor.numel()]
        # A minimum or maximum is NaN if any number is.
        values = _read([x for limit in limits for x in limit.tensor.aminmax()])
    for limit in limits:
        low, high = next(values), next(values)
        if not (limit.low <= low and high <= limit.high) and not (limit.skips_nan and _is_fine(limit)):
            raise DvoError(limit.message, field=limit.field, remedy=limit.remedy)


class _Limit(NamedTuple):
    """The numbers of a tensor lie within ``low`` and ``high``, and are not NaN unless that is skipped."""

    field: str
    tensor: Tensor
    low: float
    high: float
    message: str
    remedy: str
    skips_nan: bool = False


def _is_fine(limit: _Limit) -> bool:
    """The slow check, done only if there is a NaN."""
    return not bool(((limit.tensor < limit.low) | (limit.tensor > limit.high)).any())


def _limits(given: PatchProblem) -> list[_Limit]:
    poses = "give finite translations and unit quaternions"
    bodies = [("poses_cw", given.poses_cw)]
    if given.sensors is not None:
        bodies.append(("sensors.from_body", given.sensors.from_body))
    limits = [_finite(name, x, poses) for name, x in bodies]
    for name, x in bodies:
        length = torch.linalg.vector_norm(x[..., 3:], dim=-1)
        limits.append(_Limit(name, length, 0.95, 1.05, "a quaternion is not of unit length", poses))
    focal, pixels = given.intrinsics[..., :2], "give fx fy cx cy in pixels"
    limits += [_finite("patches", given.patches), _finite("intrinsics", given.intrinsics, pixels)]
    short = f"a focal length is below {SHORTEST_FOCAL:g}"
    limits.append(_Limit("intrinsics", focal, SHORTEST_FOCAL, math.inf, short, pixels))
    inverse = "give inverse variances, zero for an edge to leave out"
    limits.append(_Limit("weights", given.weights, 0.0, math.inf, "negative", inverse, skips_nan=True))
    return limits


def _further_limits(given: PatchProblem) -> list[_Limit]:
    limits = [_finite(f"blocks[{name!r}]", block.value) for name, block in given.blocks.items()]
    for factor in given.factors:
        field = f"factors, {type(factor).__name__}"
        for tensor in factor.tensors():
            what = f"parameters of shape {tuple(tensor.shape)} are not finite"
            largest = torch.finfo(tensor.dtype).max
            limits.append(_Limit(field, tensor, -largest, largest, what, "give finite numbers"))
        if isinstance(factor, RelativePose) and factor.weight.dim() == 4:
            failed = torch.linalg.cholesky_ex(factor.weight)[1]
            limits.append(_Limit(field, failed, 0, 0, "no positive definite weights", "give information matrices"))
        elif isinstance(factor, (DepthPrior, DepthDamping, PosePrior, RelativePose)):
            limits.append(_Limit(field, factor.weight, 0.0, math.inf, "negative weights", "give inverse variances"))
    return limits


def _finite(field: str, x: Tensor, remedy: str = "give finite numbers") -> _Limit:
    return _Limit(field, x, -LARGEST, LARGEST, f"not finite, or larger than {LARGEST:g}", remedy)


def _check_indices(given: PatchProblem) -> None:
    frames, patches, cameras = given.poses_cw.shape[1], given.patches.shape[1], given.intrinsics.shape[1]
    indices = [("ii", given.ii, frames), ("jj", given.jj, frames), ("kk", given.kk, patches)]
    if given.sensors is not None:
        indices += [(f"sensors.{x}", getattr(given.sensors, x), cameras) for x in ("source", "target")]
    if len(given.ii) == 0:
        indices = []
    reductions = [x for _, index, _ in indices for x in index.aminmax()]
    if given.plan is not None:
        numbers = edge_numbers(given.ii, given.jj, given.kk, frames, patches)
        reductions.append((numbers != given.plan.numbers).any())
    found = _read(reductions)
    for field, _, count in indices:
        low, high = next(found), next(found)
        if low < 0 or high >= count:
            remedy = "give indices of frames and patches of this problem"
            raise DvoError(f"index {low if low < 0 else high} outside 0..{count - 1}", field=field, remedy=remedy)
    if any(found):
        raise DvoError("is of other edges", field="plan", remedy="make it of these edges")


def _read(scalars: Sequence[Tensor]) -> Iterator[float]:
    """Numbers of one kind; an accelerator is waited for once."""
    if not scalars or scalars[0].device.type == "cpu":
        return iter([x.item() for x in scalars])
    kind = scalars[0].dtype if scalars[0].is_floating_point() else torch.int64
    return iter(torch.stack([x.to(kind) for x in scalars]).tolist())
