"""Fused cloud of depth images."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status
from dvo.session import depth_fusion
from dvo.session.depth_fusion import DepthCloud, depth_view, fuse_points, view_points
from dvo.session.session import Run

CAMERA = Camera(200.0, 200.0, 159.5, 119.5, 320, 240)
METRES = {"scale": {"source": "depth", "segments": [{"segment": 0, "source": "depth"}]}}


def frame(index, depth):
    image = np.full((240, 320, 3), (200, 100, 50), np.uint8)
    return Frame(index, 0.1 * index, image, CAMERA, depth=depth.astype(np.float32))


def test_a_view_keeps_the_rays_of_its_pixels_and_no_edges():
    depth = np.full((240, 320), 2.0)
    depth[:, 200:] = 3.0
    view = depth_view(frame(0, depth), depth)
    assert view.depth.shape == (120, 160)
    cloud = view_points(view, np.array([1.0, 0, 0, 0, 0, 0, 1]), 10.0)
    pixels = (cloud.points - [1, 0, 0]) @ np.diag([200, 200, 1]) / cloud.points[:, 2:] + [159.5, 119.5, 0]
    np.testing.assert_allclose(pixels[:, :2], np.rint(pixels[:, :2]), atol=1e-2)
    assert set(np.unique(cloud.points[:, 2])) == {2.0, 3.0}
    assert not ((pixels[:, 0] > 197) & (pixels[:, 0] < 202)).any()
    assert view_points(view, np.array([0.0, 0, 0, 0, 0, 0, 1]), 2.5).points[:, 2].max() == 2.0


def test_points_of_a_cell_are_averaged_in_any_number_of_batches():
    rng = np.random.default_rng(0)
    clouds = [SparseMap(rng.uniform(-1, 1, (50, 3)).astype(np.float32), rng.integers(0, 255, (50, 3)).astype(np.uint8))
              for _ in range(40)]  # fmt: skip
    fused = fuse_points(clouds, 0.5)
    points = np.concatenate([c.points for c in clouds])
    cells = np.floor(points / 0.5).astype(int)
    assert len(fused.points) == len(np.unique(cells, axis=0)) == 64
    first = (cells == np.unique(cells, axis=0)[0]).all(1)
    np.testing.assert_allclose(fused.points[0], points[first].mean(0), atol=1e-6)
    assert len(fuse_points(clouds, 0.5, least=10**6).points) == 0


def run_of(count, info=METRES):
    times = 0.1 * np.arange(count)
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (count, 1))
    return Run(Result(Trajectory(times, poses), SparseMap(), count, 0, info), count, False)


@pytest.mark.parametrize("limit", [400, 3])
def test_the_cloud_of_a_run_is_a_plane_and_bounded(tmp_path, monkeypatch, limit):
    monkeypatch.setattr(depth_fusion, "VIEWS", limit)
    cloud = DepthCloud(tmp_path / "cloud.ply")
    cloud.begin(object())
    for k in range(12):
        cloud.update(frame(k, np.full((240, 320), 2.0)), Estimate(0.1 * k, None, Status.LOST))
    assert len(cloud.views) <= limit
    cloud.finish(run_of(12))
    data = (tmp_path / "cloud.ply").read_bytes()
    header, body = data.split(b"end_header\n")
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert f"element vertex {len(rows)}".encode() in header and len(rows) > 1000
    np.testing.assert_allclose(rows["xyz"][:, 2], 2.0)
    assert (rows["rgb"] == [200, 100, 50]).all()


def test_nothing_is_written_without_depth_or_a_scale(tmp_path):
    for depth, info in ((None, METRES), (np.full((240, 320), 2.0), {})):
        cloud = DepthCloud(tmp_path / "cloud.ply")
        cloud.begin(object())
        one = frame(0, np.zeros((240, 320)))
        cloud.update(replace(one, depth=depth), Estimate(0.0, None, Status.LOST))
        cloud.finish(run_of(1, info))
        assert not list(tmp_path.iterdir())


def test_a_mesh_needs_open3d(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(DvoError, match=r"dvo\[tsdf\]"):
        DepthCloud(tmp_path / "cloud.ply", tmp_path / "mesh.ply")


def test_an_open3d_without_a_system_library_is_told(tmp_path, monkeypatch):
    class Finder:
        def find_spec(self, name, *rest):
            if name == "open3d":
                raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Finder(), *sys.meta_path])
    with pytest.raises(DvoError, match=r"cannot be imported: libusb.*Install the system library"):
        DepthCloud(tmp_path / "cloud.ply", tmp_path / "mesh.ply")


class FakeOpen3D:
    """Stand-in for the parts of Open3D that are used, as Open3D 0.20 has them; the last test runs the real one."""

    def __init__(self, vertices=5):
        self.views, self.vertices = [], range(vertices)
        self.core = SimpleNamespace(float32="float32", Tensor=np.asarray)
        self.t = SimpleNamespace(geometry=SimpleNamespace(Image=np.asarray, VoxelBlockGrid=self.grid))
        self.io = self

    def grid(self, attr_names, attr_dtypes, attr_channels, voxel_size, block_resolution, block_count):
        assert len(attr_names) == len(attr_dtypes) and sum(attr_channels) == 5
        self.voxel = voxel_size
        return self

    def compute_unique_block_coordinates(self, depth, intrinsic, extrinsic, depth_scale, depth_max, **rest):
        assert rest == {"trunc_voxel_multiplier": 4.0} and depth_scale == 1.0
        return depth

    def integrate(self, blocks, depth, color, intrinsic, color_intrinsic, extrinsic, depth_scale, depth_max, **rest):
        assert blocks is depth and color_intrinsic is intrinsic
        assert color.dtype == depth.dtype == np.float32 and color.shape == (*depth.shape, 3)
        assert color.flags.c_contiguous and depth.flags.c_contiguous and np.isfinite(depth).all()
        assert intrinsic.dtype == extrinsic.dtype == np.float64
        self.views.append((depth, color, intrinsic, extrinsic, depth_max))

    def extract_triangle_mesh(self, weight_threshold):
        return self

    def to_legacy(self):
        return self

    def write_triangle_mesh(self, filename, mesh):
        assert filename.endswith(".ply"), "the extension tells Open3D the format"
        Path(filename).write_text("mesh")
        return True


def test_what_is_passed_to_open3d(tmp_path, monkeypatch):
    fake = FakeOpen3D()
    monkeypatch.setitem(sys.modules, "open3d", fake)
    cloud = DepthCloud(tmp_path / "cloud.ply", tmp_path / "mesh.ply")
    cloud.begin(object())
    depth = np.full((240, 320), 2.0)
    depth[:40] = np.nan
    for k in range(3):
        cloud.update(frame(k, depth), Estimate(0.1 * k, None, Status.LOST))
    run = run_of(3)
    run.result.trajectory.poses_wc[2, :3] = 0.5, 0.2, -0.1
    cloud.finish(run)
    assert (tmp_path / "mesh.ply").read_text() == "mesh" and (tmp_path / "cloud.ply").is_file()
    assert fake.voxel == pytest.approx(0.02) and len(fake.views) == 3
    seen, color, camera, extrinsic, farthest = fake.views[2]
    assert seen.shape == (120, 160) and (seen[:19] == 0).all() and (seen[21:] == 2).all()
    np.testing.assert_allclose(color[0, 0] * 255, [200, 100, 50], atol=1e-4)
    assert farthest == pytest.approx(6.0)
    assert camera.tolist() == [[100.0, 0, 79.25], [0, 100.0, 59.25], [0, 0, 1]], (
        "of every other pixel from the second on"
    )
    np.testing.assert_allclose(extrinsic, [[1, 0, 0, -0.5], [0, 1, 0, -0.2], [0, 0, 1, 0.1], [0, 0, 0, 1]], atol=1e-12)


def test_a_mesh_without_a_surface_is_told(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", FakeOpen3D(vertices=0))
    cloud = DepthCloud(tmp_path / "cloud.ply", tmp_path / "mesh.ply")
    cloud.begin(object())
    cloud.update(frame(0, np.full((240, 320), 2.0)), Estimate(0.0, None, Status.LOST))
    with pytest.raises(DvoError, match="mesh.ply: --tsdf: Open3D has written no mesh"):
        cloud.finish(run_of(1))
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]


def test_the_mesh_of_a_wall(tmp_path):
    """With Open3D itself."""
    trimesh = pytest.importorskip("trimesh")
    try:
        import open3d  # noqa: F401
    except ImportError as error:
        pytest.skip(f"open3d: {error}")
    cloud = DepthCloud(tmp_path / "cloud.ply", tmp_path / "mesh.ply")
    cloud.begin(object())
    for k in range(3):
        cloud.update(frame(k, np.full((240, 320), 2.0)), Estimate(0.1 * k, None, Status.LOST))
    cloud.finish(run_of(3))
    mesh = trimesh.load(tmp_path / "mesh.ply")
    assert len(mesh.vertices) > 1000
    np.testing.assert_allclose(mesh.vertices[:, 2], 2.0, atol=0.01)
    np.testing.assert_allclose(np.ptp(mesh.vertices[:, :2], axis=0), [3.2, 2.4], atol=0.15)
    assert (np.abs(mesh.visual.vertex_colors[:, :3].astype(int) - [200, 100, 50]) <= 1).all()
