"""MonoSLAM: a camera and a map of points in one extended Kalman filter. Start reading in ``slam.py``."""

from eval.systems.baselines.monoslam.slam import MonoSlam, MonoSlamConfig

__all__ = ["MonoSlam", "MonoSlamConfig"]
