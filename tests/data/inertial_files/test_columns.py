"""Columns of tables that hold more than one gyroscope, accelerometer or time."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.inertial_files.columns import columns_of
from dvo.data.inertial_files.tables import read_inertial_table
from dvo.data.inertial_files.tidy import STANDARD_GRAVITY
from tests.support.inertial_tables import ACCEL, COUNT, GYRO, NS, TIMES, check, motion, write

ZERO, TWO = np.zeros((COUNT, 3)), np.repeat([[0, 1]], COUNT, axis=0).ravel()
MANY = {
    "uncorrected first": ("t,UncompAccel_X,UncompAccel_Y,UncompAccel_Z,UncompGyro_X,UncompGyro_Y,UncompGyro_Z,Accel_X,"
                          "Accel_Y,Accel_Z,AngularRate_X,AngularRate_Y,AngularRate_Z",
                          [TIMES, ACCEL + 0.2, GYRO + 0.05, ACCEL, GYRO]),
    "drift first": ("t,gyro_drift_x,gyro_drift_y,gyro_drift_z,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z",
                    [TIMES, ZERO, GYRO, ACCEL]),
    "increments first": ("t,delta_gyro_x,delta_gyro_y,delta_gyro_z,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z",
                         [TIMES, GYRO / 100, GYRO, ACCEL]),
    "angular acceleration first": ("t,angular_acceleration_x,angular_acceleration_y,angular_acceleration_z,gyro_x,"
                                   "gyro_y,gyro_z,acc_x,acc_y,acc_z", [TIMES, 10 * GYRO, GYRO, ACCEL]),
    "axes of the world first": ("t,acc_world_x,acc_world_y,acc_world_z,acc_x,acc_y,acc_z,wx,wy,wz",
                                [TIMES, ZERO + 5.66, ACCEL, GYRO]),
    "without gravity first": ("PacketCounter,t,FreeAcc_X,FreeAcc_Y,FreeAcc_Z,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z",
                              [TIMES * 100, TIMES, ZERO, ACCEL, np.degrees(GYRO)]),
    "g is gravity": ("t,ax,ay,az,gx,gy,gz,wx,wy,wz", [TIMES, ACCEL, ACCEL, GYRO]),
    "a second sensor": ("t,gx,gy,gz,gx,gy,gz,ax,ay,az", [TIMES, GYRO, GYRO + 1, ACCEL]),
    "px4": ("timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],gyro_integral_dt,accelerometer_timestamp_relative,"
            "accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2]",
            [TIMES * 1e6, GYRO, TIMES, 0 * TIMES, ACCEL]),
    "betaflight": ("loopIteration,time (us),gyroADC[0] (deg/s),gyroADC[1] (deg/s),gyroADC[2] (deg/s),accSmooth[0] (g),"
                   "accSmooth[1] (g),accSmooth[2] (g)",
                   [TIMES, TIMES * 1e6, np.degrees(GYRO), ACCEL / STANDARD_GRAVITY]),
    "plotjuggler": ("__time," + ",".join(f"/imu/{name}/{axis}" for name in ("angular_velocity", "linear_acceleration")
                                         for axis in "xyz"), [TIMES, GYRO, ACCEL]),
    "uzh-fpv": ("# id timestamp ang_vel_x ang_vel_y ang_vel_z lin_acc_x lin_acc_y lin_acc_z",
                [np.arange(COUNT), TIMES, GYRO, ACCEL]),
    "xsens": ("PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z", [TIMES, TIMES * 1e4, ACCEL, GYRO]),
}  # fmt: skip


@pytest.mark.parametrize("case", MANY)
def test_the_right_columns_are_taken(tmp_path, case):
    header, columns = MANY[case]
    check(read_inertial_table(write(tmp_path / "imu.csv", header, columns, form="%.12g")))


def test_what_may_be_meant_as_well_is_told(tmp_path):
    header = "t,gyro1_x,gyro1_y,gyro1_z,gyro2_x,gyro2_y,gyro2_z,acc_x,acc_y,acc_z"
    samples = read_inertial_table(write(tmp_path / "imu.csv", header, [TIMES, GYRO, GYRO + 1, ACCEL]))
    check(samples)
    assert any("gyro1_x is taken for the gyroscope, not gyro2_x" in note for note in samples.notes)


def test_each_sensor_has_the_times_beside_it(tmp_path):
    names = [f"{sensor} {axis} ({unit})" for sensor, unit in (("Acceleration", "m/s^2"), ("Gyroscope", "rad/s"))
             for axis in "xyz"]  # fmt: skip
    header = ",".join(f'"{name}"' for name in ("Time (s)", *names[:3], "Time (s)", *names[3:]))
    later = TIMES + 0.004
    check(read_inertial_table(write(tmp_path / "all.csv", header, [later, motion(later)[1], TIMES, GYRO], form="%.9g")))


def _lines(tmp_path, header, *columns):
    file = tmp_path / "imu.csv"
    rows = zip(*(column.tolist() for column in columns), strict=True)
    cells = (
        ",".join(" ".join(map(str, cell)) if isinstance(cell, list) else str(cell) for cell in row) for row in rows
    )
    file.write_text("\n".join([header, *(line.replace(" ", ",") for line in cells)]) + "\n", encoding="utf-8")
    return file


@pytest.mark.parametrize("case", ["echo", "bagpy", "seconds and nanoseconds", "date first"])
def test_the_stamp_of_a_message(tmp_path, case):
    angular = ",".join(f"angular_velocity.{axis}" for axis in "xyz")
    linear = ",".join(f"linear_acceleration.{axis}" for axis in "xyz")
    start = 1_600_000_000.0
    if case == "echo":
        field = [f"field.{name}" for name in f"{angular},{linear}".split(",")]
        file = _lines(tmp_path, ",".join(["%time,field.header.stamp", *field]), NS + 7_000_000, NS, GYRO, ACCEL)
    elif case == "bagpy":
        header = f"Time,header.stamp.secs,header.stamp.nsecs,{angular},{linear}"
        file = _lines(tmp_path, header, 1.6e9 + 0.007 + TIMES, NS // 10**9, NS % 10**9, GYRO, ACCEL)
    elif case == "seconds and nanoseconds":
        file = _lines(tmp_path, "sec,nanosec,wx,wy,wz,ax,ay,az", NS // 10**9, NS % 10**9, GYRO, ACCEL)
    else:
        dates, start = np.full(COUNT, "2024-05-05T10:00"), 0.0
        file = _lines(tmp_path, "date,elapsed_ms,wx,wy,wz,ax,ay,az", dates, TIMES * 1e3, GYRO, ACCEL)
    check(read_inertial_table(file), start)


def test_sensors_that_take_turns_in_the_rows(tmp_path):
    even = np.arange(2 * COUNT) % 2 == 0
    times = np.repeat(TIMES, 2) + np.where(even, 0, 0.004)
    gyro = np.where(even[:, None], np.repeat(GYRO, 2, axis=0), np.nan)
    accel = np.where(even[:, None], np.nan, np.repeat(ACCEL, 2, axis=0))
    header = "t,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z"
    samples = read_inertial_table(write(tmp_path / "imu.csv", header, [times, gyro, accel]))
    assert len(samples) >= COUNT - 2 and np.abs(samples.accel - ACCEL[-len(samples) :]).max() < 0.1


def test_the_first_of_several_instances(tmp_path):
    first = TWO == 0
    times = np.repeat(TIMES, 2) + np.where(first, 0, 0.005)
    gyro, accel = np.repeat(GYRO, 2, axis=0), np.repeat(ACCEL, 2, axis=0)
    columns = [times * 1e6, TWO, np.where(first[:, None], gyro, gyro + 0.2), accel]
    samples = read_inertial_table(
        write(tmp_path / "imu.csv", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", columns, form="%.12g")
    )
    check(samples)
    assert any("I is not 0" in note for note in samples.notes)


@pytest.mark.parametrize("factor", [16.4, 1000.0])
def test_numbers_that_are_in_no_unit_are_refused(tmp_path, factor):
    columns = [TIMES, np.degrees(GYRO) * factor, ACCEL]
    with pytest.raises(DvoError, match="neither in rad/s nor in deg/s"):
        read_inertial_table(write(tmp_path / "imu.csv", "t,gx,gy,gz,ax,ay,az", columns))


@pytest.mark.parametrize(("unit", "values"), [("rad/s", np.degrees(GYRO)), ("deg/s", GYRO)])
def test_a_stated_unit_that_does_not_fit_is_told(tmp_path, unit, values):
    header = f"t,gx [{unit}],gy [{unit}],gz [{unit}],ax,ay,az"
    notes = read_inertial_table(write(tmp_path / "imu.csv", header, [TIMES, values, ACCEL])).notes
    assert any("stated unit of the gyroscope does not fit" in note for note in notes)


def test_a_line_for_spreadsheets_and_comments_of_another_kind(tmp_path):
    file = write(tmp_path / "imu.csv", "t;gx;gy;gz;ax;ay;az", [TIMES, GYRO, ACCEL], ";")
    file.write_text("sep=;\n// rate: 100 Hz\n" + file.read_text(encoding="utf-8"), encoding="utf-8")
    check(read_inertial_table(file))


def test_a_file_of_all_accelerations_finds_its_gyroscope(tmp_path):
    header = "time,seconds_elapsed,z,y,x"
    for name, values in (("Gyroscope", GYRO), ("TotalAcceleration", ACCEL), ("Accelerometer", ZERO)):
        write(tmp_path / f"{name}.csv", header, [TIMES, TIMES, values[:, ::-1]])
    check(read_inertial_table(tmp_path / "TotalAcceleration.csv"))


def test_linear_acceleration_of_an_application_is_not_that_of_a_message(tmp_path):
    header = [f"{sensor} {axis}" for sensor in ("gyroscope", "linear acceleration") for axis in "xyz"]
    assert columns_of(["t", *header], tmp_path / "all.csv").keys() == {"gyro"}
