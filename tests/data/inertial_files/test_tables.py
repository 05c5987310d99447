"""Tables of inertial samples as applications write them, of one motion whose numbers are known."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data.inertial_files.tables import is_inertial_table, read_inertial_table
from dvo.data.inertial_files.tidy import STANDARD_GRAVITY, joined, tidy
from tests.support.inertial_tables import ACCEL, COUNT, GYRO, NS, RATE, TIMES, check, motion, write

APPS = {
    "euroc": ("#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],"
              "a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]", [TIMES * 1e9, GYRO, ACCEL], ","),
    "mars logger": ("Timestamp[nanosec],gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2],"
                    "Unix time[nanosec]", [TIMES * 1e9, GYRO, ACCEL, 1e18 + TIMES], ","),
    "physics toolbox": ("time,gFx,gFy,gFz,ax,ay,az,wx,wy,wz", [TIMES, ACCEL / STANDARD_GRAVITY, 0 * ACCEL, GYRO], ","),
    "androsensor": ("ACCELEROMETER X (m/s\u00b2);ACCELEROMETER Y (m/s\u00b2);ACCELEROMETER Z (m/s\u00b2);"
                    "GRAVITY X (m/s\u00b2);GRAVITY Y (m/s\u00b2);GRAVITY Z (m/s\u00b2);"
                    "LINEAR ACCELERATION X (m/s\u00b2);LINEAR ACCELERATION Y (m/s\u00b2);"
                    "LINEAR ACCELERATION Z (m/s\u00b2);GYROSCOPE X (rad/s);GYROSCOPE Y (rad/s);GYROSCOPE Z (rad/s);"
                    "Time since start in ms", [ACCEL, ACCEL, 0 * ACCEL, GYRO, TIMES * 1e3], ";"),
    "stray scanner": ("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z",
                      [TIMES, -ACCEL / STANDARD_GRAVITY, GYRO], ", "),
    "degrees by header": ("time [us],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s],acc_x [g],acc_y [g],acc_z [g]",
                          [TIMES * 1e6, np.degrees(GYRO), ACCEL / STANDARD_GRAVITY], "\t"),
    "degrees by gravity": ("time,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z", [TIMES, np.degrees(GYRO), ACCEL], ","),
    "radians by gravity": ("t,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z", [TIMES, GYRO, ACCEL], ","),
    "no header": ("", [TIMES * 1e9, ACCEL, GYRO], ","),
    "units behind the names": ("timestamp_us,gyro_x_dps,gyro_y_dps,gyro_z_dps,acc_x_m_s2,acc_y_m_s2,acc_z_m_s2",
                               [TIMES * 1e6, np.degrees(GYRO), ACCEL], ","),
    "milli-g behind the names": ("t_ms,gx_rad_s,gy_rad_s,gz_rad_s,ax_mg,ay_mg,az_mg",
                                 [TIMES * 1e3, GYRO, ACCEL * 1e3 / STANDARD_GRAVITY], ","),
    "units in a line of their own": ("t,gx,gy,gz,ax,ay,az\n[ms],[deg/s],[deg/s],[deg/s],[g],[g],[g]",
                                     [TIMES * 1e3, np.degrees(GYRO), ACCEL / STANDARD_GRAVITY], ","),
    "lines above the header": ("Device: Pixel, 7\nRate,100\n\nt,gx,gy,gz,ax,ay,az", [TIMES, GYRO, ACCEL], ","),
    "blanks in a header without marks": ("time [s] gx [rad/s] gy [rad/s] gz [rad/s] ax [m/s^2] ay [m/s^2] az [m/s^2]",
                                         [TIMES, GYRO, ACCEL], " "),
    "a clock that stands beside one that goes": ("time,seconds_elapsed,gx,gy,gz,ax,ay,az",
                                                 [1.6e9 + TIMES // 1, TIMES, GYRO, ACCEL], ","),
    "tum-vi text": ("# timestamp[s] wx[rad/s] wy[rad/s] wz[rad/s] ax[m/s^2] ay[m/s^2] az[m/s^2]",
                    [TIMES, GYRO, ACCEL], " "),
}  # fmt: skip


HEADER = "time [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"


def rows_of(times: np.ndarray) -> list[str]:
    table = np.column_stack([times, GYRO[: len(times)], ACCEL[: len(times)]])
    return [",".join(repr(value) for value in row) for row in table.tolist()]


@pytest.mark.parametrize("app", APPS)
def test_one_file(tmp_path, app):
    header, columns, mark = APPS[app]
    header = header.replace(",", mark) if mark == "\t" else header
    form = "%.15g" if app in ("euroc", "mars logger", "no header") else "%.10g"
    check(read_inertial_table(write(tmp_path / "imu.csv", header, columns, mark, form)))


@pytest.mark.parametrize("header", [HEADER, ""])
@pytest.mark.parametrize("mark", [",", ";"])
def test_marks_at_the_end_of_rows_quotes_and_decimal_commas(tmp_path, header, mark):
    """A byte order mark, decimal commas within quotes, and an empty column at the end."""
    rows = [mark.join('"' + cell.replace(".", ",") + '"' for cell in row.split(",")) + mark for row in rows_of(TIMES)]
    (tmp_path / "imu.csv").write_text("\n".join([header.replace(",", mark), *rows]), encoding="utf-8-sig")
    check(read_inertial_table(tmp_path / "imu.csv"))


GUESSES = {"degrees by gravity": "deg/s (as gravity turns)", "radians by gravity": "rad/s (as gravity turns)",
           "lines above the header": "2 lines above the header not read",
           "a clock that stands beside one that goes": "times are those of seconds_elapsed",
           "stray scanner": "Apple", "no header": "accelerometer, gyroscope"}  # fmt: skip


@pytest.mark.parametrize("app", GUESSES)
def test_guesses_are_told(tmp_path, app):
    header, columns, mark = APPS[app]
    samples = read_inertial_table(write(tmp_path / "imu.csv", header, columns, mark, "%.15g"))
    assert sum(GUESSES[app] in note for note in samples.notes) == 1


def test_the_accelerometer_is_interpolated_to_the_gyroscope(tmp_path):
    """Sensor Logger: columns z y x, nanoseconds beside seconds, Accelerometer.csv without gravity."""
    late = NS + 2_000_000
    accel = motion(TIMES + 0.002)[1]
    header = "time,seconds_elapsed,z,y,x"
    for name, stamps, values in (("Gyroscope", NS, GYRO), ("TotalAcceleration", late, accel),
                                 ("Accelerometer", late, 0 * accel)):  # fmt: skip
        rows = [f"{t},{k / RATE},{z!r},{y!r},{x!r}" for k, (t, (x, y, z)) in
                enumerate(zip(stamps.tolist(), values.tolist(), strict=True))]  # fmt: skip
        (tmp_path / f"{name}.csv").write_text("\n".join([header, *rows]) + "\n")
    samples = read_inertial_table(tmp_path / "Gyroscope.csv")
    assert "TotalAcceleration.csv" in samples.origin and len(samples) == COUNT - 1  # none before the accelerometer
    check(samples, 1.6e9)
    check(read_inertial_table(tmp_path), 1.6e9)  # the folder
    (tmp_path / "TotalAcceleration.csv").unlink()
    with pytest.raises(DvoError, match="gravity"):
        read_inertial_table(tmp_path / "Gyroscope.csv")


@pytest.mark.parametrize("given", ["VID_1gyro.csv", "VID_1accel.csv"])
def test_opencamera_sensors(tmp_path, given):
    for name, values in (("gyro", GYRO), ("accel", ACCEL)):
        write(tmp_path / f"VID_1{name}.csv", "", [values, 5e12 + TIMES * 1e9], ",", "%.15g")
    check(read_inertial_table(tmp_path / given), 5000.0)


def test_a_file_of_the_linear_acceleration_is_no_accelerometer(tmp_path):
    write(tmp_path / "Gyroscope.csv", '"Time (s)","Gyroscope x (rad/s)","Gyroscope y (rad/s)","Gyroscope z (rad/s)"',
          [TIMES, GYRO])  # fmt: skip
    names = ",".join(f'"Linear Acceleration {axis} (m/s^2)"' for axis in "xyz")
    write(tmp_path / "Linear Acceleration.csv", f'"Time (s)",{names}', [TIMES, ACCEL])
    for name in ("Gyroscope.csv", "Linear Acceleration.csv"):
        with pytest.raises(DvoError, match="accel: gravity was removed from Linear Acceleration.*with gravity"):
            read_inertial_table(tmp_path / name)


def test_numbers_out_of_bounds_are_dropped_without_warnings(tmp_path):
    gyro = GYRO.copy()
    gyro[::7] = 1e300
    gyro[3] = np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        samples = read_inertial_table(write(tmp_path / "imu.csv", "t,gx,gy,gz,ax,ay,az", [TIMES, gyro, ACCEL]))
    assert len(samples) == COUNT - 87 and any("87 rows without finite numbers" in note for note in samples.notes)


@pytest.mark.parametrize("mark", ["\t", ";"])
def test_phyphox_with_decimal_commas(tmp_path, mark):
    for name, unit, values in (("Gyroscope", "rad/s", GYRO), ("Accelerometer", "m/s^2", ACCEL)):
        label = "Acceleration" if name[0] == "A" else name
        header = mark.join(['"Time (s)"', *(f'"{label} {axis} ({unit})"' for axis in "xyz")])
        file = write(tmp_path / f"{name}.csv", header, [TIMES, values], mark)
        file.write_text(file.read_text().replace(".", ","))
    check(read_inertial_table(tmp_path / "Gyroscope.csv"))
    assert not is_inertial_table(tmp_path / "Gyroscope.csv")


@pytest.mark.parametrize("end", ["", "\n"])
def test_spectacular_ai(tmp_path, end):
    rows = []
    for k in range(COUNT):
        for kind, values in (("gyroscope", GYRO), ("accelerometer", ACCEL)):
            rows.append({"time": TIMES[k], "sensor": {"type": kind, "values": values[k].tolist()}})
        rows.append({"time": TIMES[k], "frames": []})
    file = tmp_path / "data.jsonl"
    file.write_text("\n".join(json.dumps(row) for row in rows) + end)
    check(read_inertial_table(file))
    file.write_text('{"time": 1, "sensor": {"type": "gyroscope", "values": [1, 2]}}\n')
    with pytest.raises(DvoError, match="line 1"):
        read_inertial_table(file)


def test_damage_is_repaired_and_told(tmp_path):
    rows = rows_of(TIMES)
    rows[10], rows[11] = rows[11], rows[10]
    rows[20] = rows[20].replace(rows[20].split(",")[2], "nan")
    rows[30] = rows[29]
    file = tmp_path / "imu.csv"
    file.write_text("\n".join([HEADER, *rows]) + "\n5.99,0.1")
    samples = read_inertial_table(file)
    assert len(samples) == COUNT - 2
    assert (np.diff(samples.timestamps) > 0).all() and np.isfinite(samples.gyro).all()
    for text in ("1 row without finite numbers", "1 row out of order", "1 row with the time of the one before",
                 "the last row is not whole"):  # fmt: skip
        assert sum(text in note for note in samples.notes) == 1, (text, samples.notes)


BAD = {
    "no rows": ([], "no rows"),
    "a clock that is set back": (rows_of(np.concatenate([TIMES[:300] + 100, TIMES[:300]])), "set back by 1"),
    "a row of another width": ([*rows_of(TIMES)[:5], "1,2,3", *rows_of(TIMES)[5:]], "row 6 has 3 columns, not 7"),
    "one sample a second": (rows_of(TIMES * 100), "1 samples a second"),
    "the same time": (rows_of(0 * TIMES), "do not increase: all 600 are 0. Write them with more digits"),
    "one sample": (rows_of(TIMES[:1]), "1 sample. Record for longer"),
    "a clock that is set forward": (rows_of(TIMES + 1.7e9 * (TIMES > 1)), "set forward by 1.7e.09 s at sample 101"),
    "a clock of hundredths": (rows_of(np.arange(COUNT) // 4 * 0.04), "450 of 600 samples have the time of another one"),
    "a clock of tenths": (rows_of(np.arange(COUNT) // 10 * 0.1), "10 samples a second: 90 % of the rows have the time"),
    "bursts": (rows_of(np.arange(COUNT) // 10 * 0.1 + TIMES % 0.1 * 1e-3), "in bursts: .*stamps of the sensor"),
    "no order at all": (rows_of(TIMES[np.random.default_rng(0).permutation(COUNT)]), "set back by"),
    "a slow logger": (rows_of(TIMES * 10.4), "9.615 samples a second"),
}


@pytest.mark.parametrize("case", BAD)
def test_damage_that_cannot_be_repaired(tmp_path, case):
    rows, message = BAD[case]
    file = tmp_path / "imu.csv"
    file.write_text("\n".join([HEADER, *rows]) + "\n")
    with pytest.raises(DvoError, match=message):
        read_inertial_table(file)


UNCLEAR = {
    "gravity was removed": ("time [s],gx,gy,gz,ax,ay,az", [TIMES, GYRO, 0.05 * ACCEL], "gravity was removed"),
    "gravity was removed, with units": (HEADER, [TIMES, GYRO, 0.05 * ACCEL], "gravity is not in it"),
    "a wrong unit": (HEADER, [TIMES, GYRO, 5 * ACCEL], "its unit is not m/s"),
    "an unknown unit": (HEADER.replace("[rad/s]", "[turns]"), [TIMES, GYRO, ACCEL], "unit turns is not known"),
    "no names": ("a,b,c,d,e,f,g", [TIMES, GYRO, ACCEL], "no columns of a gyroscope"),
    "no times": (HEADER.replace("time [s]", "row"), [TIMES, GYRO, ACCEL], "no column of times"),
    "no accelerometer": ("time [s],gx,gy,gz", [TIMES, GYRO], "only the gyroscope in it"),
    "times without a unit": (HEADER.replace("time [s]", "time"), [TIMES * 10, GYRO, ACCEL], "unit of the times"),
    "a slow logger without a unit": ("time,gx,gy,gz,ax,ay,az", [TIMES * 12, GYRO, ACCEL], "8.333 samples a second, if"),
    "a slow logger or a fast one": (
        "time,gx,gy,gz,ax,ay,az",
        [np.arange(COUNT) * 200, GYRO, ACCEL],
        "5 samples a second in ms, 5000 in us",
    ),
    "linear acceleration": (
        "t,gyro_x,gyro_y,gyro_z,linear_acceleration_x,linear_acceleration_y,linear_acceleration_z",
        [TIMES, GYRO, ACCEL],
        "gravity was removed from linear_acceleration_x",
    ),
    "linear acceleration alone": (
        "t,lin_acc_x,lin_acc_y,lin_acc_z",
        [TIMES, ACCEL],
        "gravity was removed from lin_acc_x",
    ),
    "too few columns": (HEADER, [TIMES, GYRO], "the header has 7 columns, the rows have 4"),
}


@pytest.mark.parametrize("case", UNCLEAR)
def test_what_is_not_clear_is_refused(tmp_path, case):
    header, columns, message = UNCLEAR[case]
    with pytest.raises(DvoError, match=message):
        read_inertial_table(write(tmp_path / "imu.csv", header, columns))


def test_a_clock_of_whole_seconds_is_refused():
    from dvo.data.files.root import data_root

    file = data_root() / "phone_desk_198" / "imu.csv"
    if not file.is_file():
        pytest.skip("no shared data")
    with pytest.raises(DvoError, match="times that are neither numbers nor dates, such as 15-23-14"):
        read_inertial_table(file)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.permutations(range(8)), st.lists(st.integers(0, 7), max_size=4))
def test_order_and_repetition_change_nothing(order, again):
    times = np.arange(8) / 100
    values = np.arange(24.0).reshape(8, 3)
    k = np.array([*order, *again])
    samples = tidy(times[k], values[k], values[k] + 1, Path("x"), "x")
    assert samples.timestamps.tolist() == times.tolist()
    assert samples.gyro.tolist() == values.tolist() and samples.accel.tolist() == (values + 1).tolist()
    assert len(samples.notes) == (list(order) + list(again) != sorted(order)) + bool(again) - \
        (bool(again) and list(k) == sorted(k))  # fmt: skip


def test_sensors_that_did_not_record_together():
    values = np.ones((5, 3))
    with pytest.raises(DvoError, match="did not record at the same time: 0.000000 to 0.040000 s and 7.000000"):
        joined(np.arange(5) / 100, values, 7 + np.arange(5) / 100, values, Path("x"), "x")
