"""Sub-pixel alignment of the edges of training clips, so that a network is trained through it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dvo.models.step import Measurement, Revision, UpdateState
from dvo.nets.alignment.alignment import AlignmentOptions, accept, align_patches, patch_warps
from dvo.nets.patch.config import ModelConfig

_GREY = (0.299, 0.587, 0.114)  # ITU-R BT.601, as OpenCV


class ClipAlignment:
    """Alignment of all edges of a batch of clips, as a :class:`dvo.models.step.Refinement`.

    It is what :class:`dvo.odometry.window.alignment.WindowAlignment` does while tracking, without a cache. Gradients
    pass from the aligned position through the iterations to the measurement of the network, and from the weight to its
    confidence; the decision between the two has none.

    Args:
        images: RGB, uint8 or float in [0, 255].
        options: of the alignment.

    Example:
        >>> refine = ClipAlignment(batch["images"])
        >>> state = step(model, state, lookup, StepOptions(), refine)
    """

    def __init__(
        self,
        images: Float[Tensor, "B N 3 H W"],
        options: AlignmentOptions = AlignmentOptions(),  # noqa: B008 (frozen)
    ) -> None:
        self.frames, self.options = images.shape[1], options
        self.images = torch.einsum("bnchw,c->bnhw", images.float(), images.new_tensor(_GREY, dtype=torch.float32))

    def __call__(self, state: UpdateState, revision: Revision) -> Measurement:
        """Replace the measurements of the network by the alignments that are accepted.

        Args:
            state: of the clips.
            revision: output of the network.

        Returns:
            Targets and weights for bundle adjustment.
        """
        graph, stride, centre = state.graph, float(ModelConfig.STRIDE), state.patches.shape[-1] // 2
        clip = self.frames * torch.arange(len(self.images), device=self.images.device)[:, None]
        measured = (revision.targets * stride).flatten(0, 1)
        found = align_patches(
            self.images.flatten(0, 1),
            (clip + graph.ii).flatten(),
            (clip + graph.jj).flatten(),
            (state.patches[:, graph.kk, :2, centre, centre] * stride).flatten(0, 1),
            measured,
            patch_warps(revision.coords.flatten(0, 1)),
            self.options,
        )
        size = self.images.shape[-1], self.images.shape[-2]
        good = accept(found, measured, size, stride, self.options)[:, None]
        targets = torch.where(good, found.positions / stride, revision.targets.flatten(0, 1))
        gain = torch.where(good, self.options.gain, 1.0).view(len(self.images), -1, 1)
        return Measurement(targets.view_as(revision.targets), revision.weights * gain)
