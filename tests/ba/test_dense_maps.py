"""Dense bundle adjustment of whole maps: the layer of patches, its gradients, and depth and motion from true flow."""

import pytest
import torch

from dvo.ba.edges import plan_edges
from dvo.ba.factors import DepthDamping
from dvo.ba.layer.dense import dense_bundle_adjust, dense_patches, dense_plan, pixel_grid
from dvo.ba.layer.layer import bundle_adjust
from dvo.ba.options import BADamping, BAOptions
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.losses.pose import pose_errors
from dvo.models.droid import damping_of, neighbour_edges
from dvo.synth.clip import make_clip

PAIRS = torch.tensor([[0, 1], [1, 0], [1, 2], [2, 1], [0, 2]])


def problem(height=4, width=5, frames=3, batch=1, dtype=torch.float64):
    """Poses, depths, intrinsics, and measurements that nearly fit them."""
    g = torch.Generator().manual_seed(0)
    poses = se3.exp(0.05 * torch.randn(batch, frames, 6, generator=g, dtype=dtype))
    depth = 0.8 + 0.4 * torch.rand(batch, frames, height, width, generator=g, dtype=dtype)
    intrinsics = torch.tensor([4.0, 4.5, 2.0, 1.5], dtype=dtype).expand(batch, frames, 4)
    ii, jj = PAIRS.unbind(1)
    there = reproject(poses, dense_patches(depth), intrinsics, ii, jj, ii).coords
    targets = there + 0.2 * torch.randn(there.shape, generator=g, dtype=dtype)
    weights = torch.rand(there.shape, generator=g, dtype=dtype)
    damping = 0.1 + torch.rand(depth.shape, generator=g, dtype=dtype)
    return poses, depth, intrinsics, targets, weights, damping


def as_patches(poses, depth, intrinsics, targets, weights, damping, options):
    """The same call with every pixel as a patch of its own and edges in a shuffled order."""
    b, n, h, w = depth.shape
    grid = pixel_grid(h, w).to(depth).expand(b, n, 2, h, w)
    patches = torch.cat([grid, depth[:, :, None]], 2).permute(0, 1, 3, 4, 2).reshape(b, -1, 3, 1, 1)
    ii, jj = (end[:, None].expand(-1, h * w).flatten() for end in PAIRS.unbind(1))
    kk = (PAIRS[:, :1] * h * w + torch.arange(h * w)).flatten()
    order = torch.randperm(len(kk), generator=torch.Generator().manual_seed(1))
    factors = () if damping is None else (DepthDamping(damping.flatten(1)),)
    measured = (x.reshape(b, -1, 2)[:, order] for x in (targets, weights))
    found = bundle_adjust(
        poses, patches, intrinsics, *measured, ii[order], jj[order], kk[order], options, factors=factors
    )
    return found.poses_cw, found.patches[:, :, 2, 0, 0].view(depth.shape)


@pytest.mark.parametrize("damped", [False, True])
@pytest.mark.parametrize("batch", [1, 2])
def test_maps_are_patches_of_one_pixel(damped, batch):
    values = problem(batch=batch)
    leaves = [x.clone().requires_grad_() for x in values]
    if not damped:
        leaves[-1] = None
    options = BAOptions(iterations=2, bounds=(5, 4))
    inputs = [x for x in leaves if x is not None]
    results = []
    for poses, depth in (
        dense_bundle_adjust(*leaves[:5], *PAIRS.unbind(1), options, damping=leaves[5]), as_patches(*leaves, options),
    ):  # fmt: skip
        total = (poses * torch.arange(7.0)).sum() + (depth * depth.detach()).sum()
        results.append((poses.detach(), depth.detach(), *torch.autograd.grad(total, inputs)))
    for mine, plain in zip(*results, strict=True):
        torch.testing.assert_close(mine, plain, atol=1e-7, rtol=1e-7)
    assert not torch.allclose(results[0][1], values[1])


def test_the_plan_sums_what_the_sorted_one_sums():
    ii, jj = PAIRS.unbind(1)
    mine = dense_plan(ii, jj, 3, 20)
    kk = mine.kk
    plain = plan_edges(*(end[:, None].expand(-1, 20).flatten() for end in (ii, jj)), kk, 3, 60)
    for plan in (mine, plain):
        assert plan.size == 20 and plan.groups == 5 and bool(plan.filled.all())
    found = []
    for plan in (mine, plain):
        ends = plan.group_pair.repeat_interleave(20)
        found.append(sorted(zip(plan.pair_i[ends].tolist(), plan.pair_j[ends].tolist(), plan.kk.tolist(), strict=True)))
    assert found[0] == found[1]


@pytest.mark.long
def test_gradients_are_the_derivatives():
    poses, depth, intrinsics, targets, weights, damping = problem(2, 3)
    ii, jj = PAIRS.unbind(1)

    def solve(depth, intrinsics, targets, weights, damping):
        options = BAOptions(iterations=1, bounds=(3, 2))
        found = dense_bundle_adjust(poses, depth, intrinsics, targets, weights, ii, jj, options, damping=damping.exp())
        return found[0][..., :3], found[1]

    leaves = [x.detach().clone().requires_grad_() for x in (depth, intrinsics, targets, weights, damping)]
    assert torch.autograd.gradcheck(solve, leaves, eps=1e-6, atol=1e-6)


def test_strong_damping_holds_the_depth_of_its_pixel():
    values = problem()
    damping = torch.full_like(values[1], 1e-6)
    damping[0, 1, 2, 3] = 1e9
    _, depth = dense_bundle_adjust(*values[:5], *PAIRS.unbind(1), damping=damping)
    moved = (depth - values[1]).abs()
    assert moved[0, 1, 2, 3] < 1e-8 and moved[0, 1].median() > 1e-3


@pytest.mark.long
@pytest.mark.parametrize("index", [0, 2])
def test_true_flow_gives_depth_and_motion(index):
    """From identity poses and constant depth, with two given poses, which set the scale."""
    clip = make_clip(21, index, frames=5, height=96, width=128, flow_range=(6.0, 9.0), sensor=False)
    truth = 1 / clip.depth[None, :, ::8, ::8].double()
    poses, intrinsics = clip.poses_cw[None].double(), clip.intrinsics[None].double() / 8
    ii, jj = neighbour_edges(5, 3)
    there = reproject(poses, dense_patches(truth), intrinsics, ii, jj, ii)
    weights = 1e-3 * there.valid[..., None].double().expand_as(there.coords)
    now, depth = torch.cat([poses[:, :2], poses[:, 1:2].expand(-1, 3, -1)], 1), torch.ones_like(truth)
    for update in range(14):
        options = BAOptions(fixed=2, damping=damping_of(update))
        now, depth = dense_bundle_adjust(now, depth, intrinsics, there.coords, weights, ii, jj, options)
    errors = pose_errors(now, poses)
    assert errors.translation < 5e-3 and errors.rotation < 2e-3
    assert ((depth / truth - 1).abs() < 0.03).double().mean() > 0.9


def test_one_step_damping_of_the_published_code_is_used():
    assert damping_of(0) == BADamping(0.1, 0.1, 1e-7) and damping_of(9) == BADamping(0.1, 1e-4, 1e-7)


@pytest.mark.parametrize("name", ["inverse_depth", "targets", "weights", "ii", "jj", "damping"])
def test_maps_that_do_not_fit_are_named(name):
    poses, depth, intrinsics, targets, weights, damping = problem()
    ii, jj = PAIRS.unbind(1)
    given = {"poses_cw": poses, "inverse_depth": depth, "intrinsics": intrinsics, "targets": targets,
             "weights": weights, "ii": ii, "jj": jj, "damping": damping.exp()}  # fmt: skip
    for wrong in (given[name][None], given[name].tolist()):
        with pytest.raises(DvoError) as error:
            dense_bundle_adjust(**(given | {name: wrong}))
        assert error.value.field == name
