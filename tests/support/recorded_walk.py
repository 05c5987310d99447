"""Two recordings of one room, by different cameras, for tests of maps."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

import dvo
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.metrics import evaluate
from dvo.odometry.loops.options import LoopOptions
from dvo.odometry.protocol import Result
from dvo.synth.sequence import make_sequence

COUNT = 36
SHORT = {
    "keyframe_motion": 0.5, "removal": 5, "lifetime": 4, "optimisation": 5, "patches": 16, "pixels": 160 * 120,
    "estimate_readout": False,
}  # fmt: skip
OPTIONS = LoopOptions(every=2, steps=8, delay=2)


@cache
def room() -> tuple[list[Frame], np.ndarray]:
    """Frames of a walk, from 100 s on, and their true poses."""
    walk = make_sequence(
        63, frames=COUNT, family="room", kind="handheld", speed=5.0, height=120, width=160, fps=15.0, sensor=False
    )
    frames = [replace(frame, timestamp=100 + k / 15) for k, frame in enumerate(walk)]
    return frames, walk.groundtruth.poses_wc


def street(count: int) -> list[Frame]:
    """Frames of another place, from 0 s on."""
    return list(
        make_sequence(64, frames=count, family="street", kind="handheld", speed=5.0, height=120, width=160, fps=15.0,
                      sensor=False)
    )  # fmt: skip


def way_back(frames: list[Frame]) -> list[Frame]:
    """The walk in reverse, from 0 s on, seen by a camera of four times the pixels and a longer focal length."""
    return [_zoomed(frame, k, k / 15) for k, frame in enumerate(reversed(frames))]


def _zoomed(frame: Frame, index: int, timestamp: float) -> Frame:
    """Frame cut to 144x108 around its centre and enlarged to 320x240."""
    image = cv2.resize(frame.image[6:114, 8:152], (320, 240), interpolation=cv2.INTER_CUBIC)
    c = frame.camera
    camera = Camera(c.fx, c.fy, c.cx - 8, c.cy - 6, 144, 108).resized(320, 240)
    return Frame(index, timestamp, np.ascontiguousarray(image), camera)


def tracked(frames: list[Frame], **settings) -> dvo.odometry.patch.tracker.PatchOdometry:
    """Finished tracker of frames."""
    odometry = dvo.load("small", device="cpu", **SHORT, **settings)
    for frame in frames:
        odometry.track(frame)
    odometry.finish()
    return odometry


@cache
def _tracked_room() -> tuple[bytes, Result]:
    odometry = tracked(room()[0])
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "room.dvo"
        odometry.save(file)
        return file.read_bytes(), odometry.finish()


def map_of_room(file: Path) -> Result:
    """Write the map of the walk, which is tracked once for all tests; returns its result."""
    content, result = _tracked_room()
    file.write_bytes(content)
    return result


def error_of_both(old: Trajectory, new: Trajectory, truth: np.ndarray) -> float:
    """Error in percent of the length of two trajectories of the walk and its way back that share a world."""
    rows = [np.round((old.timestamps - 100) * 15).astype(int), COUNT - 1 - np.round(new.timestamps * 15).astype(int)]
    times = np.concatenate([old.timestamps, 1000 + new.timestamps])
    found = Trajectory(times, np.concatenate([old.poses_wc, new.poses_wc]))
    return evaluate(found, Trajectory(times, truth[np.concatenate(rows)])).ate_percent
