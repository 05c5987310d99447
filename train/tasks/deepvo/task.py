"""Training task of :class:`dvo.models.deepvo.DeepVO`: regression of the motion between neighbouring frames."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from dvo.core.errors import DvoError
from dvo.core.settings import check_seed, shown
from dvo.geometry import se3
from dvo.losses.pose import pose_errors
from dvo.models.deepvo import DeepVO, chain, true_steps
from dvo.nets.sizes import named_preset
from train.data.augment import Augmentation, augment
from train.data.clips import Renderings
from train.data.turns import Turns, turn_cameras
from train.tasks.deepvo.objective import LossConfig, step_errors
from train.tasks.task import Batch, StepContext, StepLoss, Task


class DeepVOTask(Task):
    """Trains a preset of the pose-regression network on clips.

    The translations keep the unit of the clips, see :mod:`dvo.models.deepvo`; the depth of a clip is not used beyond
    that, and its intrinsics serve the random changes of the clips alone.

    Args:
        model: name of the preset.
        seed: of the augmentation; step ``n`` draws the same whenever it is run.
        both_ways: each clip is seen forwards and backwards. It doubles the motions of a rendered clip and takes away
            the prior that cameras move forwards; the paper has it not.
        loss: weights of the terms.
        augmentation: random changes of the clips, None for none. A change of the field of view (``zoom``) is one of the
            camera, which the network does not know.
        turns: random turns of the cameras of the clips, None for none. Clips show few rotations, and a network that
            sees the same ones again and again remembers them; these are others at every step.
        copies: of each clip in a step, each turned by a draw of its own; rendering a clip takes longer than learning
            from it.

    Raises:
        DvoError: no such preset, or another argument out of range.
    """

    data_type = Renderings

    def __init__(
        self,
        model: str = "small",
        seed: int = 0,
        both_ways: bool = False,
        loss: LossConfig | None = None,
        augmentation: Augmentation | None = None,
        turns: Turns | None = None,
        copies: int = 1,
    ) -> None:
        named_preset(DeepVO.presets, model, "model")
        check_seed(seed)
        if not isinstance(both_ways, bool):
            raise DvoError(f"must be true or false, got {shown(both_ways)}", field="both_ways", remedy="give a bool")
        if not isinstance(copies, int) or isinstance(copies, bool) or not 1 <= copies <= 64:
            raise DvoError(f"no number of copies: {shown(copies)}", field="copies", remedy="give a number from 1 to 64")
        if copies > 1 and turns is None:
            raise DvoError("copies without turns would be equal", field="copies", remedy="give turns, or one copy")
        self.model, self.seed, self.both_ways = model, seed, both_ways
        self.loss = loss or LossConfig()
        self.augmentation, self.turns, self.copies = augmentation, turns, copies

    def network(self) -> nn.Module:
        """New network of the preset."""
        return DeepVO(DeepVO.presets[self.model])

    def parts(self, net: nn.Module) -> dict[str, nn.Module]:
        """Encoder, recurrent layers and last layer."""
        net = cast(DeepVO, net)
        return {"encoder": net.encoder, "recurrent": net.recurrent, "head": net.head}

    def compute_loss(self, context: StepContext, batch: Batch) -> StepLoss:
        """Errors of the steps of a batch.

        Args:
            context: state of the engine.
            batch: ``images (B, N, 3, H, W)``, ``poses_cw (B, N, 7)``; ``depth (B, N, H, W)`` for the augmentation,
                ``intrinsics (B, N, 4)`` for augmentation and turns.

        Returns:
            The loss, with its two terms and the measures of :meth:`errors`.
        """
        if self.augmentation is not None:
            batch = augment(batch, self.augmentation, self.seed, context.step)
        if self.turns is not None:  # of what the loss uses; turning the depth would take time
            used = {
                name: batch[name].repeat_interleave(self.copies, 0) for name in ("images", "poses_cw", "intrinsics")
            }
            batch = turn_cameras(used, self.turns, self.seed, context.step)
        images, poses_cw = batch["images"], batch["poses_cw"]
        if self.both_ways:
            images, poses_cw = (torch.cat([clips, clips.flip(1)]) for clips in (images, poses_cw))
        steps, _ = cast(DeepVO, context.net)(images)
        steps = steps.float()
        found = step_errors(steps, true_steps(poses_cw))
        measures = self.errors(steps.detach(), poses_cw) | {
            "loss_translation": found.translation.detach().mean(),
            "loss_rotation": self.loss.kappa * found.rotation.detach().mean(),
        }
        return StepLoss(found.total(self.loss), measures)

    @staticmethod
    def errors(steps: Tensor, poses_cw: Tensor) -> dict[str, Tensor]:
        """Errors of clips, apart from the loss.

        Args:
            steps: ``(B, N-1, 6)`` of the network.
            poses_cw: ``(B, N, 7)`` true poses, world to camera.

        Returns:
            Means over the clips: ``translation`` (median depths) and ``rotation_deg`` of the relative motions of all
            pairs of frames, after alignment of scale (:func:`dvo.losses.pose.pose_errors`); and over those that an
            estimate without motion would have, ``rotation_ratio`` of the rotation and ``step_ratio`` of the translation
            between neighbouring frames, without alignment.
        """
        truth = true_steps(poses_cw)
        found = pose_errors(chain(steps), poses_cw)
        still = pose_errors(se3.identity(*poses_cw.shape[:2], device=poses_cw.device), poses_cw)
        missed, moved = (motion[..., :3].norm(dim=-1).mean() for motion in (steps - truth, truth))
        return {
            "translation": found.translation.mean(),
            "rotation_deg": found.rotation.rad2deg().mean(),
            "rotation_ratio": found.rotation.mean() / still.rotation.mean().clamp(min=1e-4),
            "step_ratio": missed / moved.clamp(min=1e-4),
        }

    @torch.no_grad()
    def measure(self, net: nn.Module, batch: Batch, seed: int) -> dict[str, float]:
        """Errors on a held-out clip.

        Args:
            net: the network.
            batch: one clip, as a batch of one.
            seed: not used; nothing is drawn.

        Returns:
            ``loss``; ``pose`` (translation in median depths + rotation in radians, unweighted); and those of
            :meth:`errors`.
        """
        poses_cw = batch["poses_cw"]
        steps, _ = cast(DeepVO, net)(batch["images"])
        loss = step_errors(steps, true_steps(poses_cw)).total(self.loss)
        found = self.errors(steps, poses_cw)
        pose = found["translation"] + found["rotation_deg"].deg2rad()
        return {"loss": float(loss), "pose": float(pose)} | {name: float(value) for name, value in found.items()}
