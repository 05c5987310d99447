"""Telemetry of GoPro: streams written here, and a real video."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data.files.root import data_root
from dvo.data.inertial_files.gopro import gopro_notes, read_gopro, read_gopro_positions
from dvo.data.inertial_files.gpmf import has_telemetry, read_payloads

KARMA = data_root(required=False) / "gopro_karma" / "karma.mp4"
COUNT = {"GYRO": 40, "ACCL": 20}  # samples of a payload of 0.1 s
PAYLOADS = 10


def box(kind: bytes, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack(">I4s", 8 + len(content), kind) + content


def klv(key: str, kind: str, form: str, *values: object, rows: int = 1) -> bytes:
    data = b"".join(struct.pack(f">{form}", *np.atleast_1d(value)) for value in values)
    size = len(data) // max(rows, 1)
    head = struct.pack(">4ssBH", key.encode(), kind.encode() or b"\0", size, rows)
    return head + data + b"\0" * (-len(data) % 4)


def text(key: str, value: str) -> bytes:
    return klv(key, "c", f"{len(value)}s", [value.encode()]) if value else b""


def nest(key: str, *parts: bytes) -> bytes:
    data = b"".join(parts)
    return struct.pack(">4ssBH", key.encode(), b"\0", 1, len(data)) + data


def samples_of(key: str, axes: list[np.ndarray], number: int) -> np.ndarray:
    """Numbers of a payload as the camera writes them, of axes X Y Z of GoPro in the order of the camera."""
    n = COUNT[key]
    t = (number * n + np.arange(n)) / (n * PAYLOADS)
    if key == "GYRO":
        true = np.column_stack([0.5 * np.ones(n), 1.0 * np.ones(n), np.sin(6 * t)])
    else:
        true = np.column_stack([1.0 * np.ones(n), 2.0 * np.ones(n), 9.6 * np.ones(n)])
    return np.stack([true @ axis for axis in axes], axis=1)


AXES = {"X": [1, 0, 0], "Y": [0, 1, 0], "Z": [0, 0, 1], "x": [-1, 0, 0], "y": [0, -1, 0], "z": [0, 0, -1]}


def video(
    file: Path, order: str = "ZXY", *, states: str = "ORIN", stamp: str = "", rate: float = 1.0, gps: bytes = b"",
    drop: bytes = b"", settings: bytes = b"", model: str = "HERO",
) -> Path:  # fmt: skip
    """MP4 file with telemetry alone: a payload each 0.1 s of the container, ``rate`` times as long on the camera's
    clock."""
    payloads = []
    for k in range(PAYLOADS):
        streams = []
        for key in ("ACCL", "GYRO"):
            rows = samples_of(key, [np.array(AXES[c], float) for c in order], k)
            stamps = {"": b"", "TICK": klv("TICK", "L", "I", round(5000 + 100 * k * rate)),
                      "STMP": klv("STMP", "J", "Q", round(5e6 + 1e5 * k * rate))}[stamp]  # fmt: skip
            stated = text("ORIN", order) if states == "ORIN" else b""
            if states == "MTRX":  # numbers in the order X Y Z of the sensor become Z X Y
                turn = np.stack([np.stack([np.array(AXES[c], float) for c in order]) @ np.array(AXES[c], float)
                                 for c in "ZXY"])  # fmt: skip
                stated = klv("MTRX", "f", "9f", turn.ravel())
            values = np.rint(rows * 1000).astype(int)
            streams.append(nest("STRM", stamps, stated, klv("SCAL", "s", "h", 1000),
                                klv(key, "s", "3h", *values, rows=len(values))))  # fmt: skip
        if stamp == "STMP":
            streams.append(nest("STRM", klv("STMP", "J", "Q", round(5.02e6 + 1e5 * k * rate)),
                                klv("SHUT", "f", "f", 0.01, 0.01, 0.01, rows=3)))  # fmt: skip
        streams.append(gps)
        payloads.append(nest("DEVC", klv("DVID", "L", "I", 1), text("DVNM", model), *streams))
    start = len(box(b"ftyp", b"mp41")) + 8
    places = start + np.append(0, np.cumsum([len(p) for p in payloads]))[:-1]
    table = box(b"stbl", box(b"stsd", bytes(12), b"gpmd", bytes(8)),
                box(b"stts", struct.pack(">IIII", 0, 1, PAYLOADS, 100)),
                box(b"stsc", struct.pack(">IIIII", 0, 1, 1, 1, 1)),
                box(b"stsz", struct.pack(f">III{PAYLOADS}I", 0, 0, PAYLOADS, *map(len, payloads))),
                box(b"stco", struct.pack(f">II{PAYLOADS}I", 0, PAYLOADS, *places)))  # fmt: skip
    media = box(b"mdia", box(b"mdhd", struct.pack(">IIIII", 0, 0, 0, 1000, 1000)), box(b"minf", table))
    udta = box(b"udta", box(b"GPMF", nest("DEVC", settings))) if settings else b""
    data = box(b"mdat", *payloads)
    if drop:
        data = data.replace(drop, b"ZZZZ")
    file.write_bytes(box(b"ftyp", b"mp41") + data + box(b"moov", udta, box(b"trak", media)))
    return file


@pytest.mark.parametrize("order", ["ZXY", "YxZ", "zxY", "XzY"])
@pytest.mark.parametrize("states", ["ORIN", "MTRX"])
def test_axes_become_those_of_the_image(tmp_path, order, states):
    samples = read_gopro(video(tmp_path / "a.mp4", order, states=states))
    assert samples.accel.mean(0) == pytest.approx([-1.0, -9.6, -2.0], abs=1e-3)  # right, down, forward
    assert samples.gyro.mean(0)[[0, 2]] == pytest.approx([-0.5, -1.0], abs=1e-3)
    assert samples.gyro[100, 1] == pytest.approx(-np.sin(6 * 100 / 400), abs=2e-3)
    assert samples.T_camera_imu == pytest.approx([0, 0, 0, 0, 0, 0, 1])


@pytest.mark.parametrize(("model", "order"), [("Camera", "ZXY"), ("Hero6 Black", "YxZ"), ("Fusion", "yXZ")])
def test_the_axes_of_models_that_do_not_state_them(tmp_path, model, order):
    samples = read_gopro(video(tmp_path / "a.mp4", order, states="", model=model))
    assert samples.accel.mean(0) == pytest.approx([-1.0, -9.6, -2.0], abs=1e-3) and samples.T_camera_imu is not None
    other = read_gopro(video(tmp_path / "b.mp4", order, states="", model="HERO7 Silver"))
    assert other.T_camera_imu is None and "axes of the sensors of this camera are not known" in other.notes[-1]


@pytest.mark.parametrize("turned", [90, 180])
def test_frames_that_are_turned(tmp_path, turned):
    """A camera that lies on its right side shows down at its left edge, and its frames are turned clockwise."""
    samples = read_gopro(video(tmp_path / "a.mp4"), turned)
    x, y = {90: (0, 1), 180: (-1, 0)}[turned]  # x of the sensor in the turned frame
    assert samples.T_camera_imu is not None
    q = samples.T_camera_imu[3:]
    angle = 2 * np.arctan2(q[2], q[3])
    assert [np.cos(angle), np.sin(angle)] == pytest.approx([x, y], abs=1e-9)


@pytest.mark.parametrize(("stamp", "rate", "first"), [("", 1.0, 0.0), ("TICK", 0.99, 0.0), ("STMP", 0.99, -0.02)])
def test_times_are_those_of_the_clock_of_the_camera(tmp_path, stamp, rate, first):
    samples = read_gopro(video(tmp_path / "a.mp4", stamp=stamp, rate=rate))
    assert samples.timestamps[0] == pytest.approx(first, abs=1e-3)
    assert samples.timestamps[360] - samples.timestamps[0] == pytest.approx(0.9 * rate, abs=1e-3)


def _gps5(fix: int) -> bytes:
    rows = [(450000000 + 900 * k, 70000000, 100000, 1000, 1000) for k in range(4)]
    return nest("STRM", klv("GPSF", "L", "I", fix), klv("GPSP", "S", "H", 250),
                klv("SCAL", "l", "i", 10**7, 10**7, 1000, 1000, 100, rows=5),
                klv("GPS5", "l", "5i", *rows, rows=4))  # fmt: skip


def _gps9() -> bytes:
    data = b"".join(struct.pack(">7i2H", 450000000 + 900 * k, 70000000, 100000, 1, 1, 8000, 5, 250, 3)
                    for k in range(4))  # fmt: skip
    head = struct.pack(">4ssBH", b"GPS9", b"?", 32, 4)
    return nest("STRM", klv("SCAL", "l", "i", 10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1, rows=9), head + data)


@pytest.mark.parametrize("gps", [_gps5(3), _gps9()])
def test_positions(tmp_path, gps):
    found = read_gopro_positions(video(tmp_path / "a.mp4", gps=gps))
    assert found is not None and len(found) == 4 * PAYLOADS
    facts = found.summary()
    assert facts["fix"] == {"3D": 40} and facts["precision"] == pytest.approx(2.5)
    assert found.metres()[3] == pytest.approx([0, 30.02, 0], abs=0.02)  # 0.00027 degrees of latitude
    none = read_gopro_positions(video(tmp_path / "b.mp4", gps=_gps5(0)))
    assert none is not None and none.summary()["with_fix"] == 0 and none.summary()["length"] is None


@pytest.mark.parametrize(("value", "count"), [("HS High", 2), ("N/A", 1)])
def test_settings_are_told(tmp_path, value, count):
    parts = text("MINF", "HERO9 Black") + text("EISA", value) + klv("ZFOV", "f", "f", 88.0)
    notes = gopro_notes(video(tmp_path / "a.mp4", settings=parts))
    assert len(notes) == count and "HERO9 Black: diagonal angle of view, degrees 88" in notes[0]


@pytest.mark.parametrize(("drop", "message"), [(b"GYRO", "no gyroscope"), (b"ACCL", "no accelerometer")])
def test_telemetry_without_a_sensor(tmp_path, drop, message):
    with pytest.raises(DvoError, match=message):
        read_gopro(video(tmp_path / "a.mp4", drop=drop))


@pytest.mark.parametrize("length", [0.5, 0.9])
def test_a_file_that_is_cut_has_no_telemetry(tmp_path, length):
    file = video(tmp_path / "a.mp4")
    assert has_telemetry(file)
    file.write_bytes(file.read_bytes()[: int(length * file.stat().st_size)])
    assert not has_telemetry(file)
    with pytest.raises(DvoError, match="no telemetry"):
        read_gopro(file)


@pytest.mark.parametrize("seed", range(30))
def test_damaged_telemetry_is_one_error(tmp_path, seed):
    """Bytes that are not those of the camera end in samples or one error, whatever they are."""
    random = np.random.default_rng(seed)
    file = video(tmp_path / "a.mp4")
    data = bytearray(file.read_bytes())
    for at in random.integers(20, len(data), 12):
        data[at] = int(random.integers(256))
    file.write_bytes(bytes(data))
    try:
        samples = read_gopro(file)
    except DvoError:
        return
    assert np.isfinite(samples.gyro).all() and (np.diff(samples.timestamps) > 0).all()


@pytest.fixture
def karma() -> Path:
    if not KARMA.is_file():
        pytest.skip("no shared data")
    return KARMA


def test_gravity_points_down_in_the_images_of_a_drone(karma):
    samples = read_gopro(karma)
    assert len(samples) == 4793 and samples.rate == pytest.approx(397.5, abs=0.3)
    level = (samples.timestamps > 4) & (samples.timestamps < 11)  # it has sped up, and flies evenly
    force = samples.accel[level].mean(0)
    assert np.degrees(np.arccos(-force[1] / np.linalg.norm(force))) < 3
    assert np.linalg.norm(force) == pytest.approx(9.7, abs=0.2)
    assert read_gopro_positions(karma) is None and len(read_payloads(karma)) == 13


def test_rotations_of_the_images_are_those_of_the_gyroscope(karma):
    """The drone turns to the right in the last half second: about y, which points down, so that the picture moves to
    the left, at the focal length of its README and the offset of docs/inputs.md."""
    source = dvo.open(karma, guess=True, start="348f")
    frames = list(source)[::2]
    grey = [cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float64) for frame in frames]
    moved = sum(cv2.phaseCorrelate(a, b)[0][0] for a, b in zip(grey, grey[1:], strict=False))
    assert source.inertial is not None
    part = source.inertial.between(frames[0].timestamp - 0.032, frames[-1].timestamp - 0.032)
    turn = part.gyro.sum(0) / part.rate
    assert moved < -50 and moved == pytest.approx(-560 * turn[1], rel=0.1)
    assert turn[1] > 5 * np.abs(turn[[0, 2]]).max()


def test_another_parser_reads_the_same(karma):
    parser = pytest.importorskip("telemetry_parser")
    rows = parser.Parser(str(karma)).normalized_imu()
    samples = read_gopro(karma)
    z, x, y = np.radians([row["gyro"] for row in rows[: len(samples)]]).T
    assert samples.gyro == pytest.approx(np.column_stack([-x, -z, -y]), abs=1e-9)
    assert samples.timestamps == pytest.approx([row["timestamp_ms"] / 1e3 for row in rows[: len(samples)]], abs=2e-3)
