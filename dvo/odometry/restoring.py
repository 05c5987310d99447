"""State of a tracker from a map file: its plain values, and what is computed from them and from the graph."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch

from dvo.data.image_header import MAX_PIXELS
from dvo.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.graph.map_file import MapReader
from dvo.graph.measured_arrays import STEEPEST
from dvo.odometry.config import TrackerConfig
from dvo.odometry.frame_sequence import RECENT
from dvo.odometry.front_end import View, encode_image, observe
from dvo.odometry.new_recording import require_size
from dvo.odometry.protocol import Estimate, Status
from dvo.odometry.rolling_shutter import Shutter
from dvo.odometry.uncertainty import newest_uncertainty
from dvo.odometry.window_alignment import WindowAlignment
from dvo.odometry.working_image import working_size
from dvo.settings import LARGEST_SEED

if TYPE_CHECKING:
    from dvo.odometry.tracker import PatchOdometry

_WHOLE = (0, 2**31 - 1)
_SECONDS = (-1e12, 1e12)


@dataclass(frozen=True)
class WeightsTable:
    """Network of a map.

    Attributes:
        name: of shipped weights, or a file; empty for a network that was neither.
        digest: see :func:`dvo.models.weights.tensor_digest`.
    """

    name: str
    digest: str


@dataclass(frozen=True)
class EstimateTable:
    """Last :class:`dvo.odometry.protocol.Estimate`, without its time, which is that of the last frame."""

    pose_wc: tuple[float, float, float, float, float, float, float] | None
    status: Literal["initialising", "tracking", "lost"]
    confidence: float
    segment: int
    reason: str

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {"confidence": (0, 1), "segment": _WHOLE}


@dataclass(frozen=True)
class TrackerTable:
    """Plain values of a tracker in a map file.

    Attributes:
        name, seed, config: of the tracker.
        keyframes, tracked, initialised, finished, adjustable, joining, skipped, info: of
            :class:`dvo.odometry.tracker_state.TrackerState`.
        readout, rows: of its shutter.
        size: width and height of the frames, None before the first.
        intervals: recent times between frames, seconds.
        new: time of the first frame with the last image, seconds.
        last: last estimate.
        waiting: for each waiting view, the positions of its frames in the log.
        ambiguous: of the state; not in files of earlier versions.
    """

    name: str
    seed: int
    config: TrackerConfig
    keyframes: int
    tracked: int
    initialised: bool
    finished: bool
    adjustable: tuple[int, ...]
    joining: str
    skipped: bool
    info: dict[str, Any]
    readout: float
    rows: float
    size: tuple[int, int] | None
    intervals: tuple[float, ...]
    new: float
    last: EstimateTable | None
    waiting: tuple[tuple[int, ...], ...]
    ambiguous: bool = False

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "seed": (0, LARGEST_SEED),
        "keyframes": _WHOLE,
        "tracked": (0, 2**53),
        "readout": (0, 1),
        "rows": (1e-3, 1e6),
        "new": _SECONDS,
    }


def restore_tracker(source: MapReader, odometry: PatchOdometry, table: TrackerTable) -> None:
    """Restore state and caches of a tracker.

    Args:
        source: the file.
        odometry: newly built; its graph has been read.
        table: plain values of the tracker.

    Raises:
        DvoError: a missing or invalid value or array.
    """
    state, log = odometry.state, odometry.graph.log
    source.require(len(table.intervals) <= RECENT, f"more than {RECENT} numbers", "tracker: intervals")
    source.require(all(0 < time < 1e12 for time in table.intervals), "no times between frames", "tracker: intervals")
    highest = max([frame.identifier for frame in (*odometry.graph.archive, *odometry.window.frames)], default=-1)
    source.require(table.keyframes > highest, "fewer keyframes than there are", "tracker: keyframes")
    source.require(not table.finished or not len(odometry.window), "finished, with a window", "tracker: finished")
    source.require(not table.initialised or len(odometry.window) > 1, "initialised without a window", "tracker")
    state.keyframes, state.tracked, state.initialised = table.keyframes, table.tracked, table.initialised
    state.ambiguous = table.ambiguous
    state.finished, state.adjustable = table.finished, list(table.adjustable)
    state.joining, state.skipped, state.info = table.joining, table.skipped, table.info
    state.shutter = Shutter(table.readout, table.rows)
    if len(log.frames) > odometry.graph.recording.frame:
        last = log.frames[-1].timestamp
        source.require(table.new <= last, "a time after the last frame", "tracker: new")
        state.sequence.restore(table.size, table.intervals, last, table.new)
    else:
        require_size(odometry)
    try:
        state.generator.set_state(torch.from_numpy(source.array("tracker/generator", np.uint8, (None,))))
    except (RuntimeError, TypeError) as error:
        raise source.refused("not the state of a generator of random numbers", "tracker/generator") from error
    size = _working_size(source, odometry, table)
    image = source.array("tracker/last_image", np.uint8, (None, None, 3))
    source.require((table.last is None) == (image.size == 0), "an estimate without image, or not", "tracker: last")
    if table.last is not None:
        source.require(log.frames and image.shape[:2] == size, "not of the working size", "tracker/last_image")
        pose = None if table.last.pose_wc is None else np.array(table.last.pose_wc, np.float64)
        e = table.last
        estimate = Estimate(log.frames[-1].timestamp, pose, Status(e.status), e.confidence, e.segment, e.reason)
        state.last = image, estimate
    state.world = odometry.graph.world_of(odometry.graph.segment)  # before a first pose this makes no difference
    _restore_window(source, odometry, size)
    if state.last is not None and state.last[1].pose_wc is not None and len(odometry.window):
        image, estimate = state.last
        again = newest_uncertainty(odometry.step, odometry.config, state.ambiguous)
        state.last = image, replace(estimate, covariance=again.covariance, reference=again.reference)
    _restore_waiting(source, odometry, table, size)


def _working_size(source: MapReader, odometry: PatchOdometry, table: TrackerTable) -> tuple[int, int]:
    """Height and width of the working images of the sequence; 0 before its first frame."""
    if table.size is None:
        begun = len(odometry.graph.log.frames) > odometry.graph.recording.frame
        source.require(not begun, "no size, but frames", "tracker: size")
        return 0, 0
    width, height = table.size
    fits = width > 0 and height > 0 and width * height <= MAX_PIXELS
    source.require(fits, "not the size of an image", "tracker: size")
    width, height = working_size(width, height, odometry.config.pixels)
    return height, width


def _restore_window(source: MapReader, odometry: PatchOdometry, size: tuple[int, int]) -> None:
    """Feature maps, correlations and alignments of the window."""
    window, c = odometry.window, odometry.model.config
    for frame in window.frames:
        shapes = frame.matching.shape[1], frame.context.shape[1], 0 if frame.fine is None else frame.fine.shape[1]
        wanted = c.feature_channels, c.hidden_channels, c.fine_channels
        source.require(shapes == wanted, "not the features of the network", "window/matching")
        fits = frame.image is not None and frame.image.shape[:2] == size
        source.require(fits, "not of the working size, or missing", "window/images")
        side = None if frame.visible is None else tuple(c.STRIDE * length for length in frame.visible.shape)
        source.require(side in (None, size), "not of the size of the feature maps", "window/visible")
    if not len(window):
        source.array("tracker/origins", np.int64, (None, 0, 2))
        return
    height, width = (side // c.STRIDE for side in size)
    margin = c.patch_size // 2
    _require_inside(source, window.patches[:, :2, margin, margin], (width, height), "window/patches")
    reach = (window.patches[:, :2] - window.patches[:, :2, margin, margin][..., None, None]).abs()
    source.require(bool((reach <= c.patch_size).all()), "holds patches of another size", "window/patches")
    most = max(odometry.config.removal + odometry.config.lifetime, odometry.config.initial_frames + 4)
    source.require(max(frame.map_slot for frame in window.frames) <= most, "a slot too far", "window/map_slots")
    for frame in window.frames:
        assert frame.image is not None
        features = encode_image(odometry.model, frame.image, odometry.device)
        odometry.step.keep_frame(frame.map_slot, frame.image, features.matching, features.fine)
        odometry.loops.see(frame.identifier, frame.image, features.matching)
    levels = len(c.pyramid) + bool(c.fine_channels)
    found = source.array("tracker/origins", np.int64, (levels, len(window.kk), 2))
    origins = torch.from_numpy(found).to(odometry.device)
    source.require(odometry.correlation.are_origins(origins), "holds positions outside of the maps", "tracker/origins")
    odometry.correlation.restore(origins)
    if odometry.step.align is not None:
        _restore_alignment(source, odometry, odometry.step.align, size)


def _restore_alignment(
    source: MapReader, odometry: PatchOdometry, align: WindowAlignment, size: tuple[int, int]
) -> None:
    count, device = len(odometry.window.kk), odometry.device
    images = source.array("alignment/images", np.uint8, (None, *size))
    last = max(frame.map_slot for frame in odometry.window.frames)
    source.require(last < len(images), "fewer images than slots", "alignment/images")
    align.restore_images(images)
    if odometry.config.align != "always":
        return
    known = source.array("alignment/known", np.uint8, (count,), 0, 1) > 0
    measured = source.array("alignment/measured", np.float32, (count, 2))
    measured[~known] = np.inf
    parts = (
        measured,
        source.array("alignment/aligned", np.float32, (count, 2)),
        source.array("alignment/accepted", np.uint8, (count,), 0, 1) > 0,
    )
    align.restore(*(torch.from_numpy(part).to(device) for part in parts))


def _restore_waiting(source: MapReader, odometry: PatchOdometry, table: TrackerTable, size: tuple[int, int]) -> None:
    """Views that wait to be joined, observed again."""
    if not table.waiting:
        return
    records, n = odometry.graph.log.frames, len(table.waiting)
    source.require(table.initialised, "frames that wait, but no window", "tracker: waiting")
    numbers = [number for view in table.waiting for number in view]
    fits = all(table.waiting) and len(set(numbers)) == len(numbers) and numbers == sorted(numbers)
    source.require(fits, "not a list of frames", "tracker: waiting")
    source.require(numbers[0] >= 0 and numbers[-1] < len(records), "frames that are not there", "tracker: waiting")
    # Each has had an identifier, and may take it again (:mod:`dvo.odometry.late_join`).
    room = table.keyframes - odometry.window.frames[-1].identifier > n
    source.require(room, "more views than identifiers of keyframes", "tracker: waiting")
    images = source.array("waiting/images", np.uint8, (n, *size, 3))
    intrinsics = source.array("waiting/intrinsics", np.float64, (n, 4), -1e6, 1e6)
    centres = source.array("waiting/centres", np.int64, (n, odometry.config.patches, 2), 0, 2**20)
    c = odometry.model.config
    _require_inside(source, torch.from_numpy(centres), (size[1] // c.STRIDE, size[0] // c.STRIDE), "waiting/centres")
    visible = None
    if source.has("waiting/visible"):  # of frames with masks
        shape = n, size[0] // c.STRIDE, size[1] // c.STRIDE
        visible = torch.from_numpy(source.array("waiting/visible", np.uint8, shape, 0, 1) > 0).to(odometry.device)
    measured = slopes = None
    if odometry.config.scale.measures:
        shape = n, odometry.config.patches, 2
        measured = torch.from_numpy(source.array("waiting/measured", np.float32, shape, 0, 1e12)).to(odometry.device)
        slopes = torch.zeros_like(measured)
        if source.has("waiting/slopes"):  # not in older files
            values = source.array("waiting/slopes", np.float32, shape, -STEEPEST, STEEPEST)
            slopes = torch.from_numpy(values).to(odometry.device)
    for k, view in enumerate(table.waiting):
        try:
            fx, fy, cx, cy = intrinsics[k].tolist()
            camera = Camera(fx, fy, cx, cy, size[1], size[0])
        except DvoError as error:
            raise source.refused(error.message, "waiting/intrinsics") from error
        known = torch.from_numpy(centres[k])[None, None].to(odometry.device)
        seen = observe(odometry.model, images[k], camera, odometry.select, odometry.device, known)
        seen = seen if visible is None else replace(seen, visible=visible[k])
        if measured is not None and slopes is not None:
            seen = replace(seen, measured=measured[k], slopes=slopes[k])
        odometry.state.waiting.append(View([records[number] for number in view], seen))


def _require_inside(source: MapReader, centres: torch.Tensor, size: tuple[int, int], field: str) -> None:
    """Refuse patch centres ``(..., 2)`` nearer than one pixel to the border of a feature map, or outside of it."""
    limit = torch.tensor(size, device=centres.device) - 2
    inside = ((centres >= 1) & (centres <= limit)).all()
    source.require(bool(inside), "holds patches outside of the image", field)
