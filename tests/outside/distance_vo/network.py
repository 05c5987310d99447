"""Network that regresses the distance between two frames."""

from dataclasses import asdict, dataclass

from torch import Tensor, nn


@dataclass(frozen=True)
class DistanceConfig:
    """Sizes of :class:`DistanceNet`."""

    channels: int = 4

    def to_dict(self):
        return asdict(self)

    @classmethod
    def from_dict(cls, values):
        return cls(**values)


class DistanceNet(nn.Module):
    """Distance that the camera moved between two images ``(B, 2, 3, H, W)``, ``(B, 1)``."""

    architecture = "distance_vo"
    config_type = DistanceConfig
    presets = {"tiny": DistanceConfig()}  # noqa: RUF012

    def __init__(self, config: DistanceConfig) -> None:
        super().__init__()
        self.config = config
        c = config.channels
        self.layers = nn.Sequential(
            nn.Conv2d(6, c, 5, 4), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(c, 1), nn.Softplus()
        )

    def forward(self, images: Tensor) -> Tensor:
        return self.layers(images.float().flatten(1, 2) / 255)
