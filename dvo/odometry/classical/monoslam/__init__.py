"""MonoSLAM: a camera and a map of points in one extended Kalman filter. Start reading in ``slam.py``."""

from dvo.odometry.classical.monoslam.slam import MonoSlam, MonoSlamConfig

__all__ = ["MonoSlam", "MonoSlamConfig"]
