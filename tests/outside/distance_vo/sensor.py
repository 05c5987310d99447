"""A tape that is pulled behind the camera as a sensor of the window: the distance between neighbouring keyframes.

It fixes the scale. Of each keyframe it also solves for an unknown of its own, the length that has been pulled so far.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from distance_vo.factor import KnownDistance
from dvo.ba.blocks import vector_block
from dvo.ba.problem import Factor, Linearisation, StateBlock
from dvo.data.frame import Frame
from dvo.map.window import Window
from dvo.models.patch_vo import PatchVO

SPEED = 2.0
"""Metres a second."""


@dataclass(frozen=True)
class Pulled(Factor):
    """Residual ``length - x`` of the unknowns of the tape.

    Attributes:
        length: ``(1, n, 1)`` metres.
    """

    length: Tensor

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        x = values["tape"]
        index = torch.arange(x.shape[1])
        one = torch.ones_like(x)
        return Linearisation(self.length - x, 100 * one, ("tape",), (index,), (one[..., None],))


class Tape:
    def __init__(self, model: PatchVO, device: torch.device) -> None:
        self.seen = 0

    def observe(self, frame: Frame) -> None:
        self.seen += 1

    def blocks(self, window: Window) -> Mapping[str, StateBlock]:
        values = [frame.states.get("tape", torch.zeros(1)) for frame in window.frames]
        return {"tape": vector_block(torch.stack(values)[None])}

    def factors(self, window: Window) -> tuple[Factor, ...]:
        lengths = SPEED * torch.tensor([[frame.timestamp for frame in window.frames]])
        i = torch.arange(len(window) - 1)
        steps = lengths.diff()
        return KnownDistance(steps, torch.full_like(steps, 1e4), i, i + 1), Pulled(lengths[..., None])
