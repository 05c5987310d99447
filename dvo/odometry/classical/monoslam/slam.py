"""The filter family: MonoSLAM (Davison, Reid, Molton, Stasse 2007) with inverse-depth points and one-point RANSAC.

Reads like this: :meth:`MonoSlam.track` lets the filter predict, looks for a few good points where it expects them,
takes in those that agree (:meth:`_first_round`), looks for the rest where the better state expects them
(:meth:`_second_round`), then drops bad points and begins new ones (:meth:`_tend`). Every pose is the filter's at its
frame: nothing is optimised afterwards, that is what a filter is.

The map has its own unit of length: points begin at inverse distance 1 in the first view and later at the median of
those in view. Accelerations are in that unit.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.settings import changed
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.odometry.classical.frame_log import map_of
from dvo.odometry.classical.klt import detect
from dvo.odometry.classical.monoslam.consensus import drop_inconsistent, find_consensus
from dvo.odometry.classical.monoslam.filter import Filter, Prediction
from dvo.odometry.classical.monoslam.models import directions
from dvo.odometry.classical.monoslam.search import (
    HALF,
    Appearance,
    affine_warps,
    contrast,
    find_point,
    image_pyramid,
    self_likeness,
    templates,
)
from dvo.odometry.exclusive import sheltered
from dvo.odometry.frames.gate import Admitted, Gate
from dvo.odometry.protocol import Estimate, Result, Status


@dataclass(frozen=True)
class MonoSlamConfig:
    """Settings; pixels are those of the working image, lengths in the unit of the map (see the module).

    Attributes:
        pixels: larger images are resampled to about this many.
        noise: standard deviation of a measured pixel.
        speed, rate: what the first velocity (per s) and angular rate (rad/s) may be, standard deviations.
        acceleration, angular: unknown accelerations (per s^2 and rad/s^2), standard deviations.
        rho_sigma: standard deviation of a new point's inverse distance over its value.
        sigmas, reach: size of the search ellipse, and most pixels that it may extend from its centre.
        score: smallest normalised cross-correlation of a match.
        scouts: points of the first round.
        agree: pixels that a joint update may leave between a point and its match.
        loose, samples: expected error of a prediction, pixels, above which one match does not settle the motion, and
            the number of triples that are tried then.
        visible, capacity: points wanted in view; most points in the filter.
        quality: smallest corner strength of a new point relative to the strongest of the image.
        contrast: smallest contrast of a new point over the noise of the image.
        alike: likeness to its surroundings from which a corner is avoided.
        fewest: matches below which a frame is lost.
        patience: seconds after which a lost map is given up and a new one begun.
    """

    pixels: int = 120_000
    noise: float = 0.7
    speed: float = 0.6
    rate: float = 1.0
    acceleration: float = 1.5
    angular: float = 6.0
    rho_sigma: float = 0.5
    sigmas: float = 3.0
    reach: float = 100.0
    score: float = 0.75
    scouts: int = 14
    agree: float = 2.0
    loose: float = 12.0
    samples: int = 60
    visible: int = 60
    capacity: int = 90
    quality: float = 0.005
    contrast: float = 2.5
    alike: float = 0.75
    fewest: int = 6
    patience: float = 0.7


@sheltered
class MonoSlam:
    """See the module. Deterministic for a seed; poses are up to scale, the first frame is the world."""

    name = "monoslam"

    @checked_arguments
    def __init__(self, config: MonoSlamConfig | None = None, seed: int = 0, **settings: Any) -> None:
        self.config = changed(config or MonoSlamConfig(), settings)
        self._rng = np.random.default_rng([seed, 7501])
        self._gate = Gate(self.config.pixels)
        self._times: list[float] = []
        self._poses: list[np.ndarray | None] = []
        self._filter: Filter | None = None
        self._looks = Appearance()
        self._size = (0, 0)
        self._rho = 1.0  # inverse distance that new points are given
        self._blind_since: float | None = None
        self._starts = 0
        self._map: list[tuple[np.ndarray, np.ndarray]] = []

    def track(self, frame: Frame) -> Estimate:
        with self._gate.admit(frame) as admitted:  # a repeated image is measured: the camera stands
            return self._process(admitted)

    def _process(self, admitted: Admitted) -> Estimate:
        frame, image, camera = admitted.frame, admitted.image, admitted.camera
        pyramid = image_pyramid(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        self._size = (camera.width, camera.height)
        dt = frame.timestamp - self._times[-1] if self._times else 0.0
        self._times.append(frame.timestamp)
        if self._filter is None and admitted.problem:
            self._poses.append(None)
            return Estimate(frame.timestamp, None, Status.LOST, reason=admitted.problem)
        if self._filter is None:
            self._filter = self._begin(camera.intrinsics)
            self._refill(pyramid, image)
            self._poses.append(self._pose())
            return Estimate(frame.timestamp, self._pose(), Status.INITIALISING)
        state, c = self._filter, self.config
        state.predict(dt, c.acceleration / self._rho, c.angular)
        looked, matched = self._measure(state, pyramid)
        sound = state.is_sound()
        if matched < c.fewest or matched < 0.25 * looked or not sound:
            return replace(self._lost(frame, pyramid, image, sound), reason=admitted.problem)
        self._blind_since = None
        self._tend(state, pyramid, image)
        self._poses.append(self._pose())
        settled = (state.rho_sigma < 0.3 * state.points[:, 5]).sum() >= c.fewest
        return Estimate(
            frame.timestamp, self._pose(), Status.TRACKING if settled else Status.INITIALISING, matched / looked
        )

    def finish(self) -> Result:
        if self._gate.finish():
            self._retire(None)
        rows = [index for index, pose in enumerate(self._poses) if pose is not None]
        poses = np.array([self._poses[index] for index in rows]).reshape(-1, 7)
        return Result(
            trajectory=Trajectory(np.array([self._times[index] for index in rows]), poses),
            map=map_of(self._map),
            frames_read=len(self._times),
            frames_lost=len(self._times) - len(rows),
            info={
                "working_size": list(self._size),
                "working_intrinsics": [] if self._filter is None else self._filter.intrinsics.tolist(),
                "maps_started": self._starts,
                "config": asdict(self.config),
            },
        )

    # --- measuring ----------------------------------------------------------------------------------------------------

    def _measure(self, state: Filter, pyramid: list[np.ndarray]) -> tuple[int, int]:
        """Both rounds. Returns how many points were looked for and how many were taken in."""
        looked = np.zeros(len(state), bool)
        found = np.zeros(len(state), bool)
        expected = state.expect()
        in_view = self._in_view(expected)
        self._first_round(state, pyramid, expected, in_view, looked, found)
        if found.any():
            self._second_round(state, pyramid, in_view, looked, found)
        looks = self._looks
        looks.unseen = np.where(in_view, 0, looks.unseen + 1)
        looks.tried, looks.found = looks.tried + looked, looks.found + found
        looks.missed = np.where(found, 0, looks.missed + looked)
        return int(looked.sum()), int(found.sum())

    def _first_round(
        self,
        state: Filter,
        pyramid: list[np.ndarray],
        expected: Prediction,
        in_view: np.ndarray,
        looked: np.ndarray,
        found: np.ndarray,
    ) -> None:
        """A few long-lived points all over the image pin the motion down: wide ellipses, one-point RANSAC."""
        c = self.config
        scouts = self._scouts(expected, in_view)
        if len(scouts) < 4:
            return
        loose = np.sqrt(np.trace(expected.spread[scouts], axis1=1, axis2=2)).mean() > c.loose
        scouts = scouts if loose else scouts[: c.scouts]
        rows, seen = self._look(state, pyramid, expected, scouts)
        looked[scouts] = True
        innovations, S = seen - expected.pixels[rows], state.innovation(rows, expected)[1]
        good = find_consensus(innovations, S, c.samples if loose else 0, self._rng)
        if good.sum() < max(4, (0.25 if loose else 0.4) * len(rows)):
            return
        state.update(rows[good], seen[good], expected)
        found[rows[good]] = True

    def _second_round(
        self, state: Filter, pyramid: list[np.ndarray], in_view: np.ndarray, looked: np.ndarray, found: np.ndarray
    ) -> None:
        """All other points, in ellipses that the first round has shrunk."""
        expected = state.expect()
        rest = np.flatnonzero(self._in_view(expected) & in_view & ~looked)
        rows, seen = self._look(state, pyramid, expected, rest)
        looked[rest] = True
        S = state.innovation(rows, expected)[1]
        good = drop_inconsistent(seen - expected.pixels[rows], S, self.config.noise, self.config.agree)
        state.update(rows[good], seen[good], expected)
        found[rows[good]] = True

    def _look(
        self, state: Filter, pyramid: list[np.ndarray], expected: Prediction, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Search some points. Returns those that were found and their pixels ``(M, 2)``."""
        c = self.config
        warps = affine_warps(self._looks, state.points, state.r, state.q, state.intrinsics)
        patches, usable = templates(self._looks, warps, rows)
        hits, places = [], []
        for row, patch, good in zip(rows, patches, usable, strict=True):
            if good:
                centre, spread = expected.pixels[row], expected.spread[row]
                match = find_point(pyramid, patch, centre, spread, sigmas=c.sigmas, reach=c.reach)
                if match is not None and match[1] >= c.score:
                    hits.append(row)
                    places.append(match[0])
        return np.array(hits, int), np.array(places).reshape(-1, 2)

    def _scouts(self, expected: Prediction, in_view: np.ndarray) -> np.ndarray:
        """Points of the first round: in turn from every cell of a 4x4 grid, the most often found first."""
        rows = np.flatnonzero(in_view)
        cell = np.clip((4 * expected.pixels[rows] / self._size).astype(int), 0, 3) @ [1, 4]
        order = np.lexsort((rows, -self._looks.found[rows]))
        rows, cell = rows[order], cell[order]
        turn = np.array([(cell[:k] == own).sum() for k, own in enumerate(cell)], int)
        return rows[np.lexsort((-self._looks.found[rows], turn))][: 2 * self.config.scouts]

    def _in_view(self, expected: Prediction) -> np.ndarray:
        low, high = HALF, np.array(self._size) - 1 - HALF
        return expected.front & ((expected.pixels >= low) & (expected.pixels <= high)).all(1)

    # --- the map ------------------------------------------------------------------------------------------------------

    def _begin(self, intrinsics: np.ndarray) -> Filter:
        """A new map, where the camera was last known to be."""
        c = self.config
        state = Filter(intrinsics, c.noise, c.speed / self._rho, c.rate)
        last = next((pose for pose in reversed(self._poses) if pose is not None), None)
        if last is not None:
            state.r, state.q = last[:3].copy(), last[3:].copy()
        self._looks, self._blind_since = Appearance(), None
        self._starts += 1
        return state

    def _tend(self, state: Filter, pyramid: list[np.ndarray], image: np.ndarray) -> None:
        """Drop points that are not found again, are behind infinity, or are long out of view; begin new ones."""
        looks = self._looks
        unreliable = (looks.tried >= 6) & (looks.found < 0.5 * looks.tried)
        fresh = (looks.found < 3) & (looks.missed >= 2)
        beyond = state.points[:, 5] + 2 * state.rho_sigma < 0
        self._forget(unreliable | fresh | beyond | (looks.missed >= 12))
        expected = state.expect()
        in_view = self._in_view(expected)
        wanted = self.config.visible - int(in_view.sum())
        spare = self.config.capacity - len(state)
        if wanted > spare:  # the ones that have been out of view longest make room
            old = np.argsort(-looks.unseen, kind="stable")[: wanted - spare]
            drop = np.zeros(len(state), bool)
            drop[old] = ~in_view[old]
            self._forget(drop)
        self._rho = self._typical_rho(state)
        if wanted >= max(1, 0.1 * self.config.visible):
            self._refill(pyramid, image)

    def _typical_rho(self, state: Filter) -> float:
        """Median inverse distance of the points that are known well and in view now, else as before."""
        sure = (self._looks.unseen == 0) & (state.rho_sigma < 0.3 * state.points[:, 5])
        if sure.sum() < self.config.fewest:
            return self._rho
        ray, _ = directions(state.points[sure])
        offset = state.points[sure, :3] + ray / state.points[sure, 5:] - state.r
        return float(1 / np.median(np.linalg.norm(offset, axis=1)))

    def _refill(self, pyramid: list[np.ndarray], image: np.ndarray) -> None:
        """Begin points on corners away from those in view."""
        c, state = self.config, self._filter
        assert state is not None
        expected = state.expect()
        there = expected.pixels[self._in_view(expected)]
        wanted = min(c.visible - len(there), c.capacity - len(state))
        grey, edge = pyramid[0], HALF + 3
        spacing = 0.6 * float(np.sqrt(grey.size / c.visible))
        inner = np.ascontiguousarray(grey[edge:-edge, edge:-edge])
        near = there[((there > -1e4) & (there < 1e4)).all(1)] - edge
        corners = detect(inner, near, 2 * wanted, quality=c.quality, spacing=spacing)
        corners = np.rint(corners).astype(int) + edge
        corners = corners[contrast(grey, corners) > c.contrast]
        # Points of repeating patterns only as far as there would be too few without them.
        likeness = self_likeness(grey, corners)
        enough = np.arange(len(corners)) + len(there) < c.visible // 3
        order = np.argsort(likeness, kind="stable")
        corners = corners[order][(likeness[order] < c.alike) | enough][:wanted]
        if len(corners):
            state.add(corners, self._rho, c.rho_sigma * self._rho)
            self._looks.add(corners, pyramid, image, state.q)

    def _forget(self, gone: np.ndarray) -> None:
        if gone.any():
            self._retire(gone)
            assert self._filter is not None
            self._filter.keep(~gone)
            self._looks.keep(~gone)

    def _retire(self, gone: np.ndarray | None) -> None:
        """Put the well-known ones of the points that go (None: all) into the map that is handed out."""
        state = self._filter
        if state is None or not state.is_sound():
            return
        good = (state.rho_sigma < 0.2 * state.points[:, 5]) & (self._looks.found >= 5)
        good &= True if gone is None else gone
        if good.any():
            ray, _ = directions(state.points[good])
            points = state.points[good, :3] + ray / state.points[good, 5:]
            self._map.append((points.astype(np.float32), self._looks.color[good]))

    # --- the camera ---------------------------------------------------------------------------------------------------

    def _lost(self, frame: Frame, pyramid: list[np.ndarray], image: np.ndarray, sound: bool) -> Estimate:
        """Too few matches: coast on the motion model for a while, then begin anew."""
        self._blind_since = frame.timestamp if self._blind_since is None else self._blind_since
        state = self._filter
        assert state is not None
        self._poses.append(None)
        if not sound or len(state) < self.config.fewest or frame.timestamp - self._blind_since > self.config.patience:
            self._retire(None)
            self._filter = self._begin(state.intrinsics)
            self._refill(pyramid, image)
        return Estimate(frame.timestamp, None, Status.LOST)

    def _pose(self) -> np.ndarray:
        assert self._filter is not None
        return np.concatenate([self._filter.r, self._filter.q])
