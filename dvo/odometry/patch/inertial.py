"""Inertial samples beside the tracker: prediction of rotations, poses in metres, poses without images.

The window and the map stay in the units of the images; what is given to the caller is turned upright and scaled, from
the frame at which scale and vertical are known for sure. At the end of a sequence the map follows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.data.inertial import InertialSamples, checked_samples
from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.geometry.poses import pose_from, rotation_vector, slerp, split
from dvo.geometry.undistort import read_at_once
from dvo.map.correction import Carried, Moved, apply_similarities, keyframes_of, set_solution
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.keyframe_log import FrameRecord
from dvo.map.map import Map
from dvo.odometry.frames.gate import Admitted
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions
from dvo.odometry.global_ba.inertial_adjustment import VisualInertialSolution
from dvo.odometry.global_ba.rolling_shutter import Shutter, Turns
from dvo.odometry.inertial.coupling import InertialCoupling
from dvo.odometry.inertial.estimator import (
    BodyState,
    InertialEstimator,
    Similarity,
    camera_covariance,
    camera_pose,
)
from dvo.odometry.inertial.options import InertialOptions
from dvo.odometry.inertial.smoother import Smoothed, VisualNodes, spaced
from dvo.odometry.loops.closure import LoopCloser
from dvo.odometry.maintenance.maintenance import MapMaintenance
from dvo.odometry.patch.inertial_adjustments import (
    InertialAdjustment,
    MetricPath,
    apply_solution,
    metres_per_unit,
    metric_path,
)
from dvo.odometry.protocol import Estimate, InertialEstimate, Result, ScaleState, Segment, Status

GYRO_TRUST = 0.7
"""The gyroscope predicts the rotation of a frame where its error of late is below this share of that of the motion
model: a sensor that is turned, or whose clock is off, predicts worse."""
LEAST_TURN = np.deg2rad(1.0)
"""Difference of the two predictions below which that of the motion model stays: the network finds the rest, and calm
images give the same bytes with and without samples."""
MOST_WRONG, LEAST_WRONG = 0.5, np.deg2rad(0.5)
"""Share of the turn between frames by which the gyroscope may err, or else angle, where it tells that in a readout."""
FORGET = 0.9
"""Weight of the past in these errors, from frame to frame."""
ANOTHER_CLOCK = 86400.0
"""Seconds between a sample and the newest frame that are no pause and no delay."""
MOST_NODES = 400
"""Nodes of the estimate at the end of a sequence."""
ADJUST_EVERY, ADJUST_LATER = 1.0, 3.0
"""Seconds from one adjustment of images and samples beside tracking to the next, before the alignment and after it."""
ADJUSTED, MOST_ADJUSTED = 10.0, 400
"""Seconds of frames that are solved for, and frames at most."""
HARD = 0.05
"""Deviation of the acceleration, m/s^2, above which they follow each other after the alignment as before it."""
ADJUST_DELAY, ADJUST_TOLERANCE = 10, 1e-3
"""Frames until its solution is taken, and its tolerance: with 1e-5 the scale differs by less than .1 %."""
UNTOLD = "the samples do not tell the scale of these frames"
"""Reason of a frame without a pose by its image, at the end, if none can be predicted either."""
SAME_TIME = 1e-6
"""Seconds."""


class InertialTracking:
    """What the inertial samples of a sequence tell of its frames.

    Args:
        options: settings.
        graph: of the tracker.
        metric: the scale has another source: the samples predict rotations alone.
        variance: of a visual measurement of weight 1, feature pixels squared.
        optimised: number of newest keyframes whose poses move in the window.

    Attributes:
        estimator: of scale, vertical, velocity and biases.
        coupling: measurements for the window.
        active: there are samples, and they are used; poses are predicted and expressed only then.
    """

    def __init__(
        self, options: InertialOptions, graph: KeyframeGraph, *, metric: bool = False, variance: float = 1.0,
        optimised: int = 8,
    ) -> None:  # fmt: skip
        self.options, self.graph, self.metric, self.active = options, graph, metric, False
        self.variance = variance
        self._unused = ""  # why samples are not used
        self.estimator = InertialEstimator(options)
        self.coupling = InertialCoupling(self.estimator, self._similarity, variance, optimised)
        # Squares, of errors of the gyroscope and of the motion model, and of turns between frames, rad^2.
        self._errors: tuple[float, float, float] | None = None
        self._turn: tuple[float, float, np.ndarray | None] | None = None  # newest by the gyroscope, between two times
        self._at_once: list[float] = []  # times of frames that were read at once
        self._readout = 0.0  # theirs, seconds
        self._last: tuple[float, np.ndarray] | None = None  # time and pose T_wc of the last frame with one
        self._before: tuple[float, np.ndarray] | None = None  # and of the one before it
        self._anchor: BodyState | None = None  # from which poses are predicted, while there are none by images
        self._state: BodyState | None = None  # the newest prediction
        self._way = 0.0  # metres since the alignment
        self._last_adjusted = -np.inf  # time of the newest frame of the last adjustment beside tracking

    @property
    def tells_scale(self) -> bool:
        """There are samples, and the scale has no other source."""
        return self.active and not self.metric

    def turns(self, *, told: bool = False) -> Turns | None:
        """Rotations during the readout of a rolling shutter: none in the images of frames that were read at once.

        Args:
            told: of other frames, what the gyroscope tells; otherwise they are not known.

        Returns:
            None if none are known.
        """
        found = self.estimator.turns(self._nodes(-np.inf)[0]) if self.active and told else None
        return _turns_of(np.array(self._at_once), found) if self._at_once else found

    def read_at_once(self, admitted: Admitted) -> Admitted:
        """A frame of a rolling shutter without the turn during its readout, where the gyroscope has been right of late.

        Args:
            admitted: frame with content.

        Returns:
            The same, or one whose camera has a global shutter.
        """
        camera, errors = admitted.camera, self._errors
        if not self.tells_scale or camera.readout <= 0 or errors is None:
            return admitted
        if errors[0] > max(MOST_WRONG**2 * errors[2], LEAST_WRONG**2):
            return admitted
        offsets = np.linspace(-0.5, 0.5, 5) * camera.readout
        turns = self.estimator.turns_about(admitted.timestamp, offsets)
        if turns is None:
            return admitted
        self._at_once.append(admitted.timestamp)
        self._readout = camera.readout
        image = read_at_once(admitted.image, camera, offsets, turns)
        return replace(admitted, image=image, camera=replace(camera, readout=0.0))

    @property
    def readout(self) -> float:
        """Readout time that most frames so far have been corrected for, see :meth:`read_at_once`; 0: they have not."""
        return self._readout if 2 * len(self._at_once) > len(self.graph.log.frames) else 0.0

    def add_apart(self, samples: InertialSamples) -> None:
        """Take samples that do not come with a frame.

        Args:
            samples: of the sensor.

        Raises:
            DvoError: damaged samples, or times of another clock than that of the frames.
        """
        frames = self.graph.log.frames
        if self.options.use and frames and len(checked_samples(samples)):
            ahead = float(samples.timestamps[-1]) - frames[-1].timestamp
            if abs(ahead) > ANOTHER_CLOCK:
                message = f"samples are {abs(ahead):.6g} s {'after' if ahead > 0 else 'before'} the newest frame"
                remedy = "give times of frames and samples on one clock, in seconds"
                raise DvoError(message, field="inertial: timestamps", remedy=remedy)
        self.add(samples)

    def add(self, samples: InertialSamples) -> None:
        """Take samples.

        Args:
            samples: of the sensor.

        Raises:
            DvoError: damaged samples.
        """
        if self.options.use and self.graph.recording.segment > 0 and len(checked_samples(samples)):
            self._unused = "a map that is tracked in keeps its own unit and axes"
        elif self.options.use:
            self.estimator.add(samples)
            self.active = self.estimator.state is not ScaleState.NONE

    def predicted(self, time: float, pose_cw: Tensor) -> Tensor:
        """First pose of a new frame.

        Args:
            time: of the frame, seconds.
            pose_cw: ``(7,)`` by the motion model.

        Returns:
            ``(7,)``: with the rotation by the gyroscope where that predicts better than the motion model has of late,
            and where the images have been missing with the position too.
        """
        similarity = self._similarity()
        if self._state is not None and similarity is not None:  # images are back
            state = self._predict(time)
            if state is not None:
                return self._visual_cw(state, similarity).to(pose_cw)
        turned = self._turned(time)
        if turned is None or self._errors is None or self._errors[0] > GYRO_TRUST**2 * self._errors[1]:
            return pose_cw
        rotation, position = split(se3.inverse(pose_cw.double()).cpu().numpy())
        if np.linalg.norm(rotation_vector(rotation.T @ turned)) < LEAST_TURN:
            return pose_cw
        return se3.inverse(torch.from_numpy(pose_from(turned, position))).to(pose_cw)

    def express(self, record: FrameRecord, estimate: Estimate, *, moved: bool = True) -> Estimate:
        """Estimate for the caller.

        Args:
            record: of the frame.
            estimate: by the images.
            moved: see :meth:`dvo.odometry.inertial.estimator.InertialEstimator.refresh`.

        Returns:
            In metres and upright once that is known; a predicted pose where the images give none.
        """
        time, estimator = record.timestamp, self.estimator
        if estimate.pose_wc is not None:
            self._compare(time, estimate.pose_wc)
            if self.metric:
                return estimate
            if self._anchor is None:
                estimator.refresh(time, self._nodes, moved=moved)
            else:
                estimator.update(*self._nodes(time - self.options.window))
            similarity = self._similarity()
            if similarity is not None:
                return self._metric(estimate, similarity)
        if estimator.aligned and self._last is not None:
            state = self._predict(time)
            if state is not None:
                record.inertial = estimate.pose_wc is None
                return self._bridged(estimate, state)
        return replace(estimate, scale_state=estimator.scale_state)

    def expressed(self, result: Result) -> Result:
        """Result so far, in metres where that is known; the map itself is not changed.

        Args:
            result: in the units of the images.
        """
        worlds, begun = self.estimator.worlds, self.graph.recording.segment
        if not worlds:
            return result
        segments = []
        for number, segment in enumerate(result.segments):
            found = worlds.get(self.graph.world_of(begun + number))
            segments.append(segment if found is None else _moved_segment(segment, found))
        main = worlds.get(self.graph.world_of(begun + (result.longest or 0)))
        if main is None:
            return replace(result, segments=tuple(segments))
        points = main.points(result.map.points.astype(np.float64)).astype(np.float32)
        return replace(
            result, segments=tuple(segments), trajectory=_moved(result.trajectory, main),
            map=replace(result.map, points=points),
        )  # fmt: skip

    @property
    def doubt(self) -> str:
        """Why the scale of poses in metres is in doubt; empty if it is not, and without such poses."""
        return self.estimator.reason if self.estimator.aligned and not self.metric else ""

    def settle(
        self, loops: LoopCloser, adjustment: AdjustmentOptions | None = None, shutter: Shutter | None = None
    ) -> dict[str, Any]:
        """Bring the map of a finished sequence to metres, and give frames that were bridged their poses.

        Each keyframe follows the smoothed trajectory: where the scale of the images has drifted, its own is taken. From
        there on images and samples are solved for together (:mod:`dvo.odometry.global_ba.inertial_adjustment`).

        Args:
            loops: whose measurements are scaled along.
            adjustment: options of that; None: leave it out.
            shutter: timing of the rows; None for a global shutter.

        Returns:
            Entries for run.json: ``inertial``, and ``scale``.
        """
        if self._unused or (self.active and self.metric):
            reason = self._unused or "metres come from another source"
            return {"inertial": {"state": ScaleState.NONE.value, "reason": reason}}
        if not self.active:
            return {}
        graph, estimator = self.graph, self.estimator
        nodes, worlds = self._nodes(-np.inf)
        if not estimator.aligned and len(nodes):  # of the longest world alone
            longest = int(np.bincount(nodes.segment).argmax())
            nodes, worlds = nodes.of(longest), [worlds[longest]]
        adjusted: VisualInertialSolution | None = None

        def confirm(found: Smoothed) -> float:
            """Deviation of the scale by the adjustment of a world that is not in metres yet."""
            nonlocal adjusted
            path = metric_path(found, nodes, np.ones(len(nodes), bool))
            assert adjustment is not None
            adjusted = self._adjustment(graph, worlds[0], found, path, adjustment, shutter).solve()
            return np.inf if adjusted is None else adjusted.scale_sigma

        closer = confirm if adjustment is not None and len(worlds) == 1 else None
        smoothed = estimator.settle(nodes, worlds, closer) if len(nodes) else None
        if not estimator.aligned:
            return {"inertial": estimator.information()}
        self._predict_untold()
        # A segment may have been joined to an earlier world since its similarity was found.
        found = {graph.world_of(world): estimator.worlds[world] for world in sorted(estimator.worlds, reverse=True)}
        units: dict[int, float] = {}
        for world, similarity in found.items():
            path = None
            if smoothed is not None and world in worlds:
                path = metric_path(smoothed, nodes, np.array(worlds)[nodes.segment] == world)
            units |= self._follow(world, MetricPath.constant(similarity) if path is None else path)
        loops.moved(Moved(units))
        sigma = None if smoothed is None else smoothed.scale_sigma
        begun, entries = graph.recording.segment, []
        for world, similarity in sorted(found.items()):
            graph.metric[world] = "inertial"
            if world != min(found):
                graph.join(world, min(found))
            entries.append(
                {"segment": world - begun, "source": "inertial", "factor": similarity.scale,
                 "deviation": sigma, "observations": len(nodes)}
            )  # fmt: skip
        if smoothed is not None and found and adjusted is None and adjustment is not None:
            adjusted = self._adjustment(graph, min(found), smoothed, None, adjustment, shutter).solve()
            adjusted = adjusted if adjusted and adjusted.scale_sigma <= self.options.max_scale_sigma else None
        information = estimator.information()
        if smoothed is not None and adjusted is not None:
            world = graph.world_of(graph.segment_of(int(adjusted.identifiers[0])))
            solved = adjusted.identifiers.numpy(), adjusted.poses_cw, adjusted.depths.numpy()
            loops.moved(set_solution(graph, world, *solved))
            estimator.solution = smoothed = adjusted.states
            information = estimator.information() | {"scale_sigma": adjusted.scale_sigma}
            for entry in entries:
                entry["deviation"] = adjusted.scale_sigma
        if smoothed is not None:
            self._fill(smoothed)
        scale = {"source": "inertial", "unit": "metres", "segments": entries}
        return {"inertial": information, **({"scale": scale} if entries else {})}

    def _adjustment(
        self, graph: Map, world: int, start: Smoothed, path: MetricPath | None, options: AdjustmentOptions,
        shutter: Shutter | None,
    ) -> InertialAdjustment:  # fmt: skip
        """Adjustment of images and samples of a world; see :class:`InertialAdjustment`."""
        samples, estimator = self.estimator.stream.samples(), self.estimator
        assert samples is not None
        return InertialAdjustment(
            graph, world, start, path, samples, estimator.noise, self.variance, self.options.interval, options, shutter,
        )  # fmt: skip

    def adjust(self, maintenance: MapMaintenance, options: AdjustmentOptions, shutter: Shutter) -> None:
        """Begin an adjustment of images and samples beside tracking, if one is due and no other work is in progress.

        Args:
            maintenance: of the map.
            options: of the final adjustment.
            shutter: timing of the rows.
        """
        graph, window = self.graph, self.graph.window
        maintenance.awaited = False
        if not self.tells_scale or self._anchor is not None or window.guests or not len(window):
            return
        if window.frames[-1].timestamp < self._last_adjusted + ADJUST_EVERY:
            return
        time, world, similarity = window.frames[-1].timestamp, graph.world_of(graph.segment), self._similarity()
        start = self.estimator.to_be_adjusted(world)
        if start is None:
            return
        if maintenance.job is not None:
            maintenance.awaited = True
            return
        known, nodes = start
        path = metric_path(known, nodes, np.ones(len(nodes), bool)) if nodes is not None else None
        if nodes is None and similarity is not None:
            path = MetricPath.constant(similarity)
        if path is None:
            return
        soon = similarity is None or self.estimator.force_sigma > HARD
        self._last_adjusted = time if soon else time + ADJUST_LATER - ADJUST_EVERY
        rows = replace(shutter, readout=self.readout or shutter.readout, turns=self.turns())
        snapshot = graph.copy()
        snapshot.archive.config = replace(snapshot.archive.config, features=False, images=False)
        snapshot.archive_window()
        work = self._adjustment(snapshot, world, known, path, options, rows)
        newest = snapshot.members(world)[-MOST_ADJUSTED:]
        since = max(time - ADJUSTED, newest[0].timestamp) if newest else time - ADJUSTED
        work = replace(work, since=since, tolerance=ADJUST_TOLERANCE)
        begun = _Begun(graph.segment, world, similarity is not None)
        maintenance.job = maintenance.beside("adjustment", work.solve, partial(self._apply, begun), ADJUST_DELAY)

    def _apply(self, begun: _Begun, solution: VisualInertialSolution | None) -> Moved:
        """Take the solution of an adjustment beside tracking; what has moved."""
        graph, estimator, similarity = self.graph, self.estimator, self._similarity()
        now = _Begun(graph.segment, graph.world_of(graph.segment), similarity is not None)
        if solution is None or now != begun or self._anchor is not None or not len(graph.window):
            return Moved({})
        scale = metres_per_unit(graph, begun.world, solution)
        if scale is None or not estimator.confirms(scale, solution.scale_sigma):
            return Moved({})
        applied = apply_solution(graph, begun.world, solution, similarity)
        assert applied is not None
        estimator.adopt(applied.states, applied.similarity, begun.world, solution.scale_sigma)
        for carried in applied.moved.worlds:
            self._carry(carried)
        return Moved(applied.moved.units)

    def corrected(self, carried: Carried) -> None:
        """Follow a correction of the map, after which each segment is in the world that it belongs to.

        Args:
            carried: how the newest poses of a world have moved.
        """
        by = self._carry(carried)
        if not self.metric and self.estimator.aligned:
            self.estimator.corrected(carried.world, self.graph.world_of(carried.world), by, carried.time)

    def _carry(self, carried: Carried) -> Similarity:
        """Move the newest poses along with the window; the change."""
        rotation, translation = split(carried.change[:7].numpy())
        by = Similarity(float(carried.change[7]), rotation, translation)
        if carried.window:
            self._last, self._before = (
                None if known is None else (known[0], _changed(known[1], by)) for known in (self._last, self._before)
            )
        return by

    def _follow(self, world: int, path: MetricPath) -> dict[int, float]:
        """Move the kept keyframes of a world; the scale of the similarity of each."""
        graph = self.graph
        identifiers = keyframes_of(graph, world)
        if not len(identifiers):
            return {}
        poses_wc = se3.inverse(graph.poses_cw(identifiers)).numpy()
        moved, scales = path.moved(np.array([graph.archive[k].timestamp for k in identifiers.tolist()]), poses_wc)
        poses_cw = se3.inverse(torch.from_numpy(moved))
        inverse = torch.from_numpy(1 / scales)[:, None]
        apply_similarities(graph, identifiers, torch.cat([poses_cw[:, :3] * inverse, poses_cw[:, 3:], inverse], 1))
        return dict(zip(identifiers.tolist(), (1 / scales).tolist(), strict=True))

    # ------------------------------------------------------------------------------------------------------------------

    def _similarity(self) -> Similarity | None:
        """From the present world to the metric one; None: not known, or not by samples."""
        return None if self.metric else self.estimator.worlds.get(self.graph.world_of(self.graph.segment))

    def _turned(self, time: float) -> np.ndarray | None:
        """Orientation ``(3, 3)`` of the camera by the gyroscope, from the last frame with a pose on."""
        if self._last is None or not 0 < time - self._last[0] < self.options.longest:
            return None
        if self._turn is None or self._turn[:2] != (self._last[0], time):
            self._turn = self._last[0], time, self.estimator.turn_between(self._last[0], time)
        turn = self._turn[2]
        return None if turn is None else split(self._last[1])[0] @ turn

    def _compare(self, time: float, pose_wc: np.ndarray) -> None:
        """Compare the rotations of gyroscope and motion model with the one that was found."""
        turned, found = self._turned(time), split(pose_wc)[0]
        if turned is not None and self._before is not None and self._last is not None:
            steps = time - self._last[0], self._last[0] - self._before[0]
            before, last = split(self._before[1])[0], split(self._last[1])[0]
            if steps[1] > 0 and steps[0] < 2.5 * steps[1]:
                still = rotation_vector(before.T @ last) * 0.5 * steps[0] / steps[1]
                errors = rotation_vector(turned.T @ found), rotation_vector(last.T @ found) - still
                now = tuple(float(error @ error) for error in (*errors, rotation_vector(last.T @ found)))
                past = now if self._errors is None else self._errors
                self._errors = tuple(FORGET * a + (1 - FORGET) * b for a, b in zip(past, now, strict=True))  # type: ignore[assignment]
        self._before, self._last = self._last, (time, pose_wc)

    def _nodes(self, since: float) -> tuple[VisualNodes, list[int]]:
        """Visual poses of the frames later than a time, some tenths of a second apart, and their worlds."""
        graph = self.graph
        frames: list[FrameRecord] = []
        for record in reversed(graph.log.frames):
            if record.timestamp < since:
                break
            if not record.lost and record.anchor is not None and not record.inertial:
                frames.append(record)
        frames.reverse()
        poses = graph.window.poses_cw.double().cpu().numpy()
        known = {frame.identifier: pose for frame, pose in zip(graph.window.frames, poses, strict=True)}
        rows = graph.log.trajectory(None, known, frames)
        posed = set(rows.timestamps.tolist())
        frames = [frame for frame in frames if frame.timestamp in posed]
        times, world_of = rows.timestamps, [graph.world_of(frame.segment) for frame in frames]
        spacing = self.options.interval
        if np.isneginf(since) and len(times):
            spacing = max(spacing, (times[-1] - times[0]) / MOST_NODES)
        chosen = spaced(times, world_of, spacing)
        chosen_of = np.array([world_of[k] for k in chosen], int)
        begins = np.diff(chosen_of, prepend=-1) != 0  # a world comes again where a segment was found in it
        segment, worlds = np.cumsum(begins) - 1, chosen_of[begins].tolist()
        rotation, position = split(rows.poses_wc[chosen])
        depth = self._depths([frames[k] for k in chosen])
        return VisualNodes(times[chosen], segment, rotation, position, depth), worlds

    def _depths(self, frames: list[FrameRecord]) -> np.ndarray:
        """``(N,)`` median depth of the patches of the keyframe that each frame is anchored to."""
        graph, window, m = self.graph, self.graph.window, self.graph.per_frame
        centre, anchors = window.patches.shape[-1] // 2, [frame.anchor for frame in frames if frame.anchor is not None]
        places = {frame.identifier: place for place, frame in enumerate(window.frames)}
        present = window.patches[:, 2, centre, centre].double().cpu().numpy()
        usual, found = 1.0, {}
        for anchor in dict.fromkeys(anchors):
            if anchor in places:
                inverse = present[places[anchor] * m : (places[anchor] + 1) * m]
            else:
                inverse = graph.archive[anchor].inverse_depth if anchor in graph.archive else present[:0]
            inverse = inverse[inverse > 0]
            usual = 1 / max(float(np.median(inverse)), 1e-6) if len(inverse) else usual
            found[anchor] = usual
        return np.array([found[anchor] for anchor in anchors])

    def _predict(self, time: float) -> BodyState | None:
        """State at a time after the last frame with a pose; None if that is too long ago."""
        assert self._last is not None
        if self._anchor is None:
            self.estimator.update(*self._nodes(self._last[0] - self.options.window))
            if not self.estimator.aligned:
                return None
        newest = self.estimator.last_state()
        if newest is None:
            return None
        if self._anchor is None or newest.time > self._anchor.time:  # of a new segment, whose scale is not sure yet
            self._anchor = self._state = newest
        state = self._state
        if state is None or time - self._anchor.time > self.options.longest:
            return None
        if time > state.time:
            self._state = self.estimator.predict(state, np.array([time]))[0]
        return self._state

    def _metric(self, estimate: Estimate, similarity: Similarity) -> Estimate:
        """Estimate of a visual pose in metres."""
        assert estimate.pose_wc is not None
        if self._anchor is not None:
            self._anchor = self._state = None
        rotation, position = split(estimate.pose_wc)
        rotation, position = similarity.rotation @ rotation, similarity.points(position)
        scale, covariance = similarity.scale, estimate.covariance
        if covariance is not None:
            unit = np.diag([scale] * 3 + [1.0] * 3)
            covariance = unit @ covariance @ unit
        return replace(
            estimate, pose_wc=pose_from(rotation, position), covariance=covariance,
            scale_state=self.estimator.scale_state, inertial=self._beside(estimate.timestamp, rotation, position),
        )  # fmt: skip

    def _bridged(self, estimate: Estimate, state: BodyState) -> Estimate:
        """Estimate of a pose that is predicted."""
        estimator, anchor = self.estimator, self._anchor
        assert anchor is not None and estimator.solution is not None
        rotation, position = camera_pose(
            state, estimator.solution.rotation_camera_imu, estimator.translation_camera_imu
        )
        turn = estimator.solution.rotation_camera_imu
        # Of position and rotation, in the coordinates of this camera, relative to the last frame with a pose.
        own = np.zeros((6, 15))
        own[:3, 3:6], own[3:, :3] = rotation.T, turn
        known = anchor.covariance.copy()
        known[3:6], known[:, 3:6] = 0.0, 0.0
        relative = replace(anchor, covariance=known)
        grown = estimator.predict(relative, np.array([state.time]))[0].covariance if state.time > anchor.time else known
        reason = estimate.reason or "the images have no scale yet"
        return Estimate(
            estimate.timestamp, pose_from(rotation, position), Status.INERTIAL, 0.0, estimate.segment, reason,
            covariance=own @ grown @ own.T, reference=anchor.time, scale_state=estimator.scale_state,
            inertial=InertialEstimate(
                state.velocity, state.gyro_bias, state.accel_bias, estimator.scale_sigma,
                camera_covariance(state, turn, estimator.translation_camera_imu), estimator.solution.time_offset,
            ),
        )  # fmt: skip

    def _beside(self, time: float, rotation: np.ndarray, position: np.ndarray) -> InertialEstimate | None:
        """Velocity, biases and covariance at a frame with a visual pose, that is given in metres."""
        solution = self.estimator.solution
        if solution is None:
            return None
        state, covariance = self.estimator.beside(time, rotation, position)
        return InertialEstimate(
            state.velocity,
            state.gyro_bias,
            state.accel_bias,
            self.estimator.scale_sigma,
            covariance,
            solution.time_offset,
        )

    def _visual_cw(self, state: BodyState, similarity: Similarity) -> Tensor:
        """Pose ``T_cw`` of a state, in the units of the images."""
        solution = self.estimator.solution
        assert solution is not None
        found = camera_pose(state, solution.rotation_camera_imu, self.estimator.translation_camera_imu)
        pose_wc = pose_from(similarity.rotation.T @ found[0], similarity.inverse_points(found[1]))
        return se3.inverse(torch.from_numpy(pose_wc))

    def _predict_untold(self) -> None:
        """Take the poses by images from short segments whose scale is not told: samples predict their frames, too."""
        graph, untold = self.graph, self.estimator.untold
        for world in untold:
            mine = [
                record for record in graph.log.frames if not record.lost and graph.world_of(record.segment) == world
            ]
            if mine and mine[-1].timestamp - mine[0].timestamp <= self.options.longest:
                for record in mine:
                    record.anchor, record.relative, record.lost, record.inertial = None, None, True, True
                    record.reason = record.reason or UNTOLD

    def _fill(self, smoothed: Smoothed) -> None:
        """Poses of the frames that were bridged: predicted from the smoothed state before, and led to the one after."""
        log, estimator = self.graph.log, self.estimator
        times = np.array([record.timestamp for record in log.frames])
        bridged = np.array([record.inertial and record.lost for record in log.frames])
        turn, shift = smoothed.rotation_camera_imu, estimator.translation_camera_imu
        for begin, end in _runs(bridged):
            last = int(np.searchsorted(smoothed.times, times[begin] - SAME_TIME)) - 1
            anchor = log.frames[begin - 1].anchor if begin else None
            if last < 0 or anchor is None:
                continue
            start = BodyState(
                float(smoothed.times[last]), smoothed.rotation[last], smoothed.position[last], smoothed.velocity[last],
                smoothed.gyro_bias[last], smoothed.accel_bias[last], np.zeros((15, 15)),
            )  # fmt: skip
            wanted = times[begin:end]
            then = int(np.searchsorted(smoothed.times, wanted[-1] + SAME_TIME))
            after = smoothed.times[then] if then < len(smoothed.times) else None
            states = estimator.predict(start, wanted if after is None else np.append(wanted, after))
            cameras = [camera_pose(state, turn, shift) for state in states]
            poses = np.stack([pose_from(*camera) for camera in cameras])
            if after is not None:
                goal = replace(states[-1], rotation=smoothed.rotation[then], position=smoothed.position[then])
                poses = _led(
                    poses[:-1], wanted, start.time, float(after), poses[-1], pose_from(*camera_pose(goal, turn, shift))
                )
            for record_number, pose_wc in zip(range(begin, end), poses, strict=True):
                record = log.frames[record_number]
                log.place(record_number, anchor, se3.inverse(torch.from_numpy(pose_wc)).numpy())
                record.segment, record.reason = log.frames[begin - 1].segment, ""


@dataclass(frozen=True)
class _Begun:
    """What has to be the same when the solution of an adjustment is taken."""

    segment: int
    world: int
    aligned: bool


def _turns_of(at_once: np.ndarray, told: Turns | None) -> Turns:
    """Rotations during the readout: none at some times ``(K,)``, increasing, and at others what is told."""

    def turns(times: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        found = np.full((len(times), len(offsets), 3), np.nan) if told is None else told(times, offsets)
        at = np.searchsorted(at_once, times - SAME_TIME).clip(max=len(at_once) - 1)
        return np.where((np.abs(at_once[at] - times) <= SAME_TIME)[:, None, None], 0.0, found)

    return turns


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First position and the one after the last of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _led(
    poses: np.ndarray, times: np.ndarray, start: float, end: float, reached: np.ndarray, goal: np.ndarray
) -> np.ndarray:
    """Poses ``(n, 7)`` after what is missing at the end, spread over the time."""
    share = np.clip((times - start) / max(end - start, 1e-9), 0, 1)
    led = poses.copy()
    led[:, :3] += share[:, None] * (goal[:3] - reached[:3])
    rotation = split(poses)[0]
    missing = split(goal)[0] @ split(reached)[0].T
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    part = pose_from(missing, np.zeros(3))[3:]
    turned = slerp(np.tile(identity, (len(poses), 1)), np.tile(part, (len(poses), 1)), share)
    led[:, 3:] = pose_from(split(np.concatenate([np.zeros((len(poses), 3)), turned], 1))[0] @ rotation, led[:, :3])[
        :, 3:
    ]
    return led


def _changed(poses_wc: np.ndarray, similarity: Similarity) -> np.ndarray:
    rotation, position = split(poses_wc)
    return pose_from(similarity.rotation @ rotation, similarity.points(position))


def _moved(trajectory: Trajectory, similarity: Similarity) -> Trajectory:
    return Trajectory(trajectory.timestamps, _changed(trajectory.poses_wc, similarity))


def _moved_segment(segment: Segment, similarity: Similarity) -> Segment:
    return replace(segment, trajectory=_moved(segment.trajectory, similarity))
