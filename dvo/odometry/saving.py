"""Trackers in files: ``odometry.save`` and ``dvo.load_map``.

A map file holds the graph (:mod:`dvo.graph.serialisation`), the settings and the state of the tracker
(:class:`dvo.odometry.tracker_state.TrackerState`), and which network it used: by name and by a digest of its tensors,
not the network itself. What can be computed again bit for bit is left out: feature maps of the window from its images,
and correlations from the maps and the positions of the cached windows (an interpolated value depends on these in its
last bit, so that they are written).

A sequence that is saved between two frames, loaded and continued has the results of one that is not interrupted, bit
for bit on the CPU with the same number of threads. A finished sequence can be saved too; it takes no further frames.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dvo.errors import DvoError
from dvo.graph.map_file import MapReader, open_map_file, write_map_file
from dvo.graph.serialisation import GraphTable, graph_arrays, read_graph
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import LoadedWeights, load_weights, tensor_digest
from dvo.odometry.front_end import View
from dvo.odometry.load import source_of
from dvo.odometry.loop_saving import loops_arrays, loops_table, restore_loops
from dvo.odometry.new_recording import new_recording as begin_new
from dvo.odometry.restoring import EstimateTable, TrackerTable, WeightsTable, restore_tracker
from dvo.threads import settle_threads

if TYPE_CHECKING:
    from dvo.odometry.tracker import PatchOdometry


def save_map(file: str | Path, odometry: PatchOdometry) -> None:
    """Write a tracker with its graph to a map file, between two frames or after the last one.

    The result of a search for loops or a correction in progress is waited for, also in real time
    (:attr:`dvo.odometry.config.TrackerConfig.real_time`); it takes effect at its frame, after this.

    Args:
        file: to write; replaced as a whole.
        odometry: the tracker, which is not changed.

    Raises:
        DvoError: the file cannot be written.
    """
    graph, arrays = graph_arrays(odometry.graph)
    description = {
        "weights": asdict(WeightsTable(odometry.weights, tensor_digest(odometry.model))),
        "tracker": asdict(_tracker_table(odometry)),
        "graph": graph,
        "loops": loops_table(odometry.loops),
    }
    write_map_file(file, description, arrays | _tracker_arrays(odometry) | loops_arrays(odometry.loops))


def load_map(
    file: str | Path,
    *,
    device: torch.device | str = "cpu",
    weights: str | Path | LoadedWeights | None = None,
    new_recording: bool = False,
    seed: int | None = None,
    **overrides: Any,
) -> PatchOdometry:
    """Load a tracker from a map file: to go on with its sequence, to use its map, or for a new recording in the map.

    Args:
        file: written by ``odometry.save`` or ``dvo run --save-map``.
        device: of all computation.
        weights: of the network, if they are not found by the name in the file: a name, a file, or a network in memory.
        new_recording: begin another recording in the map (:mod:`dvo.odometry.new_recording`): of any time, with any
            camera whose working images have the size of those of the map. A sequence that is not finished is finished.
        seed: of the patch centres of the new recording; None for that of the map.
        overrides: single settings of the new recording, and ``preset``, as of :func:`dvo.load`; others are those of the
            map.

    Returns:
        The tracker as it was saved. A finished one takes no frames; ``finish`` gives its result again, and ``graph`` is
        its map. Of a new recording, a tracker before its first frame; its result holds the poses of the new recording
        alone, in the world and the scale of the map from the first of them on if it was recognised in it.

    Raises:
        DvoError: no such file; not a map of a tracker, one of a newer version, or an invalid content, with the name of
            the field; weights that are not found, or are others than those that the map was made with.

    Example:
        >>> odometry = dvo.load("small")
        >>> for frame in first_half:
        ...     odometry.track(frame)
        >>> odometry.save("office.dvo")
        >>> odometry = dvo.load_map("office.dvo")  # in another process, on another day
        >>> for frame in second_half:
        ...     odometry.track(frame)
        >>> result = odometry.finish()

        Another recording of the same place:

        >>> odometry = dvo.load_map("office.dvo", new_recording=True)
        >>> result = dvo.run(odometry, dvo.open("video2.mp4", calib="calib.txt")).result
        >>> result.info["localised"] is not None, [segment.in_map for segment in result.segments]
        (True, [True])
    """
    if not new_recording and (seed is not None or overrides):
        name = next(iter(overrides), "seed")
        remedy = "leave it out, or give new_recording=True"
        raise DvoError("a sequence goes on with the settings that it began with", field=name, remedy=remedy)
    settle_threads()
    with open_map_file(file) as source:
        if "tracker" not in source.description:
            remedy = "dvo.graph.serialisation.load_graph reads it"
            raise source.refused("holds a graph without a tracker", "tracker", remedy)
        table, graph = source.table(TrackerTable, "tracker"), source.table(GraphTable, "graph")
        network = _network(source, source.table(WeightsTable, "weights"), weights, device)
        odometry = _empty(source, table, graph, network, device)
        read_graph(source, odometry.graph, graph)
        with torch.inference_mode():
            restore_tracker(source, odometry, table)
            restore_loops(source, odometry.loops, odometry.state.adjustable)
    return begin_new(odometry, seed=seed, **overrides) if new_recording else odometry


def _tracker_table(odometry: PatchOdometry) -> TrackerTable:
    state, estimate = odometry.state, None
    if state.last is not None:
        last = state.last[1]
        pose = None if last.pose_wc is None else tuple(last.pose_wc.tolist())
        confidence = last.confidence if math.isfinite(last.confidence) else 0.0
        estimate = EstimateTable(pose, last.status.value, confidence, last.segment, last.reason)
    number = {id(record): index for index, record in enumerate(odometry.graph.log.frames)}
    return TrackerTable(
        odometry.name, odometry.seed, odometry.config, state.keyframes, state.tracked, state.initialised,
        state.finished, tuple(state.adjustable), state.joining, state.skipped, state.info, state.shutter.readout,
        state.shutter.rows, state.sequence.size, tuple(state.sequence.intervals), state.sequence.new, estimate,
        tuple(tuple(number[id(record)] for record in view.records) for view in _views(odometry)), state.ambiguous,
    )  # fmt: skip


def _views(odometry: PatchOdometry) -> list[View]:
    """Waiting views; none of a finished sequence, which does not take them up any more."""
    return [] if odometry.state.finished else odometry.state.waiting


def _tracker_arrays(odometry: PatchOdometry) -> dict[str, np.ndarray]:
    state, views = odometry.state, [view.seen for view in _views(odometry)]
    last = np.zeros((0, 0, 3), np.uint8) if state.last is None else state.last[0]
    arrays = {
        "tracker/generator": state.generator.get_state().numpy(),
        "tracker/last_image": last,
        "tracker/origins": odometry.correlation.origins().cpu().numpy(),
    }
    if views:
        arrays["waiting/images"] = np.stack([seen.image for seen in views])
        arrays["waiting/intrinsics"] = np.stack([seen.image_intrinsics for seen in views]).astype(np.float64)
        if odometry.config.scale.measures:
            arrays["waiting/measured"] = np.stack([np.asarray(seen.measured, np.float32) for seen in views])
            arrays["waiting/slopes"] = np.stack([np.asarray(seen.slopes, np.float32) for seen in views])
        arrays["waiting/centres"] = np.stack([seen.centres[0, 0].cpu().numpy() for seen in views])
        if any(seen.visible is not None for seen in views):
            every = torch.ones(views[0].maps.shape[-2:], dtype=torch.bool)
            kept = [every if seen.visible is None else seen.visible.cpu() for seen in views]
            arrays["waiting/visible"] = torch.stack(kept).numpy().astype(np.uint8)
    align = odometry.step.align
    if align is not None and len(odometry.window):
        arrays["alignment/images"] = align.images
    if align is not None and odometry.config.align == "always":
        measured, aligned, accepted = (part.cpu().numpy() for part in align.results())
        known = np.isfinite(measured).all(1)
        arrays["alignment/known"] = known.astype(np.uint8)
        arrays["alignment/measured"] = np.where(known[:, None], measured, 0).astype(np.float32)
        arrays["alignment/aligned"] = aligned
        arrays["alignment/accepted"] = accepted.astype(np.uint8)
    return arrays


def _network(
    source: MapReader, table: WeightsTable, weights: str | Path | LoadedWeights | None, device: torch.device | str
) -> LoadedWeights:
    """Network with the digest of the file."""
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


def _empty(
    source: MapReader, table: TrackerTable, graph: GraphTable, network: LoadedWeights, device: torch.device | str
) -> PatchOdometry:
    """New tracker of the sizes and settings in the file."""
    from dvo.odometry.tracker import PatchOdometry

    assert isinstance(network.model, PatchVO)
    sizes = (table.config.patches, network.model.config.patch_size, network.model.config.hidden_channels)
    same = sizes == (graph.per_frame, graph.patch_size, graph.hidden)
    source.require(same, "sizes that are not those of the network and its settings", "graph")
    options: dict[str, Any] = {"seed": table.seed, "device": device, "name": table.name, "archive": graph.archive}
    try:
        return PatchOdometry(network.model, table.config, weights=source_of(network), **options)
    except DvoError as error:
        raise source.refused(error.message, f"tracker: {error.field}") from error
