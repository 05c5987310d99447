"""Estimates of a run as they came, frame by frame: poses, states of the tracker, and what inertial samples gave."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from dvo.odometry.protocol import Estimate

FILE = "streamed.npz"
_WIDTHS = {"velocity_w": (3,), "gyro_bias": (3,), "accel_bias": (3,), "scale_sigma": (), "time_offset": ()}


@dataclass(frozen=True)
class Streamed:
    """Estimates in the order of the frames; nan where an estimate has none.

    Attributes:
        timestamps: ``(N,)`` seconds.
        poses_wc: ``(N, 7)`` camera to world, as they were at that time.
        status: ``(N,)`` text, see :class:`dvo.odometry.protocol.Status`.
        segment: ``(N,)``.
        scale_state: ``(N,)`` text: ``none``, ``initialising``, ``aligned`` or ``refined``; of a system that does
            not tell, always ``none`` or empty. Of an aligned pose the world is in metres and its z axis points up.
        velocity_w: ``(N, 3)`` of the inertial sensor in the world, m/s.
        gyro_bias, accel_bias: ``(N, 3)`` in the axes of the sensor, rad/s and m/s^2.
        scale_sigma: ``(N,)`` relative standard deviation of the scale.
        time_offset: ``(N,)`` seconds by which the stamps of the samples are late.
        covariance: ``(N, 9, 9)`` of the error (truth minus estimate) of position in the world (metres), orientation
            (right tangent, rad) and velocity in the world (m/s), relative to the pose at the alignment: yaw and
            position of that pose are taken as right.
    """

    timestamps: np.ndarray
    poses_wc: np.ndarray
    status: np.ndarray
    segment: np.ndarray
    scale_state: np.ndarray
    velocity_w: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    scale_sigma: np.ndarray
    time_offset: np.ndarray
    covariance: np.ndarray

    def __len__(self) -> int:
        return len(self.timestamps)

    def write(self, folder: Path) -> None:
        """Write a file of arrays.

        Args:
            folder: of a run.
        """
        np.savez_compressed(folder / FILE, **vars(self))

    @classmethod
    def read(cls, folder: Path) -> Streamed | None:
        """Read what :meth:`write` has written; None where nothing was.

        Args:
            folder: of a run.
        """
        if not (folder / FILE).is_file():
            return None
        with np.load(folder / FILE) as arrays:
            return cls(**{item.name: arrays[item.name] for item in fields(cls)})


@dataclass
class StreamLog:
    """Collects estimates while a run goes on."""

    _rows: list[dict[str, object]] = field(default_factory=list)

    def take(self, estimate: Estimate) -> None:
        """Keep the values of an estimate.

        Args:
            estimate: of the newest frame.
        """
        record = getattr(estimate, "inertial", None)
        values = {name: _array(getattr(record, name, None), shape) for name, shape in _WIDTHS.items()}
        self._rows.append(
            {
                "timestamps": estimate.timestamp,
                "poses_wc": _array(estimate.pose_wc, (7,)),
                "status": str(estimate.status),
                "segment": estimate.segment,
                "scale_state": str(getattr(estimate, "scale_state", "")),
                "covariance": _array(getattr(record, "covariance", None), (9, 9)),
                **values,
            }
        )

    def streamed(self) -> Streamed:
        """What was kept so far; of one frame or more."""
        return Streamed(**{item.name: np.array([row[item.name] for row in self._rows]) for item in fields(Streamed)})


def _array(value: object, shape: tuple[int, ...]) -> np.ndarray:
    return np.full(shape, np.nan) if value is None else np.asarray(value, dtype=np.float64).reshape(shape)
