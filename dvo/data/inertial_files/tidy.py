"""Inertial samples of measured rows: what is damaged is repaired and told, or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.files import MAX_NUMBER
from dvo.data.inertial import InertialSamples

STANDARD_GRAVITY = 9.80665
"""m/s^2 of a g."""
GRAVITY_RANGE = (6.0, 14.0)
"""Median of the specific force that a recording on Earth has, m/s^2."""

_ANOTHER_CLOCK = 1e7  # seconds from one sample to the next that are no pause
_COARSE = 0.5  # share of samples that may have the time of another one
_SET_BACK = 1.0  # seconds: rows that are later than others by more do not stand in the order of one recording
_FEWEST = 2


def tidy(
    times: np.ndarray, gyro: np.ndarray, accel: np.ndarray, file: Path, origin: str, *, rough: bool = False
) -> InertialSamples:
    """Samples in order of time.

    Rows with numbers that are not finite are dropped, rows out of order by up to a second are sorted, and of rows that
    share a time the first is kept; the notes of the samples say how many.

    Args:
        times: ``(K,)`` seconds.
        gyro: ``(K, 3)`` rad/s.
        accel: ``(K, 3)`` m/s^2.
        file: for messages.
        origin: of the samples.
        rough: as they stand, for a check: nothing is dropped, sorted or refused.

    Raises:
        DvoError: fewer than two samples, or a clock that is set back.
    """
    if rough:
        return InertialSamples(times, gyro, accel, origin=origin)
    notes = []
    finite = (np.abs(np.column_stack([times, gyro, accel])) <= MAX_NUMBER).all(axis=1)  # false for nan
    if not finite.all():
        notes.append(f"{origin}: {_rows(~finite)} without finite numbers in bounds dropped")
        times, gyro, accel = times[finite], gyro[finite], accel[finite]
    late = np.maximum.accumulate(times) - times if len(times) else times
    if len(late) and late.max() > _SET_BACK:
        at, back = int(late.argmax()), float(late.max())
        remedy = "split the file where a new recording begins"
        raise DvoError(f"the clock is set back by {back:.6g} s at sample {at}", file=file, field="times", remedy=remedy)
    if (late > 0).any():
        order = np.argsort(times, kind="stable")
        notes.append(f"{origin}: {_rows(late > 0)} out of order sorted by time")
        times, gyro, accel = times[order], gyro[order], accel[order]
    same = np.append(False, np.diff(times) <= 0) if len(times) else np.zeros(0, bool)
    again = (gyro[1:] == gyro[:-1]).all(axis=1) & (accel[1:] == accel[:-1]).all(axis=1)
    if len(times) > 1 and (same[1:] & ~again).mean() > _COARSE:
        message = f"{int(same.sum())} of {len(times)} samples have the time of another one"
        raise DvoError(message, file=file, field="times", remedy="write times of the sensor, with more digits")
    if same.any():
        notes.append(f"{origin}: {_rows(same)} with the time of the one before dropped")
        times, gyro, accel = times[~same], gyro[~same], accel[~same]
    if len(times) > 1 and (longest := float(np.diff(times).max())) > _ANOTHER_CLOCK:
        message = f"the clock is set forward by {longest:.6g} s at sample {int(np.diff(times).argmax()) + 1}"
        raise DvoError(message, file=file, field="times", remedy="split the file where another clock begins")
    if len(times) < _FEWEST:
        message = f"{len(times)} inertial sample{'s' * (len(times) != 1)}"
        raise DvoError(message, file=file, field="times", remedy="give a recording of gyroscope and accelerometer")
    return InertialSamples(times, gyro, accel, origin=origin, notes=tuple(notes))


def _rows(mask: np.ndarray) -> str:
    count = int(mask.sum())
    return f"{count} row{'s' * (count != 1)}"


def joined(
    gyro_times: np.ndarray,
    gyro: np.ndarray,
    accel_times: np.ndarray,
    accel: np.ndarray,
    file: Path,
    origin: str,
    *,
    rough: bool = False,
) -> InertialSamples:
    """Samples of a gyroscope and an accelerometer that have clocks of the same zero: at the times of the gyroscope,
    the specific force between its samples by straight lines.

    Args:
        gyro_times: ``(K,)`` seconds.
        gyro: ``(K, 3)`` rad/s.
        accel_times: ``(L,)`` seconds.
        accel: ``(L, 3)`` m/s^2.
        file: for messages.
        origin: of the samples.
        rough: for a check: at all times of the gyroscope in their order, see :func:`tidy`.

    Raises:
        DvoError: sensors that did not record at the same time, or see :func:`tidy`.
    """
    if rough:
        order = np.argsort(accel_times, kind="stable")[: np.isfinite(accel_times).sum()]  # NaN are last
        forces = np.stack([np.interp(gyro_times, accel_times[order], accel[order, k]) for k in range(3)], axis=1)
        return tidy(gyro_times, gyro, forces, file, origin, rough=True)
    w = tidy(gyro_times, gyro, np.zeros_like(gyro), file, f"{origin}, gyroscope")
    a = tidy(accel_times, np.zeros_like(accel), accel, file, f"{origin}, accelerometer")
    both = (w.timestamps >= a.timestamps[0]) & (w.timestamps <= a.timestamps[-1])
    if both.sum() < _FEWEST:
        spans = " and ".join(f"{s.timestamps[0]:.6f} to {s.timestamps[-1]:.6f} s" for s in (w, a))
        message = f"gyroscope and accelerometer did not record at the same time: {spans}"
        raise DvoError(message, file=file, field="times", remedy="give both on one clock")
    times = w.timestamps[both]
    forces = np.stack([np.interp(times, a.timestamps, a.accel[:, k]) for k in range(3)], axis=1)
    notes = (*w.notes, *a.notes)
    outside = int((~both).sum())
    if outside > 0.1 * w.rate:  # a sample or two at the ends is none of a person's concern
        notes += (f"{origin}: {outside} samples of the gyroscope without the accelerometer dropped",)
    return InertialSamples(times, w.gyro[both], forces, origin=origin, notes=notes)


def check_gravity(samples: InertialSamples, file: Path, remedy: str) -> None:
    """Refuse samples whose specific force cannot be that of a sensor on Earth in m/s^2.

    Args:
        samples: all of a recording.
        file: for messages.
        remedy: for messages.

    Raises:
        DvoError: the median of the norm is out of :data:`GRAVITY_RANGE`.
    """
    size = float(np.median(np.linalg.norm(samples.accel, axis=1)))
    if not GRAVITY_RANGE[0] <= size <= GRAVITY_RANGE[1]:
        what = "gravity is not in it" if size < 0.3 * STANDARD_GRAVITY else "its unit is not m/s^2"
        message = f"the median of the specific force is {size:.4g} m/s^2: {what}"
        raise DvoError(message, file=file, field="accel", remedy=remedy)
