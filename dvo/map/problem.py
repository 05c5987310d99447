"""Bundle adjustment problem of archived keyframes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from dvo.ba.patch_problem import PatchProblem
from dvo.map.archive import Archive, ArchivedKeyframe
from dvo.map.measurements import depth_factors


def archive_problem(
    archive: Archive, members: Sequence[ArchivedKeyframe], poses_cw: Callable[[np.ndarray], Tensor], per_frame: int,
    dropped: bool = True, first: int = 0, last: int | None = None,
) -> PatchProblem:  # fmt: skip
    """Bundle adjustment problem of keyframes and the edges between them.

    Args:
        archive: of the edges.
        members: the keyframes, by increasing identifier.
        poses_cw: poses of identifiers.
        per_frame: patches of a keyframe.
        dropped, first, last: see :meth:`dvo.map.map.Map.problem`.
    """
    edges = archive.edges(first, last)
    linked = set(np.unique(np.concatenate([edges.source, edges.target])).tolist()) if first > 0 else set()
    frames = [
        frame
        for frame in members
        if (frame.identifier >= first or frame.identifier in linked)
        and (last is None or frame.identifier <= last)
        and (dropped or frame.anchor is None)
    ]
    identifiers = np.array([frame.identifier for frame in frames], dtype=np.int64)
    edges = edges.select(np.isin(edges.source, identifiers) & np.isin(edges.target, identifiers))
    ii, jj = np.searchsorted(identifiers, edges.source), np.searchsorted(identifiers, edges.target)
    patches = [np.column_stack([frame.centres, frame.inverse_depth]) for frame in frames]
    return PatchProblem(
        poses_cw=poses_cw(identifiers),
        patches=torch.from_numpy(np.array(patches, dtype=np.float64)).reshape(len(frames) * per_frame, 3, 1, 1),
        intrinsics=torch.from_numpy(np.array([f.intrinsics for f in frames], dtype=np.float64).reshape(-1, 4)),
        targets=torch.from_numpy(edges.position.astype(np.float64)),
        weights=torch.from_numpy(edges.weight.astype(np.float64)),
        ii=torch.from_numpy(ii),
        jj=torch.from_numpy(jj),
        kk=torch.from_numpy(ii * per_frame + edges.patch),
        factors=depth_factors(_measured(frames, per_frame)),
        identifiers=torch.from_numpy(identifiers),
    )


def _measured(frames: list[ArchivedKeyframe], per_frame: int) -> Tensor | None:
    """Measured inverse depths of all patches with their weights; None if there are none."""
    if all(frame.measured is None for frame in frames):
        return None
    none = np.zeros((per_frame, 2))
    return torch.from_numpy(np.concatenate([none if f.measured is None else f.measured for f in frames])).double()
