"""Reconstruction of a world: images, points and observations of a keyframe graph, which the map formats write.

A feature-map pixel ``(u, v)`` is centred on the image pixel ``(4u, 4v)`` (:class:`dvo.nets.patch.encoder.Encoder`), so
positions and intrinsics of the feature map times 4 are those of the working image, without a half pixel. Pixel centres
lie at integers here; a format that counts from the corner of the first pixel adds 0.5 (:data:`CORNER`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.settings import check_settings
from dvo.data.images.image_header import image_size
from dvo.geometry.camera import Camera
from dvo.geometry.poses import pose_matrices
from dvo.map.archive import ArchivedKeyframe, encode_mask
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.map import MIN_NEARNESS
from dvo.map.measurements import ArchivedEdges
from dvo.nets.patch.config import ModelConfig

CORNER = 0.5
"""Pixel coordinates counted from the corner of the first pixel, less those counted from its centre."""

TIME_ROUNDING = 1e-5
"""Largest difference of equal times, seconds; trajectory files have nine decimals, and times may be large."""
_POSE_ROUNDING = 1e-5  # of entries of a matrix, over the largest one and 1

_RANGES = {"max_error": (0, 1e6), "min_weight": (0, 1e6), "min_images": (1, 1000)}


@dataclass(frozen=True)
class PointOptions:
    """Choice of the observations and points of a reconstruction.

    Attributes:
        max_error: largest reprojection error of an observation, pixels of the image.
        min_weight: smallest weight of a measurement in bundle adjustment, mean of both axes.
        min_images: smallest number of images in which a point is observed.

    Raises:
        DvoError: a value of another type or out of range.
    """

    max_error: float = 4.0
    min_weight: float = 0.1
    min_images: int = 2

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)


@dataclass(frozen=True)
class Reconstruction:
    """Images, points and observations of the segments that share a world, in this world and its scale.

    Attributes:
        cameras: distinct pinhole cameras of the images; pixel centres at integers.
        camera_of: ``(N,)`` position in ``cameras`` of the camera of each image.
        identifiers: ``(N,)`` identifier of the keyframe of each image, or the number of the frame, increasing.
        timestamps: ``(N,)`` float64 seconds.
        T_cw: ``(N, 4, 4)`` float64 world to camera (x right, y down, z forward).
        jpegs: content of the N files; a sequence may read each when it is asked for.
        points: ``(P, 3)`` float64 in the world.
        colors: ``(P, 3)`` uint8 RGB.
        errors: ``(P,)`` mean reprojection error of the observations of each point, pixels.
        image_of, point_of: ``(O,)`` image and point of each observation, ordered by image, then by point; at most one
            observation of a point in an image.
        positions: ``(O, 2)`` observed positions, pixels with centres at integers.
        residuals: ``(O,)`` reprojection errors, pixels; 0 in the image that the patch of the point was taken from.
        without_image: number of keyframes left out because their image is not kept.
        masks: content of N PNG files, white where the image is used and black where it is not; empty without masks.
        was_found: the focal length was found in the images, or is a guess: formats with a place for it say so.
    """

    cameras: tuple[Camera, ...]
    camera_of: np.ndarray
    identifiers: np.ndarray
    timestamps: np.ndarray
    T_cw: np.ndarray
    jpegs: Sequence[bytes]
    points: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    image_of: np.ndarray
    point_of: np.ndarray
    positions: np.ndarray
    residuals: np.ndarray
    without_image: int = 0
    masks: Sequence[bytes] = ()
    was_found: bool = False

    @property
    def names(self) -> list[str]:
        """Names of the image files, by their identifiers."""
        return [f"{identifier:06d}.jpg" for identifier in self.identifiers.tolist()]

    @property
    def mean_error(self) -> float:
        """Mean reprojection error of all observations, pixels; 0 without observations."""
        return float(self.residuals.mean()) if len(self.residuals) else 0.0

    def __str__(self) -> str:
        left = f", {self.without_image} keyframes without an image left out" if self.without_image else ""
        masks = " with masks" if self.masks else ""
        counts = f"{len(self.jpegs)} images{masks}, {len(self.points)} points, {len(self.residuals)} observations"
        return f"{counts}, mean reprojection error {self.mean_error:.2f} px{left}"


@dataclass(frozen=True)
class _Patches:
    """Patches of all keyframes of a segment, one row a patch.

    Attributes:
        start: ``(F + 1,)`` first row of each keyframe.
        points: ``(K, 3)`` in the world.
        centres: ``(K, 2)`` pixels of the working image.
        colors: ``(K, 3)`` uint8 RGB.
        usable: ``(K,)`` bool, not too far for its depth to be known.
    """

    start: np.ndarray
    points: np.ndarray
    centres: np.ndarray
    colors: np.ndarray
    usable: np.ndarray


def longest_segment(graph: KeyframeGraph) -> int:
    """Segment of the last recording with the most frames.

    Args:
        graph: of a sequence.

    Returns:
        Its number; the first of several equally long ones, 0 without frames.
    """
    frames = graph.log.frames[graph.recording.frame :]
    counts = np.bincount([r.segment for r in frames if not r.lost and r.anchor is not None], minlength=1)
    return int(counts.argmax())


def reconstruct(
    graph: KeyframeGraph,
    segment: int,
    options: PointOptions = PointOptions(),  # noqa: B008 (frozen)
) -> Reconstruction:
    """Collect images, points and observations of a segment from the archive of a keyframe graph.

    Images are those of the keyframes that were kept. A point is a patch, also one of a dropped keyframe; it is observed
    in the image of its keyframe, if there is one, and in every image in which it was measured with a sufficient weight
    and a small reprojection error. Measurements of a rolling shutter are given as they are in the image.

    Args:
        graph: keyframes in the window are not part of the archive: finish the odometry first.
        segment: its number.
        options: thresholds.

    Returns:
        The reconstruction.

    Raises:
        DvoError: no archived keyframes in the segment, or none with an image.
    """
    frames = graph.members(segment)
    kept = np.array([frame.anchor is None for frame in frames], dtype=bool)
    if not kept.any():
        remedy = f"finish the odometry first, and give one of the segments 0 to {graph.segment}"
        raise DvoError("no archived keyframes in it", field=f"segment {segment}", remedy=remedy)
    contents = [b"" if frame.jpeg is None else frame.jpeg.tobytes() for frame in frames]
    sizes = [image_size(content) if here else None for content, here in zip(contents, kept, strict=True)]
    shown = np.array([size is not None for size in sizes], dtype=bool)
    if not shown.any():
        remedy = "track with ArchiveConfig(images=True) and a larger max_bytes"
        raise DvoError("no keyframe has its image", field=f"segment {segment}", remedy=remedy)
    T_cw, intrinsics = _poses(graph, frames), _intrinsics(frames)
    images = np.flatnonzero(shown)
    found = [_camera(intrinsics[image], sizes[image]) for image in images]
    cameras = tuple(dict.fromkeys(found))
    image_of = np.where(shown, np.cumsum(shown) - 1, -1)
    masks = [frames[image].mask for image in images]
    return Reconstruction(
        cameras=cameras,
        camera_of=np.array([cameras.index(camera) for camera in found]),
        identifiers=np.array([frames[image].identifier for image in images]),
        timestamps=np.array([frames[image].timestamp for image in images], dtype=np.float64),
        T_cw=T_cw[images],
        jpegs=tuple(contents[image] for image in images),
        without_image=int((kept & ~shown).sum()),
        masks=_masks(masks, found) if any(mask is not None for mask in masks) else (),
        **_content(graph, frames, T_cw, intrinsics, image_of, found, options),
    )


def observe(
    graph: KeyframeGraph,
    segment: int,
    images: Reconstruction,
    options: PointOptions = PointOptions(max_error=1.5),  # noqa: B008 (frozen)
) -> Reconstruction:
    """Give other images of a recording the points and observations of the archive of a keyframe graph.

    An image is one of a tracked frame, kept or dropped, if it has the time and the pose of one: its measurements are
    then brought to the pixels of the image by the intrinsics of both. Points of kept keyframes that too few of the
    images observe are there without observations.

    Args:
        graph: of the recording, finished.
        segment: number of a segment of the world that the images are in.
        images: undistorted, with poses.
        options: thresholds.

    Returns:
        The images with points and observations; as they are, if none is of a frame of the graph.
    """
    frames = graph.members(segment)
    if not frames or not len(images.timestamps):
        return images
    T_cw, intrinsics = _poses(graph, frames), _intrinsics(frames)
    times = np.array([frame.timestamp for frame in frames])
    nearest = np.searchsorted((images.timestamps[1:] + images.timestamps[:-1]) / 2, times)
    found = images.T_cw[nearest]
    same = np.abs(times - images.timestamps[nearest]) <= TIME_ROUNDING
    same &= np.abs(T_cw - found).max(axis=(1, 2)) <= _POSE_ROUNDING * (1 + np.abs(found).max(axis=(1, 2)))
    if not same.any():
        return images
    cameras = [images.cameras[number] for number in images.camera_of.tolist()]
    image_of = np.where(same, nearest, -1)
    return replace(images, **_content(graph, frames, T_cw, intrinsics, image_of, cameras, options, all_points=True))


def _poses(graph: KeyframeGraph, frames: list[ArchivedKeyframe]) -> np.ndarray:
    """``(F, 4, 4)`` world to camera."""
    return pose_matrices(graph.poses_cw(np.array([frame.identifier for frame in frames])).numpy())


def _intrinsics(frames: list[ArchivedKeyframe]) -> np.ndarray:
    """``(F, 4)`` of the working images."""
    return ModelConfig.STRIDE * np.array([frame.intrinsics for frame in frames], dtype=np.float64)


def _content(
    graph: KeyframeGraph,
    frames: list[ArchivedKeyframe],
    T_cw: np.ndarray,
    intrinsics: np.ndarray,
    image_of: np.ndarray,
    cameras: list[Camera],
    options: PointOptions,
    all_points: bool = False,
) -> dict[str, Any]:
    """Points and observations of a reconstruction; ``image_of (F,)``: image of each frame, -1 for none, ``cameras``:
    of each image, ``all_points``: those of kept keyframes without observations too."""
    patches = _patches(frames, T_cw, intrinsics)
    observed_in, point_of, positions, residuals = _observations(
        graph.archive.edges(), frames, T_cw, intrinsics, patches, image_of, cameras, options
    )
    views = np.bincount(point_of, minlength=len(patches.points))
    seen = views >= options.min_images
    chosen = seen[point_of]
    observed_in, point_of, positions, residuals = (x[chosen] for x in (observed_in, point_of, positions, residuals))
    listed = seen
    if all_points:
        kept = np.array([frame.anchor is None for frame in frames], dtype=bool)
        listed = seen | patches.usable & np.repeat(kept, np.diff(patches.start))
    sums = np.bincount(point_of, residuals, minlength=len(patches.points))
    return {
        "points": patches.points[listed],
        "colors": patches.colors[listed],
        "errors": (sums / np.maximum(np.where(seen, views, 0), 1))[listed],
        "image_of": observed_in,
        "point_of": (np.cumsum(listed) - 1)[point_of],
        "positions": positions,
        "residuals": residuals,
    }


def _camera(intrinsics: np.ndarray, size: tuple[int, int] | None) -> Camera:
    assert size is not None
    fx, fy, cx, cy = intrinsics.tolist()
    return Camera(fx, fy, cx, cy, *size)


def _masks(masks: list[np.ndarray | None], cameras: list[Camera]) -> list[bytes]:
    """Mask of each image, white for one without."""
    sizes = [(camera.height, camera.width) for camera in cameras]
    found = zip(masks, sizes, strict=True)
    return [(encode_mask(np.ones(size, bool)) if mask is None else mask).tobytes() for mask, size in found]


def _patches(frames: list[ArchivedKeyframe], T_cw: np.ndarray, intrinsics: np.ndarray) -> _Patches:
    """Patches of keyframes with poses ``(F, 4, 4)`` and intrinsics of the working images ``(F, 4)``."""
    counts = np.array([len(frame.inverse_depth) for frame in frames])
    owner = np.repeat(np.arange(len(frames)), counts)
    centres = ModelConfig.STRIDE * np.concatenate([frame.centres for frame in frames]).astype(np.float64)
    depth = np.concatenate([frame.inverse_depth for frame in frames]).astype(np.float64)
    usable = np.concatenate([_usable(frame.inverse_depth) for frame in frames])
    rays = np.column_stack([(centres - intrinsics[owner, 2:]) / intrinsics[owner, :2], np.ones(len(owner))])
    in_camera = rays / np.where(usable, depth, 1.0)[:, None]
    rotation, translation = T_cw[owner, :3, :3], T_cw[owner, :3, 3]
    points = np.einsum("kji,kj->ki", rotation, in_camera - translation)
    colors = np.concatenate([frame.colors for frame in frames]).astype(np.uint8)
    return _Patches(np.concatenate([[0], np.cumsum(counts)]), points, centres, colors, usable)


def _usable(inverse_depth: np.ndarray) -> np.ndarray:
    """``(M,)`` bool, patches of a keyframe with a depth, and not so far that it is uncertain."""
    known = np.isfinite(inverse_depth) & (inverse_depth > 0)
    return known & (inverse_depth > MIN_NEARNESS * np.median(inverse_depth[known])) if known.any() else known


def _observations(
    edges: ArchivedEdges,
    frames: list[ArchivedKeyframe],
    T_cw: np.ndarray,
    intrinsics: np.ndarray,
    patches: _Patches,
    image_of: np.ndarray,
    cameras: list[Camera],
    options: PointOptions,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Image ``(O,)``, patch ``(O,)``, position ``(O, 2)`` and reprojection error ``(O,)`` of each observation in an
    image, in its pixels, ordered by image, then by patch."""
    identifiers = np.array([frame.identifier for frame in frames])
    shown = image_of >= 0
    size = np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64)[image_of]
    wanted = np.where(shown[:, None], np.array([camera.intrinsics for camera in cameras])[image_of], intrinsics)
    scale = wanted[:, :2] / intrinsics[:, :2]  # from pixels of the working image to those of the image
    shift = wanted[:, 2:] - scale * intrinsics[:, 2:]
    owner = np.repeat(np.arange(len(frames)), np.diff(patches.start))
    own = np.flatnonzero(patches.usable & shown[owner])
    edges = edges.select(np.isin(edges.source, identifiers) & np.isin(edges.target, identifiers))
    ii, jj = np.searchsorted(identifiers, edges.source), np.searchsorted(identifiers, edges.target)
    kk = patches.start[ii] + edges.patch
    positions = scale[jj] * (ModelConfig.STRIDE * edges.position.astype(np.float64)) + shift[jj]
    in_camera = np.einsum("eij,ej->ei", T_cw[jj, :3, :3], patches.points[kk]) + T_cw[jj, :3, 3]
    in_front = in_camera[:, 2] > 0
    z = np.where(in_front, in_camera[:, 2], 1.0)[:, None]
    projected = in_camera[:, :2] / z * wanted[jj, :2] + wanted[jj, 2:]
    errors = np.linalg.norm(projected - positions, axis=1)
    inside = ((positions >= -CORNER) & (positions <= size[jj] - CORNER)).all(axis=1)
    weights = edges.weight.astype(np.float64).mean(axis=1)
    good = (ii != jj) & shown[jj] & patches.usable[kk] & in_front & inside
    good &= (errors <= options.max_error) & (weights >= options.min_weight)  # NaN fails too
    observed_in, point_of = image_of[np.concatenate([owner[own], jj[good]])], np.concatenate([own, kk[good]])
    positions = np.concatenate([scale[owner[own]] * patches.centres[own] + shift[owner[own]], positions[good]])
    residuals = np.concatenate([np.zeros(len(own)), errors[good]])
    order = np.lexsort([residuals, point_of, observed_in])  # of several measurements of a patch in an image the best
    pairs = np.column_stack([observed_in, point_of])[order]
    first = np.ones(len(order), dtype=bool)
    first[1:] = (pairs[1:] != pairs[:-1]).any(axis=1)
    order = order[first]
    return observed_in[order], point_of[order], positions[order], residuals[order]
