"""Checks of a batch at the door of the layer: of types and shapes always, of values with one wait for the device."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES
from dvo.ba.edges import EdgePlan, check_index
from dvo.ba.factors import DepthDamping, DepthPrior, PosePrior, RelativePose
from dvo.ba.limits import LARGEST, SHORTEST_FOCAL
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import Factor, StateBlock
from dvo.core.errors import DvoError
from dvo.core.settings import shown

FLOATS = ("poses_cw", "patches", "intrinsics", "targets", "weights")
INDICES = ("ii", "jj", "kk")
REAL = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
WHOLE = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
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
    kinds = [(name, getattr(given, name), REAL) for name in FLOATS]
    kinds += [(name, getattr(given, name), WHOLE) for name in INDICES]
    sensors = given.sensors
    if sensors is not None:
        kinds += [("sensors.from_body", sensors.from_body, REAL)]
        kinds += [("sensors.source", sensors.source, WHOLE), ("sensors.target", sensors.target, WHOLE)]
    device = getattr(given.poses_cw, "device", None)
    for name, tensor, dtypes in kinds:
        if not isinstance(tensor, Tensor):
            raise DvoError(f"is {type(tensor).__name__}, not a tensor", field=name, remedy="give a torch.Tensor")
        if tensor.dtype not in dtypes:
            remedy = "give floating-point numbers" if dtypes is REAL else "give whole numbers"
            raise DvoError(f"has dtype {tensor.dtype}", field=name, remedy=remedy)
        if tensor.device != device:
            remedy = "give all tensors on one device"
            raise DvoError(f"is on {tensor.device}, poses_cw is on {device}", field=name, remedy=remedy)
        if tensor.layout != torch.strided:
            raise DvoError(f"has layout {tensor.layout}", field=name, remedy="give a dense tensor")


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
    for factor in given.factors:
        if not isinstance(factor, Factor):
            raise DvoError(f"holds {shown(factor)}", field="factors", remedy="give objects of dvo.ba.problem.Factor")
    if not isinstance(given.blocks, Mapping):
        raise DvoError(f"is {shown(given.blocks)}", field="blocks", remedy="give state blocks by name")
    for name, block in given.blocks.items():
        field = f"blocks[{name!r}]"
        if not isinstance(block, StateBlock):
            raise DvoError(f"is {shown(block)}", field=field, remedy="give a StateBlock")
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
    if (plan.frames, plan.patches) != (frames, patches) or plan.order.device != device:
        raise DvoError(
            f"is of {plan.frames} frames and {plan.patches} patches on {plan.order.device}", field="plan",
            remedy="make it of these edges",
        )  # fmt: skip


def check_values(given: PatchProblem) -> None:
    """Check the values of a batch whose structure is right.

    Raises:
        DvoError: a number that is not finite or too large, a quaternion that is not a unit one, a focal length that is
            not positive, a negative weight, an index out of range, a layout of other edges.
    """
    frames, patches, cameras = given.poses_cw.shape[1], given.patches.shape[1], given.intrinsics.shape[1]
    indices = [("ii", given.ii, frames), ("jj", given.jj, frames), ("kk", given.kk, patches)]
    if given.sensors is not None:
        indices += [(f"sensors.{x}", getattr(given.sensors, x), cameras) for x in ("source", "target")]
    flags = [flag for _, index, count in indices if len(index) for flag in _outside(index, count)]
    with torch.no_grad():
        flags += [bad.any() for bad in _bad_values(given).values()]
        if given.plan is not None:
            flags.append(_other_edges(given, given.plan))
    if not bool(torch.stack(flags).any()):  # the only place where an accelerator is waited for
        return
    for name, index, count in indices:
        check_index(index, count, name)
    for (name, what), bad in _bad_values(given).items():
        if bool(bad.any()):
            raise DvoError(what, field=name, remedy=_REMEDIES.get(name, "give finite numbers"))
    raise DvoError("is of other edges", field="plan", remedy="make it of these edges")


_REMEDIES = {
    "weights": "give inverse variances, zero for an edge to leave out",
    "intrinsics": "give fx fy cx cy in pixels",
    "poses_cw": "give finite translations and unit quaternions",
}


def _outside(index: Tensor, count: int) -> tuple[Tensor, Tensor]:
    low, high = index.aminmax()
    return low < 0, high >= count


def _bad_values(given: PatchProblem) -> dict[tuple[str, str], Tensor]:
    """What may be wrong with the values, and where it is: bool tensors."""
    large = f"not finite, or larger than {LARGEST:g}"
    poses_cw, intrinsics, weights = given.poses_cw, given.intrinsics, given.weights
    bad = {
        ("poses_cw", large): _beyond(poses_cw),
        ("poses_cw", "a quaternion is not of unit length"): _not_unit(poses_cw),
        ("patches", large): _beyond(given.patches),
        ("intrinsics", large): _beyond(intrinsics),
        ("intrinsics", f"a focal length is below {SHORTEST_FOCAL:g}"): intrinsics[..., :2] < SHORTEST_FOCAL,
        ("weights", "negative"): weights < 0,
    }
    if given.sensors is not None:
        bad["sensors.from_body", large] = _beyond(given.sensors.from_body)
        bad["sensors.from_body", "a quaternion is not of unit length"] = _not_unit(given.sensors.from_body)
    for name, block in given.blocks.items():
        bad[f"blocks[{name!r}]", large] = _beyond(block.value)
    for factor in given.factors:
        for tensor in factor.tensors():
            bad[
                f"factors, {type(factor).__name__}", f"parameters of shape {tuple(tensor.shape)}: not finite"
            ] = ~torch.isfinite(tensor)
        if isinstance(factor, (DepthPrior, DepthDamping, PosePrior, RelativePose)):
            bad[f"factors, {type(factor).__name__}", "a weight is negative, or no positive definite matrix"] = (
                torch.linalg.cholesky_ex(factor.weight)[1] != 0
                if isinstance(factor, RelativePose) and factor.weight.dim() == 4
                else factor.weight < 0
            )
    return bad


def _beyond(x: Tensor) -> Tensor:
    return ~(x.abs() <= LARGEST)  # NaN too


def _not_unit(poses: Tensor) -> Tensor:
    """Far from unit length: half precision leaves a hundredth."""
    return ~((poses[..., 3:].float().square().sum(-1) - 1).abs() <= 0.1)


def _other_edges(given: PatchProblem, plan: EdgePlan) -> Tensor:
    """True if a layout does not hold the edges, each once and nothing else."""
    edges, places = len(given.ii), plan.order.shape[0]
    if places != plan.filled.numel() or plan.kk.shape[0] != places:
        return torch.ones((), dtype=torch.bool, device=plan.order.device)
    if edges == 0:
        return plan.filled.any()
    order = plan.order.clamp(0, edges - 1).view_as(plan.filled)
    group = plan.group_pair
    wrong = given.ii[order] != plan.pair_i[group][:, None]
    wrong |= given.jj[order] != plan.pair_j[group][:, None]
    wrong |= given.kk[order] != plan.kk.view_as(order)
    return (wrong & plan.filled).any() | (plan.filled.sum() != edges) | (plan.order >= edges).any()
