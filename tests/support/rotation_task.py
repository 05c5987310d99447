"""A second network with its task, its odometry and nothing else: what another package would bring. Imported by name."""

from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch import nn

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status
from train.data.clips import Renderings
from train.tasks.task import StepLoss, Task


@dataclass(frozen=True)
class RotationConfig:
    """Sizes of the network."""

    channels: int = 4

    def to_dict(self):
        return asdict(self)

    @classmethod
    def from_dict(cls, values):
        return cls(**values)


class RotationRegressor(nn.Module):
    """Rotation vector between two frames; its normalisation keeps running statistics."""

    architecture = "two_frame_rotation"
    config_type = RotationConfig
    presets = {"tiny": RotationConfig()}  # noqa: RUF012

    def __init__(self, config):
        super().__init__()
        self.config = config
        c = config.channels
        self.layers = nn.Sequential(
            nn.Conv2d(6, c, 5, 4, 2), nn.BatchNorm2d(c), nn.ReLU(), nn.AdaptiveAvgPool2d((2, 3)), nn.Flatten(),
            nn.Linear(6 * c, 3),
        )  # fmt: skip

    def forward(self, images):
        return self.layers(images.float().flatten(1, 2) / 255 - 0.5)


@dataclass
class RotationLoss:
    """Settings of the loss."""

    weight: float = 1.0


class RotationTask(Task):
    """Regress the rotation between the first two frames of a clip.

    Args:
        channels: of the network.
        loss: settings of the loss.
    """

    data_type = Renderings

    def __init__(self, channels: int = 4, loss: RotationLoss | None = None):
        self.channels, self.loss = channels, loss or RotationLoss()

    def network(self):
        return RotationRegressor(RotationConfig(self.channels))

    def buffers(self):
        return {"seen": torch.zeros((), dtype=torch.long)}

    def compute_loss(self, context, batch):
        poses = batch["poses_cw"]
        wanted = se3.log(se3.compose(poses[:, 1], se3.inverse(poses[:, 0])))[:, 3:]
        error = (context.net(batch["images"][:, :2]) - wanted).square().sum(-1).mean()
        return StepLoss(self.loss.weight * error, {"error": error.detach()})

    def accept_loss(self, context, found):
        context.buffers["seen"].add_(1)
        return found

    @torch.no_grad()
    def measure(self, net, batch, seed):
        found = self.compute_loss(type("Context", (), {"net": net}), batch)
        return {"error": float(found.loss)}


class RotationOdometry:
    """Chains rotations; stays where it is."""

    def __init__(self, weights, *, device="cpu", seed=0, config=None, gain=1.0):
        if gain <= 0:
            raise DvoError("must be positive", field="gain", remedy="give 1")
        self.model, self.name, self.gain = weights.model.to(device), f"dvo-{weights.name}", gain
        self.before, self.pose_cw, self.rows = None, se3.identity(dtype=torch.float64), []

    @torch.inference_mode()
    def track(self, frame):
        image = torch.from_numpy(frame.image).permute(2, 0, 1)
        if self.before is not None:
            turn = self.gain * self.model(torch.stack([self.before, image])[None])[0].double()
            self.pose_cw = se3.compose(se3.exp(torch.cat([torch.zeros(3), turn])), self.pose_cw)
        self.before = image
        pose_wc = se3.inverse(self.pose_cw).numpy()
        self.rows.append((frame.timestamp, pose_wc))
        return Estimate(frame.timestamp, pose_wc, Status.TRACKING, 1.0)

    def finish(self):
        stamps = np.array([stamp for stamp, _ in self.rows])
        poses = np.array([pose for _, pose in self.rows]).reshape(-1, 7)
        return Result(Trajectory(stamps, poses), SparseMap(), len(stamps), 0)
