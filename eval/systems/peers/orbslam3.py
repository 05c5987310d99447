"""ORB-SLAM3 (Campos et al. 2021) from the package ``pyorbslam3`` (GPL-3).

It is monocular, or takes the right images of rectified stereo pairs or depth images of its frames, and is in metres
then (``--systems orbslam3+sensor=stereo``, ``orbslam3+sensor=rgbd``). With inertial samples (``sensor=imu_monocular``,
``imu_stereo``) it is in metres with z up after its initialisation; poses of a single camera before that have a scale of
their own, and are carried along with their keyframes at the end. It is given the noise that the samples state, else
that of a phone, and stamps as they are. Poses that it predicts from the samples while it is lost are marked as such.

Its threads race: fed faster than the camera delivers, mapping starves. So frames are fed no faster than their stamps
say, and the waiting is inside ``track`` (``info["computing_fps"]`` is the speed without it). A machine that is busy
with other work needs a slower pace: ``orbslam3+pace=0.5`` takes twice the time. Poses are collected frame by frame;
when a map ends, its keyframes, which bundle adjustment has moved since, carry the frames around them along.

It closes loops and merges maps unless it is built with ``loops=False`` (``--systems orbslam3+loops=false``), which sets
``loopClosing: 0`` in its settings file. That turns off its recognition of places as a whole: the thread that closes
loops also fills the database of keyframes from which a lost camera is relocalised. The binding does not tell which
frames a loop joins, so its loops cannot be judged as right or false; ``info["map_changes"]`` has the stamps of the
frames after which a loop, or the global adjustment that follows it, had changed the map.

It ships no vocabulary. ``DVO_ORB_VOCABULARY`` names the file (``python -m eval vocabulary`` trains one),
else the small one beside the test data is taken: figures with either are not those of the official vocabulary.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.output import scratch_folder
from dvo.data.files.root import data_root
from dvo.data.frame import Frame, StereoView
from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.data.trajectory import Trajectory, read_tum
from dvo.geometry.camera import Camera
from dvo.geometry.poses import invert_poses, pose_matrices, poses_from_matrices
from dvo.odometry.protocol import Estimate, Result, ScaleState, Status
from eval.systems.peers.common import Pictures, Row, missing_module, result, version_of

VOCABULARY = "DVO_ORB_VOCABULARY"
FEATURES = 1500
KINECT_BASELINE = 0.08
"""Metres between projector and camera of a Kinect; ORB-SLAM3 makes a virtual right image of a depth image with it."""
CLOSE = 40
"""Number of baselines up to which a point counts as close, with a depth of its own."""
IMU_RATE = 200.0
"""Samples a second by which it turns densities of noise into variances."""
Sensor = Literal["monocular", "stereo", "rgbd", "imu_monocular", "imu_stereo"]
IMU = "imu_"
"""How the names of sensors with inertial samples begin."""
version = version_of("pyorbslam3")


def vocabulary_file() -> Path:
    """Vocabulary that is used: ``$DVO_ORB_VOCABULARY``, else the small one in the data folder.

    Raises:
        DvoError: there is none.
    """
    given = os.environ.get(VOCABULARY)
    path = Path(given or data_root(required=False) / "orb_vocabulary" / "tiny_orb_vocabulary.txt")
    if not path.is_file():
        raise DvoError(
            "no ORB vocabulary",
            file=path,
            field=f"${VOCABULARY}" if given else f"${VOCABULARY} is not set",
            remedy=f"run python -m eval vocabulary --out FILE, then set {VOCABULARY}=FILE",
        )
    return path


def missing() -> str | None:
    """Reasons why it cannot run here, package and vocabulary, or None."""
    reasons = [missing_module("pyorbslam3", "pip install pyorbslam3 (GPL-3; Linux x86-64)")]
    try:
        vocabulary_file()
    except DvoError as error:
        reasons.append(str(error))
    return "; ".join(reason for reason in reasons if reason) or None


class OrbSlam3:
    """See the module. Frames before its initialisation and lost ones have no row; not deterministic (threads).

    A map that is begun after a loss is a segment of its own. The binding does not tell of merged maps, but the
    keyframes of a map tell which earlier ones it has taken in: they are read while it is lost and at the end, their
    frames follow them, and the segments are joined.

    Args:
        loops: closes loops, merges maps and relocalises; see the module.
        pace: seconds of the recording that are fed in a second, at most.
        sensor: of all but ``"monocular"`` the trajectory is in metres.

    Attributes:
        waited: seconds that ``track`` has slept so far.

    Raises:
        DvoError: a pace that is not above 0, another sensor, or (when tracking) frames without what the sensor gives.
    """

    name = "orbslam3"

    def __init__(self, loops: bool = True, pace: float = 1.0, sensor: Sensor = "monocular") -> None:
        import pyorbslam3

        if not pace > 0:
            raise DvoError(f"must be above 0, got {pace}", field="pace", remedy="1 is the pace of the camera")
        if sensor not in get_args(Sensor):
            remedy = f"choose from {', '.join(get_args(Sensor))}"
            raise DvoError(f"no such sensor: {sensor}", field="sensor", remedy=remedy)
        self._sensor: Sensor = sensor
        self._is_inertial, self._is_stereo = sensor.startswith(IMU), sensor.endswith("stereo")
        self._package, self._loops, self._pace = pyorbslam3, loops, pace
        self._vocabulary = vocabulary_file()
        self._scratch = ExitStack()
        self._folder = self._scratch.enter_context(scratch_folder("dvo-orbslam3"))
        self._pictures, self._pictures_right = Pictures(), Pictures()
        self._slam: Any = None
        self._rows: list[Row] = []
        self._predicted: list[float] = []
        self._keyframes: dict[int, Trajectory] = {}
        self._map_changes: list[float] = []
        self._frames = self._part = 0
        self._was_tracking = False
        self._fed = self._stamp = self._computing = self.waited = 0.0

    def track(self, frame: Frame) -> Estimate:
        image = self._pictures(frame)
        if self._slam is None:
            assert self._pictures.camera is not None
            file = self._folder / "settings.yaml"
            baseline = KINECT_BASELINE if self._sensor == "rgbd" else None
            if self._is_stereo:
                baseline = rectified_view(frame).baseline
            samples = _samples(frame) if self._is_inertial else None
            file.write_text(settings(self._pictures.camera, self._loops, baseline, samples), encoding="utf-8")
            sensor = getattr(self._package.Sensor, self._sensor.upper())
            self._slam = self._package.Slam(str(self._vocabulary), str(file), sensor, use_viewer=False)
            self._fed, self._stamp = time.perf_counter(), frame.timestamp
        second = self._second(frame)
        self._frames += 1
        # From frame to frame: after a pause of the machine nothing is made up for.
        due = self._fed + (frame.timestamp - self._stamp) / self._pace
        before = time.perf_counter()
        time.sleep(max(0.0, due - before))
        start = self._fed = time.perf_counter()
        self.waited += start - before
        self._stamp = frame.timestamp
        beside = {"imu": _table(_samples(frame))} if self._is_inertial else {}
        track = getattr(self._slam, f"track_{self._sensor.removeprefix(IMU)}")
        said = track(image, *second, frame.timestamp, **beside)
        self._computing += time.perf_counter() - start
        if self._slam.map_changed():
            self._map_changes.append(frame.timestamp)
        states = self._package.TrackingState
        # Giving a map up and beginning the next one is a single step, after which the old one cannot be read any more.
        if said.state in (states.RECENTLY_LOST, states.LOST):
            self._read_keyframes()
        if said.state in (states.NO_IMAGES_YET, states.NOT_INITIALIZED) and self._was_tracking:
            self._part, self._was_tracking = self._part + 1, False
        scale = ScaleState.NONE
        if self._is_inertial:
            scale = ScaleState.ALIGNED if self._slam.imu_initialized() else ScaleState.INITIALISING
        # While it is RECENTLY_LOST the pose is the guess of the motion model, or of aligned inertial samples.
        is_seen = said.state in (states.OK, states.OK_KLT)
        is_predicted = scale is ScaleState.ALIGNED and said.state == states.RECENTLY_LOST
        if not said.pose_valid or not (is_seen or is_predicted):
            seen = self._was_tracking or self._part > 0
            return Estimate(frame.timestamp, None, Status.LOST if seen else Status.INITIALISING)
        self._was_tracking = True
        T_wc = np.array(said.pose_wc, np.float64)
        self._rows.append(Row(frame.timestamp, T_wc, self._part))
        if not is_seen:
            self._predicted.append(frame.timestamp)
        status = Status.TRACKING if is_seen else Status.INERTIAL
        return Estimate(
            frame.timestamp, poses_from_matrices(T_wc), status, 0.5 * is_seen, self._part, scale_state=scale
        )

    def finish(self) -> Result:
        if self._slam is not None:
            self._slam.shutdown()
            self._read_keyframes()
        rows, keyframes, worlds = place_maps(self._rows, list(self._keyframes.values()))
        self._scratch.close()
        info = {
            **self._pictures.facts(),
            "vocabulary": self._vocabulary.name,
            "vocabulary_words": count_words(self._vocabulary),
            "maps_started": self._part + 1,
            "keyframes": keyframes,
            "place_recognition": self._loops,
            "pace": self._pace,
            "sensor": self._sensor,
            "map_changes": self._map_changes,
            "computing_fps": self._frames / self._computing if self._computing else None,
        }
        return replace(result(rows, self._frames, info, worlds), inertial=tuple(self._predicted))

    def _second(self, frame: Frame) -> tuple[np.ndarray, ...]:
        """Image that the sensor gives beside that of the frame, of the same size: none of a monocular one."""
        if self._sensor.endswith("monocular"):
            return ()
        if self._is_stereo:
            view = rectified_view(frame)
            return (self._pictures_right(replace(frame, image=view.image, camera=view.camera)),)
        assert self._pictures.camera is not None
        if frame.depth is None:
            raise _lacks(frame, "depth")
        size = self._pictures.camera.width, self._pictures.camera.height
        depth = np.nan_to_num(frame.depth, nan=0.0, posinf=0.0, neginf=0.0)
        return (np.ascontiguousarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)),)

    def _read_keyframes(self) -> None:
        """Keep where the keyframes of the present map are."""
        file = self._folder / "keyframes.txt"
        file.unlink(missing_ok=True)
        self._slam.save_keyframe_trajectory_tum(str(file))
        if file.is_file() and file.read_text().strip():
            self._keyframes[self._part] = read_tum(file)


def place_maps(rows: list[Row], maps: Sequence[Trajectory]) -> tuple[list[Row], int, dict[int, int]]:
    """Carry the frames of all maps along with their keyframes.

    Args:
        rows: frames as they were tracked, in order of time.
        maps: keyframes of a map at its end, camera to world, in order of time. Those of frames of several parts stand
            for a map that has taken in others; of a part that is in several maps the last one counts.

    Returns:
        The rows, the number of keyframes found among them, and for each part with keyframes the number of the map in
        whose world it is.
    """
    parts = {part: [row for row in rows if row.part == part] for part in dict.fromkeys(row.part for row in rows)}
    placed, found, worlds = dict(parts), dict.fromkeys(parts, 0), {}
    for number, keyframes in enumerate(maps):
        T_wk = pose_matrices(keyframes.poses_wc)
        for part, mine in parts.items():
            moved, count = follow_keyframes(mine, keyframes.timestamps, T_wk)
            if count:
                placed[part], found[part], worlds[part] = moved, count, number
    return [row for mine in placed.values() for row in mine], sum(found.values()), worlds


def follow_keyframes(rows: list[Row], stamps: np.ndarray, T_wk: np.ndarray) -> tuple[list[Row], int]:
    """Carry frames along with keyframes that moved after they were tracked.

    Args:
        rows: frames as they were tracked, in order of time.
        stamps: ``(K,)`` increasing times of keyframes, seconds.
        T_wk: ``(K, 4, 4)`` where the keyframes are in the end.

    Returns:
        The rows, each moved by what its last keyframe (for the first frames: the first) moved by, and how many of the
        keyframes were found among them.
    """
    times = np.array([row.timestamp for row in rows])
    corrections: list[tuple[float, np.ndarray]] = []
    for stamp, T in zip(stamps, T_wk, strict=True):
        near = int(np.argmin(np.abs(times - stamp)))
        if abs(times[near] - stamp) < 1e-4:
            corrections.append((times[near], T @ np.linalg.inv(rows[near].T_wc)))
    if not corrections:
        return rows, 0
    starts = np.array([time for time, _ in corrections])
    which = np.maximum(np.searchsorted(starts, times, side="right") - 1, 0)
    return [
        Row(row.timestamp, corrections[k][1] @ row.T_wc, row.part) for row, k in zip(rows, which, strict=True)
    ], len(corrections)


def rectified_view(frame: Frame) -> StereoView:
    """Right image of a frame, of a camera that is parallel to its own, with its calibration, on its x axis.

    Args:
        frame: with a right image, both undistorted.

    Raises:
        DvoError: no right image, or another pair.
    """
    view = frame.right
    if view is None:
        raise _lacks(frame, "right")
    aside = np.abs(view.T_left_right[1:6]).max() > 1e-6 or view.T_left_right[0] <= 0
    if aside or view.camera != frame.camera or frame.camera.needs_undistortion:
        remedy = "rectify the images; this peer is given rectified pairs only"
        raise DvoError("not a rectified stereo pair", field=f"frame {frame.index}: right", remedy=remedy)
    return view


def _samples(frame: Frame) -> InertialSamples:
    """Inertial samples of a frame, with the pose of their sensor."""
    if frame.inertial is None or frame.inertial.T_camera_imu is None:
        raise _lacks(frame, "inertial, with the pose of the sensor")
    return frame.inertial


def _table(samples: InertialSamples) -> np.ndarray:
    """``(N, 7)`` rows of stamp, rates and forces."""
    return np.column_stack([samples.timestamps, samples.gyro, samples.accel])


def _lacks(frame: Frame, field: str) -> DvoError:
    return DvoError(
        "not there", field=f"frame {frame.index}: {field}", remedy="choose the sensor that the sequence has"
    )


def settings(
    camera: Camera, loops: bool = True, baseline: float | None = None, samples: InertialSamples | None = None
) -> str:
    """Text of its settings file.

    Args:
        camera: of the images, undistorted.
        loops: recognises places: closes loops, merges maps, relocalises.
        baseline: metres between the cameras of rectified stereo pairs, or of the virtual pair of a depth image; None
            for a single camera.
        samples: some inertial ones, with the pose of their sensor; None for a camera alone.
    """
    lines: dict[str, Any] = {
        "File.version": '"1.0"',
        # Of its type "Rectified" ORB-SLAM3 1.0 prints a second calibration that it has not got, and ends.
        "Camera.type": '"PinHole"',
        **_intrinsics("Camera1", camera),
        "Camera.width": camera.width,
        "Camera.height": camera.height,
        "Camera.fps": 30,
        "Camera.RGB": 1,
        "ORBextractor.nFeatures": FEATURES,
        "ORBextractor.scaleFactor": 1.2,
        "ORBextractor.nLevels": 8,
        "ORBextractor.iniThFAST": 20,
        "ORBextractor.minThFAST": 7,
        "loopClosing": int(loops),
        **({} if baseline is None else _pair(camera, baseline)),
        **({} if samples is None else _sensor(samples)),
        # The viewer is off, but its settings are required.
        **{f"Viewer.{name}": 0.1 for name in ("KeyFrameSize", "GraphLineWidth", "PointSize", "CameraSize")},
        **{f"Viewer.{name}": 1.0 for name in ("KeyFrameLineWidth", "CameraLineWidth", "ViewpointX", "ViewpointY")},
        **{f"Viewer.{name}": 1.0 for name in ("ViewpointZ", "ViewpointF")},
    }
    return "%YAML:1.0\n" + "".join(f"{name}: {value}\n" for name, value in lines.items())


def _intrinsics(name: str, camera: Camera) -> dict[str, float]:
    values = dict(zip(("fx", "fy", "cx", "cy"), camera.intrinsics.tolist(), strict=True))
    return {f"{name}.{key}": value for key, value in {**values, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}.items()}


def _pair(camera: Camera, baseline: float) -> dict[str, Any]:
    """Settings of a rectified pair, and of depth images in metres."""
    T_left_right = f"1.0, 0.0, 0.0, {baseline}, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0"
    return {
        **_intrinsics("Camera2", camera),
        "Stereo.T_c1_c2": f"!!opencv-matrix {{rows: 4, cols: 4, dt: f, data: [{T_left_right}]}}",
        "Stereo.b": baseline,
        "Stereo.ThDepth": float(CLOSE),
        "RGBD.DepthMapFactor": 1.0,
    }


def _sensor(samples: InertialSamples) -> dict[str, Any]:
    """Settings of an inertial sensor."""
    assert samples.T_camera_imu is not None
    T_imu_camera = ", ".join(f"{value:.9f}" for value in pose_matrices(invert_poses(samples.T_camera_imu)).ravel())
    noise = samples.noise or NOISE_PRESETS["phone"]
    return {
        "IMU.T_b_c1": f"!!opencv-matrix {{rows: 4, cols: 4, dt: f, data: [{T_imu_camera}]}}",
        "IMU.NoiseGyro": noise.gyro,
        "IMU.NoiseAcc": noise.accel,
        "IMU.GyroWalk": noise.gyro_walk,
        "IMU.AccWalk": noise.accel_walk,
        "IMU.Frequency": IMU_RATE,
        "IMU.InsertKFsWhenLost": 0,
    }


def count_words(vocabulary: Path) -> int:
    """Leaves of a DBoW2 text vocabulary: the second number of a line is 1 for a word."""
    with vocabulary.open(encoding="utf-8") as file:
        next(file, None)
        return sum(line.split(maxsplit=2)[1] == "1" for line in file if line.strip())
