"""Archive of a keyframe graph: keyframes and measurements that have left the active window, in bounded memory.

A keyframe keeps its pose, its patches with their inverse depths (points are relative to their keyframe and move with
it), their colours, float16 features and the working image as JPEG, from which feature maps can be computed again. An
edge keeps its target and weight, rounded (:mod:`dvo.map.measurements`). The archive serves global bundle adjustment,
loop edges, export and saving.

With the ``small`` network a keyframe takes about 34 kB of features and 15 to 25 kB of JPEG, and every frame between
two of them about 3 kB of edges. When the total exceeds :attr:`ArchiveConfig.max_bytes`, features and images of the
oldest keyframes are released first, then the oldest edges, then the oldest patches; poses (56 bytes a keyframe) stay.
"""

from __future__ import annotations

import mmap
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from dvo.core.errors import DvoError
from dvo.map.measurements import ArchivedEdges, PackedEdges, pack_edges

CHUNK = 2**18
"""Bytes of a mapping; larger arrays get one of their own."""
_ALIGNMENT = 64


@dataclass(frozen=True)
class ArchiveConfig:
    """Memory bound and content of an archive.

    Attributes:
        max_bytes: largest memory of features, images, edges and patches.
        features: keep float16 features of the patches.
        images: keep working images.
        jpeg_quality: 1 to 100.

    Raises:
        DvoError: a negative bound, or a quality out of range.
    """

    max_bytes: int = 256 * 2**20
    features: bool = True
    images: bool = True
    jpeg_quality: int = 90

    def __post_init__(self) -> None:
        if self.max_bytes < 0 or not 1 <= self.jpeg_quality <= 100:
            raise DvoError("out of range", field="archive", remedy="give max_bytes >= 0 and jpeg_quality of 1 to 100")


@dataclass(frozen=True)
class ArchivedKeyframe:
    """Keyframe that has left the active window.

    Attributes:
        identifier: running number in the sequence.
        timestamp: seconds.
        intrinsics: ``(4,)`` float32 fx fy cx cy of the feature map.
        pose_cw: ``(7,)`` float64 world to camera ``T_cw``; with an ``anchor``, the pose relative to that keyframe,
            ``T_cw T_cw_anchor^-1``.
        anchor: identifier of the keyframe that a dropped keyframe is relative to, None for one that was kept.
        centres: ``(M, 2)`` float32 patch centres, feature-map pixels; empty once released.
        inverse_depth: ``(M,)`` float32.
        colors: ``(M, 3)`` uint8 RGB.
        matching: ``(M, C, p, p)`` float16 matching features of the patches, None if not kept.
        context: ``(M, D)`` float16 context features of the patches, None if not kept.
        jpeg: ``(n,)`` uint8 content of a JPEG file with the working image, None if not kept.
        measured: ``(M, 2)`` float32 inverse depths (1/m) by a depth camera and their weights, 0 for none; None without
            a depth camera, or once released with the patches.
        mask: ``(n,)`` uint8 content of a PNG file of the size of the working image, white where it was used and black
            elsewhere; None for all of it, or if the image is not kept.
    """

    identifier: int
    timestamp: float
    intrinsics: np.ndarray
    pose_cw: np.ndarray
    anchor: int | None
    centres: np.ndarray
    inverse_depth: np.ndarray
    colors: np.ndarray
    matching: np.ndarray | None = None
    context: np.ndarray | None = None
    jpeg: np.ndarray | None = None
    measured: np.ndarray | None = None
    mask: np.ndarray | None = None

    @property
    def feature_bytes(self) -> int:
        """Memory of features and image."""
        arrays = (self.matching, self.context, self.jpeg, self.mask)
        return sum(a.nbytes for a in arrays if a is not None)

    @property
    def patch_bytes(self) -> int:
        """Memory of the patches."""
        measured = 0 if self.measured is None else self.measured.nbytes
        return self.centres.nbytes + self.inverse_depth.nbytes + self.colors.nbytes + measured

    def image(self) -> np.ndarray | None:
        """Decode the working image.

        Returns:
            ``(H, W, 3)`` uint8 RGB; None if the image is not kept or has been released.
        """
        if self.jpeg is None:
            return None
        import cv2

        decoded = cv2.imdecode(self.jpeg, cv2.IMREAD_COLOR)
        return None if decoded is None else np.ascontiguousarray(decoded[..., ::-1])


class Archive:
    """Keyframes by identifier, and edges in the order in which they left the window.

    Args:
        config: memory bound and content; None for the defaults.
    """

    def __init__(self, config: ArchiveConfig | None = None) -> None:
        self.config = config or ArchiveConfig()
        self._keyframes: dict[int, ArchivedKeyframe] = {}
        self._edges: deque[PackedEdges] = deque()
        self._bytes = 0
        # Identifiers in the order of archiving: those with features or an image, and those with patches.
        self._with_features: deque[int] = deque()
        self._with_patches: deque[int] = deque()
        self._storage = {kind: ArrayStorage() for kind in ("features", "edges", "patches", "poses")}  # poses stay

    def copy(self) -> Archive:
        """Archive with the same content, by references, which takes and releases content on its own."""
        new = Archive(self.config)
        new._keyframes, new._edges, new._bytes = dict(self._keyframes), deque(self._edges), self._bytes
        new._with_features, new._with_patches = deque(self._with_features), deque(self._with_patches)
        return new

    def __len__(self) -> int:
        return len(self._keyframes)

    def __iter__(self) -> Iterator[ArchivedKeyframe]:
        """Keyframes by increasing identifier, dropped ones included."""
        return (self._keyframes[identifier] for identifier in sorted(self._keyframes))

    def __contains__(self, identifier: object) -> bool:
        return identifier in self._keyframes

    def __getitem__(self, identifier: int) -> ArchivedKeyframe:
        return self._keyframes[identifier]

    def kept_after(self, identifier: int) -> list[ArchivedKeyframe]:
        """Keyframes that were not dropped, later than another one.

        Args:
            identifier: of a keyframe, or -1.

        Returns:
            By increasing identifier.
        """
        found: list[ArchivedKeyframe] = []
        for key in reversed(self._keyframes):  # those that were kept are archived in their order
            keyframe = self._keyframes[key]
            if keyframe.anchor is None:
                if key <= identifier:
                    break
                found.append(keyframe)
        return found[::-1]

    @property
    def keyframes(self) -> list[ArchivedKeyframe]:
        """Keyframes in the order in which they were archived and will be released."""
        return list(self._keyframes.values())

    @property
    def parts(self) -> list[PackedEdges]:
        """Measurements as they were added, each released as a whole, oldest first."""
        return list(self._edges)

    @property
    def nbytes(self) -> int:
        """Memory of features, images, edges and patches; at most ``config.max_bytes`` after every call."""
        return self._bytes

    def add(self, keyframe: ArchivedKeyframe) -> None:
        """Add a keyframe, or replace the one of the same identifier.

        Args:
            keyframe: the keyframe; its arrays are copied.
        """
        keyframe = self._stored(keyframe)
        before = self._keyframes.get(keyframe.identifier)
        if before is not None:
            self._bytes -= before.feature_bytes + before.patch_bytes
        self._keyframes[keyframe.identifier] = keyframe
        self._bytes += keyframe.feature_bytes + keyframe.patch_bytes
        if keyframe.feature_bytes:
            self._with_features.append(keyframe.identifier)
        self._with_patches.append(keyframe.identifier)
        self._shrink()

    def add_edges(self, edges: ArchivedEdges) -> None:
        """Add measurements.

        Args:
            edges: the measurements, possibly none; kept as :func:`dvo.map.measurements.pack_edges` rounds them.
        """
        if len(edges):
            self.add_part(pack_edges(edges).kept_by(self._storage["edges"].keep))

    def add_part(self, part: PackedEdges) -> None:
        """Add measurements that another archive keeps too.

        Args:
            part: one or more; not copied.
        """
        self._edges.append(part)
        self._bytes += part.nbytes
        self._shrink()

    def edges(self, first: int = 0, last: int | None = None) -> ArchivedEdges:
        """Measurements that are kept.

        Args:
            first, last: identifiers; only edges with an end between them and none after ``last``. None: no limit.

        Returns:
            The edges, oldest first.
        """
        if first <= 0 and last is None:
            return ArchivedEdges.concatenate([part.unpack() for part in self._edges])
        parts = []
        for part in self._edges:
            newest = part.newest()
            chosen = (newest >= first) & (newest <= (np.iinfo(np.int32).max if last is None else last))
            if chosen.any():
                parts.append(part.unpack(chosen))
        return ArchivedEdges.concatenate(parts)

    def set_pose(
        self,
        identifier: int,
        pose_cw: np.ndarray,
        inverse_depth: np.ndarray | None = None,
        anchor: int | None = None,
    ) -> None:
        """Correct a keyframe, for instance after a global bundle adjustment; its points move along.

        Args:
            identifier: of the keyframe.
            pose_cw: ``(7,)`` world to camera ``T_cw``, or relative to ``anchor``.
            inverse_depth: ``(M,)`` of its patches; None leaves them unchanged.
            anchor: keyframe that it is relative to; None for the world.
        """
        keyframe = self._keyframes[identifier]
        depth = keyframe.inverse_depth if inverse_depth is None else np.asarray(inverse_depth, np.float32)
        pose_cw = np.asarray(pose_cw, np.float64)
        self._keyframes[identifier] = replace(keyframe, pose_cw=pose_cw, anchor=anchor, inverse_depth=depth)

    def set_measured(self, identifier: int, measured: np.ndarray) -> None:
        """Give a keyframe measured depths.

        Args:
            identifier: of the keyframe.
            measured: ``(M, 2)`` see :class:`ArchivedKeyframe`; copied.
        """
        self._change(identifier, measured=self._storage["patches"].keep(measured))
        self._shrink()

    def _shrink(self) -> None:
        """Release memory until the bound holds: features and images, then edges, then patches, each oldest first."""
        limit = self.config.max_bytes
        while self._bytes > limit and self._with_features:
            self._change(self._with_features.popleft(), matching=None, context=None, jpeg=None, mask=None)
        while self._bytes > limit and self._edges:
            self._bytes -= self._edges.popleft().nbytes
        while self._bytes > limit and self._with_patches:
            centres, depth = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
            colors = np.zeros((0, 3), np.uint8)
            gone = self._with_patches.popleft()
            self._change(gone, centres=centres, inverse_depth=depth, colors=colors, measured=None)

    def _stored(self, keyframe: ArchivedKeyframe) -> ArchivedKeyframe:
        """Keyframe with its arrays in the storage."""
        features, patches = self._storage["features"].keep, self._storage["patches"].keep
        matching, context, jpeg, mask = (
            None if array is None else features(array)
            for array in (keyframe.matching, keyframe.context, keyframe.jpeg, keyframe.mask)
        )
        centres, depth, colors = map(patches, (keyframe.centres, keyframe.inverse_depth, keyframe.colors))
        intrinsics, pose_cw = map(self._storage["poses"].keep, (keyframe.intrinsics, keyframe.pose_cw))
        measured = None if keyframe.measured is None else patches(keyframe.measured)
        return replace(
            keyframe, intrinsics=intrinsics, pose_cw=pose_cw, centres=centres, inverse_depth=depth, colors=colors,
            matching=matching, context=context, jpeg=jpeg, measured=measured, mask=mask,
        )  # fmt: skip

    def _change(self, identifier: int, **fields: object) -> None:
        before = self._keyframes[identifier]
        after = replace(before, **fields)  # type: ignore[arg-type]
        self._keyframes[identifier] = after
        self._bytes += after.feature_bytes + after.patch_bytes - before.feature_bytes - before.patch_bytes


def encode_jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    """Compress an image.

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        quality: 1 to 100.

    Returns:
        ``(n,)`` uint8 content of a JPEG file.
    """
    import cv2

    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.ravel()


def encode_mask(mask: np.ndarray) -> np.ndarray:
    """Compress a mask.

    Args:
        mask: ``(H, W)`` bool.

    Returns:
        ``(n,)`` uint8 content of a PNG file, white where the mask is True.
    """
    import cv2

    return cv2.imencode(".png", np.uint8(255) * mask)[1].ravel()


class ArrayStorage:
    """Arrays in memory mappings, written one after the other.

    Arrays that stay between temporary tensors of many sizes keep the heap of the process from being reused: it grows by
    several times what they take. A mapping is returned to the system when the last array in it is gone. Use a storage
    of its own for what is released together.

    Args:
        chunk: bytes of a mapping.

    Example:
        >>> storage = ArrayStorage()
        >>> storage.keep(np.arange(3))
        array([0, 1, 2])
    """

    def __init__(self, chunk: int = CHUNK) -> None:
        self.chunk = chunk
        self._free = np.zeros(0, np.uint8)

    def keep(self, array: np.ndarray) -> np.ndarray:
        """Copy an array into the storage.

        Args:
            array: of numbers.

        Returns:
            The copy, C-contiguous and writable; an empty array itself.
        """
        if not array.nbytes:
            return array
        size = -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
        if size > self.chunk:
            room = _mapping(size)
        else:
            if size > len(self._free):
                self._free = _mapping(self.chunk)
            room, self._free = self._free[:size], self._free[size:]
        copy = room[: array.nbytes].view(array.dtype).reshape(array.shape)
        copy[...] = array
        return copy


def _mapping(size: int) -> np.ndarray:
    """New private mapping ``(size,)`` uint8, of zeros."""
    if hasattr(mmap, "MAP_PRIVATE"):
        return np.frombuffer(mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), np.uint8)
    return np.frombuffer(mmap.mmap(-1, size), np.uint8)
