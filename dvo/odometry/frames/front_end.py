"""Front end of the tracker: extraction of features and patches from a frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from dvo.geometry.camera import Camera
from dvo.map.keyframe_log import FrameRecord
from dvo.map.window import Keyframe
from dvo.models.patch_vo import PatchVO
from dvo.nets.patch.masks import places_of_patches, unmasked_centres, visible_features
from dvo.nets.patch.patchifier import Features, normalise_images


@dataclass(frozen=True)
class Observation:
    """Features and patches of one frame.

    Attributes:
        image: ``(H, W, 3)`` uint8 RGB working image.
        image_intrinsics: ``(4,)`` float64 fx fy cx cy of the working image.
        intrinsics: ``(4,)`` of the feature map.
        maps: ``(1, 1, C, h, w)`` matching features.
        centres: ``(1, 1, M, 2)`` patch centres, feature-map pixels.
        matching: ``(M, C, p, p)`` matching features of the patches.
        context: ``(M, D)`` context features of the patches.
        colors: ``(M, 3)`` uint8 RGB at the patch centres.
        visible: ``(h, w)`` bool, pixels of the feature map that a measurement may lie in; None: all.
        measured: ``(M, 2)`` inverse depths of the patches by a depth camera (1/m) and their weights in bundle
            adjustment, both 0 for a patch without one; None if depth is not used.
        slopes: ``(M, 2)`` of the surfaces of the patches, see :class:`dvo.map.window.Keyframe`; None: not known.
        mask: ``(H, W)`` bool, pixels of the image that are used; None for all.
    """

    image: np.ndarray
    image_intrinsics: np.ndarray
    intrinsics: Tensor
    maps: Tensor
    centres: Tensor
    matching: Tensor
    context: Tensor
    colors: Tensor
    visible: Tensor | None = None
    measured: Tensor | None = None
    slopes: Tensor | None = None
    mask: np.ndarray | None = None

    @property
    def bounds(self) -> tuple[int, int]:
        """Width and height of the feature map."""
        return self.maps.shape[-1], self.maps.shape[-2]


@dataclass(frozen=True)
class View:
    """Frame with content, before it is part of the window.

    Attributes:
        records: of the frame, and of those after it that repeat it.
        seen: its features.
    """

    records: list[FrameRecord]
    seen: Observation


def keyframe_of(view: View, identifier: int, map_slot: int) -> Keyframe:
    """Keyframe of the window from a view.

    Args:
        view: the frame.
        identifier, map_slot: see :class:`dvo.map.window.Keyframe`.

    Returns:
        The keyframe.
    """
    s = view.seen
    features = s.matching, s.context, s.colors, s.intrinsics, s.image, s.visible, s.measured, s.slopes
    return Keyframe(identifier, view.records[0].timestamp, map_slot, *features, mask=s.mask)


def encode_image(model: PatchVO, image: np.ndarray, device: torch.device) -> Features:
    """Features of an image.

    Args:
        model: the network.
        image: ``(H, W, 3)`` uint8 RGB.
        device: of the network.

    Returns:
        Features of a batch of one frame; the same image gives the same ones, bit for bit on the CPU.
    """
    return _encode(model, _on(image, device))


def _on(image: np.ndarray, device: torch.device) -> Tensor:
    return torch.from_numpy(image).to(device).permute(2, 0, 1)


def _encode(model: PatchVO, rgb: Tensor) -> Features:
    return model.patchify.encode(normalise_images(rgb)[None, None])


def observe(
    model: PatchVO,
    image: np.ndarray,
    camera: Camera,
    select: Callable[..., Tensor],
    device: torch.device,
    mask: np.ndarray | None = None,
) -> Observation:
    """Encode a working image and select its patches.

    Args:
        model: the network.
        image: ``(H, W, 3)`` uint8 RGB, see :func:`dvo.odometry.frames.gate.working_image`.
        camera: of the image.
        select: selection of the patches, with their number and the generator given (:mod:`dvo.nets.patch.selection`).
        device: of the network.
        mask: ``(H, W)`` bool, pixels of the image to use; None for all.

    Returns:
        Features and patches.
    """
    rgb = _on(image, device)
    features = _encode(model, rgb)
    centres = select(rgb[None, None])
    if mask is not None:
        again = partial(select, rgb[None, None])
        centres = unmasked_centres(centres, again, places_of_patches(mask, model.config.patch_size, device))
    matching, context = model.patchify.cut(features, centres)
    stride = model.config.STRIDE
    x, y = (centres[0, 0] * stride).unbind(-1)
    return Observation(
        image=image,
        image_intrinsics=camera.intrinsics,
        intrinsics=torch.tensor(camera.intrinsics / stride, dtype=torch.float32, device=device),
        maps=features.matching,
        centres=centres,
        matching=matching[0],
        context=context[0],
        colors=rgb[:, y.clamp(max=camera.height - 1), x.clamp(max=camera.width - 1)].T.cpu(),
        visible=None if mask is None else visible_features(mask, model.config.patch_size, device),
        mask=mask,
    )
