"""What goes in: frames, cameras' calibrations, trajectories, and readers for videos, image folders and datasets."""

from dvo.data.calibration import Calibration, read_calibration
from dvo.data.frame import Frame
from dvo.data.source import Source, open_source
from dvo.data.trajectory import Trajectory, interpolate, read_kitti_poses, read_tum, write_kitti_poses, write_tum

__all__ = [
    "Calibration",
    "Frame",
    "Source",
    "Trajectory",
    "interpolate",
    "open_source",
    "read_calibration",
    "read_kitti_poses",
    "read_tum",
    "write_kitti_poses",
    "write_tum",
]
