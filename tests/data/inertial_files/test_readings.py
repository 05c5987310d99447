"""Tables and lists with a row for each reading of a sensor, Sensor Logger's exports, and times that are dates."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.files.clock import parse_date
from dvo.data.inertial_files.readings import kind_of
from dvo.data.inertial_files.tables import read_inertial_table
from tests.support.inertial_tables import ACCEL, COUNT, GYRO, NS, TIMES, check

START = 1.6e9
DOWN = np.array([0.3, 9.6, 1.7])  # gravity, as an application takes it off


def cells(*values: object) -> str:
    return ",".join(map(str, values))


def long(tmp_path: Path, header: str, sensors: dict[str, np.ndarray], row: Callable[..., str]) -> Path:
    rows = [row(name, k, *values[k].tolist()) for k in range(COUNT) for name, values in sensors.items()]
    (tmp_path / "log.csv").write_text("\n".join([header, *rows]) + "\n")
    return tmp_path / "log.csv"


OTHERS = {"magnetometer": GYRO + 30, "light": GYRO}
LONG = {
    "plain": ("sensor,time,x,y,z", {"gyroscope": GYRO, "accelerometer": ACCEL, **OTHERS},
              lambda name, k, *xyz: cells(name, NS[k], *xyz)),
    "short names, the sensor last": ("time [ns];x;y;z;type", {"GYR": GYRO, "ACC": ACCEL, **OTHERS},
                                     lambda name, k, *xyz: cells(NS[k], *xyz, name).replace(",", ";")),
    "names of Android": ("timestamp_ns,sensor_name,accuracy,value_x,value_y,value_z",
                         {"android.sensor.gyroscope": GYRO, "android.sensor.accelerometer": ACCEL,
                          "android.sensor.linear_acceleration": ACCEL - DOWN,
                          "android.sensor.gravity": 0 * ACCEL + DOWN},
                         lambda name, k, *xyz: cells(NS[k], name, 3, *xyz)),
    "units in a column": ("name,time,x,y,z,unit", {"gyro": np.degrees(GYRO), "acc": ACCEL},
                          lambda name, k, *xyz: cells(name, NS[k], *xyz, "deg/s" if name == "gyro" else "m/s^2")),
    "linear acceleration and gravity": ("sensor,time,x,y,z", {"gyroscope": GYRO, "gravity": 0 * ACCEL + DOWN,
                                                              "linear_acceleration": ACCEL - DOWN},
                                        lambda name, k, *xyz: cells(name, NS[k], *xyz)),
    "dates": ("sensor,time,x,y,z", {"gyroscope": GYRO, "accelerometer": ACCEL},
              lambda name, k, *xyz: cells(name, date(k).isoformat(), *xyz)),
}  # fmt: skip


def date(k: int) -> datetime:
    return datetime.fromtimestamp(START, UTC) + timedelta(seconds=k / 100)


@pytest.mark.parametrize("case", LONG)
def test_a_row_for_each_reading(tmp_path, case):
    check(read_inertial_table(long(tmp_path, *LONG[case])), START)


def test_the_sensor_that_is_meant_comes_first_and_the_others_are_told(tmp_path):
    sensors = {"watch gyroscope": 2 * GYRO, "gyroscope_uncalibrated": GYRO + 0.1, "gyroscope": GYRO,
               "accelerometer_uncalibrated": 1.1 * ACCEL, "accelerometer": ACCEL}  # fmt: skip
    samples = read_inertial_table(long(tmp_path, "sensor,time,x,y,z", sensors, LONG["plain"][2]))
    check(samples, START)
    told = "gyroscope is taken for the gyroscope, not gyroscope_uncalibrated, watch gyroscope"
    assert any(told in note for note in samples.notes)
    assert len(set(samples.notes)) == len(samples.notes)


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ({"gyroscope": GYRO, "light": GYRO}, "sensor: no readings of the accelerometer, but of gyroscope. Give"),
        ({"accelerometer": ACCEL}, "sensor: no readings of the gyroscope, but of accelerometer"),
        ({"gyroscope": GYRO, "linear acceleration": ACCEL}, "accel: gravity was removed from linear acceleration"),
        ({"1": ACCEL, "4": GYRO}, "header: no columns of a gyroscope or an accelerometer"),
    ],
)
def test_sensors_that_are_not_there(tmp_path, sensors, message):
    with pytest.raises(DvoError, match=message):
        read_inertial_table(long(tmp_path, "sensor,time,x,y,z", sensors, LONG["plain"][2]))


def there(k: int, hours: float) -> datetime:
    return date(k).astimezone(timezone(timedelta(hours=hours)))


def test_a_unit_that_changes_is_refused(tmp_path):
    def row(name: str, k: int, *xyz: float) -> str:
        return cells(name, NS[k], *xyz, "rad/s" if name == "gyro" else ("g", "mg")[k % 2])

    file = long(tmp_path, "name,time,x,y,z,unit", {"gyro": GYRO, "acc": ACCEL}, row)
    with pytest.raises(DvoError, match="accel: the unit g,mg is not known. Name one of m/s"):
        read_inertial_table(file)


DATES = {
    "UTC": lambda k: date(k).isoformat().replace("+00:00", "Z"),
    "none": lambda k: date(k).strftime("%Y-%m-%d %H:%M:%S.%f"),
    "New York": lambda k: there(k, -4).isoformat(),
    "as SensorLog": lambda k: there(k, 5.5).strftime("%Y-%m-%d %H:%M:%S.%f %z"),
    "as SensorLog, west": lambda k: there(k, -3).strftime("%Y-%m-%d %H:%M:%S.%f %z"),
}  # fmt: skip


@pytest.mark.parametrize("case", DATES)
def test_times_that_are_dates(tmp_path, case):
    rows = [cells(DATES[case](k), *GYRO[k].tolist(), *ACCEL[k].tolist()) for k in range(COUNT)]
    (tmp_path / "imu.csv").write_text("\n".join(["timestamp,gx,gy,gz,ax,ay,az", *rows]))
    check(read_inertial_table(tmp_path / "imu.csv"), START)


def test_dates_of_the_day_alone_are_refused(tmp_path):
    rows = [cells("2024-05-01", f"12:00:{t:06.3f}", *GYRO[0].tolist(), *ACCEL[0].tolist()) for t in TIMES.tolist()]
    (tmp_path / "imu.csv").write_text("\n".join(["date,time,gx,gy,gz,ax,ay,az", *rows]))
    with pytest.raises(DvoError, match="neither numbers nor dates, such as 2024-05-01.*2024-05-01T12:00:00.123Z"):
        read_inertial_table(tmp_path / "imu.csv")


def test_numbers_of_images_behind_a_date_are_no_hours():
    assert parse_date("2024-05-01_12-00-00-0001") == parse_date("2024-05-01 12:00:00")
    assert parse_date("2024-05-01T12:00:00.5+02:00") == parse_date("2024-05-01T10:00:00.5Z")


def logged(sign: int = 1, **sensors: np.ndarray) -> list[dict[str, str]]:
    """Entries as Sensor Logger writes them, all of one sensor before the next."""
    return [
        {"sensor": name, "time": str(NS[k]), "seconds_elapsed": str(k / 100), "z": str(z), "y": str(y), "x": str(x)}
        for name, values in ({"Gyroscope": GYRO} | {name: sign * values for name, values in sensors.items()}).items()
        for k, (x, y, z) in enumerate(values.tolist())
    ]


def about(platform: str, standard: str = "false") -> list[dict[str, str]]:
    return [{"sensor": "Metadata", "version": "3", "platform": platform, "standardisation": standard}]


LOCATION = [{"sensor": "Location", "time": str(NS[0]), "seconds_elapsed": "0.1", "speed": "0", "latitude": "0.0"}]
USER, GRAVITY = ACCEL - DOWN, 0 * ACCEL + DOWN
EXPORTS = {
    "android": about("android") + logged(TotalAcceleration=ACCEL, Accelerometer=USER, Gravity=GRAVITY) + LOCATION,
    "android, uncalibrated": about("android") + logged(Accelerometer=USER, AccelerometerUncalibrated=ACCEL),
    "iphone": about("ios") + logged(-1, Accelerometer=USER, Gravity=GRAVITY),
    "iphone, standardised": about("ios", "true") + logged(Accelerometer=USER, Gravity=GRAVITY),
    "iphone, uncalibrated": about("ios") + logged(-1, AccelerometerUncalibrated=ACCEL / 9.80665, Accelerometer=USER),
    "not stated": logged(Accelerometer=USER, Gravity=GRAVITY),
    "numbers, small letters": [{**entry, "sensor": entry["sensor"].lower(), "time": int(entry["time"]),
                                "x": float(entry["x"])} for entry in logged(TotalAcceleration=ACCEL)],
}  # fmt: skip


@pytest.mark.parametrize("case", EXPORTS)
def test_sensor_logger_as_json(tmp_path, case):
    (tmp_path / "log.json").write_text(json.dumps(EXPORTS[case], indent=1))
    samples = read_inertial_table(tmp_path / "log.json")
    check(samples, START)
    told = [text for text in ("Apple's", "sum of Accelerometer and Gravity", "no platform is stated")
            if any(text in note for note in samples.notes)]  # fmt: skip
    assert told == {"iphone": ["Apple's", "sum of Accelerometer and Gravity"], "iphone, uncalibrated": ["Apple's"],
                    "iphone, standardised": ["sum of Accelerometer and Gravity"],
                    "numbers, small letters": ["no platform is stated"],
                    "not stated": ["sum of Accelerometer and Gravity", "no platform is stated"],
                    }.get(case, [])  # fmt: skip


@pytest.mark.parametrize("given", ["", "Gyroscope.csv", "Accelerometer.csv"])
def test_files_of_an_iphone(tmp_path, given):
    """No acceleration with gravity, and Apple's sign."""
    entries = EXPORTS["iphone"]
    for name in ("Gyroscope", "Accelerometer", "Gravity"):
        rows = [entry for entry in entries if entry["sensor"] == name]
        text = [cells(*(entry[column] for column in ("time", "seconds_elapsed", "z", "y", "x"))) for entry in rows]
        (tmp_path / f"{name}.csv").write_text("\n".join(["time,seconds_elapsed,z,y,x", *text]) + "\n")
    (tmp_path / "Metadata.csv").write_text('version,device name,platform,standardisation\n3,"a, b",ios,false\n')
    samples = read_inertial_table(tmp_path / given if given else tmp_path)
    check(samples, START)
    assert any("Apple's" in note for note in samples.notes) and any("sum of" in note for note in samples.notes)
    (tmp_path / "Gravity.csv").unlink()
    with pytest.raises(DvoError, match="accel: gravity was removed from Accelerometer"):
        read_inertial_table(tmp_path / "Gyroscope.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[{"sensor": "Gyroscope", "time"', r"imu: no whole JSON \(line 1: "),
        ('{"payload": []}', "imu: no list of readings"),
        ("[1, 2]", "imu: no list of readings"),
        ("[" * 100_000, "imu: no whole JSON"),
        (json.dumps(LOCATION), "sensor: no readings of a gyroscope or an accelerometer"),
        (json.dumps([{"sensor": "Gyroscope", "time": "1", "value": [1, 2, 3]}]), "sensor: no readings of a gyroscope"),
        (json.dumps(logged()), "sensor: no readings of the accelerometer, but of Gyroscope"),
        (json.dumps(logged(Accelerometer=USER)), "accel: gravity was removed from Accelerometer"),
    ],
)
def test_json_that_is_not_clear(tmp_path, text, message):
    (tmp_path / "log.json").write_text(text)
    with pytest.raises(DvoError, match=message):
        read_inertial_table(tmp_path / "log.json")


def test_kinds_of_sensors():
    kinds = {"TYPE_GYROSCOPE": "gyro", "rotationRate": "gyro", "UncalAccel": "accel", "userAcceleration": "linear",
             "LINEAR_ACCELERATION": "linear", "Gravity": "gravity", "accuracy": "", "magnetic_field": "",
             "game_rotation_vector": ""}  # fmt: skip
    assert {name: kind_of(name) for name in kinds} == kinds
    assert (
        kind_of("Accelerometer", is_logger=True) == "linear" and kind_of("TotalAcceleration", is_logger=True) == "accel"
    )
