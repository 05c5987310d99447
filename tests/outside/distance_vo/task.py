"""Training task of :class:`distance_vo.network.DistanceNet`."""

from distance_vo.network import DistanceConfig, DistanceNet
from dvo.geometry import se3
from train.data.clips import Renderings
from train.tasks.task import StepLoss, Task


class DistanceTask(Task):
    """Regress the distance between the first two frames of a clip.

    Args:
        channels: of the network.
    """

    data_type = Renderings

    def __init__(self, channels: int = 4) -> None:
        self.channels = channels

    def network(self):
        return DistanceNet(DistanceConfig(self.channels))

    def compute_loss(self, context, batch):
        centres = se3.inverse(batch["poses_cw"][:, :2])[..., :3]
        wanted = (centres[:, 1] - centres[:, 0]).norm(dim=-1, keepdim=True)
        error = (context.net(batch["images"][:, :2]) - wanted).square().mean()
        return StepLoss(error, {"error": error.detach()})
