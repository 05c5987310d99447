"""Targets of a student and its losses, against a teacher that knows the truth."""

from collections import deque
from dataclasses import replace

import pytest
import torch

from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.losses.consistency import Limits
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import Stage, full_graph, training_schedule
from dvo.nets.patch.config import preset
from train.data.augment import crop_and_resize
from train.tasks.patch_vo.objective import true_reprojection, truth_of
from train.tasks.selfsup.objective import ConsistencyConfig, lesson_targets, photometric_term, student_loss
from train.tasks.selfsup.teacher import Lesson, centres_before_crop, dense_edges, teach

ALL = Limits(confidence=0.0, residual=1e9, disagreement=1e9, share=0.0)


@pytest.fixture
def net():
    torch.manual_seed(0)
    return PatchVO(preset("tiny"))


def exact_state(batch, net, centres):
    """State after the last update of a network that knows the truth."""
    truth = truth_of(batch, net.config.STRIDE)
    n, m = centres.shape[1:3]
    stages = [Stage(full_graph(n, m, net.config.self_edges), n, None)]
    start = {"poses_cw": truth.poses_cw, "centres": centres, "mode": "structure"}
    state = deque(net.unroll(batch["images"], batch["intrinsics"], stages, **start), maxlen=1)[0]
    x, y = centres[0].unbind(-1)
    depth = truth.inverse_depth[0, torch.arange(n)[:, None], y, x].view(1, -1, 1, 1, 1).expand(-1, -1, 1, 3, 3)
    patches = torch.cat([state.patches[:, :, :2], depth], 2)
    state = replace(state, patches=patches, poses_cw=truth.poses_cw).reprojected()
    return replace(state, targets=state.coords[:, :, 1, 1])


def lesson_of(state):
    found = dense_edges(state)
    return Lesson(found.poses_cw, found.inverse_depth, found.confidence, found.known, {})


# -- targets ---------------------------------------------------------------------------------------------------------


def test_dense_tables_hold_the_values_of_the_edges(runs, net):
    batch = runs.batch(0, sizes=[(48, 64)])
    state = exact_state(batch, net, net.draw_centres(batch["images"], torch.Generator().manual_seed(0)))
    found, graph = dense_edges(state), state.graph
    m = net.config.training_patches
    for edge in (0, 17, len(graph) - 1):
        i, j, k = (int(index[edge]) for index in (graph.ii, graph.jj, graph.kk))
        torch.testing.assert_close(found.coords[0, i, k % m, j], state.coords[0, edge, 1, 1])
        torch.testing.assert_close(found.confidence[0, i, k % m, j], state.confidence[0, edge].mean())
    assert not found.known.diagonal(dim1=1, dim2=3).any()  # no edges of a frame into itself
    assert found.residual[found.known].max() < 1e-4


def test_the_targets_of_a_teacher_that_knows_the_truth_are_the_truth(runs, net):
    batch = runs.batch(0, sizes=[(48, 64)])
    state = exact_state(batch, net, net.draw_centres(batch["images"], torch.Generator().manual_seed(0)))
    truth = truth_of(batch, 4)
    coords, used, _ = lesson_targets(lesson_of(state), state.patches, state.intrinsics, state.graph, (12, 16), 0.0)
    wanted, valid = true_reprojection(truth, state.patches, state.graph, state.frames, 0.0)
    used &= valid[:, :, 1, 1]
    assert used.float().mean() > 0.3
    torch.testing.assert_close(coords[used][:, 1, 1], wanted[used][:, 1, 1], atol=1e-3, rtol=1e-3)


def test_targets_follow_into_an_enlarged_window(runs, net):
    """The rays of a window are those of the clip: a target there is the projection of the same point."""
    batch = runs.batch(0, sizes=[(48, 64)])
    clip = {name: value[0] for name, value in batch.items()}
    crop = {name: value[None] for name, value in (clip | crop_and_resize(clip, 1.4, 9.0, 6.0)).items()}
    mine = net.draw_centres(crop["images"], torch.Generator().manual_seed(1))
    there = centres_before_crop(mine, crop["intrinsics"], batch["intrinsics"], (12, 16), 4)
    assert there[..., 0].min() >= 1 and there[..., 0].max() <= 14 and there[..., 1].max() <= 10
    same = centres_before_crop(mine, batch["intrinsics"], batch["intrinsics"], (12, 16), 4)
    assert torch.equal(same, mine)

    lesson = lesson_of(exact_state(batch, net, there))
    state = exact_state(crop, net, mine)
    coords, used, _ = lesson_targets(lesson, state.patches, state.intrinsics, state.graph, (12, 16), 0.0)
    # by the rays: project the teacher's point with the intrinsics of the clip, then go into the window
    rays = (state.patches[:, :, :2] - state.intrinsics[:, :1, 2:, None, None]) / state.intrinsics[:, :1, :2, None, None]
    whole = batch["intrinsics"] / 4
    depth = lesson.inverse_depth.flatten(1)[..., None, None, None].expand(-1, -1, 1, 3, 3)
    before = torch.cat([rays * whole[:, :1, :2, None, None] + whole[:, :1, 2:, None, None], depth], 2)
    graph = state.graph
    seen = reproject(lesson.poses_cw, before, whole, graph.ii, graph.jj, graph.kk).coords
    window = (seen - whole[:, :1, None, None, 2:]) / whole[:, :1, None, None, :2]
    wanted = window * state.intrinsics[:, :1, None, None, :2] + state.intrinsics[:, :1, None, None, 2:]
    torch.testing.assert_close(coords[used], wanted[used], atol=1e-3, rtol=1e-3)
    assert used.any()


def test_backwards_is_the_same_frame_by_frame(runs, net):
    """Tables of a reversed clip, turned round again, index the same patches and frames."""
    batch = runs.batch(0, sizes=[(48, 64)])
    centres = net.draw_centres(batch["images"], torch.Generator().manual_seed(0))
    turned = {name: value.flip(1) for name, value in batch.items()}
    forward = dense_edges(exact_state(batch, net, centres))
    backward = dense_edges(exact_state(turned, net, centres.flip(1))).reversed()
    known = forward.known & backward.known
    assert known.float().mean() > 0.6
    torch.testing.assert_close(forward.coords[known], backward.coords[known], atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(forward.inverse_depth, backward.inverse_depth)


def test_a_lesson_has_the_unit_of_the_median_depth_and_its_limits_count(runs, net):
    batch = runs.batch(0, sizes=[(48, 64)])
    centres = net.draw_centres(batch["images"], [torch.Generator().manual_seed(0)])
    stages = training_schedule(4, centres.shape[2], 4, 3, 1, self_edges=False)

    def lesson(limits, patches=12):
        return teach(net, batch["images"], batch["intrinsics"], centres, stages, limits, patches, True)

    free = lesson(ALL)
    assert free.inverse_depth.flatten(1).median() == pytest.approx(1.0)
    assert lesson(ALL, 5).trusted.shape == (1, 4, 5, 4)
    assert free.trusted.sum() > 0 and free.measures["trusted"] > 0.9
    assert {"forward_backward", "teacher_residual", "teacher_flow"} < set(free.measures)
    strict = lesson(replace(ALL, disagreement=float(free.measures["forward_backward"])))
    assert 0.3 < strict.trusted.sum() / free.trusted.sum() < 0.7
    assert not lesson(replace(ALL, residual=0.0)).trusted.any()


# -- losses ----------------------------------------------------------------------------------------------------------


def test_the_exact_student_costs_less_than_one_that_is_off(runs, net):
    batch = runs.batch(0, sizes=[(48, 64)])
    state = exact_state(batch, net, net.draw_centres(batch["images"], torch.Generator().manual_seed(0)))
    lesson = lesson_of(state)

    def loss(state, **weights):
        config = ConsistencyConfig(**({"flow": 0, "target": 0, "pose": 0, "photometric": 0, "pose_from": 0} | weights))
        return float(student_loss([state], lesson, batch["images"], batch["intrinsics"], config)[0].detach())

    poses = state.poses_cw.clone()
    poses[:, 1:] = se3.retract(poses[:, 1:], torch.full((1, 3, 6), 0.04))
    off = replace(state, poses_cw=poses).reprojected()
    off = replace(off, targets=off.coords[:, :, 1, 1])
    for term in ("flow", "target", "pose"):
        assert loss(state, **{term: 1.0}) < 1e-3 < 0.02 < loss(off, **{term: 1.0}), term
    for form in ("census", "ssim"):
        assert loss(state, photometric=1.0, form=form, reach=1) < loss(off, photometric=1.0, form=form, reach=1)


def test_the_photometric_gradient_is_the_derivative(runs, net):
    """By poses and inverse depths, through the projection and the sampling of a smooth image."""
    batch = runs.batch(0, sizes=[(48, 64)])
    state = exact_state(batch, net, net.draw_centres(batch["images"], torch.Generator().manual_seed(0))[:, :, :2])
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    wave = 120 + 60 * torch.sin(x / 6) * torch.cos(y / 5) + torch.arange(4.0)[:, None, None] * 5
    images = wave[None, :, None].expand(1, 4, 3, 48, 64).double()
    used = torch.ones(1, len(state.graph), dtype=torch.bool)
    state = replace(state, intrinsics=state.intrinsics.double(), patches=state.patches.double())
    depth, config = state.patches[:, :, 2:], ConsistencyConfig(window=3, form="ssim")

    def error(poses, depth):
        at = replace(state, poses_cw=poses, patches=torch.cat([state.patches[:, :, :2], depth], 2))
        return photometric_term(at, images, batch["intrinsics"].double(), used, config)[0]

    arguments = (state.poses_cw.double().requires_grad_(), depth.clone().requires_grad_())
    assert torch.autograd.gradcheck(error, arguments, eps=1e-7, atol=1e-4, rtol=1e-2)
    assert error(*arguments).item() > 0
