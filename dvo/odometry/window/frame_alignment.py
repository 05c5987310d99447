"""Alignment of a frame with the window, without the network: the pose of a frame that has moved little.

Patches of the newest keyframes are followed from the frame before (Lucas-Kanade in a pyramid, from where the motion
model expects them), which gives a first pose, and then aligned with the images of their own keyframes to a fraction of
a pixel (:mod:`dvo.nets.alignment.alignment`), so that no error adds up. The pose is that of the frame alone; depths and
keyframes are held. Where the alignments are few, do not agree or lie on one side of the image, or the frame is
brighter, darker or more blurred than the newest keyframe, the network has to measure it. (Klein and Murray, "Parallel
tracking and mapping", ISMAR 2007, 5; Forster et al., "SVO", ICRA 2014.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch

from dvo.core.kernels import available
from dvo.geometry.poses import pose_matrices, poses_from_matrices, se3_exp
from dvo.map.window import Window
from dvo.nets.alignment.alignment import AlignmentOptions, accept, align_patches, texture
from dvo.nets.patch.config import ModelConfig
from dvo.odometry.window.patch_window import PatchWindow

KEYFRAMES = 5
"""Newest keyframes whose patches are aligned."""
MIN_CONFIDENCE = 0.1
"""Mean confidence of a patch in its measurements from which on it is aligned."""
MIN_TEXTURE, MIN_SIGNAL = 2.5, 1.4
"""Texture of its window (:func:`dvo.nets.alignment.alignment.texture`), grey levels a pixel, from which on it is, and
over the noise of the images; where surfaces are bare or it is dark, few are, and the network measures the frame."""
MAX_BRIGHTER, MAX_BLUR = 1.05, 0.8
"""Change of the mean grey level since the newest keyframe, as a factor, and share of the sharpness that has to be left,
for a frame to be aligned with it."""
MIN_INLIERS, MIN_SHARE, MIN_AGREEMENT = 16, 0.4, 0.75
"""Patches that have to agree with the pose, their share of those in view, textured or not, and of those with texture:
where leaves sway or rain falls, many of these are not found again."""
INLIER = 0.75
"""Largest distance of such a patch from its reprojection, pixels of the working image."""
MIN_FIELDS = 6
"""Fields of the image, of :data:`FIELDS`, in which some of them have to lie."""
FIELDS = (4, 3)
"""Fields of the image, across and down."""
MAX_AGE = 15
"""Frames in a row without the network."""
MAX_STEP = 1 / 3
"""Motion from one frame to the next, of the motion that the network has to measure, above which it measures each: fast
motion blurs, and little would be saved."""
ITERATIONS, TOLERANCE = 4, 1e-6
"""Steps of the pose with each width of a kernel, and the rotation (radians) and relative shift at which they end."""
NEAREST = 0.2
"""Depth behind which a patch counts as seen."""

_COARSE: dict[str, Any] = dict(winSize=(15, 15), maxLevel=3, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
               criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03))  # fmt: skip
_COARSE_WIDTHS, _FINE_WIDTHS = (4.0, 1.0), (0.3,)  # of the robust kernels, pixels
_MARGIN = 8.0  # pixels from the border


@dataclass(frozen=True)
class AlignedFrame:
    """Pose of a frame that was aligned with the window.

    Attributes:
        pose_cw: ``(7,)`` float64 world to camera.
        sure: the pose is supported; otherwise it is a first guess.
        slow: the motions from the newest keyframe and from the frame before (:data:`MAX_STEP`) are small.
        grey: ``(H, W)`` uint8 image of the frame.
        kk: ``(e,)`` patches of the window that agree with it.
        targets: ``(e, 2)`` float32 their positions in the frame, feature pixels.
        confidence: ``(e, 2)`` float32 of the network in these patches, on average.
    """

    pose_cw: np.ndarray
    sure: bool
    slow: bool
    grey: np.ndarray
    kk: np.ndarray
    targets: np.ndarray
    confidence: np.ndarray


@dataclass(frozen=True)
class _Seen:
    """A frame with its pose: ``matrix (4, 4)`` world to camera."""

    grey: np.ndarray
    time: float
    matrix: np.ndarray


class FrameAlignment:
    """Alignment of the frames between those that the network measures.

    Args:
        window: keyframes and their images.
        options: of the sub-pixel alignment.
        damping: of the motion model, see :func:`dvo.odometry.patch.initial_pose.predict_pose`.
        limit: motion above which the network measures a frame, feature pixels.

    Attributes:
        age: frames that were aligned since the network has measured one.
    """

    def __init__(self, window: PatchWindow, options: AlignmentOptions, damping: float, limit: float) -> None:
        self.patch_window, self.damping, self.limit = window, damping, limit
        self.options = replace(options, slope=0.0)
        self.age = 0
        self._poses: torch.Tensor | None = None  # of the window that it goes on from
        self._last: list[_Seen] = []
        self._patches: _Patches
        self._base: np.ndarray | None = None  # brightness and sharpness of the newest keyframe, once it is looked at

    def align(
        self, image: np.ndarray, intrinsics: np.ndarray, mask: np.ndarray | None, time: float
    ) -> AlignedFrame | None:
        """Align a frame.

        Args:
            image: ``(H, W, 3)`` uint8 RGB working image.
            intrinsics: ``(4,)`` fx fy cx cy of it.
            mask: ``(H, W)`` bool, False for ignored pixels; None: none.
            time: of the frame, seconds.

        Returns:
            The frame; None where the motion model already expects twice the limit, or nothing can be aligned.
        """
        window = self.patch_window.window
        self._begin(window, intrinsics)
        if self.age >= MAX_AGE:
            return None
        patches, limit = self._patches, self.limit
        start = _predicted(self._last, time, self.damping)
        last = self._last[-1]
        if not len(patches.kk) or patches.motion(start) > 2 * limit or patches.motion(start, last.matrix) > limit / 2:
            return None
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        patches, base = self._looked_at(window)
        brightness, sharpness = _look(grey) / base
        if not (1 / MAX_BRIGHTER <= brightness <= MAX_BRIGHTER and sharpness >= MAX_BLUR):
            return None
        pose = patches.followed(last, grey, start)
        if pose is None:
            return None
        found = self._refined(window, patches, image, mask, pose)
        if found is None:
            return None
        pose, sure, kept, measured = found
        slow = patches.motion(pose, last.matrix) <= MAX_STEP * limit and patches.motion(pose) <= limit
        targets = (measured / ModelConfig.STRIDE).astype(np.float32)
        confidence = patches.confidence[kept].astype(np.float32)
        rigid = poses_from_matrices(pose)
        return AlignedFrame(rigid, sure, slow, grey, patches.kk[kept], targets, confidence)

    def keep(self, frame: AlignedFrame, time: float) -> None:
        """Go on from an aligned frame.

        Args:
            frame: of :meth:`align`.
            time: of the frame, seconds.
        """
        self.age += 1
        self._last = [self._last[-1], _Seen(frame.grey, time, pose_matrices(frame.pose_cw))]

    def _begin(self, window: Window, intrinsics: np.ndarray) -> None:
        """Go on from the newest keyframe if the window has changed since; poses are replaced, never written to."""
        if window.poses_cw is self._poses:
            return
        newest, self._poses = window.frames[-1], window.poses_cw
        assert newest.image is not None and self.patch_window.alignment is not None
        grey = cv2.cvtColor(newest.image, cv2.COLOR_RGB2GRAY)
        self._patches, self._base = _Patches.of(window, intrinsics), None
        matrices = pose_matrices(window.poses_cw[-2:].cpu().numpy())
        none = np.zeros((0, 0), np.uint8)
        before = [_Seen(none, f.timestamp, m) for f, m in zip(window.frames[-2:-1], matrices[:-1], strict=True)]
        self._last = [*before, _Seen(grey, newest.timestamp, matrices[-1])]

    def _looked_at(self, window: Window) -> tuple[_Patches, np.ndarray]:
        """Patches with what their images tell of them, and brightness and sharpness of the newest keyframe."""
        newest, alignment = window.frames[-1], self.patch_window.alignment
        assert newest.image is not None and alignment is not None
        if self._base is None:
            grey = cv2.cvtColor(newest.image, cv2.COLOR_RGB2GRAY)
            self._base = np.maximum(_look(grey), 1e-3)
            least = max(MIN_TEXTURE, MIN_SIGNAL * noise(grey))
            self._patches = self._patches.seen_in(alignment.images, self.options.window, least)
        return self._patches, self._base

    def _refined(
        self, window: Window, patches: _Patches, image: np.ndarray, mask: np.ndarray | None, pose: np.ndarray
    ) -> tuple[np.ndarray, bool, np.ndarray, np.ndarray] | None:
        """Pose ``(4, 4)`` from the alignments with the images of the keyframes, from one nearby.

        Returns:
            The pose; whether it is supported; rows of the patches that agree with it, and their positions, pixels.
        """
        alignment, stride = self.patch_window.alignment, float(ModelConfig.STRIDE)
        assert alignment is not None
        height, width = image.shape[:2]
        places, warps, in_view = patches.warped(pose, (width, height), mask)
        rows = np.flatnonzero(in_view & patches.textured)
        if len(rows) < MIN_INLIERS:
            return None
        slot = window.free_map_slot()  # the next keyframe takes it
        alignment.keep_image(slot, image)
        device, slots = self.patch_window.device, torch.from_numpy(patches.slots[rows])
        centres, start, warped = (
            torch.from_numpy(x[rows].astype(np.float32)).to(device) for x in (patches.centres, places, warps)
        )
        pair = slots.to(device), torch.full_like(slots, slot, device=device)
        found = align_patches(alignment.images, *pair, centres, start, warped, self.options)
        good = accept(found, start, (width, height), stride, self.options).cpu().numpy()
        kept = rows[good]
        if len(kept) < MIN_INLIERS:
            return None
        measured = found.positions.cpu().numpy()[good].astype(np.float64)
        pose, _ = patches.solved(kept, measured, pose, _FINE_WIDTHS)
        away = np.linalg.norm(patches.projected(kept, pose)[0] - measured, axis=1)
        agree = away < INLIER
        fields = (measured[agree] / (width, height) * FIELDS).astype(int).clip(0, np.array(FIELDS) - 1)
        count = int(agree.sum())
        sure = (
            count >= max(MIN_INLIERS, MIN_SHARE * in_view.sum(), MIN_AGREEMENT * len(rows))
            and len(np.unique(fields @ (FIELDS[1], 1))) >= MIN_FIELDS
        )
        return pose, bool(sure), kept[agree], measured[agree]


@dataclass(frozen=True)
class _Patches:
    """Patches of the newest keyframes, in pixels of the working image.

    Attributes:
        kk: ``(K,)`` of the window.
        slots: ``(K,)`` map slots of their keyframes.
        centres: ``(K, 2)`` in their keyframes.
        points: ``(K, 3, 3)`` world points of the centre and of the pixels a feature pixel to the right and below.
        confidence: ``(K, 2)`` mean of the network's in their measurements.
        textured: ``(K,)`` bool, those that can be aligned (:data:`MIN_TEXTURE`); none before :meth:`seen_in`.
        camera: ``(4,)`` fx fy cx cy of the working image.
        newest: ``(4, 4)`` pose of the newest keyframe, world to camera.
    """

    kk: np.ndarray
    slots: np.ndarray
    centres: np.ndarray
    points: np.ndarray
    confidence: np.ndarray
    textured: np.ndarray
    camera: np.ndarray
    newest: np.ndarray

    @classmethod
    def of(cls, window: Window, camera: np.ndarray) -> _Patches:
        m, n, stride = window.per_frame, len(window), ModelConfig.STRIDE
        first = max(0, n - KEYFRAMES)
        middle = window.patches.shape[-1] // 2
        values = window.patches[first * m :].double().cpu().numpy()
        centres, depth = values[:, :2, middle, middle], values[:, 2, middle, middle]
        # Mean confidence of each patch over its measurements.
        kk, confidence = window.kk.cpu().numpy() - first * m, window.confidence.double().cpu().numpy()
        mine = kk >= 0
        counts = np.bincount(kk[mine], minlength=len(values))
        sums = np.stack([np.bincount(kk[mine], confidence[mine, axis], len(values)) for axis in (0, 1)], 1)
        mean = sums / np.maximum(counts, 1)[:, None]
        good = (mean.mean(1) > MIN_CONFIDENCE) & (depth > 0)
        rows = np.flatnonzero(good)
        frames = rows // m + first
        intrinsics = window.intrinsics.double().cpu().numpy()[frames]
        offsets = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        xy = (centres[rows, None] + offsets - intrinsics[:, None, 2:]) / intrinsics[:, None, :2]
        rays = np.concatenate([xy, np.ones((len(rows), 3, 1))], 2) / depth[rows, None, None]
        poses = pose_matrices(window.poses_cw.cpu().numpy())
        to_world = np.linalg.inv(poses)[frames]
        points = rays @ to_world[:, :3, :3].transpose(0, 2, 1) + to_world[:, None, :3, 3]
        slots = np.array([frame.map_slot for frame in window.frames])[frames]
        pixels = centres[rows] * stride
        textured = np.zeros(len(rows), bool)
        return cls(rows + first * m, slots, pixels, points, mean[rows], textured, np.asarray(camera, np.float64),
                   poses[-1])  # fmt: skip

    def seen_in(self, images: torch.Tensor, side: int, least: float) -> _Patches:
        """The same with ``textured``, by windows of a side in their keyframes' images."""
        centre = torch.from_numpy(self.centres.astype(np.float32)).to(images.device)
        strength = texture(images, torch.from_numpy(self.slots).to(images.device), centre, side)
        return replace(self, textured=strength.cpu().numpy() > least)

    def projected(self, rows: np.ndarray | slice, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres ``(e, 2)`` in a frame with a pose ``(4, 4)``, pixels, and the points ``(e, 3)`` before its camera."""
        moved = self.points[rows, 0] @ pose[:3, :3].T + pose[:3, 3]
        z = np.maximum(moved[:, 2:], NEAREST)
        return moved[:, :2] / z * self.camera[:2] + self.camera[2:], moved

    def warped(
        self, pose: np.ndarray, size: tuple[int, int], mask: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres ``(K, 2)``, affine warps ``(K, 2, 2)``, and which lie in the image, in front and not in the mask."""
        moved = self.points @ pose[:3, :3].T + pose[:3, 3]
        z = moved[..., 2:]
        places = moved[..., :2] / np.maximum(z, NEAREST) * self.camera[:2] + self.camera[2:]
        warps = np.stack([places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]], -1) / ModelConfig.STRIDE
        area = np.abs(np.linalg.det(warps))
        centre = places[:, 0]
        inside = ((centre >= _MARGIN) & (centre < np.array(size) - _MARGIN)).all(1)
        inside &= (z[..., 0] > NEAREST).all(1) & (area > 0.25) & (area < 4.0)
        if mask is not None:
            x, y = centre.clip(0, np.array(size) - 1).astype(int).T
            inside &= mask[y, x]
        return centre, warps, inside

    def motion(self, pose: np.ndarray, base: np.ndarray | None = None) -> float:
        """Mean flow of the patches from the newest keyframe, half of it without the rotation, feature pixels.

        Args:
            pose: ``(4, 4)`` of a frame.
            base: of the frame that the flow is from; None for the newest keyframe.
        """
        base = self.newest if base is None else base
        here = self.points[:, 0] @ base[:3, :3].T + base[:3, 3]
        place = np.abs(here[:, :2] / np.maximum(here[:, 2:], NEAREST) * self.camera[:2])
        seen = (here[:, 2] > NEAREST) & (place < self.camera[2:]).all(1)
        if not seen.any():
            return float("inf")
        here = here[seen]
        relative = pose @ np.linalg.inv(base)
        flows = []
        for rotation in (relative[:3, :3], np.eye(3)):
            there = here @ rotation.T + relative[:3, 3]
            flow = there[:, :2] / np.maximum(there[:, 2:], NEAREST) - here[:, :2] / here[:, 2:]
            flows.append(np.linalg.norm(flow * self.camera[:2], axis=1))
        return float(np.minimum(0.5 * (flows[0] + flows[1]), 1e3).mean()) / ModelConfig.STRIDE

    def followed(self, last: _Seen, grey: np.ndarray, start: np.ndarray) -> np.ndarray | None:
        """Pose from patches that were followed from the frame before; None with too few of them."""
        before, z = self.projected(slice(None), last.matrix)
        there, ahead = self.projected(slice(None), start)
        size = np.array(grey.shape[::-1])
        inside = (
            ((before >= _MARGIN) & (before < size - _MARGIN)).all(1) & (z[:, 2] > NEAREST) & (ahead[:, 2] > NEAREST)
        )
        rows = np.flatnonzero(inside & self.textured)
        if len(rows) < MIN_INLIERS:
            return None
        first = np.ascontiguousarray(before[rows, None], dtype=np.float32)
        guess = np.ascontiguousarray(there[rows, None], dtype=np.float32)
        found, ok, _ = cv2.calcOpticalFlowPyrLK(last.grey, grey, first, guess, **_COARSE)
        rows, found = rows[ok.ravel() > 0], found[ok.ravel() > 0, 0].astype(np.float64)
        if len(rows) < MIN_INLIERS:
            return None
        pose, away = self.solved(rows, found, start, _COARSE_WIDTHS)
        return pose if int((away < 2.0).sum()) >= MIN_INLIERS else None

    def solved(
        self, rows: np.ndarray, measured: np.ndarray, pose: np.ndarray, widths: tuple[float, ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(4, 4)`` of the frame from positions ``(e, 2)`` of patches, and the distances ``(e,)`` left."""
        solve = solve_pose if available() else solve_pose_plain
        pose = solve(self.points[rows, 0], measured, self.confidence[rows], self.camera, pose, widths)
        return pose, np.linalg.norm(measured - self.projected(rows, pose)[0], axis=1)


def solve_pose(
    points: np.ndarray, measured: np.ndarray, weights: np.ndarray, camera: np.ndarray, pose: np.ndarray,
    widths: tuple[float, ...],
) -> np.ndarray:  # fmt: skip
    """Compiled :func:`solve_pose_plain`."""
    from dvo.odometry.window.window_kernels import solve_pose_kernel

    found = np.array(pose)
    points, measured, weights = (np.ascontiguousarray(x, np.float64) for x in (points, measured, weights))
    solve_pose_kernel(points, measured, weights, camera, found, np.array(widths), ITERATIONS, NEAREST, TOLERANCE)
    return found


def solve_pose_plain(
    points: np.ndarray, measured: np.ndarray, weights: np.ndarray, camera: np.ndarray, pose: np.ndarray,
    widths: tuple[float, ...],
) -> np.ndarray:  # fmt: skip
    """Pose of a frame from positions of known points: Gauss-Newton with Cauchy kernels, one width after the other.

    Args:
        points: ``(e, 3)`` in the world.
        measured: ``(e, 2)`` their positions, pixels.
        weights: ``(e, 2)`` of the squared residuals.
        camera: ``(4,)`` fx fy cx cy.
        pose: ``(4, 4)`` world to camera to begin with.
        widths: of the kernels, pixels.

    Returns:
        ``(4, 4)`` world to camera.
    """
    fx, fy = camera[:2]
    for width in widths:
        for _ in range(ITERATIONS):
            x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
            q = 1 / np.maximum(z, NEAREST)
            o, a, b = np.zeros_like(q), x * q, y * q
            error = measured - np.stack([a, b], 1) * camera[:2] - camera[2:]
            robust = (z > NEAREST) / (1 + (error**2).sum(1) / width**2)
            w = (weights * robust[:, None]).T.ravel()
            jx = fx * np.stack([q, o, -a * q, -a * b, 1 + a * a, -b], 1)
            jy = fy * np.stack([o, q, -b * q, -1 - b * b, a * b, a], 1)
            j = np.concatenate([jx, jy])
            h = (j * w[:, None]).T @ j
            h[np.diag_indices(6)] += 1e-6 * np.trace(h) / 6 + 1e-12
            step = np.linalg.solve(h, (j * w[:, None]).T @ error.T.ravel())
            rotation, translation = se3_exp(step)
            pose = np.block([[rotation, translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]) @ pose
            if np.abs(step[3:]).max() < TOLERANCE and np.abs(step[:3]).max() * q.max() < TOLERANCE:
                break
    return pose


def noise(grey: np.ndarray) -> float:
    """Standard deviation of the noise of an image (Immerkaer, CVIU 1996, with a median).

    Args:
        grey: ``(H, W)`` uint8.

    Returns:
        Grey levels; more where textures are as fine as noise.
    """
    response = cv2.filter2D(grey, cv2.CV_16S, np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32))
    return float(np.median(np.abs(response[::2, ::2]))) / (0.6745 * 6)


def _look(grey: np.ndarray) -> np.ndarray:
    """Brightness and sharpness of an image."""
    _, spread = cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_16S))
    return np.array([grey.mean(), float(spread[0, 0])])


def _predicted(last: list[_Seen], time: float, damping: float) -> np.ndarray:
    """Pose ``(4, 4)`` of a frame by the motion model, see :func:`dvo.odometry.patch.initial_pose.predict_pose`."""
    newest = last[-1]
    if len(last) == 1:
        return newest.matrix
    share = damping * min(2.0, max(0.0, (time - newest.time) / (newest.time - last[0].time)))
    motion = newest.matrix @ np.linalg.inv(last[0].matrix)
    step = np.eye(4)
    step[:3, :3] = cv2.Rodrigues(share * cv2.Rodrigues(motion[:3, :3])[0])[0]
    step[:3, 3] = share * motion[:3, 3]
    return np.asarray(step @ newest.matrix)
