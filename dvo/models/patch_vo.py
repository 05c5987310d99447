"""Patch-flow recurrent visual odometry as one network (DPVO: Teed, Lipson, Deng, NeurIPS 2023).

An encoder gives features of the frames, patches are cut from them, and steps (:mod:`dvo.models.step`) refine poses and
inverse depths: each reprojects the patches, correlates them there, revises flow and confidence, and solves a bundle
adjustment of the revised flow.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterator
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from dvo.ba.options import BAOptions, damping_at
from dvo.core.context import multiplies_bfloat16
from dvo.geometry import se3
from dvo.map.edges import PatchGraph
from dvo.models.schedule import Stage, to_device, training_schedule
from dvo.models.step import UpdateState, flow_step, recent_depth, step
from dvo.nets.correlation.correlation import Correlation, CorrelationVolume
from dvo.nets.patch.config import PRESETS, ModelConfig
from dvo.nets.patch.frame_encoder import FrameEncoder
from dvo.nets.patch.patchifier import Patchifier, normalise_images, patch_coordinates
from dvo.nets.patch.selection import SELECTIONS, PatchSelection
from dvo.nets.update.int8 import with_int8_layers
from dvo.nets.update.update import UPDATE_OPERATORS, Update

__all__ = ["Mode", "PatchVO", "UpdateState"]

Mode = Literal["joint", "structure", "flow"]
"""``joint`` refines poses and depths, ``structure`` depths alone; ``flow`` skips bundle adjustment."""


class PatchVO(nn.Module):
    """Encoder and update operator. The state dict of the ``full`` configuration has DPVO's names and shapes.

    Args:
        config: sizes, see :class:`dvo.nets.patch.config.ModelConfig`.

    Raises:
        DvoError: the selection ``learned`` without the head.

    Example:
        >>> model = PatchVO(preset("tiny"))
        >>> images = torch.zeros(1, 5, 3, 96, 128, dtype=torch.uint8)
        >>> intrinsics = torch.tensor([80.0, 80.0, 64.0, 48.0]).expand(1, 5, 4)
        >>> state = model(images, intrinsics, updates=4)
        >>> state.poses_cw.shape
        torch.Size([1, 5, 7])
    """

    architecture = "patch_vo"
    config_type = ModelConfig
    presets = PRESETS

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.patchify = Patchifier(config)
        self.select = self.selection()
        self.update = UPDATE_OPERATORS.resolve(config.update_operator)(config)

    @property
    def encoder(self) -> FrameEncoder:
        """Encoder as a module of its own, which shares the parameters; :mod:`dvo.models.onnx_export` writes it."""
        return FrameEncoder(self.patchify).train(self.training)

    def selection(self, name: str = "") -> PatchSelection:
        """Patch selection by name.

        Args:
            name: in :data:`dvo.nets.patch.selection.SELECTIONS`; empty for that of the configuration.

        Raises:
            DvoError: no such selection.
        """
        select: PatchSelection = SELECTIONS.resolve(name or self.config.selection)
        return select

    @property
    def precision(self) -> torch.dtype:
        """Type of the encoder's parameters."""
        return self.patchify.fnet.conv1.weight.dtype

    @torch.inference_mode(False)
    def in_bfloat16(self) -> PatchVO:
        """Copy for inference that multiplies in bfloat16, about twice as fast on processors with instructions for it.

        Inputs and outputs are float32, as are bundle adjustment and update operators of other kinds than the gated one.
        A tracker's look-ups are in bfloat16 too where the processor multiplies it.

        Returns:
            The copy, in evaluation mode; parameters are rounded.

        Example:
            >>> model = PatchVO(preset("tiny")).in_bfloat16()
            >>> model.patchify.encode(torch.zeros(1, 1, 3, 96, 128)).matching.dtype
            torch.float32
        """
        model = copy.deepcopy(self).eval().requires_grad_(False)
        model.patchify.bfloat16()
        if isinstance(model.update, Update):
            model.update.bfloat16()
        return model

    @torch.inference_mode(False)
    def in_int8(self) -> PatchVO:
        """Copy for inference whose gated update operator multiplies in 8 bits (:mod:`dvo.nets.update.int8`).

        Its encoder is in bfloat16 where the processor multiplies that, and as it is elsewhere.

        Returns:
            The copy, in evaluation mode, on the CPU.

        Example:
            >>> model = PatchVO(preset("tiny")).in_int8()
            >>> type(model.update.c1[0]).__name__
            'Int8Linear'
        """
        half = multiplies_bfloat16(torch.device("cpu"))
        model = self.in_bfloat16() if half else copy.deepcopy(self).eval().requires_grad_(False)
        if isinstance(model.update, Update):
            with_int8_layers(model.update, self.update, model.precision)
        return model

    def forward(
        self,
        images: Float[Tensor, "B N 3 H W"],
        intrinsics: Float[Tensor, "B N 4"],
        *,
        updates: int = 10,
        generator: torch.Generator | None = None,
    ) -> UpdateState:
        """Run a fixed number of updates on a clip in which every patch has an edge into every frame.

        Args:
            images: uint8 RGB (or float in the same range).
            intrinsics: ``fx fy cx cy`` in image pixels.
            updates: number of steps.
            generator: of the patch centres; on the CPU.

        Returns:
            State after the last update: poses ``T_cw`` relative to the first frame, up to scale; patches, targets and
            confidence of every edge.
        """
        b, n = images.shape[:2]
        stages = training_schedule(n, self.config.training_patches, updates, self_edges=self.config.self_edges)
        start = se3.identity(b, n, device=images.device)
        stages = to_device(stages, images.device)
        return deque(self.unroll(images, intrinsics, stages, poses_cw=start, generator=generator), maxlen=1)[0]

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
        centres: Int[Tensor, "B N M 2"] | None = None,
        select: PatchSelection | None = None,
    ) -> Iterator[UpdateState]:
        """Run the updates of a schedule on a clip; the training pass.

        Args:
            images: uint8 RGB (or float in the same range).
            intrinsics: ``fx fy cx cy`` in image pixels.
            stages: see :func:`dvo.models.schedule.training_schedule`.
            poses_cw: initial poses ``T_cw``. A frame that joins later starts at the current pose of the frame before
                it, except in mode ``structure``, which holds poses as given.
            inverse_depth: of each patch at the start, 1 if None (clips are normalised to median depth 1; a random
                start ruins bundle adjustment at small resolution).
            mode: see :data:`Mode`. ``flow`` trains the flow revision alone, at the lowest cost; it
                needs a schedule in which no frame joins later.
            generator: of the patch centres and of the edges that train the features; on the CPU. With a generator for
                each clip, the draws of a clip do not depend on the other clips of the batch.
            correlation_gradient: share of the edges whose correlation propagates a gradient to the features.
            ba_iterations: Gauss-Newton iterations an update.
            centres: integer patch centres ``x, y`` in feature pixels, at least one from the border, as many a frame as
                in the schedule; None: the selection of the configuration draws them.
            select: selection of the patches if no ``centres`` are given, None for that of the configuration.

        Yields:
            The state after each update, with ``coords``. Poses and depths are detached between updates (DPVO 3.3): only
            the hidden state carries gradients across.
        """
        config = self.config
        b, n = images.shape[:2]
        features = self.patchify.encode(normalise_images(images))
        height, width = features.matching.shape[-2:]
        if centres is None:
            centres = self.draw_centres(images, generator, select)
        m = centres.shape[2]
        matching, context = self.patchify.cut(features, centres)
        volume = CorrelationVolume(matching, features.matching, config.pyramid, config.radius)
        scaled = intrinsics / config.STRIDE
        if inverse_depth is None:
            inverse_depth = torch.ones(b, n * m, device=images.device)
        all_patches = patch_coordinates(centres, inverse_depth, config.patch_size)
        frames, graph = stages[0].frames, stages[0].graph
        hidden = context.new_zeros(b, len(graph), config.hidden_channels)
        start = poses_cw[:, :frames], all_patches[:, : frames * m], scaled[:, :frames]
        state = UpdateState(graph, *start, context, hidden)

        def lookup(coords: Tensor, graph: PatchGraph) -> Correlation:
            learn = None
            if correlation_gradient < 1 and torch.is_grad_enabled():
                learn = _draw_edges(b, len(graph), correlation_gradient, generator).to(images.device)
            return Correlation(volume.lookup(coords, graph.kk, graph.jj, learn), learn=learn)

        for update, stage in enumerate(stages):
            poses, patches, hidden = state.poses_cw.detach(), state.patches.detach(), state.hidden
            coords = state.coords
            if stage.carry is not None:
                arriving = poses_cw[:, frames : stage.frames] if mode == "structure" else poses[:, -1:]
                poses = torch.cat([poses, arriving.expand(-1, stage.frames - frames, -1)], 1)
                joined = all_patches[:, frames * m : stage.frames * m].clone()
                joined[:, :, 2] = recent_depth(patches, m, 2)[:, None, None, None]
                patches = torch.cat([patches, joined], 1)
                hidden = hidden.index_select(1, stage.carry.clamp(min=0)) * (stage.carry >= 0)[:, None]
                frames, coords = stage.frames, None
            present = scaled[:, :frames]
            state = UpdateState(stage.graph, poses, patches, present, context, hidden, coords)
            if mode == "flow":
                state = flow_step(self, state, lookup)
            else:
                options = BAOptions(
                    iterations=ba_iterations, damping=damping_at(update), structure_only=mode == "structure",
                    bounds=(width, height),
                )  # fmt: skip
                state = step(self, state, lookup, options).reprojected()
            yield state

    def draw_centres(
        self,
        images: Float[Tensor, "B N 3 H W"],
        generator: torch.Generator | list[torch.Generator] | None = None,
        select: PatchSelection | None = None,
    ) -> Int[Tensor, "B N M 2"]:
        """Draw the patch centres of training clips.

        Args:
            images: uint8 RGB (or float in the same range).
            generator: on the CPU; one for each clip, or one for all.
            select: selection of the patches, None for that of the configuration.

        Returns:
            Integer ``x, y`` in feature pixels, ``training_patches`` a frame.
        """
        select = select or self.select
        draw = partial(select, patches=self.config.training_patches)
        if not isinstance(generator, list):
            return draw(images, generator=generator)
        return torch.cat([draw(images[i : i + 1], generator=one) for i, one in enumerate(generator)])


def _draw_edges(
    clips: int, edges: int, share: float, generator: torch.Generator | list[torch.Generator] | None
) -> Tensor:
    """Draw a share of the ``clips * edges`` edges of a batch, over all of them or, with a generator each, by clip."""
    if not isinstance(generator, list):
        return torch.randperm(clips * edges, generator=generator)[: max(1, round(share * clips * edges))]
    count = max(1, round(share * edges))
    return torch.cat([torch.randperm(edges, generator=one)[:count] + i * edges for i, one in enumerate(generator)])
