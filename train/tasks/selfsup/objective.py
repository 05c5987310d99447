"""Objective of a student: the teacher's adjusted flow and poses, and the photometric error of its own adjusted flow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.core.settings import check_settings
from dvo.geometry.projection import reproject
from dvo.losses.consistency import masked_mean
from dvo.losses.flow import flow_loss, weighted_flow_error
from dvo.losses.photometric import Photometric, photometric_error
from dvo.losses.pose import pose_errors
from dvo.map.edges import PatchGraph
from dvo.models.patch_vo import UpdateState
from dvo.nets.alignment.alignment import sample_images
from dvo.nets.patch.config import ModelConfig
from train.tasks.selfsup.teacher import Lesson


@dataclass(frozen=True)
class ConsistencyConfig:
    """Weights of the terms.

    Attributes:
        flow: of the error of the flow after the student's bundle adjustment, weighted by the teacher's confidence,
            feature pixels.
        target: of the error of the flow that its bundle adjustment is given, feature pixels.
        target_limit: cap of one edge's target error.
        pose: of the mean translation (in median depths) plus rotation (rad) error against the teacher's poses.
        pose_from: first update whose poses count.
        photometric: of the photometric error of the last update.
        form: of the photometric error, ``census`` or ``ssim``.
        window: side of the windows compared, image pixels, odd.
        reach: largest distance in frames over which windows are compared.
        margin: an edge counts while its target is within this many feature pixels of the map.

    Raises:
        DvoError: a weight or a size out of range.
    """

    flow: float = 5.0
    target: float = 0.5
    target_limit: float = 8.0
    pose: float = 1.0
    pose_from: int = 2
    photometric: float = 1.0
    form: Photometric = "census"
    window: int = 7
    reach: int = 2
    margin: float = 0.0

    def __post_init__(self) -> None:
        weight = (0.0, 1e6)
        check_settings(self, {
            "flow": weight, "target": weight, "pose": weight, "photometric": weight, "window": (3, 31),
            "reach": (1, 1000), "target_limit": (0.01, 1e6), "pose_from": (0, 1000),
        })  # fmt: skip
        if self.window % 2 == 0:
            raise DvoError(f"must be odd, got {self.window}", field="window", remedy="give 5, 7 or 9")


def lesson_targets(
    lesson: Lesson, patches: Tensor, intrinsics: Tensor, graph: PatchGraph, size: tuple[int, int], margin: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions that the teacher gives the pixels of the student's patches.

    Args:
        lesson: of the clip.
        patches: ``(B, K, 3, p, p)``; only their pixel positions are used.
        intrinsics: ``(B, N, 4)`` of the student's feature map.
        graph: ``E`` edges of the student, among the first ``N`` frames.
        size: height and width of the feature map.
        margin: see :class:`ConsistencyConfig`.

    Returns:
        feature pixels ``(B, E, p, p, 2)``; which edges count, ``(B, E)`` bool; the teacher's confidence ``(B, E)``.
    """
    n, p = intrinsics.shape[1], patches.shape[-1]
    m = lesson.inverse_depth.shape[2]
    depth = lesson.inverse_depth[:, :n].flatten(1)[..., None, None, None].expand(-1, -1, 1, p, p)
    exact = torch.cat([patches[:, :, :2], depth], 2)
    there = reproject(lesson.poses_cw[:, :n], exact, intrinsics, graph.ii, graph.jj, graph.kk)
    x, y = there.coords[:, :, p // 2, p // 2].unbind(-1)
    inside = (x > -margin) & (x < size[1] - 1 + margin) & (y > -margin) & (y < size[0] - 1 + margin)
    where = graph.ii, graph.kk % m, graph.jj
    trusted = lesson.trusted[:, *where] & inside & there.valid[:, :, p // 2, p // 2] & (graph.ii != graph.jj)
    return there.coords, trusted, lesson.confidence[:, *where]


def photometric_term(
    state: UpdateState, images: Tensor, intrinsics: Tensor, used: Tensor, config: ConsistencyConfig
) -> tuple[Tensor, Tensor]:
    """Photometric error of the windows around the patches, warped by the student's poses and inverse depths.

    Args:
        state: after the last update, with gradients.
        images: ``(B, N, 3, H, W)`` that are not degraded, as the student sees them otherwise.
        intrinsics: ``(B, N, 4)`` of the images, pixels.
        used: ``(B, E)`` edges that count.
        config: form, window and reach.

    Returns:
        Scalar mean over the edges that count, are near, and whose windows lie in both images; and their share of
        ``used``.
    """
    near = (state.graph.ii - state.graph.jj).abs() <= config.reach
    edges = near.nonzero(as_tuple=True)[0]
    ii, jj, kk = state.graph.ii[edges], state.graph.jj[edges], state.graph.kk[edges]
    b, n, _, h, w = images.shape
    p, side = state.patches.shape[-1] // 2, config.window
    grey = images.to(state.patches.dtype).mean(2).flatten(0, 1)
    steps = torch.arange(side, device=images.device, dtype=grey.dtype) - side // 2
    centre = state.patches[:, :, :2, p, p] * ModelConfig.STRIDE
    x = (centre[..., 0, None, None] + steps).expand(-1, -1, side, side)
    y = (centre[..., 1, None, None] + steps[:, None]).expand(-1, -1, side, side)
    windows = torch.stack([x, y, state.patches[:, :, 2, p, p, None, None].expand_as(x)], 2)
    there = reproject(state.poses_cw, windows, intrinsics, ii, jj, kk)
    here = torch.stack([x, y], -1).index_select(1, kk)

    def within(points: Tensor) -> Tensor:
        u, v = points.unbind(-1)
        return ((u >= 0) & (u <= w - 1) & (v >= 0) & (v <= h - 1)).flatten(2).all(2)

    def sampled(points: Tensor, frames: Tensor) -> Tensor:
        of = (torch.arange(b, device=frames.device)[:, None] * n + frames).flatten()
        return sample_images(grey, of, points.flatten(0, 1).flatten(1, 2)).view(b, -1, side, side)

    seen = used[:, edges] & within(here) & within(there.coords.detach()) & there.valid.flatten(2).all(2)
    error = photometric_error(sampled(here, ii), sampled(there.coords, jj), config.form)
    return masked_mean(error, seen), seen.sum() / used[:, edges].sum().clamp(min=1)


def student_loss(
    states: Iterable[UpdateState], lesson: Lesson, clean: Tensor, intrinsics: Tensor, config: ConsistencyConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss of a student on a batch of clips.

    Args:
        states: of :meth:`dvo.models.patch_vo.PatchVO.unroll` on the degraded clip.
        lesson: of the teacher.
        clean: ``(B, N, 3, H, W)`` the same clip without degradation.
        intrinsics: ``(B, N, 4)`` of it, pixels.
        config: weights of the terms.

    Returns:
        Scalar with a graph, summed over the updates; detached measures of the last update.
    """
    graph: PatchGraph | None = None
    height, width = (-(-size // ModelConfig.STRIDE) for size in clean.shape[-2:])
    teaching = lesson.trusted.flatten(1).any(1)
    total, measures = clean.new_zeros((), dtype=torch.float32), {}
    state = None
    for update, state in enumerate(states):
        if state.graph is not graph:
            graph = state.graph
            coords, used, confidence = lesson_targets(
                lesson, state.patches.detach(), state.intrinsics, graph, (height, width), config.margin
            )
            every = torch.ones_like(graph.ii, dtype=torch.bool)
            valid = used[:, :, None, None].expand(coords.shape[:-1])
        assert state.coords is not None and state.targets is not None
        p = coords.shape[2] // 2
        error = weighted_flow_error(state.coords, coords, valid, confidence[..., None].expand(-1, -1, 2))
        flow = flow_loss(error, every)
        wanted = (state.targets - coords[:, :, p, p]).square().sum(-1).add(1e-12).sqrt()
        target = masked_mean(wanted.clamp(max=config.target_limit), used)
        total = total + config.flow * flow + config.target * target
        if config.pose > 0 and update >= config.pose_from:
            errors = pose_errors(state.poses_cw, lesson.poses_cw[:, : state.frames])
            pose = torch.where(teaching, errors.translation + errors.rotation, 0.0).mean()
            total = total + config.pose * pose
            measures["pose"] = pose
        measures |= {"flow": flow, "target": target, "confidence": state.confidence.mean()}
        measures["target_px<0.25"] = masked_mean((wanted.detach() < 0.25).float(), used)
    assert state is not None
    if config.photometric > 0:
        error, share = photometric_term(state, clean, intrinsics, used, config)
        total = total + config.photometric * error
        measures |= {"photometric": error, "photometric_share": share}
    return total, {name: value.detach() for name, value in (measures | lesson.measures).items()}
