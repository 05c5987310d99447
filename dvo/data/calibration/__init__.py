"""Calibrations: the type, the dialects of their files, and guesses where there is none."""

from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.calibration.read import read_calibration

__all__ = ["Calibration", "StereoRig", "read_calibration"]
