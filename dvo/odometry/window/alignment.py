"""Sub-pixel alignment of the edges of a sliding window."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from dvo.geometry.projection import reproject
from dvo.map.window import Window
from dvo.nets.alignment.alignment import AlignmentOptions, accept, align_patches, patch_warps
from dvo.nets.patch.config import ModelConfig
from dvo.nets.patch.slopes import SlopeEquations, slope_equations

_ROUNDS = 2  # alignments that slopes are found from, each with those of the one before
_STEEPEST = 0.3  # largest slope that is found, 1 / feature pixel


@dataclass(frozen=True)
class AlignmentSnapshot:
    """State of an alignment, for :meth:`WindowAlignment.restore`.

    Attributes:
        count: number of images. It, and what is in the slots that no frame has, takes part in the rounding of a sampled
            grey level (:func:`dvo.nets.alignment.alignment.sample_images`).
        slot: map slot of the next frame.
        image: ``(H, W)`` what is in it; None if there is no such slot yet.
    """

    count: int
    slot: int
    image: Tensor | None


class WindowAlignment:
    """Images of the keyframes of a window, and alignment of the edges that leave it.

    Args:
        window: provides the edges.
        options: of the alignment.
        device: of the images.

    Attributes:
        images: ``(N, H, W)`` grey images by map slot.
    """

    def __init__(self, window: Window, options: AlignmentOptions, device: torch.device) -> None:
        self.window, self.options = window, options
        self.images = torch.zeros(0, 0, 0, device=device)

    def keep_image(self, map_slot: int, image: np.ndarray) -> None:
        """Store the working image of a frame.

        Args:
            map_slot: slot of the frame; its content is overwritten.
            image: ``(H, W, 3)`` uint8 RGB.
        """
        grey = torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).to(self.images)
        missing = map_slot + 1 - len(self.images)
        if missing > 0:
            empty = grey.new_zeros(missing, *grey.shape)
            self.images = torch.cat([self.images, empty]) if len(self.images) else empty
        self.images[map_slot] = grey

    def snapshot(self) -> AlignmentSnapshot:
        """Record what one more frame changes."""
        count, slot = len(self.images), self.window.free_map_slot()
        return AlignmentSnapshot(count, slot, self.images[slot].clone() if slot < count else None)

    def restore(self, before: AlignmentSnapshot) -> None:
        """Restore the images.

        Args:
            before: a snapshot of a window with the same frames, to which one frame was added since.
        """
        self.images = self.images[: before.count]
        if before.image is not None:
            self.images[before.slot] = before.image

    def finalise(self, edges: Tensor) -> None:
        """Replace the measurements of edges in the window by their alignments, where these are accepted.

        For edges that leave the window: their measurements will not change any more, so that each is aligned once.

        Args:
            edges: ``(e,)`` positions among the edges of the window; its targets and weights are changed.
        """
        window, before = self.window, (self.window.targets, self.window.weights)
        if self.options.slope > 0:
            first = window.slopes
            first = window.poses_cw.new_zeros(len(window.patches), 2) if first is None else first
            for _ in range(_ROUNDS):
                self._replace(edges)
                self._revise_slopes(edges, first)
                window.targets, window.weights = before
        self._replace(edges)

    def _replace(self, edges: Tensor) -> None:
        """Replace measurements by alignments with the present slopes."""
        window = self.window
        poses, patches, intrinsics = window.poses_cw[None], window.patches[None], window.intrinsics[None]
        coords = reproject(poses, patches, intrinsics, window.ii[edges], window.jj[edges], window.kk[edges]).coords[0]
        targets, weights = window.targets.clone(), window.weights.clone()
        aligned, good = self._find(edges, coords, targets[edges])
        targets[edges] = torch.where(good[:, None], aligned, targets[edges])
        weights[edges] *= torch.where(good, self.options.gain, 1.0)[:, None]
        window.targets, window.weights = targets, weights

    def slope_equations(self, edges: Tensor) -> SlopeEquations:
        """Equations of the slopes of the surfaces, from measurements that :meth:`finalise` has aligned.

        Args:
            edges: ``(e,)`` positions among the edges of the window.

        Returns:
            Those of each edge, for slopes in 1 / feature-map pixel; zero for one whose alignment was not accepted.
        """
        window, stride = self.window, float(ModelConfig.STRIDE)
        centre, kk, map_slots = window.patches.shape[-1] // 2, window.kk[edges], window.map_slots
        at = window.poses_cw[None], window.patches[None], window.intrinsics[None]
        seen = reproject(*at, window.ii[edges], window.jj[edges], kk, jacobians=True)
        assert seen.jac_d is not None
        found = slope_equations(
            self.images, map_slots[window.ii[edges]], map_slots[window.jj[edges]],
            window.patches[kk, :2, centre, centre] * stride, window.targets[edges] * stride,
            patch_warps(seen.coords[0], self.tilts(edges)),
            seen.jac_d[0, ..., 0] * window.patches[kk, 2, centre, centre, None], self.options,
        )  # fmt: skip
        good = (window.weights[edges] > window.confidence[edges]).any(-1).to(found.matrix)
        return SlopeEquations(found.matrix * good[:, None, None], found.vector * good[:, None])

    def _revise_slopes(self, edges: Tensor, first: Tensor) -> None:
        """One step of the slopes of the surfaces that edges see, from all of these and the first slopes ``(K, 2)``."""
        window, m = self.window, self.window.per_frame
        found = self.slope_equations(edges)
        patches, row = window.kk[edges].unique(return_inverse=True)
        count = len(patches)
        matrix = found.matrix.new_zeros(count, 2, 2).index_add_(0, row, found.matrix)
        vector = found.vector.new_zeros(count, 2).index_add_(0, row, found.vector)
        slopes = first.clone() if window.slopes is None else window.slopes
        prior = 1 / self.options.slope**2
        vector = vector + prior * (first - slopes)[patches]
        change = torch.linalg.solve(matrix + prior * torch.eye(2).to(matrix), vector)
        slopes[patches] = (slopes[patches] + change).clamp(-_STEEPEST, _STEEPEST)
        for frame in (patches // m).unique().tolist():
            window.frames[frame].slopes = slopes[frame * m : (frame + 1) * m].clone()

    def _find(self, edges: Tensor, coords: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """Align edges ``(e,)`` of the window from measured positions ``(e, 2)``, with warps from reprojected patches.

        Returns:
            Aligned positions ``(e, 2)``, feature pixels, and whether they are accepted.
        """
        window, options = self.window, self.options
        centre = window.patches.shape[-1] // 2
        stride = float(ModelConfig.STRIDE)
        centres = window.patches[window.kk[edges], :2, centre, centre] * stride
        map_slots = window.map_slots
        found = align_patches(
            self.images, map_slots[window.ii[edges]], map_slots[window.jj[edges]], centres, measured * stride,
            patch_warps(coords, self.tilts(edges)), options,
        )  # fmt: skip
        size = self.images.shape[2], self.images.shape[1]
        return found.positions / stride, accept(found, measured * stride, size, stride, options)

    def tilts(self, edges: Tensor) -> Tensor | None:
        """Part of the warps of edges by the slopes of the surfaces.

        Where the inverse depth at an offset ``o`` from the centre is ``d (1 + s o)``, the pixel there moves by
        ``du/dd d s o`` more than at the depth of the centre.

        Args:
            edges: ``(e,)`` positions among the edges of the window.

        Returns:
            ``(e, 2, 2)``; None if no slope is known.
        """
        w = self.window
        slopes, centre = w.slopes, w.patches.shape[-1] // 2
        if slopes is None:
            return None
        kk = w.kk[edges]
        at = w.poses_cw[None], w.patches[None], w.intrinsics[None], w.ii[edges], w.jj[edges], kk
        slope_of_depth = reproject(*at, jacobians=True).jac_d
        assert slope_of_depth is not None
        return slope_of_depth[0] * w.patches[kk, 2, centre, centre, None, None] * slopes[kk, None]
