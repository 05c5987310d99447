"""Inertial samples as they arrive."""

from __future__ import annotations

import threading

import numpy as np

from dvo.data.inertial import InertialSamples, checked_samples


class SampleStream:
    """Samples of one sensor in order of time; threads may add to it while another one reads.

    Args:
        seconds: of samples that are kept.
    """

    def __init__(self, seconds: float = 600.0) -> None:
        self.seconds = seconds
        self._lock = threading.Lock()
        self._parts: list[InertialSamples] = []
        self._whole: InertialSamples | None = None

    def add(self, samples: InertialSamples) -> None:
        """Add samples, in any order of calls; those of a time that is there already are left out.

        Args:
            samples: with the extrinsic calibration and noise of those before.

        Raises:
            DvoError: no samples, times that do not increase, or values that are not finite.
        """
        if not len(checked_samples(samples)):
            return
        with self._lock:
            self._parts.append(samples)
            self._whole = None

    def samples(self) -> InertialSamples | None:
        """All samples that are kept; None before the first."""
        with self._lock:
            if self._whole is None and self._parts:
                self._whole = self._merged(self._parts)
                self._parts = [self._whole]
            return self._whole

    def near(self, after: float, until: float) -> InertialSamples | None:
        """Samples of a short time, without a copy of the others.

        Args:
            after, until: seconds; see :meth:`dvo.data.inertial.InertialSamples.between`.

        Returns:
            The samples; None if there are none.
        """
        with self._lock:
            parts = [part for part in self._parts if part.timestamps[-1] > after and part.timestamps[0] <= until]
        near = [part for part in (part.between(after, until) for part in parts) if len(part)]  # none within a gap
        return self._merged(near) if near else None

    def __len__(self) -> int:
        return sum(len(part) for part in self._parts)

    @property
    def end(self) -> float:
        """Time of the newest sample, seconds; minus infinity without one."""
        with self._lock:
            return max((float(part.timestamps[-1]) for part in self._parts), default=-np.inf)

    def _merged(self, parts: list[InertialSamples]) -> InertialSamples:
        times = np.concatenate([part.timestamps for part in parts])
        values = np.concatenate([np.concatenate([part.gyro, part.accel], 1) for part in parts])
        if not (np.diff(times) > 0).all():  # some came late, or twice
            times, order = np.unique(times, return_index=True)
            values = values[order]
        last = parts[-1]
        recent = times >= last.timestamps[-1] - self.seconds  # a wrong time in the future costs no others
        return InertialSamples(times[recent], values[recent, :3], values[recent, 3:], last.T_camera_imu, last.noise)
