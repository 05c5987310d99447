"""Fused cloud of the depth images of a run: points averaged in the cells of a grid; and a mesh by Open3D.

Views are kept at a reduced size while a run goes on, at most :data:`VIEWS` of them, evenly spread: when there are more,
every other one is given up, and from then on every other one is taken. Those of keyframes are fused, at their final
poses.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.output import replaced
from dvo.data.frame import Frame
from dvo.geometry.poses import pose_matrices
from dvo.odometry.depth.patch_depth import checked_depth
from dvo.odometry.protocol import Estimate, Odometry, SparseMap
from dvo.session.files import write_ply
from dvo.session.frame_table import keyframe_times
from dvo.session.session import Run

VIEWS = 400
_WIDTH = 160  # of the views, pixels
_CELL = 0.01  # side of a cell, of the median depth
_SMALLEST = 0.005  # and at least, metres
_FARTHEST = 3.0  # of the median depth, beyond which depths are left out
_STEP = 0.05  # relative difference of neighbouring depths at the edge of a body
_TRUNCATION = 4.0  # of the signed distance, in cells
_BLOCKS = 4000  # of 16^3 voxels, room for them at the start; more is taken when it is needed
_BATCH = 16  # views whose points are averaged at once, which bounds the memory


@dataclass(frozen=True)
class DepthView:
    """Depth and colours of a frame at a reduced size.

    Attributes:
        timestamp: seconds.
        depth: ``(h, w)`` float32 metres, nan where unknown or at the edge of a body.
        colors: ``(h, w, 3)`` uint8 RGB.
        intrinsics: ``(4,)`` fx fy cx cy of these pixels.
    """

    timestamp: float
    depth: np.ndarray
    colors: np.ndarray
    intrinsics: np.ndarray


def depth_view(frame: Frame, depth: np.ndarray, width: int = _WIDTH) -> DepthView:
    """Reduce a frame by taking every n-th pixel, which invents no depth.

    Args:
        frame: its image and camera.
        depth: ``(H, W)`` metres.
        width: of the view, at least.

    Returns:
        The view.
    """
    step = max(1, depth.shape[1] // width)
    small = depth[step // 2 :: step, step // 2 :: step].astype(np.float32)
    with np.errstate(invalid="ignore"):
        small = np.where(np.isfinite(small) & (small > 0), small, np.float32(np.nan))
        edge = np.zeros(small.shape, bool)
        for axis in (0, 1):
            jump = np.abs(np.diff(small, axis=axis)) > _STEP * np.minimum(*_pair(small, axis))
            edge |= np.insert(jump, 0, False, axis=axis) | np.insert(jump, jump.shape[axis], False, axis=axis)
    small[edge] = np.nan
    fx, fy, cx, cy = frame.camera.intrinsics
    intrinsics = np.array([fx / step, fy / step, (cx - step // 2) / step, (cy - step // 2) / step])
    return DepthView(frame.timestamp, small, frame.image[step // 2 :: step, step // 2 :: step].copy(), intrinsics)


def _pair(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours along an axis."""
    n = values.shape[axis]
    return np.take(values, range(n - 1), axis), np.take(values, range(1, n), axis)


def view_points(view: DepthView, pose_wc: np.ndarray, farthest: float) -> SparseMap:
    """Points of a view in the world.

    Args:
        view: depth and colours.
        pose_wc: ``(7,)`` camera to world.
        farthest: depth beyond which pixels are left out, metres.

    Returns:
        The points.
    """
    fx, fy, cx, cy = view.intrinsics
    with np.errstate(invalid="ignore"):
        v, u = np.nonzero(view.depth <= farthest)
    z = view.depth[v, u].astype(np.float64)
    camera = np.column_stack([(u - cx) / fx * z, (v - cy) / fy * z, z])
    matrix = pose_matrices(pose_wc)
    return SparseMap((camera @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32), view.colors[v, u])


def fuse_points(clouds: Iterable[SparseMap], cell: float, least: int = 1) -> SparseMap:
    """Average points and colours in the cells of a grid.

    Args:
        clouds: points of each view.
        cell: side of a cell, metres.
        least: points that a cell needs.

    Returns:
        A point for each cell, in the order of the cells.
    """
    total: tuple[np.ndarray, np.ndarray] = (np.zeros((0, 3), np.int64), np.zeros((0, 7)))
    batch: list[SparseMap] = []
    for cloud in clouds:
        batch.append(cloud)
        if len(batch) == _BATCH:
            total, batch = _merged(total, batch, cell), []
    _, sums = _merged(total, batch, cell)
    sums = sums[sums[:, 6] >= least]
    means = sums[:, :6] / sums[:, 6:]
    return SparseMap(means[:, :3].astype(np.float32), np.rint(means[:, 3:]).astype(np.uint8))


def _merged(
    total: tuple[np.ndarray, np.ndarray], batch: Sequence[SparseMap], cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cells ``(C, 3)`` and their sums ``(C, 7)`` of positions, colours and ones, with those of further points."""
    keys, sums = [total[0]], [total[1]]
    for cloud in batch:
        keys.append(np.floor(cloud.points / cell).astype(np.int64))
        sums.append(np.column_stack([cloud.points, cloud.colors, np.ones(len(cloud.points))]))
    cells, index = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
    rows = np.concatenate(sums)
    found = np.column_stack([np.bincount(index.ravel(), rows[:, k], len(cells)) for k in range(7)])
    return cells, found


class DepthCloud:
    """Observer of a run that writes the fused cloud of its depth images.

    Args:
        file: PLY of the cloud.
        mesh: PLY of a mesh from a truncated signed distance function, by Open3D; None for none.

    Attributes:
        views: kept so far, at most :data:`VIEWS`.

    Raises:
        DvoError: Open3D is not installed.
    """

    def __init__(self, file: Path, mesh: Path | None = None) -> None:
        self.file, self.mesh = file, mesh
        self._open3d = None if mesh is None else import_open3d()
        self.views: list[DepthView] = []
        self._every, self._seen = 1, 0
        self._odometry: Odometry | None = None

    def begin(self, odometry: Odometry) -> None:
        """See :class:`dvo.session.observer.Observer`."""
        self._odometry = odometry

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """See :class:`dvo.session.observer.Observer`."""
        depth = None if estimate is None or self._seen % self._every else checked_depth(frame)
        self._seen += estimate is not None
        if depth is None:
            return
        self.views.append(depth_view(frame, depth))
        if len(self.views) > VIEWS:
            self.views, self._every = self.views[::2], 2 * self._every

    def finish(self, run: Run) -> None:
        """See :class:`dvo.session.observer.Observer`."""
        if not run.result.metric:
            return
        posed = self._posed(run)
        if not posed:
            return
        depths = np.concatenate([view.depth[np.isfinite(view.depth)] for view, _ in posed])
        median = float(np.median(depths)) if len(depths) else 1.0
        cell, farthest = max(_SMALLEST, _CELL * median), _FARTHEST * median
        clouds = (view_points(view, pose, farthest) for view, pose in posed)
        fused = fuse_points(clouds, cell, least=2 if len(posed) > 4 else 1)
        with replaced(self.file) as part:
            write_ply(part, fused)
        if self.mesh is not None:
            write_mesh(self._open3d, self.mesh, posed, cell, farthest)

    def close(self) -> None:
        """See :class:`dvo.session.observer.Observer`."""
        self.views.clear()

    def _posed(self, run: Run) -> list[tuple[DepthView, np.ndarray]]:
        """Views with final poses: those of keyframes, unless fewer than two are kept."""
        trajectory = run.result.trajectory
        poses = dict(zip(trajectory.timestamps.tolist(), trajectory.poses_wc, strict=True))
        posed = [(view, poses[view.timestamp]) for view in self.views if view.timestamp in poses]
        assert self._odometry is not None
        keyframes = set(keyframe_times(self._odometry, run.result) or ())
        chosen = [pair for pair in posed if pair[0].timestamp in keyframes]
        return chosen if len(chosen) > 1 else posed


def import_open3d() -> Any:
    """Import the package ``open3d``.

    Returns:
        The module.

    Raises:
        DvoError: it is not installed, or lacks a library of the system.
    """
    try:
        import open3d
    except ModuleNotFoundError as error:
        remedy = "run pip install 'dvo[tsdf]'"
        raise DvoError(f"the package {error.name} is not installed", field="--tsdf", remedy=remedy) from error
    except ImportError as error:
        remedy = "install the system library that it names, or leave --tsdf out"
        raise DvoError(f"the package open3d cannot be imported: {error}", field="--tsdf", remedy=remedy) from error
    return open3d


def write_mesh(
    open3d: Any, file: Path, posed: Sequence[tuple[DepthView, np.ndarray]], cell: float, farthest: float
) -> None:
    """Integrate views into a truncated signed distance function (Curless and Levoy, SIGGRAPH 1996), and write its mesh.

    Args:
        open3d: the module.
        file: PLY to write.
        posed: views with their poses ``(7,)`` camera to world.
        cell: side of a voxel, metres; the function is truncated at four of them.
        farthest: depth beyond which pixels are left out, metres.

    Raises:
        DvoError: Open3D has not written the file, for instance because there is no surface.
    """
    core, tensors = open3d.core, open3d.t.geometry
    grid = tensors.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(core.float32, core.float32, core.float32),
        attr_channels=(1, 1, 3),
        voxel_size=cell,
        block_resolution=16,
        block_count=_BLOCKS,
    )
    ranges = {"depth_scale": 1.0, "depth_max": farthest, "trunc_voxel_multiplier": _TRUNCATION}
    for view, pose_wc in posed:
        if not (view.depth <= farthest).any():
            continue
        fx, fy, cx, cy = view.intrinsics
        camera = core.Tensor(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        pose_cw = core.Tensor(np.linalg.inv(pose_matrices(pose_wc)))
        depth = tensors.Image(core.Tensor(np.nan_to_num(view.depth, nan=0.0)))
        color = tensors.Image(core.Tensor(view.colors.astype(np.float32) / 255))
        blocks = grid.compute_unique_block_coordinates(depth, camera, pose_cw, **ranges)
        grid.integrate(blocks, depth, color, camera, camera, pose_cw, **ranges)
    mesh = grid.extract_triangle_mesh(weight_threshold=1.0).to_legacy()
    with replaced(file) as part:
        if not (len(mesh.vertices) and open3d.io.write_triangle_mesh(str(part), mesh)):
            remedy = "check the depth images and their scale; the fused cloud is written without it"
            raise DvoError("Open3D has written no mesh", file=file, field="--tsdf", remedy=remedy)
