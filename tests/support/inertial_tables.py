"""One motion of an inertial sensor, tables of it, and what a reader must make of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvo.data.inertial import InertialSamples
from dvo.data.inertial_files.tidy import STANDARD_GRAVITY

COUNT, RATE = 600, 100.0
TIMES = np.arange(COUNT) / RATE


def motion(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A sensor that turns about x, gravity with it: ``da/dt = -w x a``."""
    angle = 0.8 * np.sin(1.5 * times)
    rate = 1.2 * np.cos(1.5 * times)
    gyro = np.column_stack([rate, 0.01 * np.ones(COUNT), -0.02 * np.ones(COUNT)])
    accel = STANDARD_GRAVITY * np.column_stack([0.05 * np.ones(COUNT), np.cos(angle), -np.sin(angle)])
    return gyro, accel


GYRO, ACCEL = motion(TIMES)


def write(file: Path, header: str, columns: list[np.ndarray], mark: str = ",", form: str = "%.9g") -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    table = np.column_stack(columns)
    forms = [form] * table.shape[1]
    lines = ([header] if header else []) + [mark.join(f % v for f, v in zip(forms, row, strict=True)) for row in table]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def check(samples: InertialSamples, start: float = 0.0) -> None:
    assert len(samples) >= COUNT - 2 and samples.rate == pytest.approx(RATE, rel=1e-3)
    k = np.rint((samples.timestamps - start) * RATE).astype(int)
    assert samples.timestamps == pytest.approx(start + k / RATE, abs=2e-5)
    assert samples.gyro == pytest.approx(GYRO[k], abs=1e-4)
    assert samples.accel == pytest.approx(ACCEL[k], abs=1e-3)


NS = 1_600_000_000 * 10**9 + np.rint(TIMES * 1e9).astype(np.int64)
