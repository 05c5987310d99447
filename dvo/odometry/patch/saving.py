"""Maps in files: what ``odometry.save`` writes, and :mod:`dvo.odometry.load_map` reads.

A map file holds the graph (:mod:`dvo.map.io.serialisation`), the loops and the descriptors of places, the settings and
the metadata of the result, and which network made it: by name and by a digest of its tensors, not the network itself.
A sequence in progress is written as a map of what it has so far: in the file its segment is closed, with the poses of
the moment. The tracker goes on as if it had not been saved.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from dvo.map.io.map_file import write_map_file
from dvo.map.io.serialisation import graph_arrays
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.places import PlaceIndex
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import tensor_digest
from dvo.odometry.frames.gate import Gate
from dvo.odometry.loops.closure import LoopCloser
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.finishing import run_information
from dvo.odometry.patch.inertial import InertialTracking
from dvo.odometry.patch.initialisation import NOT_INITIALISED
from dvo.odometry.patch.map_tables import LoopsTable, LoopTable, MapTable, WeightsTable
from dvo.odometry.patch.state import TrackerState
from dvo.odometry.scale.metric_scale import settle_scale
from dvo.odometry.window.patch_window import PatchWindow


class SavedTracker(Protocol):
    """What is read of a tracker, see :class:`dvo.odometry.patch.tracker.PatchOdometry`."""

    name: str
    seed: int
    weights: str
    config: TrackerConfig
    model: PatchVO
    graph: KeyframeGraph
    gate: Gate
    state: TrackerState
    patch_window: PatchWindow
    loops: LoopCloser
    inertial: InertialTracking


def save_map(file: str | Path, odometry: SavedTracker) -> None:
    """Write the map of a tracker, between two frames or after the last one.

    Args:
        file: to write; replaced as a whole.
        odometry: the tracker, which is not changed.

    Raises:
        DvoError: the file cannot be written.
    """
    state, graph, loops, info = odometry.state, odometry.graph, odometry.loops, None
    if not odometry.gate.finished and state.map is None:
        graph, loops, info = _closed(odometry)
    found = run_information(graph, state, odometry.config, loops, odometry.seed) | (info or {})
    # Images that were read at once, with the gyroscope, are as those of a global shutter to a program without one.
    readout = 0.0 if odometry.inertial.readout > 0 else state.shutter.readout
    table = state.map or MapTable(
        odometry.name, odometry.seed, odometry.config, tuple(state.adjustable), readout,
        state.shutter.rows, {name: value for name, value in found.items() if name not in ("seed", "config")},
    )  # fmt: skip
    graph_table, arrays = graph_arrays(graph)
    description = {
        "weights": asdict(WeightsTable(odometry.weights, tensor_digest(odometry.model))),
        "map": asdict(table),
        "graph": graph_table,
        "loops": asdict(LoopsTable(tuple(map(LoopTable.of, loops.loops)))),
    }
    measured = [loop.measurement.numpy() for loop in loops.loops]
    arrays["loops/measurements"] = np.array(measured, np.float64).reshape(-1, 8)
    arrays |= {f"places/{name}": values for name, values in loops.finder.places.to_arrays().items()}
    write_map_file(file, description, arrays)


def _closed(odometry: SavedTracker) -> tuple[KeyframeGraph, LoopCloser, dict[str, Any]]:
    """Copies of graph and loops with the segment closed, and the scale for run.json."""
    state, config, graph = odometry.state, odometry.config, closed_graph(odometry)
    finder = odometry.loops.finder
    places = PlaceIndex.from_arrays(finder.places.to_arrays())
    finder = replace(finder, graph=graph, kept=list(finder.kept), places=places)
    loops = replace(odometry.loops, graph=graph, finder=finder, loops=list(odometry.loops.loops))
    with torch.inference_mode():
        for frame in graph.archive.kept_after(finder.kept[-1] if finder.kept else -1):
            if graph.segment_of(frame.identifier) in state.adjustable:
                finder.keep(frame.identifier)
        return graph, loops, settle_scale(graph, state.adjustable, config.scale, loops)


@torch.inference_mode()
def closed_graph(odometry: SavedTracker) -> KeyframeGraph:
    """Copy of the graph of a tracker with everything archived, at the poses of the moment; tracking may go on.

    Args:
        odometry: between two frames of a sequence.
    """
    state, graph = odometry.state, odometry.graph.copy()
    graph.finalise = odometry.patch_window.of_copy(graph.window, state.initialised).finalise
    graph.begin_segment(state.keyframes, state.initialised, NOT_INITIALISED)
    return graph
