"""Loops that a run tells of, against the rendered truth.

Definitions:

- A loop is two times of a run, its later and its earlier visit of a place (``from`` and ``to`` under ``loops`` of
  :attr:`dvo.odometry.protocol.Result.info`). It is right if the frames of these times share :data:`RIGHT` of the view
  by the rendered depth and poses, and false if neither of them sees anything of what the other one sees.
- The unit of recall is a second. It is represented by its first frame, and is a revisit if that frame shares
  :data:`RIGHT` of the view with the first frame of a second that is :data:`OLDER` seconds older or more. Frames without
  a view (in the dark) are left out.
- A revisit is found if a loop that is not false has its later visit within :data:`NEAR` seconds of it. Recall is the
  share of the revisits that are found by the loops that had more inliers than every false one: recall at a precision of
  100 %, as the score of the system itself allows it. Without a false loop all loops count.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from dvo.synth.sequence import SyntheticSequence, make_sequence
from eval.scoring.overlap import both_shares, depth_maps
from eval.suites.suite import Sequence as Recording

RIGHT = 0.3
OLDER = 10.0
NEAR = 3.0
SAME_TIME = 1e-6  # seconds


@dataclass(frozen=True)
class LoopErrors:
    """Judgement of the loops of a run; nan where the system tells of none, or nothing is known of the truth.

    Attributes:
        loops: number of loops.
        right, false: of these.
        revisit_s: seconds that are a revisit.
        recall: share of them that are found.
    """

    loops: float = math.nan
    right: float = math.nan
    false: float = math.nan
    revisit_s: float = math.nan
    recall: float = math.nan


@dataclass
class Revisits:
    """Truth about the views of a rendered sequence.

    Args:
        sequence: as it was rendered.

    Attributes:
        seconds: ``(N,)`` index of the first frame of each second.
        shared: ``(N, N)`` shared view of these frames (row) with those at least :data:`OLDER` seconds older, else 0.
    """

    sequence: SyntheticSequence
    seconds: np.ndarray = field(init=False)
    shared: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        stamps = self.sequence.groundtruth.timestamps
        self.seconds = np.unique(np.floor(stamps - stamps[0] + SAME_TIME), return_index=True)[1]
        times = stamps[self.seconds]
        older = times[None] <= times[:, None] - OLDER + SAME_TIME
        self.shared = np.minimum(*self._shares(self.seconds, older)) if older.any() else np.zeros(older.shape)

    def revisited(self, unseen: np.ndarray) -> np.ndarray:
        """Times ``(M,)`` of the seconds that are a revisit.

        Args:
            unseen: ``(K,)`` stamps of the frames without a view, seconds.
        """
        times = self.sequence.groundtruth.timestamps[self.seconds]
        limit = self.sequence.interval / 2
        seen = np.abs(times[:, None] - unseen[None]).min(1) > limit if len(unseen) else np.ones(len(times), bool)
        return times[seen & ((self.shared >= RIGHT) & seen[None]).any(1)]

    def views(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Smaller and larger share ``(M,)`` of the view that the frames of two times have in common.

        Args:
            pairs: ``(M, 2)`` seconds.
        """
        stamps = self.sequence.groundtruth.timestamps
        frames, places = np.unique(np.abs(stamps - pairs.reshape(-1, 1)).argmin(1), return_inverse=True)
        first, second = places.reshape(-1, 2).T
        wanted = np.zeros((len(frames), len(frames)), bool)
        wanted[first, second] = True
        there, back = (shares[first, second] for shares in self._shares(frames, wanted))
        return np.minimum(there, back), np.maximum(there, back)

    def _shares(self, frames: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        depth, intrinsics = depth_maps(self.sequence, frames)
        return both_shares(depth, intrinsics, self.sequence.groundtruth.poses_wc[frames], pairs)


@lru_cache(maxsize=8)
def revisits_of(recording: Recording) -> Revisits | None:
    """Truth about the views of a sequence; None of a recording.

    Args:
        recording: of a suite.
    """
    if recording.rendered is None:
        return None
    others = ("version", "depth", "baseline")  # of the images beside those of the camera
    options = {key: value for key, value in recording.rendered if key not in others}
    return Revisits(make_sequence(**options))


def told_loops(info: Mapping[str, Any]) -> list[dict[str, Any]] | None:
    """Loops that a system tells of; None if it tells nothing, or something else under that name.

    Args:
        info: of its result.
    """
    loops = info.get("loops")
    if not isinstance(loops, list):
        return None
    known = [loop for loop in loops if isinstance(loop, dict) and all(_is_time(loop.get(k)) for k in ("from", "to"))]
    return known if len(known) == len(loops) else None


def _is_time(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def loop_errors(
    info: Mapping[str, Any], recording: Recording, stamps: Sequence[float], unseen: Sequence[float] = ()
) -> LoopErrors:
    """Judge the loops of a run.

    Args:
        info: of its result.
        recording: that it ran on.
        stamps: of the frames that were fed, seconds.
        unseen: of those without a view.
    """
    loops = told_loops(info)
    count = math.nan if loops is None else float(len(loops))
    if recording.rendered is None or not len(stamps):
        return LoopErrors(count)
    if not loops and stamps[-1] - stamps[0] < OLDER:  # spares the scene
        return LoopErrors(count, *((math.nan, math.nan) if loops is None else (0.0, 0.0)), revisit_s=0.0)
    truth = revisits_of(recording)
    assert truth is not None
    times = truth.revisited(np.asarray(unseen, float))
    times = times[(times >= stamps[0] - SAME_TIME) & (times <= stamps[-1] + SAME_TIME)]
    if loops is None:
        return LoopErrors(revisit_s=float(len(times)))
    pairs = np.array([[loop["from"], loop["to"]] for loop in loops]).reshape(-1, 2)
    smaller, larger = truth.views(pairs) if len(pairs) else (np.zeros(0), np.zeros(0))
    false = larger <= 0
    score = np.array([float(loop.get("inliers", 0.0)) for loop in loops])
    counts = score > score[false].max() if false.any() else np.ones(len(loops), bool)
    found = (np.abs(times[:, None] - pairs[counts, 0][None]) <= NEAR + SAME_TIME).any(1)
    recall = float(found.mean()) if len(times) else math.nan
    return LoopErrors(count, float((smaller >= RIGHT).sum()), float(false.sum()), float(len(times)), recall)
