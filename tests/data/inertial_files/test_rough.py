"""Inertial samples as they stand, for a check: what readers refuse or repair is kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.companions.inertial_source import InertialInput, read_inertial_file
from dvo.data.inertial_files.imu_calibration import ImuCalibration
from dvo.data.inertial_files.tables import read_inertial_table
from dvo.data.inertial_files.tidy import joined, tidy

FILE = Path("f.csv")
TIMES = np.array([0.0, 0.01, 0.03, 0.02, 0.02, 5.0, 0.04])
ROWS = np.arange(21.0).reshape(7, 3)


def test_nothing_is_sorted_dropped_or_refused() -> None:
    with pytest.raises(DvoError, match="set back"):
        tidy(TIMES, ROWS, ROWS, FILE, "f")
    samples = tidy(TIMES, ROWS, ROWS, FILE, "f", rough=True)
    assert np.array_equal(samples.timestamps, TIMES) and np.array_equal(samples.gyro, ROWS) and not samples.notes
    both = joined(TIMES, ROWS, np.array([0.04, 0.0]), np.array([[4.0, 0, 0], [0, 0, 0]]), FILE, "f", rough=True)
    assert np.array_equal(both.timestamps, TIMES) and both.accel[:, 0] == pytest.approx([0, 1, 3, 2, 2, 4, 4])


@pytest.mark.parametrize("scale", [2.0, 0.1])
def test_units_that_are_not_clear_are_left(tmp_path: Path, scale: float) -> None:
    times = np.arange(100) / 100
    times[40:60] = times[40:60][::-1]
    lines = [f"{t:.3f},0.1,0.2,0.3,0,{9.8 * scale},0" for t in times]
    file = tmp_path / "imu.csv"
    file.write_text("time [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]\n" + "\n".join(lines))
    with pytest.raises(DvoError):
        read_inertial_table(file)
    given = InertialInput(lambda rough=False: read_inertial_file(file, rough=rough), ImuCalibration(time_offset=0.5))
    samples = given.rough()
    assert np.allclose(samples.timestamps, times - 0.5) and np.allclose(samples.accel, [0, 9.8 * scale, 0])
    assert np.allclose(samples.gyro, [0.1, 0.2, 0.3])


STAMPS = np.arange(200) / 100
ODD = {
    "s": np.arange(200) * 0.104,
    "ms": 1_700_000_000_000 + np.arange(200) * 200,
    "us": np.arange(200) * 104_167,
    "ns": np.arange(200) * 10**8,
    "bursts": np.arange(200) // 10 * 0.1 + STAMPS % 0.1 * 1e-3,
    "the same": STAMPS * 0 + 3,
    "no order": STAMPS[::-1],
    "one": STAMPS[:1],
}


@pytest.mark.parametrize("is_stated", [False, True])
@pytest.mark.parametrize("case", ODD)
def test_any_rate_is_read(tmp_path: Path, case: str, is_stated: bool) -> None:
    parts = {"ms": 10**3, "us": 10**6, "ns": 10**9}.get(case, 1)
    unit = f" [{case if parts > 1 else 's'}]" if is_stated else ""
    rows = [f"{t},0.1,0.2,0.3,0,9.8,0" for t in ODD[case].tolist()]
    file = tmp_path / "imu.csv"
    file.write_text("\n".join([f"time{unit},gx,gy,gz,ax,ay,az", *rows]))
    with pytest.raises(DvoError, match="times?:"):
        read_inertial_table(file)
    assert np.allclose(read_inertial_table(file, rough=True).timestamps, ODD[case] / parts, rtol=0, atol=1e-6)
