"""Depth images for any source: those of a folder, or of a list with times."""

from __future__ import annotations

from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration
from dvo.data.calibration.read import read_calibration
from dvo.data.companions.bag_topics import CompanionTopic, depth_camera, topic_of
from dvo.data.companions.companions import CompanionFiles, CompanionKind, files_of_frames, of_positions
from dvo.data.opening import locate
from dvo.data.readers.ros_images import decode_depth
from dvo.data.readers.rosbag import BagRecording
from dvo.data.readers.tum import DEPTH_SCALE
from dvo.data.recording import ImageRecording
from dvo.data.sensors.depth import read_depth
from dvo.data.sensors.sensors import MILLIMETRES
from dvo.data.source import Source

_LOOKED_AT = 5  # frames, of which the first with depth tells the range
_FARTHEST, _NEAREST = 100.0, 0.15
"""Metres: a depth image nine tenths of which are farther, or nearer, is in another unit, or that of no usual scene."""
_KIND = CompanionKind("depth images", "--depth", "16-bit PNG files", (".npy", ".npz"))


def with_depth(
    source: Source,
    depth: Path | str | None = None,
    scale: float | None = None,
    calib: Path | str | Calibration | None = None,
) -> Source:
    """Give the frames of a source depth.

    A depth image belongs to the image with the nearest time stamp, up to half a frame interval, if it has one (in a
    list, or as its name) and the images have times that are on the same clock; otherwise to the image whose name holds
    the same numbers; otherwise, where there are as many depth images as images, to that of the same place in the order.
    Depth is registered to the images, or of another size and the same aspect; or ``calib`` says of which camera it is.

    Args:
        source: opened with :func:`dvo.open`; not changed.
        depth: of a bag the topic, None for the only one of depth; folder of 16-bit PNG files (or other files of
        :func:`dvo.data.sensors.depth.read_depth`), or a list of
            ``time file`` rows such as ``depth.txt`` of TUM RGB-D; None for the depth that the data set has itself.
            Relative paths are looked up from the working directory, then from the source's folder.
        scale: units of a metre in integers; None for that of the data set, of a list 5000, of a folder 1000.
        calib: camera of the depth images, without distortion, whose centre and axes are taken for those of the camera;
            None for registered ones.

    Returns:
        A source with the same frames, whose ``depth`` is read when it is first wanted.

    Raises:
        DvoError: nothing there, a source without depth of its own, or depth images that belong to no image.

    Example:
        >>> source = with_depth(dvo.open("video.mp4", calib="calib.txt"), "depth", scale=1000)
        >>> result = dvo.run(dvo.load("small", scale={"depth": True}), source).result
    """
    if scale is not None and not 0 < scale < float("inf"):
        raise DvoError(f"is {scale}", field="--depth-scale", remedy="give the units of a metre, such as 1000")
    changes: dict[str, Any] = {}
    if calib is not None:
        if not isinstance(calib, Calibration):
            calib = read_calibration(locate(calib, source.path, "depth-calib"))
        changes["depth_calibration"] = calib
    recording = source.recording
    if isinstance(recording, BagRecording) and (depth is None or not Path(depth).exists()):
        topic = topic_of(recording, None if depth is None else str(depth), "depth")
        if calib is None:
            other = depth_camera(recording, topic, source.calibration)
            changes |= {} if other is None else {"depth_calibration": other}
        decode = partial(decode_depth, scale=scale or MILLIMETRES)
        return _in_doubt(
            source.changed(
                stages=(*source.reading.stages, CompanionTopic(recording, topic, "depth", decode)), **changes
            )
        )
    path = None if depth is None else locate(depth, source.path, "depth")
    own = recording.sensors.depth if isinstance(recording, ImageRecording) else None
    if isinstance(recording, ImageRecording) and path is None:
        if own is None:
            remedy = "give --depth PATH: a folder of 16-bit PNG files, or a list such as depth.txt"
            raise DvoError("the source has no depth of its own", file=source.path, field=_KIND.option, remedy=remedy)
        file, usual = of_positions(own, recording), recording.sensors.depth_scale
    else:
        file = files_of_frames(path, recording, _KIND)
        usual = DEPTH_SCALE if path is not None and path.is_file() else MILLIMETRES
        inside = path is not None and path.resolve() == source.path.resolve()
        if inside and isinstance(recording, ImageRecording):
            usual = recording.sensors.depth_scale or usual
    stage = CompanionFiles("depth", file, partial(read_depth, scale=scale or usual))
    return _in_doubt(source.changed(stages=(*source.reading.stages, stage), **changes))


def depth_range(source: Source) -> tuple[float, float] | None:
    """Depth of the nearest and of the farthest tenth of the first depth image, in metres.

    Args:
        source: whose frames have depth; it is read from its beginning.

    Returns:
        None for a source without depth, or without a readable one among the first frames; and for a stream, which is
        read once.
    """
    has_depth = any(getattr(stage, "field", None) == "depth" for stage in source.reading.stages)
    if type(source) is not Source or not has_depth:
        return None
    try:
        found = (frame.depth for frame in islice(source.changed(), _LOOKED_AT))
        first = next((depth[np.isfinite(depth)] for depth in found if depth is not None), np.zeros(0))
    except DvoError:  # that is told when it is read for the poses
        return None
    return (float(np.quantile(first, 0.1)), float(np.quantile(first, 0.9))) if len(first) else None


def _in_doubt(source: Source) -> Source:
    """The source with a note on depth in what looks like another unit than metres."""
    span = depth_range(source)
    if span is None or (span[0] < _FARTHEST and span[1] > _NEAREST):
        return source
    note = (
        f"most of the depth is {span[0]:.4g} to {span[1]:.4g} m: is it in another unit? Images of integers have "
        "--depth-scale, those of floats must be metres"
    )
    return source.changed(doubts=(*source.reading.doubts, note))
