"""Pose of a keyframe relative to a place of long ago, from the images alone.

The patches of the earlier keyframes, whose depths are known, are searched in the whole feature map of the later one.
Pose from points in RANSAC (Fischler and Bolles, "Random sample consensus", 1981) picks those that agree. It takes a few
milliseconds and serves two purposes: candidates that do not show the same are told apart before the network looks at
them, and the update operator, which sees only a few pixels around a reprojection, starts from a pose near the true one
although the camera is elsewhere than it was.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, normalize

from dvo.geometry import se3, so3
from dvo.map.archive import ArchivedKeyframe
from dvo.odometry.loops.candidates import Candidate
from dvo.odometry.loops.joint_window import Group

GUESSED = 8
"""Least number of patches that agree on the pose of a candidate."""
MATCHED = 3
"""Candidates that are verified by the network, at most."""
_REACH = 1.5  # largest distance of an inlier from its reprojection, feature pixels
_TRIALS = 300  # of RANSAC
_LEAD = 0.01  # least lead of the best place of a patch over the next one, in mean cosines
_GOOD = 0.75  # share of the inliers of the best candidate above which another one is as good
_GUESSES = 2  # poses in a step: about as long as an update of the network
_SAMPLE = 4  # points of a trial: three for the pose, one to choose among its solutions


@dataclass(frozen=True)
class Guess:
    """Pose from patches that were found in a keyframe.

    Attributes:
        pose_cw: ``(7,)`` float64 ``T_cw`` of the keyframe in the world of the patches.
        inliers: number of patches that agree with it.
    """

    pose_cw: Tensor
    inliers: int


def guess_pose(
    maps: Tensor, intrinsics: np.ndarray, frames: Sequence[ArchivedKeyframe], poses_cw: Tensor
) -> Guess | None:
    """Find the pose of a keyframe in the world of earlier ones.

    Args:
        maps: ``(1, 1, C, h, w)`` matching features of the keyframe.
        intrinsics: ``(4,)`` fx fy cx cy of its feature map.
        frames: ``n`` earlier keyframes; those without features of their patches are left out.
        poses_cw: ``(n, 7)`` their poses ``T_cw``.

    Returns:
        The pose with the most inliers; None if there are too few clear matches for any.
    """
    patches, points = [], []
    for frame, pose in zip(frames, poses_cw, strict=True):
        if frame.matching is not None:
            patches.append(torch.from_numpy(frame.matching))
            points.append(se3.act(se3.inverse(pose), points_of(frame)))
    if not patches:
        return None
    places, lead = find_patches(maps, torch.cat(patches))
    clear = (lead > _LEAD).cpu().numpy()
    if clear.sum() < _SAMPLE:
        return None
    fx, fy, cx, cy = intrinsics.astype(float).tolist()
    camera = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    found, turn, shift, inliers = cv2.solvePnPRansac(
        torch.cat(points).numpy()[clear], places.double().cpu().numpy()[clear], camera, None,
        iterationsCount=_TRIALS, reprojectionError=_REACH, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not found or inliers is None or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    rotation = so3.exp(torch.from_numpy(turn.ravel()))
    return Guess(torch.cat([torch.from_numpy(shift.ravel()), rotation]), len(inliers))


@dataclass(frozen=True)
class Pair:
    """Candidate with all that its verification reads.

    Attributes:
        candidate: the two keyframes, and a pose to start from.
        old, new: both with their neighbours.
        old_cw: ``(n, 7)`` poses ``T_cw`` of ``old``.
        moved: ``(m, 7)`` transforms from the camera of the later keyframe to those of ``new``.
        present_cw: ``(7,)`` pose ``T_cw`` of the later keyframe that is known otherwise: by the present poses, or, in
            another world, by corners (:mod:`dvo.odometry.loops.wide_baseline`); None if there is none.
        joins: the two are of different worlds.
        scale: of the lengths of ``new`` here, in the unit of their segment.
    """

    candidate: Candidate
    old: Group
    new: Group
    old_cw: Tensor
    moved: Tensor
    present_cw: Tensor | None
    joins: bool = False
    scale: float = 1.0

    def placed(self, pose_cw: Tensor, scale: float) -> Pair:
        """Pair whose newer group starts from a pose and a scale that its match has to agree with.

        Args:
            pose_cw: ``(7,)`` of the later keyframe.
            scale: of the lengths of its group.
        """
        moved = torch.cat([self.moved[:, :3] * scale, self.moved[:, 3:]], -1)
        new = tuple(replace(one, inverse_depth=one.inverse_depth / np.float32(scale)) for one in self.new)
        candidate = replace(self.candidate, pose_cw=pose_cw)
        return replace(self, candidate=candidate, new=new, moved=moved, present_cw=pose_cw, scale=scale)

    @property
    def later(self) -> ArchivedKeyframe:
        """Later keyframe of the two."""
        return next(frame for frame in self.new if frame.identifier == self.candidate.new)

    @property
    def start(self) -> Tensor:
        """Poses ``(n + m, 7)`` of both groups to start from, in the world of the earlier."""
        return torch.cat([self.old_cw, se3.compose(self.moved, self.candidate.pose_cw.expand(len(self.moved), 7))])


def order_pairs(
    maps: Tensor, pairs: Sequence[Pair], inliers: int = GUESSED, count: int = MATCHED
) -> Generator[None, None, list[Pair]]:
    """Choose the pairs to match, in steps.

    Those with nearly as many inliers as the best one come first, the earliest visit before the others, since a loop
    with it corrects the most drift; then the others by inliers. Candidates by proximity for which no pose was guessed
    follow, as the poses alone tell that they may show the same. Of several candidates with the same neighbours, as at
    the beginning of a segment, only the first is left.

    Args:
        maps: ``(1, 1, C, h, w)`` matching features of the later keyframe, which all pairs share.
        pairs: in the order of the candidates.
        inliers: of a guess, at least.
        count: pairs, at most.

    Returns:
        Pairs that start from the pose of their guess; the last ones, without, from that of the candidate.
    """
    found: list[tuple[int, Pair]] = []
    others = []
    for number, pair in enumerate(pairs):
        if number % _GUESSES == 0:
            yield
        guess = guess_pose(maps, pair.later.intrinsics, pair.old, pair.old_cw)
        if guess is not None and guess.inliers >= inliers:
            found.append((guess.inliers, replace(pair, candidate=replace(pair.candidate, pose_cw=guess.pose_cw))))
        elif pair.candidate.kind == "proximity":
            others.append(pair)
    least = _GOOD * max((number for number, _ in found), default=0)
    good = sorted((pair for number, pair in found if number >= least), key=lambda pair: pair.candidate.old)
    weak = sorted((entry for entry in found if entry[0] < least), key=lambda entry: -entry[0])
    ordered = [*good, *(pair for _, pair in weak), *others]
    different = {tuple(frame.identifier for frame in pair.old): pair for pair in reversed(ordered)}
    return [pair for pair in ordered if any(pair is one for one in different.values())][:count]


def find_patches(maps: Tensor, patches: Tensor) -> tuple[Tensor, Tensor]:
    """Find patches in a feature map by the mean cosine of the features of their pixels.

    Args:
        maps: ``(1, 1, C, h, w)`` matching features.
        patches: ``(M, C, p, p)`` matching features of the patches.

    Returns:
        ``(M, 2)`` best places of their centres, feature pixels; ``(M,)`` lead of each over the best one elsewhere.
    """
    side = patches.shape[-1]
    area, kernels = normalize(maps[0].float(), dim=1), normalize(patches.to(maps.device).float(), dim=1) / side**2
    scores = conv2d(area, kernels)[0]
    height, width = scores.shape[1:]
    best, index = scores.flatten(1).max(1)
    row, column = index // width, index % width
    v, u = (torch.arange(n, device=scores.device) for n in (height, width))
    near = ((v[None, :, None] - row[:, None, None]).abs() <= side) & ((u - column[:, None])[:, None].abs() <= side)
    second = scores.masked_fill(near, -1.0).flatten(1).max(1).values
    return torch.stack([column, row], -1).float() + (side - 1) / 2, best - second


def points_of(frame: ArchivedKeyframe) -> Tensor:
    """Points of a keyframe.

    Args:
        frame: with its patches.

    Returns:
        ``(M, 3)`` float64 centres of its patches in its camera.
    """
    fx, fy, cx, cy = torch.from_numpy(frame.intrinsics).double()
    x, y = torch.from_numpy(frame.centres).double().unbind(-1)
    depth = 1.0 / torch.from_numpy(frame.inverse_depth).double().clamp(min=1e-6)
    return torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], -1) * depth[:, None]
