"""Patch-flow recurrent visual odometry as one network (DPVO: Teed, Lipson, Deng, NeurIPS 2023).

Features and patches of the frames, then updates. Each one reprojects the patches, looks up how well they correlate
there, revises flow and confidence, and lets a few Gauss-Newton steps of bundle adjustment explain the revised flow by
poses and inverse depths.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dvo.ba.cold_start import damping_at
from dvo.ba.layer import BAOptions, bundle_adjust
from dvo.geometry.projection import reproject
from dvo.graph.edges import PatchGraph
from dvo.models.schedule import Stage
from dvo.nets.config import ModelConfig
from dvo.nets.correlation import CorrelationVolume
from dvo.nets.patchifier import Patchifier, normalise_images, patch_coordinates, random_centres
from dvo.nets.update import Update

Mode = Literal["joint", "structure", "flow"]


@dataclass(frozen=True)
class UpdateState:
    """What one update leaves behind; poses are world to camera, lengths in feature pixels.

    Attributes:
        graph: edges of this update.
        frames: frames present.
        poses_cw: ``(B, frames, 7)``.
        patches: ``(B, frames * M, 3, p, p)``.
        coords: ``(B, E, p, p, 2)`` reprojection under these poses and depths.
        targets: ``(B, E, 2)`` where the network wants the patch centres, what bundle adjustment was given.
        weights: ``(B, E, 2)`` confidence.
    """

    graph: PatchGraph
    frames: int
    poses_cw: Tensor
    patches: Tensor
    coords: Tensor
    targets: Tensor
    weights: Tensor


class PatchVO(nn.Module):
    """The network. Its state dict with the ``full`` configuration has DPVO's names and shapes."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.patchify = Patchifier(config)
        self.update = Update(config)

    def unroll(
        self,
        images: Float[Tensor, "B N 3 H W"],
        intrinsics: Float[Tensor, "B N 4"],
        stages: list[Stage],
        *,
        poses_cw: Float[Tensor, "B N 7"],
        inverse_depth: Float[Tensor, "B K"] | None = None,
        mode: Mode = "joint",
        generator: torch.Generator | list[torch.Generator] | None = None,
        correlation_gradient: float = 1.0,
        ba_iterations: int = 2,
    ) -> Iterator[UpdateState]:
        """Run the updates of a schedule on a clip; the training pass.

        Args:
            images: uint8 RGB (or float in the same range).
            intrinsics: ``fx fy cx cy`` in image pixels.
            stages: see :func:`dvo.models.schedule.training_schedule`.
            poses_cw: poses to start from. A frame that joins later starts at the current pose of the one before,
                unless poses are held as given.
            inverse_depth: of each patch at the start, 1 if None (clips are normalised to median depth 1; a random
                start ruins bundle adjustment at small resolution).
            mode: ``joint`` refines poses and depths; ``structure`` holds the poses; ``flow`` leaves bundle adjustment
                out and moves each edge by its own revision alone, the cheapest way to learn to see motion (for a
                schedule in which no frame joins later).
            generator: draws patch centres and the edges that train the features; on the CPU. With one for each clip a
                clip draws the same in any batch.
            correlation_gradient: share of the edges whose correlation sends a gradient to the features.
            ba_iterations: Gauss-Newton steps an update.

        Yields:
            the state after each update. Poses and depths are detached between updates (DPVO 3.3): only the hidden
            state carries gradients across.
        """
        config = self.config
        b, n = images.shape[:2]
        m = config.training_patches
        features = self.patchify.encode(normalise_images(images))
        height, width = features.matching.shape[-2:]
        if isinstance(generator, list):
            drawn = [random_centres(n, m, height, width, one) for one in generator]
            centres = torch.cat(drawn).to(images.device)
        else:
            centres = random_centres(n, m, height, width, generator, b).to(images.device)
        matching, context = self.patchify.cut(features, centres)
        volume = CorrelationVolume(matching, features.matching, config.pyramid, config.radius)
        scaled = intrinsics / config.STRIDE
        if inverse_depth is None:
            inverse_depth = torch.ones(b, n * m, device=images.device)
        all_patches = patch_coordinates(centres, inverse_depth, config.patch_size)
        frames = stages[0].frames
        poses, patches = poses_cw[:, :frames], all_patches[:, : frames * m]
        hidden = context.new_zeros(b, len(stages[0].graph), config.hidden_channels)
        coords: Tensor | None = None

        for update, stage in enumerate(stages):
            graph = stage.graph
            poses, patches = poses.detach(), patches.detach()
            if stage.carry is not None:
                arriving = poses_cw[:, frames : stage.frames] if mode == "structure" else poses[:, -1:]
                poses = torch.cat([poses, arriving.expand(-1, stage.frames - frames, -1)], 1)
                joined = all_patches[:, frames * m : stage.frames * m].clone()
                joined[:, :, 2] = patches[:, -2 * m :, 2, 0, 0].median(dim=1).values[:, None, None, None]
                patches = torch.cat([patches, joined], 1)
                hidden = hidden.index_select(1, stage.carry.clamp(min=0)) * (stage.carry >= 0)[:, None]
                frames, coords = stage.frames, None
            now = scaled[:, :frames]
            if coords is None:
                coords = reproject(poses, patches, now, graph.ii, graph.jj, graph.kk).coords
            coords = coords.detach()
            learn = None
            if correlation_gradient < 1 and torch.is_grad_enabled():
                learn = _draw_edges(b, len(graph), correlation_gradient, generator).to(images.device)
            correlation = volume.lookup(coords, graph.kk, graph.jj, learn)
            hidden, delta, weights = self.update(hidden, context.index_select(1, graph.kk), correlation, graph)
            targets = coords[:, :, config.patch_size // 2, config.patch_size // 2] + delta
            if mode == "flow":
                coords = coords + delta[:, :, None, None]
            else:
                result = bundle_adjust(
                    poses,
                    patches,
                    now,
                    targets,
                    weights,
                    graph.ii,
                    graph.jj,
                    graph.kk,
                    BAOptions(
                        iterations=ba_iterations,
                        damping=damping_at(update),
                        structure_only=mode == "structure",
                        bounds=(width, height),
                    ),
                )
                poses, patches = result.poses_cw, result.patches
                coords = reproject(poses, patches, now, graph.ii, graph.jj, graph.kk).coords
            yield UpdateState(graph, frames, poses, patches, coords, targets, weights)


def _draw_edges(
    clips: int, edges: int, share: float, generator: torch.Generator | list[torch.Generator] | None
) -> Tensor:
    """A share of the ``clips * edges`` edges of a batch, drawn over all of them or, with a generator each, by clip."""
    if not isinstance(generator, list):
        return torch.randperm(clips * edges, generator=generator)[: max(1, round(share * clips * edges))]
    count = max(1, round(share * edges))
    return torch.cat([torch.randperm(edges, generator=one)[:count] + i * edges for i, one in enumerate(generator)])
