"""Learned score of patch positions, for the selection ``learned`` (:mod:`dvo.nets.selection`).

Training regresses the usefulness of a patch to bundle adjustment: the mean confidence of its edges where their error is
small (:mod:`train.tasks.patch_vo.usefulness`).
"""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.nets.patchifier import crop_patches

_SIDE = 3  # of the window of features, feature pixels; every position of a selection has one


class ScoreHead(nn.Module):
    """Score of positions, from the 3x3 matching features around each.

    Args:
        features: channels of the matching features.
        channels: between the two layers.

    Example:
        >>> head = ScoreHead(64)
        >>> points = torch.tensor([[[[1, 1], [8, 5]]]])
        >>> head(torch.randn(1, 1, 64, 30, 40), points).shape
        torch.Size([1, 1, 2])
    """

    def __init__(self, features: int, channels: int = 32) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(features, channels, _SIDE)
        self.conv2 = nn.Conv2d(channels, 1, 1)

    def forward(self, matching: Float[Tensor, "B N C h w"], points: Int[Tensor, "B N P 2"]) -> Float[Tensor, "B N P"]:
        """Score positions.

        Args:
            matching: features of the frames; they receive no gradient.
            points: ``x, y`` in feature pixels, at least one from the border.

        Returns:
            Logit of the usefulness, which lies in (0, 1).
        """
        windows = crop_patches(matching.detach(), points, _SIDE).flatten(0, 2)
        return self.conv2(F.relu(self.conv1(windows))).reshape(points.shape[:-1])
