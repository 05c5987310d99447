"""Right and depth images of another topic of a bag of ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.readers.rosbag import BagRecording, calibration_of_info, info_matrices, is_depth
from dvo.data.recording import Log, RawFrame, Selection
from dvo.geometry.poses import poses_from_matrices

_RIGHT = (("left", "right"), ("cam0", "cam1"), ("cam_0", "cam_1"), ("camera0", "camera1"), ("infra1", "infra2"),
          ("image_0", "image_1"))  # fmt: skip


@dataclass(frozen=True)
class CompanionTopic:
    """Stage that adds the images of another topic: those with the nearest stamp, up to half a frame interval.

    Attributes:
        recording: the bag.
        topic: of the other images.
        field: of the frame that they are for, ``depth`` or ``right``.
        decode: image of a message, from it and its name.
    """

    recording: BagRecording
    topic: str
    field: Literal["depth", "right"]
    decode: Callable[[Any, str], np.ndarray | None]

    def __call__(self, frames: Iterator[RawFrame], log: Log, selection: Selection) -> Iterator[RawFrame]:
        """See :class:`dvo.data.source.Stage`."""
        others = enumerate(self.recording.messages(self.topic))
        before = after = next(others, None)
        for raw in frames:
            stamp = self.recording.stamp(raw.index, raw.timestamp)
            while after is not None and (after[0] < raw.index if stamp is None else after[1][0] < stamp):
                before, after = after, next(others, None)
            chosen = self._nearest(before, after, raw.index, stamp)
            if chosen is None:
                yield raw
                continue
            load = partial(self._load, chosen, f"{self.recording.path} {self.topic} at frame {raw.index}", log)
            yield replace(raw, depth=load) if self.field == "depth" else replace(raw, right=load)

    def _nearest(self, before: Any, after: Any, index: int, stamp: float | None) -> Any:
        found = [item for item in (before, after) if item is not None]
        if stamp is None:
            return next((item[1][1] for item in found if item[0] == index), None)
        best = min(found, key=lambda item: abs(item[1][0] - stamp), default=None)
        return None if best is None or abs(best[1][0] - stamp) > self.recording.reach else best[1][1]

    def _load(self, message: Any, name: str, log: Log) -> np.ndarray | None:
        image = self.decode(message, name)
        if image is None:
            log.without.append(name)
        return image


def topic_of(recording: BagRecording, asked: str | None, field: Literal["depth", "right"]) -> str:
    """Topic of the images that belong to those of a bag.

    Args:
        recording: the bag.
        asked: by the user; None for the only one whose name fits.
        field: ``depth`` or ``right``.

    Returns:
        Its name.

    Raises:
        DvoError: no such topic, or none or several that fit.
    """
    others = [name for name in sorted(recording.image_topics) if name != recording.topic]
    listed = ", ".join(others) or "none"
    option = f"--{field}"
    if asked is not None:
        name = f"/{asked.lstrip('/')}"
        if name not in others:
            message = f"{name[:80]} is no other topic of images in this bag; those are: {listed}"
            raise DvoError(message, file=recording.path, field=option, remedy="give one of them")
        return name
    if field == "depth":
        fit = [name for name in others if is_depth(name)]
        plain = [name for name in fit if not name.endswith("/compressedDepth")]
        fit = plain or fit
        aligned = [name for name in fit if "aligned" in name]
        fit = aligned or fit
    else:
        pairs = (recording.topic.replace(left, right) for left, right in _RIGHT if left in recording.topic)
        fit = [name for name in pairs if name in others]
    if len(fit) != 1:
        message = f"the topic of {field} images is not clear; others are: {listed}"
        raise DvoError(message, file=recording.path, field=option, remedy=f"give one with {option} TOPIC")
    return fit[0]


def rig_of_bag(recording: BagRecording, right: str) -> StereoRig | None:
    """Right camera by the ``camera_info`` of both topics.

    The projection of the right camera holds ``-fx b`` in its fourth column; of images that are not rectified, the
    rotations R of both messages turn the cameras to the rectified ones.

    Args:
        recording: the bag.
        right: topic of the right images.

    Returns:
        None without messages, or if they state no baseline.

    Raises:
        DvoError: a camera that is not calibrated, or a model that is not known.
    """
    infos = recording.camera_info(recording.topic), recording.camera_info(right)
    if infos[0] is None or infos[1] is None:
        return None
    left_m, right_m = (info_matrices(info) for info in infos)
    P_left, P_right = (matrices["P"].reshape(3, 4) for matrices in (left_m, right_m))
    if not P_right[0, 0] > 0:
        return None
    baseline = -P_right[0, 3] / P_right[0, 0] + (P_left[0, 3] / P_left[0, 0] if P_left[0, 0] > 0 else 0.0)
    if not 1e-6 < abs(baseline) < 1e3:
        return None
    last = right.removesuffix("/compressed").split("/")[-1]
    T = np.eye(4)
    T[0, 3] = baseline
    if "rect" not in last:
        to_left, to_right = (np.eye(4), np.eye(4))
        for matrix, values in ((to_left, left_m["R"]), (to_right, right_m["R"])):
            R = values.reshape(3, 3)
            if np.abs(R @ R.T - np.eye(3)).max() < 1e-3:  # a camera that was never rectified has zeros
                matrix[:3, :3] = R
        T = to_left.T @ T @ to_right
    return StereoRig(calibration_of_info(infos[1], last, recording.path), poses_from_matrices(T))


def depth_camera(recording: BagRecording, topic: str, calibration: Calibration | None) -> Calibration | None:
    """Camera of depth images that are not registered to the images, by their ``camera_info``.

    Args:
        recording: the bag.
        topic: of the depth images.
        calibration: of the images.

    Returns:
        The camera, without distortion; None for registered depth, or without a message.
    """
    info = recording.camera_info(topic)
    if info is None or calibration is None or "aligned" in topic:
        return None
    matrices = info_matrices(info)
    K = matrices["K"].tolist()
    own, width = np.array([calibration.fx, calibration.fy, calibration.cx, calibration.cy]), calibration.width
    other = np.array([K[0], K[4], K[2], K[5]])
    scale = float(info.width) / width if width and info.width else 1.0
    if not (other[:2] > 0).all() or np.abs(other - own * scale).max() <= 0.02 * own[0] * scale:
        return None
    fx, fy, cx, cy = other.tolist()
    size = int(info.width) or None, int(info.height) or None
    return Calibration(fx, fy, cx, cy, "none", (), *size, file=recording.path)
