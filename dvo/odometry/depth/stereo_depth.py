"""Depth of patches from the right image of a stereo pair, measured by the network.

An edge from a patch into the right image is measured as any other edge of the tracker: the patch is reprojected,
correlated there, and revised by the update operator, several times. The pose of the right camera is known, so that the
inverse depth alone is fitted. Its start is the best match of the features of the patch along its epipolar line. The
sub-pixel alignment that follows finds the slopes of the surface too (:mod:`dvo.nets.patch.slopes`), which every later
alignment of the patch uses. The measurement then enters bundle adjustment as the factor that it is: ``w (u(d) -
u_measured)^2`` with the confidence ``w`` of the network, linear in the inverse depth ``d`` for parallel cameras, is the
prior ``w |du/dd|^2 (d - d_measured)^2``. Patches whose match is not confident, does not lie on the epipolar line, or
tells nothing about the depth have none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from dvo.data.frame import Frame
from dvo.geometry import se3
from dvo.geometry.projection import Reprojection, reproject
from dvo.map.measurements import SIGMA
from dvo.map.window import Keyframe, Window
from dvo.models.patch_vo import PatchVO
from dvo.nets.patch.patchifier import Features, patch_coordinates
from dvo.odometry.depth.right_view import RightView, right_view
from dvo.odometry.frames.front_end import Observation, encode_image
from dvo.odometry.window.patch_window import PatchWindow, StepSettings

_UPDATES = 2  # of the network, from the best match along the epipolar line
_SPACING = 0.5  # of the matches that are tried, feature pixels
_WIDEST = 0.4  # largest disparity that is tried, in widths of the image
_RESIDUAL = 0.06  # distance from the epipolar line above which a patch has none, feature pixels
_RELATIVE = 0.3  # standard deviation relative to the inverse depth above which a patch has none
_SLOPE = 0.03  # standard deviation of the slopes of surfaces before anything is measured, 1 / feature pixel
_NEAREST = 0.2  # metres; bundle adjustment leaves out points that are nearer (dvo.ba.layer.layer)


@dataclass(frozen=True)
class StereoMatches:
    """Measurements of the patches of a frame in its right image.

    Attributes:
        inverse_depth: ``(M,)`` 1/m, that fits them best.
        weight: ``(M,)`` of the inverse depth in bundle adjustment, where 1 stands for the standard deviation
            :data:`dvo.map.measurements.SIGMA`.
        residual: ``(M,)`` distance of the measurement from the epipolar line, feature pixels.
        found: ``(M,)`` bool, the measurement lies in the image and its alignment was accepted.
        slopes: ``(M, 2)`` of the surfaces, see :class:`dvo.map.window.Keyframe`.
    """

    inverse_depth: Tensor
    weight: Tensor
    residual: Tensor
    found: Tensor
    slopes: Tensor

    @property
    def good(self) -> Tensor:
        """``(M,)`` bool: patches whose depth is taken."""
        sure = self.weight * self.inverse_depth**2 > (SIGMA / _RELATIVE) ** 2
        near = (self.inverse_depth > 0) & (self.inverse_depth < 1 / _NEAREST)
        return self.found & (self.residual < _RESIDUAL) & sure & near


def measure_stereo(
    model: PatchVO, seen: Observation, frame: Frame, settings: StepSettings, deviation: float
) -> Observation:
    """Measure the depths of the patches of a frame in its right image.

    Args:
        model: the network.
        seen: the patches.
        frame: of the same image; its right image is read.
        settings: of the measurements: alignment and kernel.
        deviation: standard deviation of a disparity, pixels (:attr:`ScaleOptions.stereo_error`).

    Returns:
        The observation with ``measured`` and ``slopes``, of zeros for a frame without a right image.

    Raises:
        DvoError: a right image that cannot be used, see :func:`dvo.odometry.depth.right_view.right_view`.
    """
    view = right_view(frame, seen.image.shape[1], seen.image.shape[0])
    measured = slopes = seen.intrinsics.new_zeros(seen.centres.shape[2], 2)
    if view is not None:
        found = match_right(model, seen, view, settings, deviation)
        values = torch.stack([found.inverse_depth, found.weight], 1).to(measured)
        measured = torch.where(found.good[:, None], values, measured)
        slopes = torch.where(found.good[:, None], found.slopes.to(measured), slopes)
    return replace(seen, measured=measured, slopes=slopes)


def match_right(
    model: PatchVO, seen: Observation, view: RightView, settings: StepSettings, deviation: float
) -> StereoMatches:
    """Match the patches of a frame with its right image.

    Args:
        model: the network.
        seen: the patches.
        view: right image of the size of the working image.
        settings: of the measurements: alignment and kernel.
        deviation: standard deviation of a disparity, pixels (:attr:`ScaleOptions.stereo_error`).

    Returns:
        The measurements.
    """
    device, stride = seen.intrinsics.device, model.config.STRIDE
    features = encode_image(model, view.image, device)
    intrinsics = torch.tensor(view.intrinsics / stride).to(seen.intrinsics)
    pose = torch.from_numpy(view.pose_right_left).to(seen.intrinsics)
    focal, right = (seen.intrinsics, intrinsics), features.matching[0, 0]
    depth = search_line(seen.matching, seen.centres[0, 0].to(pose), right, focal, pose)[0][None]
    pair = _pair(model, seen, features, view.image, intrinsics, pose, depth, settings)
    for _ in range(_UPDATES):
        pair.step(2, structure_only=True)
    pair.finalise(torch.arange(len(pair.window.kk), device=device))
    return _fitted(pair.window, seen.bounds, deviation)


def search_line(
    matching: Tensor,
    centres: Tensor,
    target: Tensor,
    intrinsics: tuple[Tensor, Tensor],
    pose: Tensor,
) -> tuple[Tensor, Tensor]:
    """Find for patches of one image of a pair where the features of the other are most like theirs.

    Args:
        matching: ``(M, C, p, p)`` features of the patches.
        centres: ``(M, 2)`` feature pixels.
        target: ``(C, h, w)`` features of the other image.
        intrinsics: ``(4,)`` of the feature maps of the patches and of the target.
        pose: ``(7,)`` from the camera of the patches to that of the target, metres.

    Returns:
        ``(M,)`` inverse depths, 1/m, of a grid of disparities: the farthest of equal matches; and ``(M, 2)`` the
        positions of the matches.
    """
    height, width = target.shape[-2:]
    count, m, size = int(_WIDEST * width / _SPACING) + 1, len(centres), matching.shape[-1]
    step = _SPACING / (float(intrinsics[1][0]) * float(pose[:3].norm()))
    depths = (torch.arange(count, device=pose.device) * step).to(pose)
    patches = [patch_coordinates(centres[None, None], d.expand(1, m), size)[0] for d in depths]
    kk = torch.arange(count * m, device=pose.device)
    found = _across(torch.cat(patches), torch.stack(intrinsics), pose, kk)
    sampled = sample_features(F.normalize(target, dim=0), found.coords[0].reshape(count, m, size * size, 2))
    own = F.normalize(matching, dim=1).flatten(2)  # (M, C, p p)
    score = torch.einsum("cnmp,mcp->nm", sampled, own)
    places = found.coords[0, :, size // 2, size // 2].reshape(count, m, 2)
    best = score.masked_fill(~_inside(places, width, height), -torch.inf).argmax(0)
    return depths[best], places[best, torch.arange(m, device=pose.device)]


def sample_features(features: Tensor, positions: Tensor) -> Tensor:
    """Sample a feature map bilinearly.

    Args:
        features: ``(C, h, w)``.
        positions: ``(..., 2)`` x, y in its pixels; outside they are those of the border.

    Returns:
        ``(C, ...)``.
    """
    size = positions.new_tensor([features.shape[-1] - 1, features.shape[-2] - 1])
    grid = (2 * positions / size - 1).reshape(1, 1, -1, 2)
    found = F.grid_sample(features[None], grid, padding_mode="border", align_corners=True)
    return found.reshape(len(features), *positions.shape[:-1])


def _inside(position: Tensor, width: int, height: int) -> Tensor:
    """Positions ``(..., 2)`` that lie in a feature map."""
    x, y = position.unbind(-1)
    return (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)


def _across(patches: Tensor, intrinsics: Tensor, pose: Tensor, kk: Tensor, jacobians: bool = False) -> Reprojection:
    """Reproject patches ``(K, 3, p, p)`` of one image of a pair into the other."""
    poses = torch.stack([se3.identity(device=pose.device, dtype=pose.dtype), pose])
    zero = torch.zeros_like(kk)
    return reproject(poses[None], patches[None], intrinsics[None], zero, zero + 1, kk, jacobians=jacobians)


def _pair(
    model: PatchVO,
    seen: Observation,
    features: Features,
    image: np.ndarray,
    intrinsics: Tensor,
    pose: Tensor,
    depth: Tensor,
    settings: StepSettings,
) -> PatchWindow:
    """Window of the left and the right image, with an edge from each patch into the right one."""
    c, device = model.config, seen.intrinsics.device
    settings = replace(settings, alignment=replace(settings.alignment, slope=_SLOPE), align="final")
    pair = PatchWindow.empty(model, seen.centres.shape[2], settings, device)
    patches = patch_coordinates(seen.centres, depth, c.patch_size)[0]
    maps = seen.maps, features.matching
    both = (seen.image, seen.intrinsics, se3.identity().to(pose)), (image, intrinsics, pose)
    for slot, (picture, focal, at) in enumerate(both):  # patches of the right image have no edges
        keyframe = Keyframe(slot, float(slot), slot, seen.matching, seen.context, seen.colors, focal, picture)
        pair.insert(slot, keyframe, maps[slot], at, patches)
    kk = torch.arange(pair.window.per_frame, device=device)
    pair.window.connect(kk, torch.ones_like(kk))
    return pair


def _fitted(window: Window, bounds: tuple[int, int], deviation: float) -> StereoMatches:
    """Fit the inverse depths to the measurements of a pair, of the given standard deviation in feature pixels."""
    patches, middle = window.patches[: window.per_frame], window.patches.shape[-1] // 2
    for _ in range(2):  # of Gauss-Newton; exact after one for parallel cameras
        found = _across(patches, window.intrinsics, window.poses_cw[1], window.kk, jacobians=True)
        assert found.jac_d is not None
        slope = found.jac_d[0, ..., 0]
        residual = window.targets - found.coords[0, :, middle, middle]
        square = (slope**2).sum(-1)
        delta = (slope * residual).sum(-1) / square.clamp(min=1e-12)
        patches = torch.cat([patches[:, :2], patches[:, 2:] + delta[:, None, None, None]], 1)
    off = (residual - slope * delta[:, None]).norm(dim=-1)
    aligned = (window.weights > window.confidence).any(-1)
    known = aligned & _inside(window.targets, *bounds) & found.valid[0, :, middle, middle]
    slopes = window.frames[0].slopes
    assert slopes is not None, "the alignment of the pair was to find them"
    return StereoMatches(patches[:, 2, middle, middle], (SIGMA / deviation) ** 2 * square, off, known, slopes)
