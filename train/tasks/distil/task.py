"""Training task of an encoder of the patch-flow network that takes the place of another one: its maps become those of a
teacher with trained weights, whose other parts the network has."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dvo.core.errors import DvoError
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import LoadedWeights, load_weights
from dvo.nets.patch.config import preset
from train.data.augment import Augmentation, augment
from train.data.clips import Renderings
from train.tasks.task import Batch, StepContext, StepLoss, Task

_REACH = 3  # feature pixels about a position, in which the measures look for the largest correlation


class DistilTask(Task):
    """Trains the encoder of a preset on the maps of a teacher; everything else is the teacher's and held.

    A new run of the task ``patch_vo`` may start from its state, and holds nothing.

    Args:
        model: name of the preset of the network.
        teacher: weights of the network ``patch_vo``, by name or file.
        seed: draws the augmentation; step ``n`` draws the same whenever it is run.
        direction: weight of the angle between features in the loss, beside their difference. Of features that are
            short the difference says little.
        augmentation: random changes of the clips, None for none.

    Raises:
        DvoError: a weight out of range.
    """

    data_type = Renderings

    def __init__(
        self,
        model: str = "light",
        teacher: str = "small",
        seed: int = 0,
        direction: float = 0.5,
        augmentation: Augmentation | None = None,
    ) -> None:
        self.model, self.teacher, self.seed = model, teacher, seed
        self.direction, self.augmentation = direction, augmentation
        if not 0 <= direction <= 1e6:
            raise DvoError(f"{direction} is not from 0 to 1e6", field="model.direction", remedy="give 0 for none")
        self._teacher: LoadedWeights | None = None

    def network(self) -> nn.Module:
        """New network with the teacher's parts, all but the encoder held; its last layer begins as the teacher's.

        Raises:
            DvoError: a teacher of another architecture or of other sizes.
        """
        net, self._teacher = PatchVO(preset(self.model)), load_weights(self.teacher)
        teacher = self._teacher.model
        if not isinstance(teacher, PatchVO):
            remedy = "give weights of the network 'patch_vo', such as small"
            raise DvoError("holds another network", file=self.teacher, field="model.teacher", remedy=remedy)
        self._check_sizes(net, teacher)
        net.update.load_state_dict(teacher.update.state_dict())
        net.update.requires_grad_(False)
        for name, encoder in net.patchify.named_children():  # its trunk is to become like the teacher's: the same scale
            last = getattr(teacher.patchify, name).conv2
            if encoder.conv2.weight.shape == last.weight.shape:
                encoder.conv2.load_state_dict(last.state_dict())
        teacher.requires_grad_(False)
        return net

    def origin(self) -> LoadedWeights | None:
        """The teacher."""
        return self._teacher

    def _check_sizes(self, net: PatchVO, teacher: PatchVO) -> None:
        """Check that the maps and the update operators of two networks have the same sizes."""
        names = (
            "feature_channels", "hidden_channels", "shared_encoder", "patch_size", "radius", "pyramid",
            "update_operator",
        )  # fmt: skip
        for name in names:
            mine, theirs = getattr(net.config, name), getattr(teacher.config, name)
            if mine != theirs:
                message = f"has the {name} {theirs}, the preset '{self.model}' has {mine}"
                raise DvoError(message, file=self.teacher, field="model.teacher", remedy="give weights of its sizes")

    def parts(self, net: nn.Module) -> dict[str, nn.Module]:
        """The encoder."""
        return {"encoder": cast(PatchVO, net).patchify}

    def compute_loss(self, context: StepContext, batch: Batch) -> StepLoss:
        """Difference of the maps of all frames from the teacher's."""
        assert self._teacher is not None
        net, teacher = cast(PatchVO, context.net), cast(PatchVO, self._teacher.model)
        if self.augmentation is not None:
            batch = augment(batch, self.augmentation, self.seed, context.step)
        images = batch["images"].flatten(0, 1)
        with torch.no_grad():
            wanted = teacher.to(images.device).encoder(images)
        found = net.encoder(images)
        loss, measures = images.new_zeros((), dtype=torch.float32), {}
        for name, mine, theirs in zip(net.encoder.names, found, wanted, strict=True):
            error, angle = relative_error(mine, theirs), 1 - F.cosine_similarity(mine, theirs, dim=1).mean()
            loss = loss + error + self.direction * angle
            measures |= {f"{name}_error": error.detach(), f"{name}_angle": angle.detach()}
        with torch.no_grad():
            agreement = agreeing_share(found[0][:2], wanted[0][:2], _REACH)
        shown = {name: measures.pop(name) for name in ("matching_error", "context_error")}
        return StepLoss(loss, measures, shown | {"agreement": agreement})


def relative_error(found: Tensor, wanted: Tensor) -> Tensor:
    """Mean squared difference of maps over the variance of the wanted ones within their images, mean over the images.

    A constant map in place of the wanted one has an error of at least 1.

    Args:
        found, wanted: ``(n, c, h, w)``.
    """
    variance = wanted.var((2, 3), unbiased=False).mean(1)
    least = 0.01 * variance.mean()  # of images that show nothing, such as dark ones
    return ((found - wanted).square().mean((1, 2, 3)) / torch.maximum(variance, least).clamp(min=1e-12)).mean()


def agreeing_share(found: Tensor, wanted: Tensor, reach: int) -> Tensor:
    """Share of the positions of a frame at which two kinds of features correlate most with the same one of another.

    Args:
        found, wanted: ``(2, c, h, w)`` matching features of two frames.
        reach: largest distance of the positions along an axis, feature pixels.
    """
    return (_best_shift(found, reach) == _best_shift(wanted, reach)).float().mean()


def _best_shift(maps: Tensor, reach: int) -> Tensor:
    """``(h, w)`` index of the shift with the largest product, among the ``(2 reach + 1)^2`` about no shift."""
    here, there = maps
    h, w = here.shape[-2:]
    there = F.pad(there, (reach,) * 4)
    shifts = range(2 * reach + 1)
    products = [(here * there[:, dy : dy + h, dx : dx + w]).sum(0) for dy in shifts for dx in shifts]
    return torch.stack(products).argmax(0)
