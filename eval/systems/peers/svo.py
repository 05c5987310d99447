"""SVO (Forster, Pizzoli, Scaramuzza 2014), from the package ``svo-cpp`` (GPL-3): semi-direct, no loops, no refinement.

One object per process: a second one uses timers that the first has destroyed. The package requires ``opencv-python``,
which would overwrite ``opencv-python-headless``, and does not use it: install it with ``--no-deps``.
"""

from __future__ import annotations

import ctypes
import sys
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry.poses import pose_matrices, poses_from_matrices
from dvo.odometry.protocol import Estimate, Result, Status
from eval.systems.peers.common import Pictures, Row, missing_module, result, version_of

version = version_of("svo-cpp")


def missing() -> str | None:
    """Reason why it cannot run here, or None."""
    return missing_module("svo_cpp", "pip install --no-deps svo-cpp (GPL-3)")


class Svo:
    """See the module. Frames without a pose (start, relocalisation) have no row; a map begun anew is a segment."""

    name = "svo"

    def __init__(self) -> None:
        import svo_cpp

        self._svo_cpp = svo_cpp
        self._pictures = Pictures()
        self._system: Any = None
        self._rows: list[Row] = []
        self._frames = self._part = 0
        self._was_tracking = False

    def track(self, frame: Frame) -> Estimate:
        self._frames += 1
        image = self._pictures(frame)
        if self._system is None:
            camera = self._pictures.camera
            assert camera is not None
            self._system = self._svo_cpp.SVO(
                self._svo_cpp.PinholeCamera(camera.width, camera.height, *camera.intrinsics.tolist())
            )
            self._system.start()
        self._system.addImage(image, frame.timestamp)
        stage = self._system.stage()
        if stage == self._svo_cpp.Stage.PAUSED:  # lost for good: it waits to be started anew
            self._system.start()
        if stage != self._svo_cpp.Stage.DEFAULT_FRAME:
            if stage != self._svo_cpp.Stage.RELOCALIZING and self._was_tracking:
                self._part, self._was_tracking = self._part + 1, False
            lost = self._was_tracking or self._part > 0
            return Estimate(frame.timestamp, None, Status.LOST if lost else Status.INITIALISING)
        self._was_tracking = True
        T_wc = np.linalg.inv(read_se3(self._system.lastFrame().T_f_w))
        self._rows.append(Row(frame.timestamp, T_wc, self._part))
        return Estimate(frame.timestamp, poses_from_matrices(T_wc), Status.TRACKING, 0.5, self._part)

    def finish(self) -> Result:
        return result(self._rows, self._frames, {**self._pictures.facts(), "maps_started": self._part + 1})


def read_se3(pose: Any) -> np.ndarray:
    """``(4, 4)`` of the binding's ``SE3d``.

    Its ``unit_quaternion`` raises (no converter for Eigen's quaternion), so the four numbers are read where they lie:
    pybind11 keeps a pointer to the value behind the object's head, and Sophus keeps ``qx qy qz qw tx ty tz`` there.
    What can be read in the regular way, the translation and that of the inverse, must agree.

    Raises:
        DvoError: it does not, so this is another build of the package.
    """
    if sys.implementation.name != "cpython":
        raise DvoError("the rotation can be read under CPython only", field="svo")
    head = ctypes.c_void_p.from_address(id(pose) + object.__basicsize__).value
    values = np.array((ctypes.c_double * 7).from_address(head))  # type: ignore[arg-type]
    t, centre = np.ravel(pose.translation()), np.ravel(pose.inverse().translation())
    sound = bool(np.isfinite(values).all()) and abs(np.linalg.norm(values[:4]) - 1) < 1e-6
    T = pose_matrices(np.concatenate([t, values[:4]])) if sound else np.full((4, 4), np.nan)
    if not (np.allclose(values[4:7], t) and np.allclose(-T[:3, :3].T @ t, centre, atol=1e-6)):
        raise DvoError("cannot read the rotation of this build of svo-cpp", field="svo", remedy="use svo-cpp 1.5.0")
    return T
