"""Shot: one camera on one path through one scene, rendered at any time through its shutter.

Timestamp, pose, depth, surfaces and all other ground truth of a frame are those of the middle of the exposure. With a
rolling shutter each row has a middle of its own (:func:`row_offsets`); the frame's pose is that of the middle row,
depth and surfaces are those of each row's camera. Motion blur is the mean of sharp images taken along the path of the
camera and of the bodies; ground truth stays that of mid-exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.geometry.poses import compose_rodrigues, pose_from, quaternion_to_matrix, split
from dvo.synth.protocols import Motion
from dvo.synth.render.lens import distorted_pixels, plate_of, render_lens, undistorted_pixels
from dvo.synth.render.quality import Quality
from dvo.synth.render.renderer import Rendering, render, trace
from dvo.synth.render.rolling import render_rows, row_offsets
from dvo.synth.scenes.bodies import Stage
from dvo.synth.scenes.scene import Scene

Array = np.ndarray
BLUR_STEP, MOST = 1.5, 15  # pixels between sub-exposures, and how many there are at most


@dataclass(frozen=True)
class Offset:
    """Motion of a frame fixed to a moving one: ``T_wc(t) T_cd``.

    Attributes:
        motion: T_wc.
        mount: ``(7,)`` T_cd.
    """

    motion: Motion
    mount: Array

    def poses_wc(self, times: Array) -> Array:
        """Poses ``(T, 7)`` at ``times (T,)`` seconds.

        Args:
            times: ``(T,)`` seconds.

        Returns:
            ``(T, 7)``.
        """
        poses = self.motion.poses_wc(times)
        return compose_rodrigues(poses, np.broadcast_to(self.mount, poses.shape))


@dataclass(frozen=True)
class Rest:
    """Motion that stays at one pose.

    Attributes:
        pose_wc: ``(7,)``.
    """

    pose_wc: Array

    def poses_wc(self, times: Array) -> Array:
        """Poses ``(T, 7)`` at ``times (T,)`` seconds.

        Args:
            times: ``(T,)`` seconds.

        Returns:
            ``(T, 7)``.
        """
        return np.tile(np.asarray(self.pose_wc, float), (len(np.asarray(times)), 1))


@dataclass(frozen=True)
class Shot:
    """Scene, path and read-out of the sensor.

    Attributes:
        scene: static, or a :class:`Stage` with moving bodies.
        path: camera to world at any time.
        camera: pinhole, or with distortion (:mod:`dvo.synth.render.lens`); depth is along the optical axis in any case;
            its own readout is not used.
        exposure: seconds during which a row gathers light; 0 freezes the motion.
        readout: seconds from the first to the last row of a rolling shutter; 0 is a global shutter.
        supersample: rays per pixel edge for the colours.
        device: where to render.

    Raises:
        DvoError: a rolling shutter with a lens with distortion, which is not supported.
    """

    scene: Scene | Stage
    path: Motion
    camera: Camera
    exposure: float = 0.0
    readout: float = 0.0
    supersample: int = 1
    device: torch.device | str = "cpu"

    def __post_init__(self) -> None:
        if self.readout > 0 and self.camera.needs_undistortion:
            raise DvoError(
                "a rolling shutter is not rendered through a lens with distortion",
                field="readout, camera",
                remedy="set readout to 0 or give a camera without model",
            )

    @property
    def _size(self) -> tuple[int, int]:
        return self.camera.height, self.camera.width

    def beside(self, baseline: float) -> Shot:
        """Shot of the second camera of a rectified stereo pair.

        Args:
            baseline: distance to the right, world units.

        Returns:
            The shot of the right camera.
        """
        return replace(self, path=Offset(self.path, np.array([baseline, 0, 0, 0, 0, 0, 1.0])))

    def sharp(self, time: float, pose_wc: Array | None = None, coordinates: bool = True) -> Rendering:
        """Image frozen in the middle of the exposure.

        Args:
            time: seconds.
            pose_wc: ``(1, 7)`` saves evaluating the path.
            coordinates: fill ``uv`` too.

        Returns:
            Batch of one.
        """
        if self.readout > 0:
            when = self._row_times(time)
            poses = self.path.poses_wc(when)
            return render_rows(
                self.scene, poses, self.camera.intrinsics, self.camera.width, times=when,
                quality=Quality(self.supersample), device=self.device, coordinates=coordinates,
            )  # fmt: skip
        when = np.array([time])
        pose = self.path.poses_wc(when) if pose_wc is None else pose_wc
        return self._render(pose, when, self.supersample, coordinates)

    def _render(self, poses_wc: Array, when: Array, supersample: int = 1, coordinates: bool = True) -> Rendering:
        """Sharp frames ``(N, ...)`` with a global shutter."""
        if self.camera.needs_undistortion:
            return render_lens(
                self.scene, poses_wc, self.camera, times=when, quality=Quality(supersample), device=self.device,
                coordinates=coordinates,
            )  # fmt: skip
        return render(
            self.scene, poses_wc, self.camera.intrinsics, *self._size, times=when, quality=Quality(supersample),
            device=self.device, coordinates=coordinates,
        )  # fmt: skip

    def rendering(self, time: float, pose_wc: Array | None = None, coordinates: bool = True) -> Rendering:
        """Clean image, with motion blur if the exposure lasts.

        Args:
            time: seconds.
            pose_wc: ``(1, 7)`` saves evaluating the path.
            coordinates: fill ``uv`` too.

        Returns:
            Batch of one.
        """
        middle = self.sharp(time, pose_wc, coordinates)
        if self.exposure <= 0:
            return middle
        count = self.sub_exposures(middle, time)
        total = middle.images.clone()
        offsets = ((np.arange(count) + 0.5) / count - 0.5) * self.exposure
        others = time + np.delete(offsets, count // 2)
        if self.readout > 0:
            for other in others:
                when = self._row_times(other)
                poses, k = self.path.poses_wc(when), self.camera.intrinsics
                rows = render_rows(
                    self.scene, poses, k, self.camera.width, times=when, device=self.device, coordinates=False
                )
                total += rows.images
        elif count > 1:
            many = self._render(self.path.poses_wc(others), others, coordinates=False)
            total += many.images.sum(0, keepdim=True)
        return replace(middle, images=total / count)

    def sub_exposures(self, middle: Rendering, time: float) -> int:
        """Number of sharp images that make up a blurred one.

        It is odd, and large enough for steps of at most ``BLUR_STEP`` pixels in 95 % of the image (but at most
        ``MOST``).

        Args:
            middle: sharp image at mid-exposure.
            time: seconds.

        Returns:
            Number of images.
        """
        step = 10
        depth = middle.depth[0, ::step, ::step].cpu().numpy().astype(float)
        surface = middle.surface[0, ::step, ::step].cpu().numpy().ravel()
        y, x = np.mgrid[: self.camera.height : step, : self.camera.width : step]
        pixels = np.stack([x.ravel(), y.ravel()], -1).astype(float)
        hit = depth.ravel() > 0
        if not hit.any():
            return 1
        points = self.lift(time, pixels[hit], depth.ravel()[hit], surface[hit])
        first, last = (self.place(time + s * self.exposure, points, surface[hit]) for s in (-0.5, 0.5))
        seen = (first[1] > 0) & (last[1] > 0)
        if not seen.any():
            return MOST
        longest = float(np.quantile(np.linalg.norm(last[0] - first[0], axis=-1)[seen], 0.95))
        return int(np.clip(2 * np.ceil((longest / BLUR_STEP - 1) / 2) + 1, 1, MOST))

    def lift(self, time: float, pixels: Array, depth: Array, surface: Array) -> Array:
        """Points shown by pixels, each in the frame of its owner: the world, or a body.

        Args:
            time: of the frame, seconds.
            pixels: ``(M, 2)``.
            depth, surface: ``(M,)``.

        Returns:
            ``(M, 3)``.
        """
        fx, fy, cx, cy = self.camera.intrinsics
        ideal = undistorted_pixels(pixels, self.camera)
        ray = np.stack([(ideal[:, 0] - cx) / fx, (ideal[:, 1] - cy) / fy, np.ones(len(pixels))], -1)
        rotation, centre = self._read(self.path, time, pixels[:, 1])
        points = (rotation @ (ray * depth[:, None])[..., None])[..., 0] + centre
        for at, motion in self._moving(surface):
            turn, shift = self._read(motion, time, pixels[at, 1])
            points[at] = (np.swapaxes(turn, -1, -2) @ (points[at] - shift)[..., None])[..., 0]
        return points

    def place(self, time: float, points: Array, surface: Array) -> tuple[Array, Array]:
        """Projection of points from :meth:`lift` into a frame.

        With a rolling shutter the row determines the pose and the pose the row: solved by fixed-point steps.

        Args:
            time: of the frame, seconds.
            points: ``(M, 3)``.
            surface: ``(M,)``.

        Returns:
            Pixels ``(M, 2)`` and depth ``(M,)``; points behind the camera have depth <= 0 and pixels without meaning.
        """
        fx, fy, cx, cy = self.camera.intrinsics
        moving = self._moving(surface)
        rows = np.full(len(points), (self.camera.height - 1) / 2)
        for _ in range(12 if self.readout > 0 else 1):
            world = points.copy()
            for at, motion in moving:
                turn, shift = self._read(motion, time, rows[at])
                world[at] = (turn @ points[at][..., None])[..., 0] + shift
            rotation, centre = self._read(self.path, time, rows)
            local = (np.swapaxes(rotation, -1, -2) @ (world - centre)[..., None])[..., 0]
            z = local[:, 2]
            ahead = np.where(z > 1e-9, z, 1e-9)
            pixels = distorted_pixels(
                np.stack([fx * local[:, 0] / ahead + cx, fy * local[:, 1] / ahead + cy], -1), self.camera
            )
            change = float(np.abs(pixels[:, 1] - rows).max(initial=0))
            rows = np.clip(pixels[:, 1], -1.0, self.camera.height)
            if change < 1e-7:
                break
        return pixels, z

    def inside(self, pixels: Array, depth: Array) -> Array:
        """Points in front of the camera and in the image.

        Args:
            pixels: ``(M, 2)``.
            depth: ``(M,)``.

        Returns:
            ``(M,)`` bool.
        """
        edge = np.array([self.camera.width, self.camera.height]) - 0.5
        return (depth > 0) & (pixels >= -0.5).all(-1) & (pixels <= edge).all(-1)

    def trace(self, time: float, pixels: Array) -> tuple[Array, Array, Array]:
        """Surfaces at places of a frame (not only at pixel centres), in float64.

        Args:
            time: of the frame, seconds.
            pixels: ``(M, 2)``.

        Returns:
            depth ``(M,)``, surface ``(M,)``, uv ``(M, 2)``.
        """
        k = self.camera.intrinsics
        if self.readout <= 0:
            when, size = np.array([time]), self._size
            if self.camera.needs_undistortion:  # through the pinhole picture that covers what the lens sees
                plate = plate_of(self.camera, 2)
                pixels = undistorted_pixels(pixels, self.camera) + (plate.intrinsics - k)[2:]
                k, size = plate.intrinsics, plate.size
            depth, surface, uv = trace(self.scene, self.path.poses_wc(when), k, pixels[None], when, size)
            return depth[0], surface[0], uv[0]
        when = time + row_offsets(pixels[:, 1], self.camera.height, self.readout)
        poses = pose_from(*self._read(self.path, time, pixels[:, 1]))
        k = np.tile(k, (len(pixels), 1))
        k[:, 2:] -= pixels  # each pixel is the origin of a camera of its own
        depth, surface, uv = trace(self.scene, poses, k, np.zeros((len(pixels), 1, 2)), when, (1, 1))
        return depth[:, 0], surface[:, 0], uv[:, 0]

    def _row_times(self, time: float) -> Array:
        return time + row_offsets(np.arange(self.camera.height), self.camera.height, self.readout)

    def _moving(self, surface: Array) -> list[tuple[Array, Motion]]:
        """Points on each moving body: indices and the body's motion."""
        if not isinstance(self.scene, Stage) or not self.scene.bodies:
            return []
        owner = self.scene.owner(surface)
        riders = [(np.flatnonzero(owner == k + 1), body.motion) for k, body in enumerate(self.scene.bodies)]
        return [(at, motion) for at, motion in riders if len(at)]

    def _read(self, motion: Motion, time: float, rows: Array) -> tuple[Array, Array]:
        """Rotation ``(M, 3, 3)`` or ``(1, 3, 3)`` and translation of a motion while ``rows (M,)`` are exposed.

        Between neighbouring whole rows poses are interpolated: they are about 1e-4 s apart, the error is below 1e-8.
        """
        if self.readout <= 0:
            return split(motion.poses_wc(np.array([time])))
        grid = np.arange(-2, self.camera.height + 3)
        table = motion.poses_wc(time + row_offsets(grid, self.camera.height, self.readout))
        table[1:, 3:] *= np.cumprod(np.where((table[1:, 3:] * table[:-1, 3:]).sum(-1) < 0, -1.0, 1.0))[:, None]
        place = np.clip(rows, grid[0], grid[-1] - 1e-9) - grid[0]
        index = place.astype(int)
        share = (place - index)[:, None]
        mixed = (1 - share) * table[index] + share * table[index + 1]
        return quaternion_to_matrix(mixed[:, 3:]), mixed[:, :3]
