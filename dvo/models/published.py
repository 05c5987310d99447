"""Published checkpoints of DPVO, DROID-SLAM and TartanVO in the names and shapes of dvo's ``full`` presets."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

_DPVO_UNUSED = "update.lmbda"
_DROID_SIGN = "update.agg.eta.0.weight"  # DPVO has no damping head
_TARTANVO = {"flowNet.": "matching.", "flowPoseNet.": "pose."}  # prefixes of the published names to those of dvo
_DROID_HEADS = ("update.weight.2", "update.delta.2")


@dataclass(frozen=True)
class Published:
    """Tensors of a published checkpoint.

    Attributes:
        architecture: name in :data:`dvo.models.registry.ARCHITECTURES`.
        origin: for the model card.
        tensors: by dvo's names; neither names nor shapes are checked.
        bgr: names of first convolutions that expect BGR.
    """

    architecture: str
    origin: str
    tensors: dict[str, Tensor]
    bgr: tuple[str, ...] = ()


def read_published(state: dict[str, Tensor]) -> Published:
    """Recognise a checkpoint and rename its tensors.

    The prefix ``module.`` is dropped. DPVO has an unused tensor and is fed BGR. DROID-SLAM's file has three channels in
    its heads, of which its own code keeps the first two; it is fed RGB. TartanVO's two networks have other names, and
    it is fed BGR.

    Args:
        state: tensors by the names of the checkpoint.

    Returns:
        The tensors; those of DPVO unless there is a damping head, or a name of TartanVO.
    """
    tensors = {key.removeprefix("module."): value.detach() for key, value in state.items()}
    if any(name.startswith(tuple(_TARTANVO)) for name in tensors):
        renamed = {_tartanvo_name(name): value for name, value in tensors.items()}
        return Published("tartanvo", "TartanVO checkpoint", renamed, ("matching.conv1a.0.weight",))
    if _DROID_SIGN not in tensors:
        tensors.pop(_DPVO_UNUSED, None)
        bgr = ("patchify.fnet.conv1.weight", "patchify.inet.conv1.weight")
        return Published("patch_vo", "DPVO checkpoint", tensors, bgr)
    for head in _DROID_HEADS:
        for name in (f"{head}.weight", f"{head}.bias"):
            if name in tensors and tensors[name].dim() and tensors[name].shape[0] == 3:
                tensors[name] = tensors[name][:2]
    return Published("droid", "DROID-SLAM checkpoint", tensors)


def _tartanvo_name(name: str) -> str:
    """Name in dvo of a tensor of TartanVO's checkpoint."""
    for there, here in _TARTANVO.items():
        if name.startswith(there):
            return here + name.removeprefix(there)
    return name
