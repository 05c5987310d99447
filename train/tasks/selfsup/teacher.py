"""Teacher: the network on the clean clip with more updates and patches, whose adjusted flow a student is to find."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from dvo.core.settings import check_settings
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.losses.consistency import Limits, trusted_edges
from dvo.models.patch_vo import PatchVO, UpdateState
from dvo.models.schedule import Stage
from dvo.nets.patch.selection import random_centres


@dataclass(frozen=True)
class TeacherConfig:
    """Settings of the teacher.

    Attributes:
        updates: updates a clip.
        patches: patches a frame beside those of the student.
        decay: of the moving average of the student's weights that the teacher is; 1: it stays what the run began with.
        backwards: run on the clip in reverse order too, for the check of forward against backward flow.

    Raises:
        DvoError: a value out of range.
    """

    updates: int = 16
    patches: int = 24
    decay: float = 1.0
    backwards: bool = True

    def __post_init__(self) -> None:
        check_settings(self, {"updates": (1, 1000), "patches": (0, 10_000), "decay": (0, 1)})


@dataclass(frozen=True)
class DenseEdges:
    """Result of the updates on a clip as tables over all patches and frames; lengths in feature pixels.

    Attributes:
        poses_cw: ``(B, N, 7)``.
        inverse_depth: ``(B, N, M)`` of the ``M`` patches of each frame.
        coords: ``(B, N, M, N, 2)`` centre of each patch reprojected into each frame.
        residual: ``(B, N, M, N)`` distance of the network's flow from it.
        confidence: ``(B, N, M, N)`` mean over the axes.
        known: ``(B, N, M, N)`` bool, edges that there are, in front of the camera.
    """

    poses_cw: Tensor
    inverse_depth: Tensor
    coords: Tensor
    residual: Tensor
    confidence: Tensor
    known: Tensor

    def reversed(self) -> DenseEdges:
        """The same with the frames in reverse order."""
        tables = (self.coords, self.residual, self.confidence, self.known)
        return DenseEdges(
            self.poses_cw.flip(1), self.inverse_depth.flip(1), *(table.flip(1).flip(3) for table in tables)
        )


@dataclass(frozen=True)
class Lesson:
    """Targets of a student, poses and depths in units of the median depth.

    Attributes:
        poses_cw: ``(B, N, 7)``.
        inverse_depth: ``(B, N, M)`` of the student's patches.
        confidence: ``(B, N, M, N)`` of the teacher in each edge, mean over the axes.
        trusted: ``(B, N, M, N)`` bool, edges that count.
        measures: scalars for the log.
    """

    poses_cw: Tensor
    inverse_depth: Tensor
    confidence: Tensor
    trusted: Tensor
    measures: dict[str, Tensor]


def dense_edges(state: UpdateState) -> DenseEdges:
    """Tables over all patches and frames of the last state of a clip.

    Args:
        state: with ``coords``, ``targets`` and ``confidence``.
    """
    graph, n = state.graph, state.frames
    b, k = state.patches.shape[:2]
    p = state.patches.shape[-1] // 2
    there = reproject(state.poses_cw, state.patches, state.intrinsics, graph.ii, graph.jj, graph.kk)
    assert state.targets is not None and state.confidence is not None
    centre = there.coords[:, :, p, p]
    residual = (state.targets - centre).norm(dim=-1)
    slot = graph.kk * n + graph.jj

    def table(values: Tensor, fill: float | bool) -> Tensor:
        whole = values.new_full((b, k * n, *values.shape[2:]), fill)
        whole[:, slot] = values
        return whole.view(b, n, k // n, n, *values.shape[2:])

    return DenseEdges(
        state.poses_cw,
        state.patches[:, :, 2, p, p].view(b, n, -1),
        table(centre, 0.0),
        table(residual, torch.inf),
        table(state.confidence.mean(-1), 0.0),
        table(there.valid[:, :, p, p], False),
    )


@torch.no_grad()
def teach(
    net: PatchVO,
    images: Float[Tensor, "B N 3 H W"],
    intrinsics: Float[Tensor, "B N 4"],
    centres: Int[Tensor, "B N K 2"],
    stages: list[Stage],
    limits: Limits,
    patches: int,
    backwards: bool,
) -> Lesson:
    """Run the teacher on a clip.

    Args:
        net: its network.
        images: clean clip, uint8.
        intrinsics: of the images, pixels.
        centres: of the student's patches in feature pixels of the clean clip, and behind them further ones.
        stages: schedule with as many patches.
        limits: within which an edge counts.
        patches: number of patches a frame that are the student's, the first ones.
        backwards: see :class:`TeacherConfig`.

    Returns:
        The lesson on the student's patches.
    """
    b, n = images.shape[:2]
    start = se3.identity(b, n, device=images.device)

    def run(images: Tensor, intrinsics: Tensor, centres: Tensor) -> DenseEdges:
        states = net.unroll(images, intrinsics, stages, poses_cw=start, centres=centres)
        return dense_edges(deque(states, maxlen=1)[0])

    found = run(images, intrinsics, centres)
    apart = None
    if backwards:
        other = run(images.flip(1), intrinsics.flip(1), centres.flip(1)).reversed()
        apart = torch.where(other.known, (found.coords - other.coords).norm(dim=-1), torch.inf)
    trusted = trusted_edges(
        found.confidence.flatten(1), found.residual.flatten(1), None if apart is None else apart.flatten(1),
        found.known.flatten(1), limits,
    ).view_as(found.known)  # fmt: skip
    scale = found.inverse_depth.flatten(1).median(1).values.clamp(min=1e-6)  # unit := median depth
    poses = torch.cat([found.poses_cw[..., :3] * scale[:, None, None], found.poses_cw[..., 3:]], -1)
    here = centres[:, :, :, None].to(found.coords)
    known = found.known
    measures = {
        "trusted": trusted.sum() / known.sum().clamp(min=1),
        "teacher_residual": found.residual[known].median(),
        "teacher_confidence": found.confidence[known].mean(),
        "teacher_flow": (found.coords - here).norm(dim=-1)[known].mean(),
    }
    if apart is not None:
        measures["forward_backward"] = apart[known].median()
    mine = slice(patches)
    return Lesson(
        poses,
        found.inverse_depth[:, :, mine] / scale[:, None, None],
        found.confidence[:, :, mine],
        trusted[:, :, mine],
        measures,
    )


def centres_before_crop(
    centres: Int[Tensor, "B N M 2"], cropped: Tensor, whole: Tensor, size: tuple[int, int], stride: int
) -> Int[Tensor, "B N M 2"]:
    """Feature positions in a clip from those in an enlarged window of it, along the same rays.

    Args:
        centres: in the window, feature pixels.
        cropped, whole: ``(B, N, 4)`` intrinsics of window and clip, image pixels.
        size: height and width of the feature map.
        stride: image pixels to a feature pixel.

    Returns:
        Nearest whole positions, at least one from the border.
    """
    ray = (centres * stride - cropped[:, :, None, 2:]) / cropped[:, :, None, :2]
    place = ((ray * whole[:, :, None, :2] + whole[:, :, None, 2:]) / stride).round().long()
    most = torch.tensor([size[1] - 2, size[0] - 2], device=place.device)
    return torch.minimum(place.clamp(min=1), most)


def further_centres(
    frames: int, patches: int, size: tuple[int, int], generators: list[torch.Generator]
) -> Int[Tensor, "B N P 2"]:
    """Further patches of the teacher, uniform over the feature map.

    Args:
        frames: of a clip.
        patches: number in each frame.
        size: height and width of the feature map.
        generators: one for each clip, on the CPU.
    """
    return torch.cat([random_centres(frames, patches, *size, one) for one in generators])


def flat_weights(net: nn.Module) -> Tensor:
    """All parameters of a network in one vector, a copy."""
    return torch.cat([parameter.detach().flatten() for parameter in net.parameters()])


def use_weights(net: nn.Module, flat: Tensor) -> None:
    """Give the parameters of a network the values of a vector, see :func:`flat_weights`."""
    parameters = list(net.parameters())
    with torch.no_grad():
        for parameter, values in zip(parameters, flat.split([p.numel() for p in parameters]), strict=True):
            parameter.copy_(values.view_as(parameter))
