"""Interface of a streaming visual odometry, and the types of its output.

The learned tracker and every classical baseline implement :class:`Odometry`. The command line, the evaluation and the
plots use this interface alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from dvo.data.frame import Frame, Lazy, LazyNumber
from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import pose_matrices
from dvo.odometry.quality import Quality


class Status(StrEnum):
    """State of the tracker after a frame; a string, so that ``status == "tracking"`` works.

    Attributes:
        INITIALISING: ``initialising``, the camera has not moved enough for a first pose.
        TRACKING: ``tracking``, the frame has a pose that its image supports.
        LOST: ``lost``, the image supports no pose. The result may have one all the same, if a later frame helps.
        INERTIAL: ``inertial``, the image supports no pose, and inertial samples alone predict it.
    """

    INITIALISING = "initialising"
    TRACKING = "tracking"
    LOST = "lost"  # the result may have a pose all the same (:mod:`dvo.odometry.patch.retry`)
    INERTIAL = "inertial"  # the images give no pose: it is predicted from inertial samples alone


class ScaleState(StrEnum):
    """What inertial samples have told of scale and vertical."""

    NONE = "none"  # there are no samples, or they are not used
    INITIALISING = "initialising"  # poses are as without samples; or in metres, and their scale is in doubt for now
    ALIGNED = "aligned"  # poses are in metres, and z points up
    REFINED = "refined"  # for long enough that the scale changes little


@dataclass(frozen=True)
class InertialEstimate:
    """What is known beside a pose in metres, from inertial samples.

    Attributes:
        velocity_w: ``(3,)`` of the sensor in the world, m/s.
        gyro_bias, accel_bias: ``(3,)`` rad/s and m/s^2.
        scale_sigma: standard deviation of the scale, relative.
        covariance: ``(9, 9)`` of the errors of position in the world (m) and orientation (right tangent, rad) of the
            camera, and of the velocity (m/s), where heading and position of the pose at the alignment are held.
        time_offset: seconds by which the stamps of the samples are late.
    """

    velocity_w: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    scale_sigma: float
    covariance: np.ndarray
    time_offset: float = 0.0


@dataclass(frozen=True)
class Estimate:
    """Estimate for one frame, available right after it.

    Attributes:
        timestamp: seconds, of the frame.
        pose_wc: ``(7,)`` float64 camera to world ``T_wc`` (x y z, quaternion x y z w), or None while there is none:
            never with the status ``lost``, always with ``tracking`` and ``inertial``.
        status: state of the tracker.
        confidence: in [0, 1], 0 without a pose. Of the patch tracker, the probability that the error of the pose
            relative to the reference displaces the scene by less than half a pixel of an image of 320x240, in the RMS
            over the image (:func:`dvo.odometry.uncertainty.displacement.confidence_of`): comparable between runs. Of
            other odometries comparable within one run only.
        segment: number of the segment that the pose belongs to, from 0. Poses of two segments have different worlds and
            different scales.
        reason: cause of the status ``lost``, such as ``"black image"``, or what an odometry that is ``initialising``
            waits for, such as ``"too little motion"``; empty otherwise.
        recovered: the first pose after the segment was joined to an earlier world (of an earlier segment, or of a map):
            this pose and those after it are in that world and scale, earlier ones of the segment were not.
        covariance: ``(6, 6)`` float64 of the error ``xi`` of ``pose_wc`` relative to the pose of the reference, which
            is held fixed, as is the scale of the segment (:mod:`dvo.odometry.uncertainty.uncertainty`). ``xi = [tau,
            phi]`` is a right tangent, in the coordinates of this camera: ``T_wc_true = T_wc Exp(xi)``, ``tau`` in units
            of the segment, ``phi`` in radians. (The left tangent of ``T_cw`` is ``-xi``, with the same covariance; that
            of ``T_wc`` has the covariance ``A C A^T`` with ``A = se3.adjoint(pose_wc)``.) Where the measurements fit
            two motions about as well, it contains both (:mod:`dvo.odometry.uncertainty.second_solution`). None without
            a pose, where the measurements do not determine it, and from odometries that have none.
        reference: timestamp of the reference, seconds: the oldest keyframe of the window that a measurement still
            reaches; None without one. Of the status ``inertial``, the last frame with a pose by its image.
        scale_state: of the pose, where inertial samples are used.
        inertial: velocity, biases and more, of a pose in metres by samples.

    ``confidence``, ``covariance`` and ``reference`` may be functions, which are called when the value is first read.

    Example:
        >>> estimate = dvo.Estimate(0.5, np.array([1.0, 2, 3, 0, 0, 0, 1]), dvo.Status.TRACKING)
        >>> estimate
        Estimate(0.500 s, tracking, x y z [1. 2. 3.])
        >>> estimate.matrix[:3, 3].tolist(), estimate.covariance
        ([1.0, 2.0, 3.0], None)
    """

    timestamp: float
    pose_wc: np.ndarray | None
    status: Status
    confidence: LazyNumber = LazyNumber(0.0)  # noqa: RUF009 (a descriptor)
    segment: int = 0
    reason: str = ""
    recovered: bool = False
    covariance: Lazy[np.ndarray] = Lazy()  # noqa: RUF009
    reference: Lazy[float] = Lazy()  # noqa: RUF009
    scale_state: ScaleState = ScaleState.NONE
    inertial: InertialEstimate | None = None

    @property
    def matrix(self) -> np.ndarray | None:
        """``(4, 4)`` float64 camera to world, the pose as a matrix; None without one."""
        return None if self.pose_wc is None else pose_matrices(self.pose_wc)

    @property
    def position_sigma(self) -> float | None:
        """Standard deviation of the position relative to the reference, units of the segment: root of the trace."""
        covariance = self.covariance
        return None if covariance is None else float(np.sqrt(np.trace(covariance[:3, :3])))

    @property
    def rotation_sigma(self) -> float | None:
        """Standard deviation of the rotation relative to the reference, degrees: root of the trace."""
        covariance = self.covariance
        return None if covariance is None else float(np.rad2deg(np.sqrt(np.trace(covariance[3:, 3:]))))

    def __repr__(self) -> str:
        where = self.reason if self.pose_wc is None else f"x y z {np.array2string(self.pose_wc[:3], precision=3)}"
        rest = "".join(f", {part}" for part in (where, f"segment {self.segment}" if self.segment else "") if part)
        return f"Estimate({self.timestamp:.3f} s, {self.status}{rest})"

    def __getstate__(self) -> dict[str, Any]:
        """State for pickling and copying: values in place of functions that would give them."""
        _ = self.confidence, self.covariance, self.reference
        return self.__dict__


@dataclass(frozen=True)
class SparseMap:
    """Coloured points in the world frame of the trajectory.

    Attributes:
        points: ``(M, 3)`` float32, in the unit of the trajectory.
        colors: ``(M, 3)`` uint8 RGB.
    """

    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))


@dataclass(frozen=True)
class DepthMap:
    """Depth of the pixels of a keyframe.

    Attributes:
        timestamp: seconds, of the keyframe.
        segment: number of the segment whose world and scale it has.
        pose_wc: ``(7,)`` float64 camera to world.
        intrinsics: ``(4,)`` float32 fx fy cx cy in pixels of the map.
        depth: ``(h, w)`` float32 along the optical axis, in the scale of the segment.
        confidence: ``(h, w)`` float32 in [0, 1]; comparable within one run only.
        reliable: ``(h, w)`` bool, depths that are confident and agree with those of neighbouring keyframes.
    """

    timestamp: float
    segment: int
    pose_wc: np.ndarray
    intrinsics: np.ndarray
    depth: np.ndarray
    confidence: np.ndarray
    reliable: np.ndarray


@dataclass(frozen=True)
class Segment:
    """Uninterrupted part of a trajectory, with a world and a scale of its own.

    Attributes:
        trajectory: camera-to-world pose of every tracked frame of the segment.
        start, end: timestamps of its first and last row, seconds.
        joined_to: number of the segment whose world and scale it shares; None for its own.
        in_map: its world and scale are those of the map that the recording was tracked in.
    """

    trajectory: Trajectory
    start: float
    end: float
    joined_to: int | None = None
    in_map: bool = False

    def __repr__(self) -> str:
        joined = "" if self.joined_to is None else f", joined to {self.joined_to}"
        return f"Segment({len(self)} poses, {self.start:.3f} to {self.end:.3f} s{joined}{', in the map' * self.in_map})"

    def __len__(self) -> int:
        return len(self.trajectory)


@dataclass(frozen=True)
class Break:
    """Interval without poses, or a change of segment between two frames.

    Attributes:
        start: timestamp of the last frame with a pose before it, seconds; None if there is none.
        end: timestamp of the first frame with a pose after it, seconds; None if there is none.
        frames: number of input frames without a pose.
        reason: cause, such as ``"black image"``.
        new_segment: True if the poses after it belong to another segment than those before it.
    """

    start: float | None
    end: float | None
    frames: int
    reason: str
    new_segment: bool = True


@dataclass(frozen=True)
class Result:
    """Result for a sequence, available after the last frame.

    Positions and points are up to scale, unless ``metric`` is True.

    Attributes:
        trajectory: camera-to-world pose of every tracked frame of the longest segment, with those that share its world,
            frames before the initialisation included; lost frames have no row. In a map, of the segments that share its
            world, if there are any.
        map: sparse coloured map in the world of ``trajectory``, empty for systems without one.
        frames_read: number of input frames.
        frames_lost: number of input frames without a row in any segment.
        inertial: timestamps of the rows that are predicted from inertial samples alone.
        info: JSON-able metadata for run.json: working resolution, intrinsics, number of keyframes, loops, scale.
        segments: all segments in order of time; given none, the trajectory is the only one.
        breaks: intervals without poses, and changes of segment, in order of time.
        depth: depth maps of the keyframes of all segments, in order of time; empty for systems without them.
        quality: whether the result can be trusted, a :class:`dvo.odometry.quality.Quality` with ``verdict`` (``good``,
            ``doubtful`` or ``failed``), ``reason`` and ``remedy``; None from systems that do not judge themselves, and
            of a map without a new recording.

    Example:
        >>> poses_wc = np.array([[0.0, 0, 0, 0, 0, 0, 1], [0, 0, 1, 0, 0, 0, 1]])
        >>> trajectory = dvo.Trajectory(np.array([0.0, 0.1]), poses_wc)
        >>> result = dvo.Result(trajectory, dvo.SparseMap(), frames_read=3, frames_lost=1)
        >>> result
        Result(2 of 3 frames tracked, 1 segment, 0 map points)
        >>> len(result.segments), result.metric, result.quality
        (1, False, None)
    """

    trajectory: Trajectory
    map: SparseMap
    frames_read: int
    frames_lost: int
    info: dict[str, Any] = field(default_factory=dict)
    segments: tuple[Segment, ...] = ()
    breaks: tuple[Break, ...] = ()
    depth: tuple[DepthMap, ...] = ()
    quality: Quality | None = None
    inertial: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        times = self.trajectory.timestamps
        if not self.segments and len(times):
            only = Segment(self.trajectory, float(times[0]), float(times[-1]))
            object.__setattr__(self, "segments", (only,))

    def __repr__(self) -> str:
        count = len(self.segments)
        verdict = "" if self.quality is None else f", {self.quality.verdict}"
        parts = f"{count} segment{'s' * (count != 1)}, {len(self.map.points)} map points{verdict}"
        return f"Result({self.frames_tracked} of {self.frames_read} frames tracked, {parts})"

    @property
    def frames_tracked(self) -> int:
        """Number of rows of all segments, without those that are predicted."""
        return sum(len(segment) for segment in self.segments) - len(self.inertial)

    @property
    def metric(self) -> bool:
        """True if ``trajectory`` and ``map`` are in metres."""
        return self.longest is not None and self.is_metric(self.longest)

    def is_metric(self, number: int) -> bool:
        """True if a segment is in metres (``scale`` of the metadata).

        Args:
            number: of the segment.
        """
        entries = self.info.get("scale", {}).get("segments", ())
        return any(entry["segment"] == number and entry["source"] != "none" for entry in entries)

    @property
    def longest(self) -> int | None:
        """Number of the segment that ``trajectory`` is, of joined ones the longest; None without segments."""
        if not self.segments:
            return None
        times = self.trajectory.timestamps
        inside = [k for k, s in enumerate(self.segments) if np.isin(s.trajectory.timestamps, times).all()]
        return max(inside or range(len(self.segments)), key=lambda k: len(self.segments[k]))


@runtime_checkable
class Odometry(Protocol):
    """Interface of a streaming visual odometry. One object tracks one sequence.

    An object is used by one thread at a time, unless its class is :func:`dvo.odometry.exclusive.exclusive`, as those of
    the networks of this package are; :class:`dvo.data.streams.live.LiveFrames` takes what arrives in another one.
    Estimates and results may be read in any thread.

    Attributes:
        name: of the system, in reports.

    Example:
        An odometry that never moves:

        >>> class Still:
        ...     name = "still"
        ...     def __init__(self) -> None:
        ...         self.times: list[float] = []
        ...     def track(self, frame: dvo.Frame) -> dvo.Estimate:
        ...         self.times.append(frame.timestamp)
        ...         return dvo.Estimate(frame.timestamp, np.array([0.0, 0, 0, 0, 0, 0, 1]), dvo.Status.TRACKING)
        ...     def finish(self) -> dvo.Result:
        ...         poses_wc = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(self.times), 1))
        ...         trajectory = dvo.Trajectory(np.array(self.times), poses_wc)
        ...         return dvo.Result(trajectory, dvo.SparseMap(), len(self.times), 0)
        >>> isinstance(Still(), dvo.Odometry)
        True
    """

    name: str

    def track(self, frame: Frame) -> Estimate:
        """Process the next frame.

        Args:
            frame: of the same size as the first, with a later timestamp than the one before.

        Returns:
            Pose of the frame, if there is one, and state of the tracker.

        Raises:
            DvoError: a frame that cannot be tracked, such as one of another size or an earlier time, or a finished
                odometry; the odometry stays as it was.
        """
        ...

    def finish(self) -> Result:
        """Run the final optimisation. May be called after any number of frames, including none.

        Returns:
            Trajectory and map of the sequence.
        """
        ...


@runtime_checkable
class Interim(Protocol):
    """Interface of an odometry that gives its result so far between two frames."""

    def current(self) -> Result:
        """Compute the result of the frames so far, without a final optimisation; tracking goes on unchanged.

        Returns:
            Trajectory and map so far.
        """
        ...


@runtime_checkable
class Resettable(Protocol):
    """Interface of an odometry that can track one sequence after another."""

    def reset(self) -> None:
        """Forget the sequence, and begin the next one as a new odometry with the same network, settings and seed would:
        the same frames give the same bytes. Results that it has given stay as they are.
        """
        ...


@runtime_checkable
class Saveable(Protocol):
    """Interface of an odometry that can be written to a map file."""

    def save(self, file: str | Path) -> None:
        """Write the map so far; tracking goes on unchanged.

        Args:
            file: to write; replaced as a whole.

        Raises:
            DvoError: the file cannot be written.
        """
        ...
