"""Two-frame visual odometry as one network (TartanVO: Wang, Hu, Scherer, CoRL 2020).

A matching network gives the flow between two images, and a pose network reads that flow together with the rays of the
pixels (the intrinsics layer) and gives the motion of the camera, its translation up to scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dvo.core.errors import DvoError
from dvo.geometry import so3
from dvo.nets.two_frame.flow_pose_net import FlowPoseNet
from dvo.nets.two_frame.flow_pyramid import STRIDE, Flows, MatchingNetwork
from dvo.nets.two_frame.pwc_net import PWCNet
from dvo.nets.two_frame.tartanvo import PRESETS, PoseNetwork, TartanVOConfig, derotate

__all__ = ["TartanVO", "TwoFrameMotion"]


@dataclass(frozen=True)
class TwoFrameMotion:
    """Flow and motion between the two images of each pair, from ``a`` to ``b``.

    Attributes:
        translation: ``(B, 3)`` position of camera ``b`` in the coordinates of camera ``a``, up to scale: only its
            direction is trained.
        rotation: ``(B, 3)`` rotation vector of camera ``b`` in the coordinates of camera ``a``, radians.
        flows: of all levels, feature pixels.
        passes: translation and rotation after each pass of the pose network, the last one included.
    """

    translation: Tensor
    rotation: Tensor
    flows: Flows
    passes: tuple[tuple[Tensor, Tensor], ...] = ()

    def poses_ab(self, lengths: Tensor | float = 1.0) -> Float[Tensor, "B 7"]:
        """Motions as poses ``T_ab``, camera ``b`` in the coordinates of camera ``a``: ``T_wc[b] = T_wc[a] T_ab``.

        Args:
            lengths: length of each translation, ``(B,)`` or one number.

        Returns:
            ``tx ty tz qx qy qz qw``.
        """
        direction = nn.functional.normalize(self.translation, dim=-1, eps=1e-6)
        length = torch.as_tensor(lengths, dtype=direction.dtype, device=direction.device)
        return torch.cat([direction * length.reshape(-1, 1), so3.exp(self.rotation)], -1)


class TartanVO(nn.Module):
    """Matching network and pose network.

    Images of any size from :attr:`dvo.nets.two_frame.tartanvo.TartanVOConfig.smallest_side` on, and any pinhole camera.

    Args:
        config: sizes, see :class:`dvo.nets.two_frame.tartanvo.TartanVOConfig`.

    Example:
        >>> model = TartanVO(preset("tiny"))
        >>> a, b = torch.zeros(2, 1, 3, 96, 128, dtype=torch.uint8)
        >>> model.flow(a, b).shape
        torch.Size([1, 2, 24, 32])
        >>> model(a, b, torch.tensor([[80.0, 80.0, 64.0, 48.0]])).poses_ab().shape
        torch.Size([1, 7])
    """

    architecture = "tartanvo"
    config_type = TartanVOConfig
    presets = PRESETS
    STRIDE = STRIDE

    def __init__(self, config: TartanVOConfig) -> None:
        super().__init__()
        self.config = config
        self.matching: MatchingNetwork | PWCNet
        self.pose: PoseNetwork | FlowPoseNet
        if config.design == "published":
            self.matching, self.pose = PWCNet(), FlowPoseNet()
        else:
            sizes = config.stem_channels, config.feature_channels, config.radius, config.decoder_channels
            self.matching, self.pose = MatchingNetwork(*sizes), PoseNetwork(config)

    def encode(self, images: Float[Tensor, "n 3 H W"]) -> list[Tensor]:
        """Matching features of images, which serve as either image of a pair.

        Args:
            images: RGB, uint8 or float in the same range.

        Returns:
            Features of each level, from fine to coarse.

        Raises:
            DvoError: images too small for the levels of the network.
        """
        least = self.config.smallest_side
        if min(images.shape[-2:]) < least:
            height, width = images.shape[-2:]
            raise DvoError(
                f"{width}x{height} pixels are too few for the network",
                field="images",
                remedy=f"give images of at least {least}x{least} pixels",
            )
        return self.matching.encode(self.matching.normalise(images))

    def flow(self, a: Float[Tensor, "B 3 H W"], b: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 2 h w"]:
        """Optical flow from images ``a`` to images ``b``, at a quarter of the resolution.

        Args:
            a, b: RGB, uint8 or float in the same range; of one size.

        Returns:
            Displacements ``x, y`` in pixels of the image, ``h = ceil(H / 4)`` and ``w = ceil(W / 4)``: what is seen at
            pixel ``(4u, 4v)`` of ``a`` is seen at ``(4u, 4v) + flow[:, :, v, u]`` of ``b``.

        Raises:
            DvoError: images of different sizes, or too small for the levels of the network.

        Example:
            >>> flow = dvo.load_model("tartanvo.safetensors").flow(a, b)
        """
        if a.shape != b.shape:
            raise DvoError(
                f"{tuple(a.shape)} and {tuple(b.shape)} differ", field="a, b", remedy="give images of one size"
            )
        return self.matching.match(self.encode(a), self.encode(b)).flow * STRIDE

    def motion(
        self, flow: Float[Tensor, "B 2 h w"], intrinsics: Float[Tensor, "B 4"]
    ) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B 3"]]:
        """Motion of the camera from a flow, see :class:`dvo.nets.two_frame.tartanvo.PoseNetwork`.

        Args:
            flow: at a quarter of the resolution, feature pixels.
            intrinsics: ``fx fy cx cy`` in image pixels.

        Returns:
            Translation, up to scale, and rotation vector of ``T_ab``, radians.
        """
        return self.motions(flow, intrinsics)[-1]

    def motions(
        self, flow: Float[Tensor, "B 2 h w"], intrinsics: Float[Tensor, "B 4"]
    ) -> tuple[tuple[Float[Tensor, "B 3"], Float[Tensor, "B 3"]], ...]:
        """Motion of the camera from a flow after each pass of the pose network (:attr:`TartanVOConfig.passes`).

        A pass reads what the rotation of the passes before it leaves of the flow
        (:func:`dvo.nets.two_frame.tartanvo.derotate`), so that it sees a smaller motion and corrects the rotation; the
        gradient of each stays in its pass.

        Args:
            flow: at a quarter of the resolution, feature pixels.
            intrinsics: ``fx fy cx cy`` in image pixels.

        Returns:
            Translation, up to scale, and rotation vector of ``T_ab`` after each pass.
        """
        translation, rotation = self.pose(flow, intrinsics)
        found = [(translation, rotation)]
        small = intrinsics.float() / self.STRIDE
        for _ in range(self.config.passes - 1):
            turned = so3.exp(rotation.detach())
            translation, change = self.pose(derotate(flow.float(), turned, small), intrinsics)
            # The point p of camera b is R_ab p + t in camera a; with p' = R p turned back, it is (R_ab R^-1) p' + t.
            rotation = so3.log(so3.multiply(so3.exp(change), turned))
            found.append((translation, rotation))
        return tuple(found)

    def between(self, first: list[Tensor], second: list[Tensor], intrinsics: Float[Tensor, "B 4"]) -> TwoFrameMotion:
        """Flow and motion between images whose features are known.

        Args:
            first, second: features of :meth:`encode`.
            intrinsics: ``fx fy cx cy`` in image pixels.

        Returns:
            Flow and motion.
        """
        flows = self.matching.match(first, second)
        found = self.motions(flows.flow, intrinsics)
        return TwoFrameMotion(*found[-1], flows, found)

    def forward(
        self, a: Float[Tensor, "B 3 H W"], b: Float[Tensor, "B 3 H W"], intrinsics: Float[Tensor, "B 4"]
    ) -> TwoFrameMotion:
        """Flow and motion between two images.

        Args:
            a, b: RGB, uint8 or float in the same range; of one size.
            intrinsics: ``fx fy cx cy`` in image pixels.

        Returns:
            Flow from ``a`` to ``b`` and pose of camera ``b`` in the coordinates of camera ``a``.
        """
        return self.between(self.encode(a), self.encode(b), intrinsics)
