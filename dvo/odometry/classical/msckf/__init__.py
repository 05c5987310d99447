"""The inertial filter, a baseline without weights. Begin with ``system.py``."""

from dvo.odometry.classical.msckf.config import MsckfConfig
from dvo.odometry.classical.msckf.system import Msckf

__all__ = ["Msckf", "MsckfConfig"]
