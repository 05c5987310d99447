"""Relocalisation: the pose of a single frame among the keyframes of the archive.

A tracker that is lost, or that begins a recording in a map, compares each frame with the places it knows. Candidates
are the keyframes whose images are most alike, and the newest ones; pose from points (:mod:`dvo.odometry.loops.guess`)
orders them, and the network measures the best in a joint window (:mod:`dvo.odometry.loops.joint_window`), as it does
for a loop. The frame that is found begins a segment in the world and the scale of these keyframes, which are guests of
its
window: their poses are held and their depths have a prior, so that tracking goes on from a single frame and, as long as
the camera sees them, does not drift away.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.map.archive import ArchivedKeyframe, encode_jpeg
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.measurements import SIGMA
from dvo.map.window import Keyframe, Window
from dvo.nets.patch.patchifier import patch_coordinates
from dvo.odometry.frames.front_end import View
from dvo.odometry.loops.candidates import LIKENESS, MIN_DISTANCE, RETRIEVED, rays_of, share_in_view
from dvo.odometry.loops.finder import Loop, LoopFinder
from dvo.odometry.loops.guess import MATCHED, guess_pose
from dvo.odometry.loops.joint_window import Group, Match
from dvo.odometry.maintenance.background import all_steps
from dvo.odometry.window.patch_window import PatchWindow

GROUP_REACH = 12
"""Kept keyframes before and after a candidate among which its group is chosen."""
GROUP_SIZE = 4
"""Keyframes that a frame is matched with at once."""
MIN_OVERLAP = 0.5
"""Share of the patches of a candidate that another keyframe of its group has in view."""
REFRESH_EVERY = 2
"""Frames from one choice of the guests of a window to the next."""
MIN_GUESSED = 0.2
"""Share of the patches of a group that agree on a pose from points, below which the network does not look at it. Other
places had at most a tenth, the same place more than 0.4."""
UPDATES, MIN_MATCHED = (8, 6), 0.08
"""Updates of the network in two parts, and the share of inliers below which a candidate is refused after the first."""
MIN_INLIERS, MIN_INLIERS_IN_MAP = 0.25, 0.15
"""The same after the second part: for a place of the recording, with which its segments are compared once more at the
end, and for one of an earlier recording. The same place had 0.2 to 0.5 (patches of a group that lie out of view count
as none), other places none."""
ACCURACY = 0.02
"""Relative standard deviation of the inverse depths of archived patches."""


@dataclass(frozen=True)
class Guest:
    """Archived keyframe for the window of a frame that was found.

    Attributes:
        keyframe: with the image, and the inverse depths of its patches as a prior.
        pose_cw: ``(7,)`` float64.
        patches: ``(M, 3, p, p)``.
        maps: ``(1, 1, C, h, w)`` matching features.
    """

    keyframe: Keyframe
    pose_cw: Tensor
    patches: Tensor
    maps: Tensor


@dataclass(frozen=True)
class Located:
    """Frame that was found among archived keyframes.

    Attributes:
        loop: the best of these keyframes and the frame, with their measurements.
        pose_cw: ``(7,)`` float64 ``T_cw`` of the frame in their world.
        depths: ``(M,)`` float32 inverse depths of its patches in the unit of that world.
        guests: these keyframes, the farthest first.
    """

    loop: Loop
    pose_cw: Tensor
    depths: Tensor
    guests: tuple[Guest, ...]


def locate(finder: LoopFinder, view: View, identifier: int) -> Located | None:
    """Find a frame among the archived keyframes. Nothing changes.

    Args:
        finder: with the keyframes, their descriptors and the network.
        view: the frame.
        identifier: of the keyframe that it becomes, larger than those of the archive.

    Returns:
        Its pose; None if it shows no known place.
    """
    frame = _as_keyframe(view, identifier)
    finder.matcher.maps.put(frame, view.seen.maps)
    try:
        return _found_among(finder, view, frame)
    finally:  # the identifier may become that of another keyframe
        finder.matcher.maps.drop(frame)


def _found_among(finder: LoopFinder, view: View, frame: ArchivedKeyframe) -> Located | None:
    guesses = []
    for old, group in _groups(finder, view):
        poses_cw = finder.graph.poses_cw(np.array([member.identifier for member in group]))
        guess = guess_pose(view.seen.maps, frame.intrinsics, group, poses_cw)
        if guess is not None and guess.inliers >= MIN_GUESSED * sum(len(member.centres) for member in group):
            guesses.append((guess, old, group, poses_cw))
    guesses.sort(key=lambda found: -found[0].inliers)
    for guess, old, group, poses_cw in guesses[:MATCHED]:
        start = torch.cat([poses_cw, guess.pose_cw[None]])
        in_map = finder.graph.segment_of(old) < finder.graph.recording.segment
        decisions = tuple(zip(UPDATES, (MIN_MATCHED, MIN_INLIERS_IN_MAP if in_map else MIN_INLIERS), strict=True))
        match = all_steps(finder.matcher.match(group, (_seen_from(frame, group, start),), start, decisions))
        if match is not None:
            return _located(finder, group, frame, old, match)
    return None


def invite(patch_window: PatchWindow, guests: Sequence[Guest]) -> None:
    """Add guests to a window, after those that it has.

    Args:
        patch_window: the window.
        guests: that the window does not hold.
    """
    window = patch_window.window
    for guest in guests:
        keyframe = replace(guest.keyframe, map_slot=window.free_map_slot())
        patch_window.insert(window.guests, keyframe, guest.maps, guest.pose_cw.to(window.poses_cw), guest.patches)


def hold_to_map(graph: KeyframeGraph, patch_window: PatchWindow, finder: LoopFinder) -> None:
    """Choose the guests of a window again: keyframes of other segments that show what its newest one shows.

    Args:
        graph: of the tracker, whose segment was located; its window is changed.
        patch_window: the window.
        finder: with the keyframes.
    """
    window = graph.window
    wanted = _overlapping(graph, finder)
    for position in reversed(range(window.guests)):
        if window.frames[position].identifier not in wanted:
            graph.release(position)
    here = {frame.identifier for frame in window.frames}
    missing = [k for k in wanted if k not in here]
    poses_cw = graph.poses_cw(np.array(missing, dtype=np.int64))
    before = window.guests
    guests = [_guest(finder, graph.archive[k], pose) for k, pose in zip(missing, poses_cw, strict=True)]
    invite(patch_window, [guest for guest in guests if guest is not None])
    if window.guests > before:
        patch_window.window.connect(*_edges(window, range(before, window.guests)))


def _edges(window: Window, guests: range) -> tuple[Tensor, Tensor]:
    """Edges between new guests and the newest keyframe, both ways: patches and target frames."""
    m, newest, device = window.per_frame, len(window) - 1, window.jj.device
    every = torch.tensor(list(guests), device=device)
    into = (every[:, None] * m + torch.arange(m, device=device)).flatten()
    own = torch.arange(newest * m, (newest + 1) * m, device=device).repeat(len(every))
    return torch.cat([into, own]), torch.cat([torch.full_like(into, newest), every.repeat_interleave(m)])


def _overlapping(graph: KeyframeGraph, finder: LoopFinder) -> list[int]:
    """Keyframes of the map that the newest keyframe of the window overlaps with, the farthest from each other."""
    window, m = graph.window, graph.window.per_frame
    world = graph.world_of(graph.segment)
    others = [k for k in finder.kept if graph.segment_of(k) != graph.segment]
    others = [k for k in others if graph.segment_of(k) >= 0 and graph.world_of(graph.segment_of(k)) == world]
    others = [k for k in others if finder.matcher.can_match(graph.archive[k])]
    if not others:
        return []
    pose_cw, middle = window.poses_cw[-1].double().cpu(), window.patches.shape[-1] // 2
    centres = window.patches[-m:, :, middle, middle].double().cpu()
    rays = rays_of(centres[:, :2], window.frames[-1].intrinsics.double().cpu())
    points = rays / centres[:, 2:].clamp(min=1e-6)
    return _spread(graph, points, pose_cw, np.array(others, dtype=np.int64), [], GROUP_SIZE)


def _as_keyframe(view: View, identifier: int) -> ArchivedKeyframe:
    """View in the form of the keyframes that it is matched with; inverse depths of 1."""
    seen = view.seen
    centres = seen.centres[0, 0].float().cpu().numpy()
    return ArchivedKeyframe(
        identifier, view.records[0].timestamp, seen.intrinsics.float().cpu().numpy(), np.zeros(7), None, centres,
        np.ones(len(centres), np.float32), seen.colors.cpu().numpy(), seen.matching.float().cpu().numpy(),
        seen.context.float().cpu().numpy(), encode_jpeg(seen.image, 90),
    )  # fmt: skip


def _groups(finder: LoopFinder, view: View) -> Iterator[tuple[int, Group]]:
    """Keyframes that may show what a frame shows, each with others that look at the same from elsewhere."""
    seen, known = view.seen, set[tuple[int, ...]]()
    if finder.descriptor is None or not finder.kept:
        return
    row = finder.descriptor(seen.image, seen.maps)
    found = finder.places.query(finder.descriptor.views(row), RETRIEVED, apart=MIN_DISTANCE)
    alike = [int(k) for k, score in zip(found.identifiers, found.scores, strict=True) if score >= LIKENESS]
    for old in dict.fromkeys([*alike, finder.kept[-1]]):
        group = _group(finder, old)
        if group is not None and (members := tuple(frame.identifier for frame in group)) not in known:
            known.add(members)
            yield old, group


def _group(finder: LoopFinder, old: int) -> Group | None:
    """Keyframe and those of its segment that see the same from farthest away; None if it cannot be matched."""
    graph, at = finder.graph, bisect_left(finder.kept, old)
    segment = graph.segment_of(old)
    near = [k for k in finder.kept[max(0, at - GROUP_REACH) : at + GROUP_REACH + 1] if graph.segment_of(k) == segment]
    near = [k for k in near if finder.matcher.can_match(graph.archive[k]) and len(graph.archive[k].inverse_depth)]
    if segment < 0 or old not in near:
        return None
    others = np.array([k for k in near if k != old], dtype=np.int64)
    if not len(others):
        return None
    frame, pose_cw = graph.archive[old], graph.poses_cw(np.array([old]))[0]
    rays = rays_of(torch.from_numpy(frame.centres).double(), torch.from_numpy(frame.intrinsics).double())
    points = rays / torch.from_numpy(frame.inverse_depth).double().clamp(min=1e-6)[:, None]
    chosen = _spread(graph, points, pose_cw, others, [old], GROUP_SIZE)
    return tuple(graph.archive[k] for k in sorted(chosen)) if len(chosen) > 1 else None


def _spread(
    graph: KeyframeGraph, points: Tensor, pose_cw: Tensor, others: np.ndarray, chosen: list[int], count: int
) -> list[int]:
    """Keyframes that see points of a camera, the farthest from it and from each other, after those chosen already."""
    shared = share_in_view(graph, points, pose_cw, others) >= MIN_OVERLAP
    centres = se3.inverse(graph.poses_cw(others))[:, :3]
    apart = (centres - se3.inverse(pose_cw)[:3]).norm(dim=1)
    while len(chosen) < count and shared.any():
        best = int(np.where(shared, apart.numpy(), -1.0).argmax())
        chosen.append(int(others[best]))
        apart = torch.minimum(apart, (centres - centres[best]).norm(dim=1))
        shared[best] = False
    return chosen


def _seen_from(frame: ArchivedKeyframe, group: Group, poses_cw: Tensor) -> ArchivedKeyframe:
    """Frame whose patches have the median depth of those of a group in its camera; its pose is the last one."""
    depths = []
    for member, pose_cw in zip(group, poses_cw[:-1], strict=True):
        rays = rays_of(torch.from_numpy(member.centres).double(), torch.from_numpy(member.intrinsics).double())
        points = rays / torch.from_numpy(member.inverse_depth).double().clamp(min=1e-6)[:, None]
        depths.append(se3.act(se3.relative(pose_cw, poses_cw[-1]), points)[:, 2])
    seen = torch.cat(depths)
    depth = float(seen[seen > 0].median()) if bool((seen > 0).any()) else 1.0
    return replace(frame, inverse_depth=np.full(len(frame.centres), 1 / depth, np.float32))


def _located(finder: LoopFinder, group: Group, frame: ArchivedKeyframe, old: int, match: Match) -> Located:
    pose_cw = match.poses_cw[-1]
    first = next(k for k, member in enumerate(group) if member.identifier == old)
    measurement = torch.cat([se3.relative(match.poses_cw[first], pose_cw), torch.ones(1, dtype=torch.float64)])
    loop = Loop(
        old, frame.identifier, group[first].timestamp, frame.timestamp, "relocalisation", match.inliers, measurement,
        len(match.edges), match.edges, joins=True,
    )  # fmt: skip
    distance = (se3.inverse(match.poses_cw[:-1])[:, :3] - se3.inverse(pose_cw)[:3]).norm(dim=1)
    order = distance.argsort(descending=True).tolist()
    guests = (_guest(finder, group[k], match.poses_cw[k]) for k in order)
    return Located(loop, pose_cw, match.depths, tuple(guest for guest in guests if guest is not None))


def _guest(finder: LoopFinder, frame: ArchivedKeyframe, pose_cw: Tensor) -> Guest | None:
    """Archived keyframe in the form of the window; None if its image cannot be read."""
    image, maps = frame.image(), finder.matcher.maps.maps(frame)
    if image is None or maps is None or frame.matching is None or frame.context is None:
        return None
    device = maps.device
    matching, context = (torch.from_numpy(x).float().to(device) for x in (frame.matching, frame.context))
    depth = torch.from_numpy(frame.inverse_depth).to(device).clamp(min=1e-6)
    prior = torch.stack([depth, (SIGMA / (ACCURACY * depth)).square()], 1)
    intrinsics = torch.from_numpy(frame.intrinsics).to(device)
    keyframe = Keyframe(
        frame.identifier, frame.timestamp, 0, matching, context, torch.from_numpy(frame.colors), intrinsics, image,
        prior=prior, guest=True,
    )  # fmt: skip
    centres = torch.from_numpy(frame.centres)[None, None].to(device)
    patches = patch_coordinates(centres, depth[None], finder.matcher.model.config.patch_size)[0]
    return Guest(keyframe, pose_cw, patches, maps)
