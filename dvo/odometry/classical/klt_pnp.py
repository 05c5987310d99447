"""The classical baseline: KLT tracks, five-point essential matrix, triangulation, PnP. No bundle adjustment, no loops.

Reads like this: :meth:`KltPnp.track` follows the corners into the new image, then either tries to start from two views
(:meth:`_try_start`) or takes the pose from the points that are known (:meth:`_pose`) and refines the points with the
new view (:meth:`_update_points`).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.settings import changed
from dvo.data.frame import Frame
from dvo.odometry.classical import two_view
from dvo.odometry.classical.frame_log import FrameLog, map_of
from dvo.odometry.classical.klt import Tracks, detect, follow
from dvo.odometry.exclusive import sheltered
from dvo.odometry.frames.gate import Admitted, Gate
from dvo.odometry.protocol import Estimate, Result, Status


@dataclass(frozen=True)
class KltPnpConfig:
    """Settings; pixels are those of the images given, angles degrees.

    Attributes:
        corners: number of tracks kept alive.
        refill: new corners are looked for when fewer than this part of ``corners`` is alive.
        quality, window, levels, closed: corner strength, patch side, pyramid levels and forward-backward tolerance.
        start_parallax: rotation-compensated parallax that starts the map, as part of the focal length.
        start_points: points that the first two views must give.
        angle: smallest angle between the views from which a point is triangulated.
        epipolar, reprojection: inlier thresholds, pixels.
        pose_points: inliers below which a pose from points is not believed.
        step_parallax: parallax in pixels that a step between two views needs to have a direction.
        step_points: points that the length of such a step needs.
        patience: frames without a usable track before the map is given up and started anew.
    """

    corners: int = 800
    refill: float = 0.85
    quality: float = 0.001
    window: int = 15
    levels: int = 4
    closed: float = 0.7
    start_parallax: float = 0.04
    start_points: int = 40
    angle: float = 1.0
    epipolar: float = 1.0
    reprojection: float = 2.0
    pose_points: int = 12
    step_parallax: float = 1.5
    step_points: int = 5
    patience: int = 10


@sheltered
class KltPnp:
    """See the module. Deterministic for a seed; poses are up to scale, the first frame is the world."""

    name = "klt-pnp"

    @checked_arguments
    def __init__(self, config: KltPnpConfig | None = None, seed: int = 0, **settings: Any) -> None:
        self.config = changed(config or KltPnpConfig(), settings)
        self.seed = seed
        self._gate = Gate(pixels=None)
        self._log = FrameLog()
        self._tracks = Tracks()
        self._grey: np.ndarray | None = None  # the last image in which the tracks were seen
        self._intrinsics = np.ones(4)
        self._size = (0, 0)
        self._started = False
        self._reference = 0
        self._reference_count = 0
        self._pending: list[tuple[int, np.ndarray, np.ndarray]] = []  # frame, ids, uv: to be back-filled at the start
        self._speed: float | None = None  # camera centres' distance per frame, running mean; None before the first map
        self._starts = 0
        self._blind = 0
        self._map: list[tuple[np.ndarray, np.ndarray]] = []

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
        if admitted.problem or not self._follow(grey, index):
            self._blind += 1
            if self._blind >= self.config.patience or not self._started:
                self._begin(frame, grey, index)
            return self._log.lose(index, admitted.problem)
        self._grey, self._blind = grey, 0
        if not self._started:
            self._try_start(frame, grey, index)
            return self._log.estimate(Status.TRACKING if self._started else Status.INITIALISING, 0.5)
        confidence = self._pose(index)
        self._update_points(index)
        self._refill(frame, grey, index)
        return self._log.estimate(Status.TRACKING, confidence)

    def finish(self) -> Result:
        if self._gate.finish():
            self._retire(np.ones(len(self._tracks), bool))
        info = {
            "working_size": list(self._size),
            "working_intrinsics": self._intrinsics.tolist(),
            "maps_started": self._starts,
            "config": asdict(self.config),
        }
        return self._log.result(map_of(self._map), info)

    # --- tracks -------------------------------------------------------------------------------------------------------

    def _follow(self, grey: np.ndarray, index: int) -> bool:
        """Carry the tracks into the new image. False, and nothing changed, when too few hold."""
        assert self._grey is not None
        c, tracks = self.config, self._tracks
        uv, held = follow(self._grey, grey, tracks.uv, window=c.window, levels=c.levels, tolerance=c.closed)
        if held.sum() < max(c.pose_points, 8):
            return False
        if not self._blind:
            self._log.turns[index] = two_view.rotation_between(tracks.uv[held], uv[held], self._intrinsics)
        self._retire(~held)
        tracks.keep(held)
        tracks.last_uv, tracks.uv = tracks.uv, uv[held]
        return True

    def _refill(self, frame: Frame, grey: np.ndarray, index: int) -> None:
        c, tracks = self.config, self._tracks
        if len(tracks) < c.refill * c.corners:
            spacing = 0.5 * float(np.sqrt(grey.size / c.corners))
            corners = detect(grey, tracks.uv, c.corners - len(tracks), quality=c.quality, spacing=spacing)
            tracks.add(corners, index, frame.image)

    def _retire(self, gone: np.ndarray) -> None:
        """Put the points of tracks that end into the map."""
        ends = gone & self._tracks.has_point
        if ends.any():
            self._map.append((self._tracks.points[ends].astype(np.float32), self._tracks.colors[ends]))

    # --- the start ----------------------------------------------------------------------------------------------------

    def _begin(self, frame: Frame, grey: np.ndarray, index: int) -> None:
        """Make this frame the first of two views."""
        self._retire(np.ones(len(self._tracks), bool))
        self._tracks.keep(np.zeros(len(self._tracks), bool))
        self._grey, self._started, self._blind = grey, False, 0
        self._refill(frame, grey, index)
        self._reference, self._reference_count, self._pending = index, len(self._tracks), []

    def _try_start(self, frame: Frame, grey: np.ndarray, index: int) -> None:
        c, tracks = self.config, self._tracks
        pair = two_view.relative_pose(tracks.anchor_uv, tracks.uv, self._intrinsics, c.epipolar, self.seed + index)
        focal = float(self._intrinsics[:2].mean())
        if pair is not None and pair.parallax > c.start_parallax * focal and self._start(pair, index):
            self._update_points(index)
            self._refill(frame, grey, index)
        elif len(tracks) < max(0.4 * self._reference_count, c.start_points):
            self._begin(frame, grey, index)
        else:
            self._pending.append((index, tracks.ids.copy(), tracks.uv.copy()))

    def _start(self, pair: two_view.RelativePose, index: int) -> bool:
        """Points from the two views, poses of the frames between by PnP. False if the points are not convincing."""
        c, tracks = self.config, self._tracks
        first = self._log.last_pose()
        second = pair.T_21 @ first
        terms = [
            two_view.ray_terms(two_view.rays(uv, self._intrinsics) @ T[:3, :3], _centre(T), np.ones(len(tracks)))
            for uv, T in ((tracks.anchor_uv, first), (tracks.uv, second))
        ]
        points = two_view.solve_points(terms[0] + terms[1])
        good = (
            pair.inliers & self._seen_well(points, tracks.anchor_uv, first) & self._seen_well(points, tracks.uv, second)
        )
        if good.sum() < max(c.start_points, 0.5 * len(tracks)):
            return False
        depth = float(np.median(two_view.project(points[good], first, self._intrinsics)[1]))
        scale = 1 / depth if self._speed is None else self._speed * (index - self._reference)
        second[:3, 3] = scale * pair.T_21[:3, 3] + pair.T_21[:3, :3] @ first[:3, 3]
        self._log.set_pose(self._reference, first)
        self._log.set_pose(index, second)
        tracks.points[good] = _centre(first) + scale * (points[good] - _centre(first))
        tracks.keep(good | ~pair.inliers)
        self._observe(np.arange(len(tracks)), tracks.anchor_uv, first)
        for frame, ids, uv in self._pending:
            row = {track: position for position, track in enumerate(ids)}
            both = np.array([i for i, track in enumerate(tracks.ids) if track in row and tracks.has_point[i]], int)
            seen = uv[[row[tracks.ids[i]] for i in both]]
            pose = two_view.pose_from_points(
                tracks.points[both], seen, self._intrinsics, c.reprojection, self.seed + frame
            )
            if pose is not None:
                self._log.set_pose(frame, pose[0])
                self._observe(both[pose[1]], seen[pose[1]], pose[0])
        self._started, self._pending = True, []
        self._starts += 1
        return True

    # --- poses and points ---------------------------------------------------------------------------------------------

    def _pose(self, index: int) -> float:
        """Pose of the newest frame by PnP, else from two views; the part of the points that agree with it."""
        c, tracks = self.config, self._tracks
        known = np.flatnonzero(tracks.has_point)
        points, uv = tracks.points[known], tracks.uv[known]
        found = two_view.pose_from_points(points, uv, self._intrinsics, c.reprojection, self.seed + index)
        if found is not None and found[1].sum() >= max(c.pose_points, 0.2 * len(known)):
            T, inliers = found
        else:
            T = self._step(index, known)
            inliers = self._seen_well(points, uv, T)
        before = self._log.pose(index - 1)
        if before is not None:
            step = float(np.linalg.norm(_centre(T) - _centre(before)))
            self._speed = step if self._speed is None else 0.9 * self._speed + 0.1 * step
        self._log.set_pose(index, T)
        tracks.keep(np.isin(np.arange(len(tracks)), known[~inliers], invert=True))
        return float(inliers.mean()) if len(known) else 0.0

    def _step(self, index: int, known: np.ndarray) -> np.ndarray:
        """Too few points for PnP: motion since the frame before by the essential matrix.

        Its length comes from the points that are left, or else the camera keeps its speed; without parallax it is 0.
        """
        c, tracks = self.config, self._tracks
        last = self._log.last_pose()
        pair = two_view.relative_pose(tracks.last_uv, tracks.uv, self._intrinsics, c.epipolar, self.seed + index)
        step = np.eye(4)
        if pair is None or pair.parallax < c.step_parallax:
            step[:3, :3] = two_view.rotation_between(tracks.last_uv, tracks.uv, self._intrinsics)
            return step @ last
        step = pair.T_21.copy()
        local = tracks.points[known] @ last[:3, :3].T + last[:3, 3]
        lengths = two_view.step_length(local, two_view.rays(tracks.uv[known], self._intrinsics), step)
        length = float(np.median(lengths)) if len(lengths) >= c.step_points else 0.0
        step[:3, 3] *= length if length > 0 else self._speed or 0.0
        return step @ last

    def _known_pose(self, index: int) -> np.ndarray:
        """World-to-camera pose ``(4, 4)`` of a frame that has one."""
        pose = self._log.pose(index)
        assert pose is not None
        return pose

    def _update_points(self, index: int) -> None:
        """Add the newest view to every point, triangulate what has become possible, drop what contradicts."""
        c, tracks = self.config, self._tracks
        T = self._known_pose(index)
        old = np.flatnonzero(tracks.has_point)
        self._observe(old, tracks.uv[old], T)
        new = np.flatnonzero(~tracks.has_point & (tracks.anchor != index))
        if len(new):
            first, which = np.unique(tracks.anchor[new], return_inverse=True)
            anchors = [self._known_pose(a) for a in first]
            R = np.array([a[:3, :3] for a in anchors])[which]
            centres = np.array([_centre(a) for a in anchors])[which]
            one = np.einsum("nji,nj->ni", R, two_view.rays(tracks.anchor_uv[new], self._intrinsics))
            two = two_view.rays(tracks.uv[new], self._intrinsics) @ T[:3, :3]
            ones = np.ones(len(new))
            points = two_view.solve_points(
                two_view.ray_terms(one, centres, ones) + two_view.ray_terms(two, _centre(T), ones)
            )
            cosine = (one * two).sum(1) / np.linalg.norm(one, axis=1) / np.linalg.norm(two, axis=1)
            depth = np.einsum("ni,ni->n", points - centres, R[:, 2])
            good = (cosine < np.cos(np.radians(c.angle))) & (depth > 0) & self._seen_well(points, tracks.uv[new], T)
            chosen = new[good]
            tracks.points[chosen] = points[good]
            tracks.normal[chosen] = two_view.ray_terms(one[good], centres[good], depth[good] ** -2)
            self._observe(chosen, tracks.uv[chosen], T)

    def _observe(self, rows: np.ndarray, uv: np.ndarray, T_cw: np.ndarray) -> None:
        """Add one view of the points ``rows`` to their normal equations and solve them again."""
        tracks = self._tracks
        known = tracks.has_point[rows]
        rows, uv = rows[known], uv[known]
        depth = np.maximum(two_view.project(tracks.points[rows], T_cw, self._intrinsics)[1], 1e-6)
        directions = two_view.rays(uv, self._intrinsics) @ T_cw[:3, :3]
        tracks.normal[rows] += two_view.ray_terms(directions, _centre(T_cw), depth**-2)
        solved = two_view.solve_points(tracks.normal[rows])
        better = self._seen_well(solved, uv, T_cw)
        tracks.points[rows[better]] = solved[better]

    def _seen_well(self, points: np.ndarray, uv: np.ndarray, T_cw: np.ndarray) -> np.ndarray:
        """``(N,)`` bool: in front of the camera and within the reprojection threshold of the pixel."""
        pixels, depth = two_view.project(points, T_cw, self._intrinsics)
        error = np.nan_to_num(np.linalg.norm(pixels - uv, axis=1), nan=np.inf)
        return (depth > 0) & (error < self.config.reprojection)


def _centre(T_cw: np.ndarray) -> np.ndarray:
    return -T_cw[:3, :3].T @ T_cw[:3, 3]
