"""Frames, calibrations and trajectories, and the readers of videos, image folders, data sets and streams."""

from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.calibration.read import read_calibration
from dvo.data.frame import Frame, StereoView
from dvo.data.inertial import InertialSamples
from dvo.data.open import open_source
from dvo.data.readers.registry import READERS
from dvo.data.recording import ImageRecording, Reader, Recording, Request
from dvo.data.sensors.sensors import Sensors
from dvo.data.source import Source
from dvo.data.streams.streams import FrameStream, stream
from dvo.data.trajectory import Trajectory, interpolate, read_kitti_poses, read_tum, write_kitti_poses, write_tum

__all__ = [
    "READERS",
    "Calibration",
    "Frame",
    "FrameStream",
    "ImageRecording",
    "InertialSamples",
    "Reader",
    "Recording",
    "Request",
    "Sensors",
    "Source",
    "StereoRig",
    "StereoView",
    "Trajectory",
    "interpolate",
    "open_source",
    "read_calibration",
    "read_kitti_poses",
    "read_tum",
    "stream",
    "write_kitti_poses",
    "write_tum",
]
