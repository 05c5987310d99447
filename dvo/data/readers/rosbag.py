"""Bags of ROS 1 (``.bag``) and ROS 2 (folder with ``metadata.yaml``, ``.mcap``, ``.db3``), read by the package rosbags.

Times are the stamps of the headers. The calibration is that of the ``camera_info`` topic beside the image topic; frames
carry the samples of the only ``sensor_msgs/Imu`` topic, or of the chosen one, without the pose of the sensor (no ``tf``
is read).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.calibration.values import from_values
from dvo.data.files.files import is_file, lookups
from dvo.data.files.stamps import checked_rate, read_times
from dvo.data.images.images import few_bits, used_bits
from dvo.data.inertial import InertialSamples
from dvo.data.inertial_files.tidy import joined, tidy
from dvo.data.positions import Positions
from dvo.data.readers.ros_images import decode_message, raw_levels
from dvo.data.recording import EVERYTHING, Log, RawFrame, Reader, Recording, Request, Selection
from dvo.data.trajectory import Trajectory

SUFFIXES = (".bag", ".mcap", ".db3")
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_LOOKED_AT = 5  # images of 16 bits whose largest values are compared
INFO, IMU = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu"


def matches(path: Path) -> bool:
    """True for a file named as a bag is, and for a folder with ``metadata.yaml`` and a ``.db3`` or ``.mcap`` file.

    Args:
        path: existing file or folder.
    """
    if not path.is_dir():
        return path.suffix.lower() in SUFFIXES
    return is_file(path / "metadata.yaml") and any(child.suffix in SUFFIXES for child in path.iterdir())


def split_topic(source: Path | str, topic: str | None) -> tuple[Path, str | None]:
    """Path and topic of ``bag.mcap:/camera/image``.

    Args:
        source: path, with or without a topic.
        topic: given apart.

    Raises:
        DvoError: a topic for what is no bag, or a path that cannot be looked up.
    """
    path, (file, mark, name) = Path(source), str(source).partition(":/")
    with lookups(path):
        if mark and "://" not in str(source) and not path.exists() and Path(file).exists():
            path, topic = Path(file), f"/{name}"
        is_no_bag = topic is not None and path.exists() and not matches(path)
    if is_no_bag:
        raise DvoError("only bags have topics", file=path, field="topic", remedy="leave it out")
    return path, topic


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Reader of rosbags; whatever it raises about a bag becomes one error."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        message = "the package rosbags is not installed"
        raise DvoError(message, file=path, remedy="run pip install 'dvo[ros]'") from error
    try:
        # Bags in SQLite of ROS before Iron do not hold the definitions of their messages.
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except (DvoError, OSError):
        raise
    except Exception as error:  # damaged bags end in errors of many types
        reason = " ".join(str(error).split()) or type(error).__name__
        remedy = "check it with the tools of ROS (ros2 bag info, rosbag info, mcap doctor)"
        raise DvoError(f"cannot be read as a bag ({reason[:200]})", file=path, remedy=remedy) from error


def _seconds(message: Any) -> float:
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


def is_depth(topic: str) -> bool:
    """True for the name of a topic of depth images.

    Args:
        topic: its name.
    """
    return "depth" in topic.lower()


def _choose_topic(path: Path, topics: dict[str, Any], asked: str | None) -> str:
    found = {name: info.msgcount for name, info in topics.items() if info.msgtype in IMAGES and info.msgcount}
    others = {name: count for name, count in found.items() if not is_depth(name)}
    if asked is None and others:
        found = others
    listed = ", ".join(f"{name} ({count})" for name, count in sorted(found.items())) or "none"
    if asked is not None:
        asked = f"/{asked.lstrip('/')}"
        if asked not in found:
            message = f"{asked[:80]} is no topic of images; those are: {listed}"
            raise DvoError(message, file=path, field="topic", remedy="give one of them")
        return asked
    if not found:
        raise DvoError("no images in this bag", file=path, remedy="record sensor_msgs/Image or CompressedImage")
    if len(found) > 1:
        message = f"several topics of images: {listed}"
        raise DvoError(message, file=path, field="topic", remedy="give one with --topic")
    return next(iter(found))


class BagRecording:
    """Images of one topic.

    Raises:
        DvoError: rosbags is not there, the bag cannot be read, or its topic of images is not clear.
    """

    kind = "rosbag"
    timestamps: np.ndarray | None = None
    images: list[Path] | None = None
    turned = 0
    groundtruth: Trajectory | None = None
    stereo: Callable[[], StereoRig | None] | None = None
    positions: Callable[[], Positions | None] | None = None

    def __init__(self, path: Path, request: Request) -> None:
        self.path, self.name = path, path.resolve().stem
        self.warnings: list[str] = []
        self._fps = checked_rate(request.fps)
        with _opened(path) as reader:
            topics = reader.topics
            self.topic = _choose_topic(path, topics, request.topic)
            self.frame_count: int | None = topics[self.topic].msgcount
            self.image_topics = {
                n: info.msgcount for n, info in topics.items() if info.msgtype in IMAGES and info.msgcount
            }
            seconds = (reader.end_time - reader.start_time) / 1e9
            self.reach = max(0.5 * seconds / max(topics[self.topic].msgcount, 1), 1e-3)
            self._times = (
                read_times(request.times, self.frame_count, self.warnings) if request.times is not None else None
            )
            self._bits = self._used_bits(reader)
            beside = sorted(name for name in self.image_topics if is_depth(name) and name != self.topic)
            if beside:
                self.warnings.append(f"reading {self.topic}; depth is beside it for --depth: {', '.join(beside)}")
            first = _first(reader, self.topic)
            self._stamped = first is not None and _seconds(first) > 0
            self.calibration: Calibration | None = None
            if request.calibration is None:
                self.calibration = self._read_calibration(reader, topics)
            imu = [name for name, info in topics.items() if info.msgtype == IMU and info.msgcount]
        has_clock = self._times is None and self._fps is None and self._stamped
        if not self._stamped and self._times is None and self._fps is None:
            self.warnings.append(f"headers of {self.topic} have no stamps: times of recording are used")
        self.imu_topics = sorted(imu)
        chosen = imu_topic_of(path, self.imu_topics, request.imu_topic)
        if len(imu) > 1 and chosen is None:
            listed = ", ".join(self.imu_topics)
            self.warnings.append(f"several topics of inertial samples, none is used: {listed} (give --imu-topic)")
        if chosen is not None and not has_clock:
            self.warnings.append(f"inertial samples of {chosen} are not used: the images have no times on their clock")
        self.inertial: Callable[[], InertialSamples] | None = (
            partial(read_inertial, path, chosen) if has_clock and chosen is not None else None
        )

    def _used_bits(self, reader: Any) -> int:
        """Bits that images of 16 bits use, by the first ones."""
        some = islice(_messages(reader, self.topic), _LOOKED_AT)
        messages = (reader.deserialize(data, connection.msgtype) for connection, _, data in some)
        bits = used_bits(raw_levels(message, str(self.path)) for message in messages)
        if bits < 16:
            self.warnings.append(few_bits(bits))
        return bits

    def messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Messages of a topic in the order of recording.

        Args:
            topic: of the bag.

        Yields:
            Seconds of the header, or of recording where the images are timed by it, and the message.
        """
        with _opened(self.path) as reader:
            for connection, recorded, data in _messages(reader, topic):
                message = reader.deserialize(data, connection.msgtype)
                yield (_seconds(message) if self._stamped else recorded / 1e9), message

    def camera_info(self, topic: str) -> Any:
        """Message of the ``camera_info`` topic in the namespace of a topic of images.

        Args:
            topic: of images.

        Returns:
            The first message; None if there is none.
        """
        name = _info_topic(topic)
        with _opened(self.path) as reader:
            return _first(reader, name) if name in reader.topics and reader.topics[name].msgtype == INFO else None

    def stamp(self, index: int, timestamp: float) -> float | None:
        """Seconds of the clock of the bag of a frame.

        Args:
            index: of the frame.
            timestamp: that it has.

        Returns:
            None if the user gave the times or a rate: frames of other topics then belong to them by order.
        """
        return timestamp if self._times is None and self._fps is None else None

    def _read_calibration(self, reader: Any, topics: dict[str, Any]) -> Calibration | None:
        """Calibration of the ``camera_info`` topic in the namespace of the images, if there is one."""
        parts, name = self.topic.removesuffix("/compressed").split("/"), _info_topic(self.topic)
        info = _first(reader, name) if name in topics and topics[name].msgtype == INFO else None
        if info is None:
            return None
        try:
            return calibration_of_info(info, parts[-1], self.path)
        except DvoError as error:
            self.warnings.append(
                f"{name} {error.message}" if error.field == "K" else f"{name} was not used: {error.message}"
            )
            return None

    def frames(self, log: Log, selection: Selection = EVERYTHING) -> Iterator[RawFrame]:
        """See :class:`dvo.data.recording.Recording`; messages passed over by the stride are not decoded."""
        previous, late = -np.inf, False
        with _opened(self.path) as reader:
            numbered = ((index, *item) for index, item in enumerate(_messages(reader, self.topic)))

            def time(item: tuple[int, Any, int, bytes]) -> float:
                index, connection, recorded, data = item
                return self._time(index, reader.deserialize(data, connection.msgtype), recorded)

            for index, connection, recorded, data in selection.interval.select(
                numbered, time, selection.stride, self.path
            ):
                message = reader.deserialize(data, connection.msgtype)
                timestamp = self._time(index, message, recorded)
                if not timestamp > previous:
                    if not late:
                        log.notes.append(f"from image {index} on, images not later than the one before were dropped")
                    late = True
                    continue
                origin = f"{self.path} {self.topic} image {index}"
                image = decode_message(message, origin, self._bits)
                if image is None:
                    log.unreadable.append(f"image {index}")
                    continue
                previous = timestamp
                image = image if selection.reduction is None else selection.reduction(image)
                yield RawFrame(index, timestamp, image, origin)

    def _time(self, index: int, message: Any, recorded: int) -> float:
        if self._times is not None:
            return float(self._times[index])
        if self._fps is not None:
            return index / self._fps
        return _seconds(message) if self._stamped else recorded / 1e9


def _info_topic(topic: str) -> str:
    parts = topic.removesuffix("/compressed").removesuffix("/compressedDepth").split("/")
    return "/".join([*parts[:-1], "camera_info"])


def info_matrices(info: Any) -> dict[str, np.ndarray]:
    """Matrices K, D, R and P of a ``camera_info`` message of ROS 1 or 2.

    Args:
        info: deserialised.

    Returns:
        Name in capitals to float64 numbers: 9, any number, 9 and 12.
    """
    return {key: np.asarray(getattr(info, key if hasattr(info, "K") else key.lower()), np.float64) for key in "KDRP"}


def calibration_of_info(info: Any, image: str, path: Path) -> Calibration:
    """Calibration of a ``camera_info`` message.

    Args:
        info: deserialised.
        image: last part of the name of the topic of images: rectified ones have the projection.
        path: of the bag, for messages.

    Raises:
        DvoError: a camera that is not calibrated (``field`` K), or a model that is not known.
    """
    matrices = info_matrices(info)
    k, d, p = (matrices[key].tolist() for key in "KDP")
    values: dict[str, Any] = {"camera_matrix": k, "distortion_model": info.distortion_model, "D": d}
    if "rect" in image:
        values = {"camera_matrix": [*p[0:3], *p[4:7], *p[8:11]]}
    if not min(values["camera_matrix"][0], values["camera_matrix"][4]) > 0:
        raise DvoError("is not calibrated", file=path, field="K", remedy="give a calibration with --calib")
    size = {key: getattr(info, key) for key in ("width", "height") if getattr(info, key)}
    roi = getattr(info, "roi", None)
    region = {key: getattr(roi, key, 0) for key in ("x_offset", "y_offset", "width", "height")}
    binning = {key: getattr(info, key, 0) for key in ("binning_x", "binning_y")}
    return from_values({**values, **(size if len(size) == 2 else {}), **binning, "roi": region}, path)


def _messages(reader: Any, topic: str) -> Iterator[tuple[Any, int, bytes]]:
    return reader.messages([connection for connection in reader.connections if connection.topic == topic])


def _first(reader: Any, topic: str) -> Any:
    for connection, _, data in _messages(reader, topic):
        return reader.deserialize(data, connection.msgtype)
    return None


def imu_topic_of(path: Path, topics: Sequence[str], asked: str | None) -> str | None:
    """Topic of inertial samples, or two of them: RealSense has one for the gyroscope and one for the accelerometer.

    Args:
        path: of the bag, for messages.
        topics: of type ``sensor_msgs/Imu`` that have messages.
        asked: by the user; two names apart by a comma; None for the only one.

    Returns:
        The name, or two apart by a comma, that of the gyroscope first; None if there is none, or if it is not clear.

    Raises:
        DvoError: no such topic.
    """
    if asked is not None:
        names = [f"/{name.strip().lstrip('/')}" for name in asked.split(",")]
        unknown = next((name for name in names if name not in topics), None)
        if unknown is not None or len(names) > 2:
            message = f"{str(unknown or asked)[:80]} is no topic of inertial samples"
            remedy = f"give one of {', '.join(topics) or 'none, there are none'}"
            raise DvoError(message, file=path, field="imu_topic", remedy=remedy)
        return ",".join(names)
    if len(topics) == 2:
        gyro, accel = ([name for name in topics if word in name.lower()] for word in ("gyro", "accel"))
        if len(gyro) == len(accel) == 1 and gyro != accel:
            return f"{gyro[0]},{accel[0]}"
    return topics[0] if len(topics) == 1 else None


def read_inertial(path: Path, topic: str | None = None, *, rough: bool = False) -> InertialSamples:
    """Read all samples of a topic.

    Args:
        path: of the bag.
        topic: of type ``sensor_msgs/Imu``, rad/s and m/s^2; two apart by a comma, that of the gyroscope first; None for
            the only one.
        rough: in the order of the bag, for a check, see :func:`dvo.data.inertial_files.tidy.tidy`.

    Raises:
        DvoError: the bag cannot be read, the topic is not clear, or see :func:`dvo.data.inertial_files.tidy.tidy`.
    """
    with _opened(path) as reader:
        there = sorted(name for name, info in reader.topics.items() if info.msgtype == IMU and info.msgcount)
        topic = imu_topic_of(path, there, topic)
        if topic is None:
            message = f"the topic of inertial samples is not clear; there are {', '.join(there) or 'none'}"
            raise DvoError(message, file=path, field="imu_topic", remedy="give one with --imu-topic")
        tables = [_imu_rows(reader, name) for name in topic.split(",")]
    origin = f"topic {topic.replace(',', ' and ')}"
    if len(tables) == 1:
        return tidy(tables[0][:, 0], tables[0][:, 1:4], tables[0][:, 4:], path, origin, rough=rough)
    gyro, accel = tables
    return joined(gyro[:, 0], gyro[:, 1:4], accel[:, 0], accel[:, 4:], path, origin, rough=rough)


def _imu_rows(reader: Any, topic: str) -> np.ndarray:
    """``(K, 7)`` float64 seconds, gyroscope and accelerometer."""
    rows = []
    for connection, _, data in _messages(reader, topic):
        message = reader.deserialize(data, connection.msgtype)
        gyro, accel = message.angular_velocity, message.linear_acceleration
        rows.append([_seconds(message), gyro.x, gyro.y, gyro.z, accel.x, accel.y, accel.z])
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def open_rosbag(path: Path, request: Request) -> Recording:
    """Open a bag.

    Args:
        path: file or folder.
        request: options of the user.

    Raises:
        DvoError: see :class:`BagRecording`.
    """
    return BagRecording(path, request)


READER = Reader("rosbag", matches, open_rosbag)
