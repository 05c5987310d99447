"""Clips from recordings."""

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.data.files.root import data_root
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from train.data.real import RealClips, RealData
from train.tasks.patch_vo.objective import LossConfig

DATA = data_root(required=False)
real = pytest.mark.skipif(not DATA.is_dir(), reason="set DVO_DATA to the folder of real sequences")


@real
@pytest.mark.parametrize("name", ["tartanair_v1_60", "tartanair_v2_10"])
def test_depth_of_tartanair_fits_its_poses(name):
    """A pixel of known depth, projected into the next frame, finds that surface there."""
    clips = RealClips(0, RealData([str(DATA / name)], hops=[1]), 2, 96, 128)
    start = {"tartanair_v1_60": 20, "tartanair_v2_10": 0}[name]
    clip = {k: torch.from_numpy(v) for k, v in clips.read(0, start, 1).items()}
    depth = clip["depth"]
    known = torch.isfinite(depth)
    if name == "tartanair_v1_60":  # three maps only, this is frame 149
        assert known[0].all() and not known[1].any()
        assert depth[0].median() == pytest.approx(1, abs=1e-3)
        return
    assert known.all() and depth.median() == pytest.approx(1, abs=1e-3)
    y, x = torch.meshgrid(torch.arange(8, 88, 4), torch.arange(8, 120, 4), indexing="ij")
    x, y = x.flatten(), y.flatten()
    patches = torch.stack([x.float(), y.float(), 1 / depth[0, y, x]], -1)[None, :, :, None, None]
    kk = torch.arange(len(x))
    there = reproject(
        clip["poses_cw"][None], patches, clip["intrinsics"][None], torch.zeros_like(kk), torch.ones_like(kk), kk
    )
    at = there.coords[0, :, 0, 0].round().long()
    inside = (at >= 0).all(1) & (at[:, 0] < 128) & (at[:, 1] < 96)
    found = depth[1, at[inside, 1], at[inside, 0]]
    expected = (there.depth[0, :, 0, 0] * depth[0, y, x])[inside]  # reprojection works with depths over source depth
    error = (found - expected).abs() / found
    assert inside.float().mean() > 0.6 and error.median() < 0.01


@real
def test_recordings_without_depth_have_poses_of_the_unit_of_training():
    clips = RealClips(3, RealData([str(DATA / "kitti00_120"), str(DATA / "tum_fr1_xyz_10_rgbd")]), 3, 48, 64)
    a, b = clips[0], clips[0]
    assert all(torch.equal(a[k].nan_to_num(), b[k].nan_to_num()) for k in a)
    assert a["images"].shape == (3, 3, 48, 64) and torch.isnan(a["depth"]).all()
    torch.testing.assert_close(a["poses_cw"][0], se3.identity(1, 1)[0, 0])
    centres = se3.inverse(a["poses_cw"])[:, :3]
    assert centres.diff(dim=0).norm(dim=1).mean() == pytest.approx(0.15, rel=1e-3)


@real
@pytest.mark.parametrize(
    "name",
    [
        "tartanair_v2_10",
        "tum_fr1_rpy_60",
        pytest.param("kitti00_120", marks=pytest.mark.slow),
        pytest.param("euroc_V1_01", marks=pytest.mark.slow),
    ],
)
def test_a_step_runs_on_recordings(name, tmp_path, runs):
    """With depth the whole loss applies, elsewhere only that of the poses; nothing trained here is kept."""
    data = runs.data(real=RealData([str(DATA / name)], hops=[1], flow_low=0.1))
    program = runs.module(loss=LossConfig(pose_from=0))
    logged = {}
    program.log_dict = lambda values, **_: logged.update(values)
    _, losses = runs.fit(tmp_path, 1, program, data=data)
    assert np.isfinite(losses).all() and losses[0] > 0
    assert (logged["loss_flow"] > 0) == (name == "tartanair_v2_10")
    assert logged["loss_rotation"] > 0


@real
def test_recordings_without_truth_or_too_short_are_refused(tmp_path):
    with pytest.raises(DvoError, match="in a row"):
        RealClips(0, RealData([str(DATA / "tartanair_v2_10")]), 30, 48, 64)
