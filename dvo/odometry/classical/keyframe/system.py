"""Keyframe system in the manner of PTAM and ORB-SLAM: two-view start, PnP tracking, keyframes, local bundle adjustment.

Reads like this: :meth:`KeyframeOdometry.track` follows the corners into the new image and takes the pose from those
with a known point (:meth:`_follow`, :meth:`_pose`), or starts a map (:meth:`_try_start`), or looks for the lost camera
in the map (:meth:`_recover`). Every so often the frame becomes a keyframe (:meth:`_insert`): points are found again,
triangulated and adjusted, and new corners begin. Without the setting ``loops`` nothing older than the neighbourhood is
corrected.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import cv2
import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.settings import changed
from dvo.data.frame import Frame
from dvo.odometry.classical import two_view
from dvo.odometry.classical.frame_log import FrameLog
from dvo.odometry.classical.keyframe.adjust import adjust, neighbourhood
from dvo.odometry.classical.keyframe.config import KeyframeConfig
from dvo.odometry.classical.keyframe.initialise import start_from_two_views
from dvo.odometry.classical.keyframe.loops import LoopCloser
from dvo.odometry.classical.keyframe.map import Keyframe, Map
from dvo.odometry.classical.keyframe.pose import centre, refine_pose
from dvo.odometry.classical.keyframe.relocalise import relocalise, search
from dvo.odometry.classical.klt import detect, follow
from dvo.odometry.exclusive import sheltered
from dvo.odometry.frames.gate import Admitted, Gate
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status


@sheltered
class KeyframeOdometry:
    """See the module. Deterministic for a seed; poses are up to scale, the first frame is the world."""

    name = "keyframe"

    @checked_arguments
    def __init__(self, config: KeyframeConfig | None = None, seed: int = 0, **settings: Any) -> None:
        self.config = changed(config or KeyframeConfig(), settings)
        self._seed = seed
        self._loops = LoopCloser(self.config, seed) if self.config.loops else None
        self._gate = Gate(pixels=None)
        self._log = FrameLog()
        self._intrinsics, self._size = np.ones(4), (0, 0)
        self._map, self._old = Map(), Map()  # the map in use or being started; the one before it
        self._retired: list[tuple[np.ndarray, np.ndarray]] = []  # points of maps that were given up
        self._started = False
        self._grey: np.ndarray | None = None  # the last image in which the tracks were seen
        self._ids = np.zeros(0, int)  # tracks: landmarks and where they are in that image
        self._uv = np.zeros((0, 2), np.float32)
        self._followed = self._ids, self._uv  # the same in the newest image, before a pose confirms them
        self._first: Keyframe | None = None  # first view of a map that is being started
        self._T = np.eye(4)  # last pose and last motion, world to camera
        self._motion = np.eye(4)
        self._blind = 0  # frames since the tracks were seen
        self._pending: list[tuple[int, np.ndarray, np.ndarray]] = []  # frame, ids, uv: to be filled in at the start
        self._speed: float | None = None  # distance per frame, running mean
        self._counts = {"maps_started": 0, "planar_starts": 0, "keyframes": 0, "culled": 0, "relocalised": 0}

    def track(self, frame: Frame) -> Estimate:
        with self._gate.admit(frame) as admitted:
            return self._process(admitted)

    def _process(self, admitted: Admitted) -> Estimate:
        if admitted.repeated and not admitted.problem:
            return self._log.repeat(admitted.timestamp)
        index, frame = self._log.begin(admitted.timestamp), admitted.frame
        self._intrinsics, self._size = frame.camera.intrinsics, (frame.camera.width, frame.camera.height)
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        if self._grey is None and admitted.problem:
            return self._log.lose(index, admitted.problem)
        if self._grey is None:
            self._begin(frame, grey, index)
            return self._log.estimate(Status.INITIALISING)
        followed = not admitted.problem and self._follow(grey, index)
        if not self._started:
            return self._initialise(frame, grey, index, followed, admitted.problem)
        confidence = self._pose(index) if followed else None
        if confidence is None and not self._recover(self._map, grey, index):
            self._blind += 1
            if self._blind >= self.config.patience:
                self._give_up(frame, grey, index)
            return self._log.lose(index, admitted.problem)
        self._grey, self._blind = grey, 0
        if self._wants_keyframe(index):
            self._insert(frame, grey, index)
        return self._log.estimate(Status.TRACKING, confidence or 0.3)

    def finish(self) -> Result:
        self._gate.finish()
        points, colors = zip(*self._retired, self._old.points(), self._map.points(), strict=True)
        info = {
            "working_size": list(self._size),
            "working_intrinsics": self._intrinsics.tolist(),
            **self._counts,
            "config": asdict(self.config),
            **({} if self._loops is None else self._loops.information(self._log.keyframes)),
        }
        return self._log.result(SparseMap(np.concatenate(points), np.concatenate(colors)), info)

    # --- every frame --------------------------------------------------------------------------------------------------

    def _follow(self, grey: np.ndarray, index: int) -> bool:
        """Carry the tracks into the new image, from where the motion model puts them. False, and nothing changed, when
        too few hold."""
        assert self._grey is not None
        c = self.config
        settings = {"window": c.window, "levels": c.levels, "tolerance": c.closed}
        uv, held = follow(self._grey, grey, self._uv, **settings)  # type: ignore[arg-type]
        if self._started and held.sum() < 0.5 * len(held):
            again, held_again = follow(self._grey, grey, self._uv, **settings, guess=self._guess())  # type: ignore[arg-type]
            if held_again.sum() > held.sum():
                uv, held = again, held_again
        if held.sum() < max(c.pose_points, 8):
            return False
        if not self._blind:
            self._log.turns[index] = two_view.rotation_between(self._uv[held], uv[held], self._intrinsics)
        self._followed = self._ids[held], uv[held]
        if not self._started:
            self._ids, self._uv = self._followed
        return True

    def _guess(self) -> np.ndarray:
        """Pixels of the tracks predicted by the motion model; of those without a point, by its rotation."""
        rays = two_view.rays(self._uv, self._intrinsics) @ self._motion[:3, :3].T
        guess = rays[:, :2] / np.maximum(rays[:, 2:], 0.1) * self._intrinsics[:2] + self._intrinsics[2:]
        projected = two_view.project(self._map.xyz[self._ids], self._motion @ self._T, self._intrinsics)[0]
        return np.where(np.isnan(projected), guess, projected).astype(np.float32)

    def _pose(self, index: int) -> float | None:
        """Pose of the newest frame from its tracks: from the motion model, else by RANSAC. None if lost, else the part
        of the points that agree."""
        c = self.config
        ids, uv = self._followed
        known = np.flatnonzero(self._map.known(ids))
        points, seen = self._map.xyz[ids[known]], uv[known]
        needed = max(c.pose_points, c.pose_part * len(known))
        T, inliers = refine_pose(points, seen, self._intrinsics, self._motion @ self._T, c.reprojection)
        if inliers.sum() < 0.7 * len(known):
            found = two_view.pose_from_points(points, seen, self._intrinsics, c.reprojection, self._seed + index)
            if found is not None and found[1].sum() > inliers.sum():
                T, inliers = found
        if inliers.sum() < needed:
            return None
        keep = np.ones(len(ids), bool)
        keep[known[~inliers]] = False
        self._ids, self._uv = ids[keep], uv[keep]
        self._moved(index, T)
        return float(inliers.mean())

    def _moved(self, index: int, T: np.ndarray) -> None:
        """Take a pose relative to the newest keyframe and update the motion model."""
        if self._blind == 0:
            self._motion = T @ np.linalg.inv(self._T)
            step = float(np.linalg.norm(centre(T) - centre(self._T)))
            self._speed = step if self._speed is None else 0.9 * self._speed + 0.1 * step
        else:
            self._motion = np.eye(4)
        self._T = T
        self._log.keyframes.place(index, self._map.keyframes[-1].frame, T)

    def _recover(self, world: Map, grey: np.ndarray, index: int) -> bool:
        """Find the lost camera in a map and the map's points in the image."""
        c = self.config
        found = relocalise(world, grey, self._intrinsics, c, self._seed + index)
        if found is None:
            return False
        T, keyframe = found
        near = np.argsort(-world.shared(keyframe), kind="stable")[:4]
        sources = [keyframe, *(world.keyframes[i] for i in near if world.keyframes[i] is not keyframe)]
        ids, uv = search(world, grey, T, self._intrinsics, c, sources=sources, skip=np.zeros(0, int), radius=12)
        if len(ids) < c.pose_points:
            return False
        T, inliers = refine_pose(world.xyz[ids], uv, self._intrinsics, T, c.reprojection)
        if inliers.sum() < max(2 * c.pose_points, 0.5 * len(ids)):
            return False
        if world is not self._map:
            self._map, self._old, self._started = world, Map(), True
        self._ids, self._uv = ids[inliers], uv[inliers]
        self._blind = max(self._blind, 1)
        self._moved(index, T)
        self._counts["relocalised"] += 1
        return True

    # --- keyframes ----------------------------------------------------------------------------------------------------

    def _wants_keyframe(self, index: int) -> bool:
        c, last = self.config, self._map.keyframes[-1]
        known = self._ids[self._map.known(self._ids)]
        before = last.ids[self._map.known(last.ids)]
        if len(known) < c.keyframe_points * len(before) or len(self._ids) < 0.5 * c.corners:
            return True
        _, rows, now = np.intersect1d(last.ids, self._ids, return_indices=True)
        if not len(rows):
            return True
        turn = self._T[:3, :3] @ last.T_cw[:3, :3].T
        rays = two_view.rays(last.uv[rows], self._intrinsics) @ turn.T
        turned = rays[:, :2] / np.maximum(rays[:, 2:], 0.1) * self._intrinsics[:2] + self._intrinsics[2:]
        parallax = float(np.median(np.linalg.norm(self._uv[now] - turned, axis=1)))
        return parallax > c.keyframe_parallax * float(self._intrinsics[:2].mean())

    def _insert(self, frame: Frame, grey: np.ndarray, index: int) -> None:
        """Make the newest frame a keyframe."""
        c, world = self.config, self._map
        last = world.keyframes[-1]
        shared = np.argsort(-world.shared(last), kind="stable")[:6]
        sources = [world.keyframes[i] for i in shared]
        again = search(
            world, grey, self._T, self._intrinsics, c, sources=sources, skip=self._ids, radius=2 * c.reprojection
        )
        self._ids, self._uv = np.concatenate([self._ids, again[0]]), np.concatenate([self._uv, again[1]])
        self._refill(frame, grey)
        newest = self._keyframe(index, self._T, grey)
        world.triangulate(newest, self._intrinsics, c.angle, c.reprojection)
        free, held = neighbourhood(world, newest, c.adjusted, c.anchors)
        self._adjust(free, held, c.iterations)
        gone = world.redundant(c.redundant, spared=4)
        if gone is not None:
            self._drop(gone)
        self._close_loop(newest)
        self._T = newest.T_cw
        good = np.isin(self._ids, newest.ids)
        self._ids, self._uv = self._ids[good], self._uv[good]

    def _close_loop(self, newest: Keyframe) -> None:
        """Look for an earlier visit of the place of the newest keyframe; the motion model takes the corrected unit."""
        if self._loops is None:
            return
        scale = self._loops.visit(self._map, newest, self._log.keyframes, self._intrinsics)
        if scale is not None:
            self._motion[:3, 3] /= scale
            self._speed = None if self._speed is None else self._speed / scale

    def _keyframe(self, index: int, T: np.ndarray, grey: np.ndarray) -> Keyframe:
        """Add a keyframe of the present tracks to the map; its frame is anchored to it."""
        order = np.argsort(self._ids, kind="stable")
        self._ids, self._uv = self._ids[order], self._uv[order]
        keyframe = Keyframe(index, T, self._ids, self._uv, grey)
        self._map.keyframes.append(keyframe)
        self._log.keyframes.set_pose(index, T)
        self._log.keyframes.place(index, index, T)
        self._counts["keyframes"] += 1
        return keyframe

    def _adjust(self, free: list[Keyframe], held: list[Keyframe], iterations: int) -> None:
        """Bundle adjustment of some keyframes; their frames move with them."""
        adjust(self._map, free, held, self._intrinsics, iterations, self.config.reprojection)
        for keyframe in free:
            self._log.keyframes.set_pose(keyframe.frame, keyframe.T_cw)

    def _drop(self, gone: Keyframe) -> None:
        """Remove a keyframe; its frames are anchored to the one before."""
        at = next(i for i, keyframe in enumerate(self._map.keyframes) if keyframe is gone)
        self._log.keyframes.reanchor(gone.frame, self._map.keyframes[at - 1].frame)
        del self._map.keyframes[at]
        self._counts["culled"] += 1

    def _refill(self, frame: Frame, grey: np.ndarray) -> None:
        """New corners where there are none, as landmarks without position."""
        c = self.config
        spacing = 0.5 * float(np.sqrt(grey.size / c.corners))
        uv = detect(grey, self._uv, c.corners - len(self._uv), quality=c.quality, spacing=spacing)
        ids = self._map.add(frame.image[np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)])
        self._ids, self._uv = np.concatenate([self._ids, ids]), np.concatenate([self._uv, uv])

    # --- the start ----------------------------------------------------------------------------------------------------

    def _begin(self, frame: Frame, grey: np.ndarray, index: int) -> None:
        """Make this frame the first of two views of a new map."""
        self._map, self._started = Map(), False
        self._grey, self._blind, self._pending = grey, 0, []
        self._ids, self._uv = np.zeros(0, int), np.zeros((0, 2), np.float32)
        self._refill(frame, grey)
        order = np.argsort(self._ids)
        self._first = Keyframe(index, self._T, self._ids[order], self._uv[order], grey)

    def _give_up(self, frame: Frame, grey: np.ndarray, index: int) -> None:
        """Start anew; the map stays at hand for relocalisation until the next one is started."""
        self._old = self._map
        self._begin(frame, grey, index)

    def _initialise(self, frame: Frame, grey: np.ndarray, index: int, followed: bool, problem: str) -> Estimate:
        if self._old.keyframes and self._recover(self._old, grey, index):
            self._grey, self._blind = grey, 0
            return self._log.estimate(Status.TRACKING, 0.3)
        if not followed:
            self._begin(frame, grey, index)
            return self._log.lose(index, problem)
        self._grey = grey
        assert self._first is not None
        if self._try_start(self._first, index, grey):
            return self._log.estimate(Status.TRACKING, 0.5)
        if len(self._ids) < max(0.4 * len(self._first.ids), self.config.start_points):
            self._begin(frame, grey, index)
        else:
            self._pending.append((index, self._ids, self._uv))
        return self._log.estimate(Status.INITIALISING)

    def _try_start(self, first: Keyframe, index: int, grey: np.ndarray) -> bool:
        """Start the map from the first view and this one if they are far enough apart; fill in the frames between."""
        c = self.config
        _, rows, now = np.intersect1d(first.ids, self._ids, return_indices=True)
        one, two = first.uv[rows], self._uv[now]
        waited = min((index - first.frame) / c.start_wait, 1)
        parallax = (1 - 0.5 * waited) * c.start_parallax * float(self._intrinsics[:2].mean())
        turned = two_view.rays(one, self._intrinsics) @ two_view.rotation_between(one, two, self._intrinsics).T
        turned = turned[:, :2] / turned[:, 2:] * self._intrinsics[:2] + self._intrinsics[2:]
        if np.median(np.linalg.norm(turned - two, axis=1)) < 0.1 * parallax:
            return False  # clearly too little; spares the models
        start = start_from_two_views(
            one,
            two,
            self._intrinsics,
            threshold=c.epipolar,
            reprojection=c.reprojection,
            planar=c.planar,
            seed=self._seed + index,
        )
        if start is None or start.parallax < parallax:
            return False
        good = ~np.isnan(start.points[:, 0])
        if good.sum() < max(c.start_points, 0.5 * len(rows)):
            return False
        depth = float(np.median(start.points[good, 2]))
        scale = 1 / depth if self._speed is None else self._speed * (index - first.frame)
        step = start.T_21.copy()
        step[:3, 3] *= scale
        world, first_T = self._map, first.T_cw
        world.xyz[first.ids[rows[good]]] = (scale * start.points[good] - first_T[:3, 3]) @ first_T[:3, :3]
        world.keyframes.append(first)
        self._log.keyframes.set_pose(first.frame, first_T)
        self._log.keyframes.place(first.frame, first.frame, first_T)
        self._counts["keyframes"] += 1
        second = self._keyframe(index, step @ first_T, grey)
        self._adjust([second], [first], 20)
        for frame, ids, uv in self._pending:
            known = world.known(ids)
            T, inliers = refine_pose(
                world.xyz[ids[known]], uv[known], self._intrinsics, first_T, c.reprojection, iterations=20
            )
            if inliers.sum() >= c.pose_points:
                self._log.keyframes.place(frame, first.frame, T)
        if self._old.keyframes:
            self._retired.append(self._old.points())
        self._old, self._pending, self._started = Map(), [], True
        self._T, self._motion = second.T_cw, np.eye(4)
        self._counts["maps_started"] += 1
        self._counts["planar_starts"] += int(start.planar)
        return True
