"""Sizes of the patch-flow recurrent update network, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

from dvo.core.errors import DvoError
from dvo.core.settings import check_settings, shown
from dvo.nets.sizes import Sizes, check_sizes, named_preset

# Smallest and largest sizes; the largest are far beyond networks of use, and keep a file from claiming the memory.
RANGES = {
    "stem_channels": (1, 512),
    "trunk_channels": (1, 512),
    "feature_channels": (1, 1024),
    "hidden_channels": (1, 2048),
    "patch_size": (1, 9),
    "radius": (1, 16),
    "training_patches": (1, 100_000),
}
RETIRED = {"fine_channels": 0, "score_head": False}
"""Options in the metadata of older weights, with the value that loads."""
LEVELS, COARSEST, CORRELATIONS = 8, 64, 16_384  # of the pyramid: levels and largest factor; channels of an edge


@dataclass(frozen=True)
class ModelConfig(Sizes):
    """Sizes of :class:`dvo.models.patch_vo.PatchVO`.

    Attributes:
        stem_channels, trunk_channels: encoder channels at 1/2 and 1/4 of the image resolution.
        feature_channels: matching features, compared by correlation.
        hidden_channels: state of the update operator and context features.
        shared_encoder: one encoder with two heads (cheap) or two encoders (DPVO).
        patch_size: side of a patch in feature pixels.
        radius: correlation radius in pixels of each level.
        pyramid: down-sampling of each correlation level relative to the features.
        training_patches: patches drawn from a frame in training.
        self_edges: join patches with their own frame too, as DPVO does.
        selection: of the patches, a name in :data:`dvo.nets.patch.selection.SELECTIONS`.
        update_operator: name in :data:`dvo.nets.update.update.UPDATE_OPERATORS`.
        encoder: ``residual`` (DPVO's) or ``light``, see :mod:`dvo.nets.patch.encoder`.

    Raises:
        DvoError: a size of another type or out of :data:`RANGES`, or an even patch.
    """

    stem_channels: int = 32
    trunk_channels: int = 64
    feature_channels: int = 128
    hidden_channels: int = 384
    shared_encoder: bool = False
    patch_size: int = 3
    radius: int = 3
    pyramid: tuple[int, ...] = (1, 4)
    training_patches: int = 80
    self_edges: bool = True
    selection: str = field(default="random", compare=False)  # no size: a preset stays one
    update_operator: str = "gated"
    encoder: Literal["residual", "light"] = "residual"

    STRIDE = 4  # image pixels to a feature pixel; feature (u, v) is centred on image pixel (4u, 4v)

    def __post_init__(self) -> None:
        check_settings(self, RANGES)
        check_sizes(self.pyramid, "pyramid", (1, LEVELS), COARSEST)
        if self.correlation_channels > CORRELATIONS:
            message = f"too many correlation channels: {self.correlation_channels:,}, {CORRELATIONS:,} at most"
            raise DvoError(message, field="radius", remedy="give a smaller radius, patch or pyramid")
        if self.patch_size % 2 == 0:
            raise DvoError(f"must be odd, got {self.patch_size}", field="patch_size", remedy="give 1, 3 or 5")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Build from plain values; see :meth:`dvo.nets.sizes.Sizes.from_dict`. Parts that networks had once may be off.

        Raises:
            DvoError: an unknown attribute, an invalid size, or a part that networks do not have.
        """
        for name, off in RETIRED.items():
            if values.get(name, off) not in (off, None):
                message = f"is {shown(values[name])}, a part that networks do not have"
                raise DvoError(message, field=name, remedy="use weights without it, such as small")
        gone = {*RETIRED, "fine_radius"}
        return super().from_dict({name: value for name, value in values.items() if name not in gone})

    @property
    def correlation_channels(self) -> int:
        """Number of correlation channels of an edge: levels x offsets x patch pixels."""
        return len(self.pyramid) * (2 * self.radius + 1) ** 2 * self.patch_size**2


PRESETS: dict[str, ModelConfig] = {
    # DPVO (Teed, Lipson, Deng 2023), tensor for tensor.
    "full": ModelConfig(),
    # Sized to track 320x240 video on two CPU cores and to be trained on one.
    "small": ModelConfig(
        stem_channels=16,
        trunk_channels=32,
        feature_channels=64,
        hidden_channels=128,
        shared_encoder=True,
        training_patches=24,
        self_edges=False,
    ),
    # For tests and controlled studies.
    "tiny": ModelConfig(
        stem_channels=8,
        trunk_channels=16,
        feature_channels=32,
        hidden_channels=48,
        shared_encoder=True,
        training_patches=12,
        self_edges=False,
    ),
}

# The small sizes with the state-space update operator.
PRESETS["mamba"] = replace(PRESETS["small"], update_operator="mamba")
# The small sizes with the encoder for slow machines.
PRESETS["light"] = replace(PRESETS["small"], encoder="light")


def preset(name: str) -> ModelConfig:
    """Configuration of a preset, a key of :data:`PRESETS`; see :func:`dvo.nets.sizes.named_preset`."""
    return named_preset(PRESETS, name)
