"""Which inertial samples the frames of a source carry."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data.companions.inertial_source import InertialInput, described
from dvo.data.inertial import NOISE_PRESETS
from dvo.data.inertial_files.imu_calibration import ImuCalibration
from dvo.data.readers.euroc import read_inertial

HEADER = "time [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"
NS = 1403636579758555392
DENSITIES = """accelerometer_noise_density: 0.002
accelerometer_random_walk: 0.003
gyroscope_noise_density: 0.0001
gyroscope_random_walk: 0.00002
"""


def table(start: float = 0.0, count: int = 120) -> str:
    rows = (f"{start + k / 100:.6f},{k},0,0,0,9.8,0" for k in range(count))
    return "\n".join([HEADER, *rows]) + "\n"


@pytest.fixture
def video(make) -> Path:
    make.calib()
    return make.video("clip.avi", "MJPG", frames=20, fps=20.0)


def open_(path: Path, **options: object) -> dvo.Source:
    return dvo.open(path, calib="calib.txt", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["clip.csv", "clip_imu.csv", "gyro_accel.csv"])
def test_a_table_beside_a_video_is_found(make, video, name):
    make.text(name, table())
    frames = list(open_(video))
    assert frames[0].inertial is not None and len(frames[0].inertial) == 0
    assert [len(frame.inertial) for frame in frames[1:5]] == [5, 5, 5, 5]
    assert frames[2].inertial.gyro[:, 0].tolist() == [6, 7, 8, 9, 10]


@pytest.mark.parametrize("where", [".", "clip"])
def test_two_tables_beside_a_video_are_found(make, video, where):
    rows = [f"0.1,{k % 2},0,{k * 10**7}" for k in range(120)]
    make.text(f"{where}/clipgyro.csv", "\n".join(rows))
    make.text(f"{where}/clipaccel.csv", "\n".join(f"0,9.8,0,{k * 10**7}" for k in range(120)))
    assert [len(frame.inertial) for frame in open_(video)][:3] == [0, 5, 5]


def test_other_tables_beside_a_video_are_left(make, video):
    make.text("clip.csv", "time,x,y\n0,1,2\n1,2,3\n")
    make.video("other.avi", "MJPG", frames=3)  # to which of two videos imu.csv belongs is not known
    make.text("imu.csv", table())
    source = open_(video)
    assert source.inertial is None and not any("inertial" in note for note in source.warnings)
    assert all(frame.inertial is None for frame in source)


def test_none_gives_none(make, video):
    make.text("clip.csv", table())
    source = open_(video, imu="none")
    assert source.inertial is None and next(iter(source)).inertial is None
    with pytest.raises(DvoError, match="imu_calib: there are no inertial samples"):
        open_(video, imu="none", imu_calib="phone")


@pytest.mark.parametrize(
    ("start", "count", "told"), [(0.0, 50, "cover 49 %"), (0.7, 120, "cover 3. %"), (0.0, 120, "")]
)
def test_samples_of_a_part_of_the_frames_are_told(make, video, start, count, told):
    make.text("other.csv", table(start, count))
    notes = [note for note in open_(video, imu="other.csv").warnings if "cover" in note]
    assert len(notes) == bool(told) and all(re.search(told, note) for note in notes)


def test_a_sensor_that_is_off_is_told(make, video):
    make.text("other.csv", re.sub(r"(?m)^([0-9.]+),[0-9]+,", r"\1,0,", table()))
    notes = [note for note in open_(video, imu="other.csv").warnings if "in all samples" in note]
    assert any(note.startswith("the gyroscope is 0, 0, 0 in all samples") for note in notes)


def euroc(rate: float = 100.0, gyro: float = 0.1, accel: float = 9.8, count: int = 300) -> str:
    """Rows of ``imu0/data.csv`` on a clock that begins at zero, of a sensor that turns about its first axis."""
    rows = []
    for k in range(count):
        angle = np.sin(k / rate)
        force = (0, accel * np.cos(angle), -accel * np.sin(angle))
        rows.append(
            f"{round(k * 1e9 / rate)},{gyro * np.cos(k / rate):.6f},0.01,0.5,{','.join(f'{f:.6f}' for f in force)}"
        )
    return "#timestamp [ns],...\n" + "\n".join(rows) + "\n"


def test_nanoseconds_of_a_clock_that_has_just_begun_are_no_dates(make):
    """Their median, 1.5e9, is a date in seconds."""
    samples = read_inertial(make.text("data.csv", euroc()))
    assert samples.timestamps[-1] == pytest.approx(2.99) and samples.rate == pytest.approx(100)
    dates = read_inertial(
        make.text("data.csv", "\n".join(f"{1_600_000_000_000 + 10 * k},0.1,0,0,0,9.8,0" for k in range(9)))
    )
    assert dates.timestamps[0] == 1.6e9 and dates.rate == pytest.approx(100, rel=1e-3)


def test_decimal_commas_of_euroc_are_refused(make):
    text = "\n".join(row.replace(",", ";").replace(".", ",") for row in euroc().splitlines()[1:])
    with pytest.raises(DvoError, match="decimal commas"):
        read_inertial(make.text("data.csv", text))


REMARKS = {
    "none": ("", "there are no inertial samples"),
    "of a slow logger": (euroc(10.0), "10 inertial samples a second, not 15 to 5000"),
    "without gravity": (euroc(accel=2.0), "the median of the accelerometer is 2 m/s"),
    "of a sensor that is off": (
        re.sub(r"(?m)^([0-9]+),[^,]*,[^,]*,[^,]*", r"\1,0,0,0", euroc()),
        "the gyroscope is 0, 0, 0 in",
    ),
    "in degrees": (euroc(gyro=57.3), "gravity turns 0.017"),
    "of another clock": (euroc(), "from 0.000 to 2.990 s cover 0 % of the frames from 10.000 to 20.000 s"),
    "as they should be": (euroc(gyro=1.0), ""),
}


@pytest.mark.parametrize("case", REMARKS)
def test_samples_of_a_data_set_that_are_of_little_use_are_told(make, case):
    text, told = REMARKS[case]
    file = make.text("data.csv", text)
    span = (10.0, 20.0) if "clock" in case else None
    notes = InertialInput(lambda rough=False: read_inertial(file), ImuCalibration(), span).samples.notes
    assert any(told in note for note in notes) if told else not notes


@pytest.mark.parametrize("start", [100.0, -50.0])
def test_another_clock(make, video, start):
    """A note of what was looked for, an error of what was named; an offset brings both together."""
    make.text("clip.csv", table(start))
    source = open_(video)
    assert source.inertial is None
    assert sum("clip.csv are not used" in note and "do not meet the frames from 0.0" in note
               for note in source.warnings) == 1  # fmt: skip
    with pytest.raises(DvoError, match=f"inertial samples from {start:.6f} to {start + 1.19:.6f} s do not meet"):
        open_(video, imu="clip.csv")
    moved = open_(video, imu="clip.csv", imu_calib=make.text("c.yaml", f"time_offset: {start}\n"))
    assert [len(frame.inertial) for frame in moved][:4] == pytest.approx([0, 5, 5, 5], abs=1)  # rounding at the ends
    assert open_(video, imu_calib=ImuCalibration(time_offset=start)).inertial is not None


@pytest.mark.parametrize(
    ("name", "header"), [("frame_timestamps.txt", "Frame timestamp[nanosec],Unix time[nanosec]\n"),
                         ("clip_timestamps.csv", "")],
)  # fmt: skip
def test_times_of_a_logger_bring_both_clocks_together(make, video, name, header):
    make.text("gyro_accel.csv", table(7000.0))
    stamps = [7_000_000_000_000 + 50_000_000 * k for k in range(20)]
    file = make.text(name, header + "".join(f"{t},{t}\n" if header else f"{t}\n" for t in stamps))
    source = open_(video)
    assert source.inertial is None
    assert sum(f"(is --times {name} on their clock?)" in note for note in source.warnings) == 1
    assert [len(frame.inertial) for frame in open_(video, times=file)][:4] == pytest.approx([0, 5, 5, 5], abs=1)


def test_a_calibration_without_samples_is_refused(video):
    with pytest.raises(DvoError, match="imu_calib: there are no inertial samples"):
        open_(video, imu_calib="phone")
    with pytest.raises(DvoError, match="no such file or folder"):
        open_(video, imu="absent.csv")
    with pytest.raises(DvoError, match="no such file"):
        open_(video, imu_calib="absent.yaml")
    with pytest.raises(DvoError, match="imu_topic: only bags have topics"):
        open_(video, imu="calib.txt", imu_topic="/imu")


@pytest.mark.parametrize("text", ["phone", "imu.yaml,chain.yaml", ["imu.yaml", "chain.yaml:0"]])
def test_calibration_files_beside_the_source(make, video, text):
    make.text("clip.csv", table())
    make.text("imu.yaml", DENSITIES)
    make.text("chain.yaml", f"cam0:\n  T_cam_imu: {np.eye(4).tolist()}\n")
    samples = open_(video, imu_calib=text).inertial
    assert samples is not None and samples.noise is not None
    known = "pose in the camera known" in described(samples)
    assert (samples.noise == NOISE_PRESETS["phone"], known) == ((True, False) if text == "phone" else (False, True))


@pytest.fixture
def mav(make) -> Path:
    stamps = [NS + 50_000_000 * k for k in range(4)]
    make.images("s/mav0/cam0/data", [f"{stamp}.png" for stamp in stamps])
    rows = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
    make.text("s/mav0/cam0/data.csv", f"#timestamp [ns],filename\n{rows}")
    samples = "".join(f"{NS + 5_000_000 * k},{k},0,0,0,0,9.8\n" for k in range(1, 31))
    make.text("s/mav0/imu0/data.csv", f"#t\n{samples}")
    make.text("calib.txt", "50 51 31 23\n")
    return make.root / "s"


@pytest.mark.parametrize("place", ["mav0/imu0/sensor.yaml", "dso/imu_config.yaml"])
def test_the_noise_of_euroc_and_tum_vi(make, mav, place):
    make.text(f"s/{place}", f"sensor_type: imu\nrate_hz: 200\n{DENSITIES}")
    source = dvo.open(mav, calib=make.root / "calib.txt")
    assert source.inertial is not None and source.inertial.noise is not None
    assert source.inertial.noise.gyro == 0.0001
    assert "200 a second, of imu0/data.csv; pose in the camera not known; noise as stated" in described(source.inertial)
    assert [len(frame.inertial) for frame in source] == [0, 10, 10, 10]
    assert [len(frame.inertial) for frame in pickle.loads(pickle.dumps(source))] == [0, 10, 10, 10]
    assert next(iter(dvo.open(mav, calib=make.root / "calib.txt", imu="none"))).inertial is None


@pytest.mark.parametrize(("given", "first"), [(None, -0.015), (0.1, -0.095)])
def test_the_time_shift_of_tum_vi(make, mav, given, first):
    """Of the data set's own camchain, or of the calibration that is named, never both."""
    make.text("s/dso/camchain.yaml", f"cam0:\n  T_cam_imu: {np.eye(4).tolist()}\n  timeshift_cam_imu: 0.02\n"
              "  camera_model: pinhole\n  intrinsics: [50, 50, 31, 23]\n  distortion_model: none\n")  # fmt: skip
    calibration = None if given is None else ImuCalibration(time_offset=given)
    source = dvo.open(mav, calib=make.root / "calib.txt", imu_calib=calibration)
    assert source.inertial is not None
    assert source.inertial.timestamps[0] - NS / 1e9 == pytest.approx(first, abs=1e-6)
    assert source.inertial.T_camera_imu == pytest.approx([0, 0, 0, 0, 0, 0, 1])


def test_a_file_wins_over_that_of_the_data_set(make, mav):
    make.text("other.csv", table(NS / 1e9))
    source = dvo.open(mav, calib=make.root / "calib.txt", imu=make.root / "other.csv")
    assert source.inertial is not None and source.inertial.origin == "other.csv"
    make.text("s/imu0.csv", table(NS / 1e9).replace("9.8", "nan"))
    with pytest.raises(DvoError, match="imu0.csv: accel: no row with three numbers"):
        dvo.open(mav, calib=make.root / "calib.txt", imu="imu0.csv")


@pytest.mark.parametrize("option", [{"imu": "imu.csv"}, {"imu_calib": "phone"}, {"imu_topic": "/imu"}])
def test_a_stream_has_none(option):
    (field,) = option
    with pytest.raises(DvoError, match=f"{field}: not for a stream"):
        dvo.open("webcam:0", **option)
