"""Trackers in the maps of files: ``dvo.load_map``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dvo.core.arguments import checked_arguments
from dvo.core.context import in_own_context
from dvo.core.errors import DvoError
from dvo.core.settings import check_seed
from dvo.core.threads import settle_threads
from dvo.map.io.map_file import MapReader, open_map_file
from dvo.map.io.serialisation import GraphTable, read_graph
from dvo.map.places import LARGEST, PlaceIndex
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import LoadedWeights, load_weights, tensor_digest
from dvo.odometry.frames.gate import RequiredSize
from dvo.odometry.load import source_of
from dvo.odometry.loops.closure import LoopCloser
from dvo.odometry.loops.finder import Loop
from dvo.odometry.patch.config import PRESETS, TrackerConfig, with_changes
from dvo.odometry.patch.map_tables import LoopsTable, LoopTable, MapTable, WeightsTable
from dvo.odometry.patch.new_recording import images_size, take_places
from dvo.odometry.patch.old_maps import OLD_VERSION, OldLoops, OldTracker, close_old_sequence, old_table
from dvo.odometry.patch.tracker import PatchOdometry


@partial(checked_arguments, skip=("seed", "preset"))
@in_own_context
def load_map(
    file: str | Path,
    *,
    device: torch.device | str = "cpu",
    weights: str | Path | LoadedWeights | None = None,
    new_recording: bool = True,
    seed: int | None = None,
    preset: str = "default",
    **overrides: Any,
) -> PatchOdometry:
    """Load a map: for a new recording in it, or to use it.

    Before its first frame the tracker is the map: ``finish`` and ``current`` give the result of its last recording, and
    ``graph`` holds its keyframes. The first frame begins a recording with a clock of its own, by any camera whose
    working images have the size of those of the map; the tracker looks for its place in the map.

    Args:
        file: written by ``odometry.save`` or ``dvo run --save-map``.
        device: of all computation.
        weights: of the network, if they are not found by the name in the file: a name, a file, or a network in memory.
        new_recording: what a map is loaded for; nothing else can be asked for.
        seed: of the patch centres of the recording; None for that of the map.
        preset: settings on top of those of the map, a name in :data:`dvo.odometry.patch.config.PRESETS`.
        overrides: single settings, by the names of :class:`dvo.odometry.patch.config.TrackerConfig`; they win.

    Returns:
        The tracker. The result of a recording holds its poses alone, in the world and the scale of the map if it was
        recognised in it.

    Raises:
        DvoError: no such file; not a map of a tracker, one of a newer version, or an invalid content, with the name of
            the field; weights that are not found, or are others than those that the map was made with; an unknown or
            invalid setting, or one that does not go with the map.

    Example:
        >>> odometry = dvo.load("small")
        >>> for frame in dvo.open("monday.mp4", calib="calib.txt"):
        ...     estimate = odometry.track(frame)
        >>> odometry.save("office.dvo")
        >>> odometry = dvo.load_map("office.dvo")  # in another process, on another day
        >>> result = dvo.run(odometry, dvo.open("tuesday.mp4", calib="calib.txt")).result
        >>> result.info["localised"] is not None, [segment.in_map for segment in result.segments]
        (True, [True])
    """
    if not new_recording:
        remedy = "leave new_recording out; finish() before the first frame gives the result of the map"
        raise DvoError("a sequence is not continued, a map begins a new one", field="new_recording", remedy=remedy)
    settle_threads()
    if seed is not None:
        check_seed(seed)
    with open_map_file(file) as source:
        is_old = source.version <= OLD_VERSION
        if ("tracker" if is_old else "map") not in source.description:
            remedy = "dvo.map.io.serialisation.load_graph reads it"
            raise source.refused("holds a graph without a tracker", "map", remedy)
        if is_old:
            tracker, old_loops = old_table(source, OldTracker, "tracker"), old_table(source, OldLoops, "loops")
            table, loops = tracker.table(), old_loops.loops
        else:
            table, loops = source.table(MapTable, "map"), source.table(LoopsTable, "loops").loops
        graph, network = source.table(GraphTable, "graph"), _network(source, weights, device)
        assert isinstance(network.model, PatchVO)
        sizes = table.config.patches, network.model.config.patch_size, network.model.config.hidden_channels
        same = sizes == (graph.per_frame, graph.patch_size, graph.hidden)
        source.require(same, "sizes that are not those of the network and its settings", "graph")
        odometry = PatchOdometry(
            network.model, _changed(table.config, preset, overrides), seed=table.seed if seed is None else seed,
            device=device, name=table.name, archive=graph.archive, weights=source_of(network),
        )  # fmt: skip
        read_graph(source, odometry.graph, graph)
        _check_features(source, odometry)
        _read_loops(source, odometry.loops, loops)
        if is_old:
            table = close_old_sequence(source, odometry, tracker, old_loops)
        _read_places(source, odometry, table.initialised)
    state, size = odometry.state, images_size(odometry.graph)
    state.keyframes, state.adjustable, state.map = odometry.graph.starts[-1][0], list(table.initialised), table
    highest = max((frame.identifier for frame in odometry.graph.archive), default=-1)
    source.require(state.keyframes > highest, "begins the next segment before the last keyframe", "segments")
    odometry.gate.sequence.required = None if size is None else RequiredSize(size, odometry.config.pixels)
    return odometry


def _network(
    source: MapReader, weights: str | Path | LoadedWeights | None, device: torch.device | str
) -> LoadedWeights:
    """Network with the digest of the file."""
    table = source.table(WeightsTable, "weights")
    remedy = "give the file of the weights that the map was made with: weights=FILE"
    if weights is None and not table.name:
        raise source.refused("was made with a network that has no name", "weights", remedy)
    try:
        found = weights if isinstance(weights, LoadedWeights) else load_weights(weights or table.name, device)
    except DvoError as error:
        if weights is not None:
            raise
        raise source.refused(f"its weights are not found ({error})", "weights", remedy) from error
    if not isinstance(found.model, PatchVO) or tensor_digest(found.model) != table.digest:
        raise source.refused(f"'{found.name}' are other weights than those it was made with", "weights", remedy)
    return found


def _check_features(source: MapReader, odometry: PatchOdometry) -> None:
    """Refuse features that are not of the size of those of the network."""
    c, archive = odometry.model.config, odometry.graph.archive
    matching = {frame.matching.shape[1] for frame in archive if frame.matching is not None}
    context = {frame.context.shape[1] for frame in archive if frame.context is not None}
    source.require(matching <= {c.feature_channels}, "not the features of the network", "archive/matching")
    source.require(context <= {c.hidden_channels}, "not the features of the network", "archive/context")


def _changed(config: TrackerConfig, preset: str, overrides: dict[str, Any]) -> TrackerConfig:
    """Settings of a recording in a map; those under which nothing could be recognised are refused."""
    found = with_changes(config, preset, PRESETS, {"loops": True, **overrides})
    if found.patches != config.patches:
        remedy = f"leave out patches, or give {config.patches}"
        raise DvoError(f"is {found.patches}, the map has {config.patches}", field="patches", remedy=remedy)
    if not found.loops:
        problem = "a map is recognised by loops, but loops are turned off"
        raise DvoError(problem, field="loops", remedy="turn them on (loops=True)")
    return found


def _read_loops(source: MapReader, closer: LoopCloser, loops: tuple[LoopTable, ...]) -> None:
    """Confirmed loops of a map whose graph has been read."""
    graph, archive = closer.graph, closer.graph.archive
    for row, loop in zip(source.similarities("loops/measurements", None), loops, strict=False):
        ends = loop.old, loop.new
        known = all(k in archive and archive[k].anchor is None and graph.segment_of(k) >= 0 for k in ends)
        source.require(known and loop.old < loop.new, "between keyframes that are not there", "loops: loops")
        times = archive[loop.old].timestamp, archive[loop.new].timestamp
        measured = torch.from_numpy(row.copy())
        closer.loops.append(Loop(*ends, *times, loop.kind, loop.inliers, measured, loop.count, None, loop.joins))
    source.require(len(closer.loops) == len(loops), "fewer than there are loops", "loops/measurements")


def _read_places(source: MapReader, odometry: PatchOdometry, segments: tuple[int, ...]) -> None:
    """Keyframes that can be recognised, with their descriptors."""
    finder = odometry.loops.finder
    dimensions = finder.places.dimensions
    arrays = {
        "identifiers": source.array("places/identifiers", np.int64, (None,), 0, 2**31 - 1),
        "descriptors": source.array("places/descriptors", np.float16, (None, dimensions), -LARGEST, LARGEST),
        "capacity": np.array(finder.places.capacity, np.int64),
    }
    try:
        finder.places = PlaceIndex.from_arrays(arrays)
    except DvoError as error:
        raise source.refused(error.message, "places/descriptors") from error
    with torch.inference_mode():
        take_places(finder, odometry.network, segments, odometry.device)
    known = np.isin(finder.places.identifiers, finder.kept).all()
    source.require(known, "keyframes that are not there", "places/identifiers")
