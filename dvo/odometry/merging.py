"""Merging of two map files: the second is searched in the first as if it were a recording that is tracked in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.map.merging import append_graph
from dvo.models.weights import LoadedWeights, tensor_digest
from dvo.odometry.global_ba.rolling_shutter import Shutter
from dvo.odometry.load_map import load_map
from dvo.odometry.patch.new_recording import begin_in_map, images_size

if TYPE_CHECKING:
    from dvo.odometry.patch.tracker import PatchOdometry


@checked_arguments
def merge_maps(
    first: str | Path,
    second: str | Path,
    *,
    device: torch.device | str = "cpu",
    weights: str | Path | LoadedWeights | None = None,
) -> PatchOdometry:
    """Tracker with the content of two maps, of which ``finish`` searches the second in the first.

    The first map stays as it is. What of the second one is recognised gets its world and scale; ``info["localised"]``
    of the result is None if nothing is.

    Args:
        first: file of a map.
        second: file of a map with a single recording.
        device: of all computation.
        weights: of the network of both maps, see :func:`dvo.load_map`.

    Returns:
        The tracker, to finish and to save. Its result is that of the second map.

    Raises:
        DvoError: an invalid map, or maps of different networks, numbers of patches or sizes of images.

    Example:
        >>> odometry = merge_maps("monday.dvo", "tuesday.dvo")
        >>> if odometry.finish().info["localised"] is not None:
        ...     odometry.save("office.dvo")
    """
    merged = load_map(first, device=device, weights=weights)
    other = load_map(second, device=device, weights=weights)
    _check(Path(second), merged, other)
    state, found, loops, finder = merged.state, other.state, merged.loops, other.loops.finder
    assert found.map is not None
    begin_in_map(merged.graph, loops.finder, state)
    keyframe, segment = append_graph(merged.graph, other.graph)
    state.keyframes += found.keyframes
    state.adjustable += [number + segment for number in found.adjustable]
    state.info, state.shutter = found.map.info, Shutter(found.map.readout, found.map.rows)
    for loop in other.loops.loops:
        loops.loops.append(replace(loop, old=loop.old + keyframe, new=loop.new + keyframe))
    for identifier in finder.places.identifiers.tolist():
        row = finder.places.descriptor(identifier)
        if row is not None:
            loops.finder.describe(identifier + keyframe, row)
    return merged


def _check(file: Path, merged: PatchOdometry, other: PatchOdometry) -> None:
    """Refuse maps that cannot be compared."""
    if tensor_digest(merged.model) != tensor_digest(other.model):
        raise DvoError("was made with other weights than the first map", file=file, remedy="merge maps of one network")
    if len(other.graph.recordings) > 1:
        problem = f"holds {len(other.graph.recordings)} recordings, and only one can be added to a map"
        raise DvoError(problem, file=file, remedy="give it as the first map")
    if merged.config.patches != other.config.patches:
        problem = f"has {other.config.patches} patches a frame, the first map {merged.config.patches}"
        raise DvoError(problem, file=file, remedy="merge maps made with the same patches")
    sizes = images_size(merged.graph), images_size(other.graph)
    if sizes[0] != sizes[1]:
        one, two = ("no size" if size is None else "x".join(map(str, size)) for size in sizes)
        problem = f"holds working images of {two}, the first map of {one}"
        raise DvoError(problem, file=file, remedy="merge maps whose working images have one size")
