"""The training objective: exact estimates cost nothing, and bundle adjustment of exact targets finds the motion."""

from dataclasses import replace

import pytest
import torch

from dvo.ba.layer.layer import BAOptions, bundle_adjust
from dvo.ba.multistart import COLD_STARTS, multistart
from dvo.ba.options import damping_at
from dvo.ba.patch_problem import PatchProblem
from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.losses.pose import pose_errors
from dvo.models.patch_vo import UpdateState
from dvo.models.schedule import full_graph
from dvo.nets.patch.patchifier import patch_coordinates
from dvo.nets.patch.selection import random_centres
from dvo.synth.clip import make_clip
from train.data.augment import Augmentation
from train.tasks.patch_vo.objective import LossConfig, clip_terms, true_reprojection, truth_of

PATCHES = 24


@pytest.mark.parametrize(("settings", "change"), [(LossConfig, {"pose": None}), (Augmentation, {"zoom": None})])
def test_a_setting_without_a_value_is_refused(settings, change):
    with pytest.raises(DvoError, match=f"{next(iter(change))}: must be a number, got None"):
        settings(**change)


@pytest.mark.parametrize(
    ("name", "weight", "words"),
    [
        ("flow", 1.0, "another loss term 'flow'"),
        ("sharpness", float("nan"), "sharpness: must be a number, got nan"),
        ("sharpness", "much", "sharpness: must be a number, got 'much'"),
        ("softness", 1.0, "no loss term 'softness'"),
    ],
)
def test_further_terms_have_names_and_weights_of_their_own(name, weight, words, monkeypatch):
    targets = {name: "somewhere:TERM" for name in ("flow", "sharpness")}
    monkeypatch.setattr("train.tasks.patch_vo.objective.LOSS_TERMS", Registry("loss term", targets=targets))
    with pytest.raises(DvoError, match=words):
        LossConfig(terms={name: weight})


def state_of(graph, poses_cw, patches, coords, targets, weights):
    """A state as a step leaves it; what the losses do not read is empty."""
    none = torch.zeros(1, 0)
    return UpdateState(graph, poses_cw, patches, none, none, none, coords, targets, weights)


def rendered(index, **options):
    clip = make_clip(11, index, sensor=False, **options)
    names = ("images", "depth", "poses_cw", "intrinsics")
    return {name: torch.as_tensor(getattr(clip, name))[None] for name in names}


def patches_of(truth, generator):
    b, n, h, w = truth.inverse_depth.shape
    centres = random_centres(n, PATCHES, h, w, generator)
    return centres, patch_coordinates(centres, torch.ones(b, n * PATCHES), 3)


def loss_of(states, truth, config, mode="joint"):
    terms, measures = clip_terms(states, truth, config, mode)
    return terms.total(config), measures


def test_exact_estimates_cost_nothing():
    truth = truth_of(rendered(0, frames=4, height=64, width=80), 4)
    graph = full_graph(4, PATCHES, self_edges=False)
    centres, patches = patches_of(truth, torch.Generator().manual_seed(0))
    coords, _ = true_reprojection(truth, patches, graph, 4, 4.0)
    state = state_of(graph, truth.poses_cw, patches, coords, coords[:, :, 1, 1], torch.ones(1, len(graph), 2))
    loss, measures = loss_of([state] * 3, truth, LossConfig())
    assert loss < 1e-3
    assert measures["px<0.25"] == 1
    assert measures["rotation_ratio"] < 1e-2


def test_flow_mode_counts_the_target_alone():
    truth = truth_of(rendered(0, frames=4, height=64, width=80), 4)
    graph = full_graph(4, PATCHES, self_edges=False)
    _, patches = patches_of(truth, torch.Generator().manual_seed(0))
    coords, _ = true_reprojection(truth, patches, graph, 4, 4.0)
    off = coords[:, :, 1, 1] + torch.tensor([3.0, 4.0])
    state = state_of(graph, se3.identity(1, 4), patches, coords + 1, off, torch.ones(1, len(graph), 2))
    loss, measures = loss_of([state], truth, LossConfig(target=0.1), "flow")
    torch.testing.assert_close(loss, torch.tensor(0.5), atol=1e-4, rtol=1e-4)  # 0.1 x 5 px
    assert "rotation_deg" not in measures


def off_by(truth, offset, weight):
    """A state whose patches all land ``offset`` pixels from the truth, with poses at identity."""
    graph = full_graph(4, PATCHES, self_edges=True)
    _, patches = patches_of(truth, torch.Generator().manual_seed(0))
    coords, _ = true_reprojection(truth, patches, graph, 4, 4.0)
    seen = coords + torch.tensor(offset)
    weights = torch.full((1, len(graph), 2), weight)
    return state_of(graph, se3.identity(1, 4), patches, seen, seen[:, :, 1, 1], weights)


def test_the_terms_add_up_with_their_weights():
    """Hand-computed: every flow is off by 5 px, every confidence is one half, three updates, poses count from 2 on."""
    truth = truth_of(rendered(0, frames=4, height=64, width=80), 4)
    state = off_by(truth, [3.0, 4.0], 0.5)
    errors = pose_errors(state.poses_cw, truth.poses_cw)
    tau, phi = errors.translation.item(), errors.rotation.item()
    plain = LossConfig(pose=10.0, flow=0.1, target=0.2, pose_from=2)
    loss, measures = loss_of([state] * 3, truth, plain)
    assert loss.item() == pytest.approx(3 * (0.1 * 5 + 0.2 * 5) + 10 * (tau + phi), rel=1e-4)
    assert measures["px<4"] == 0 and measures["confidence"] == 0.5
    weighted = replace(plain, weighted=True)
    terms, _ = clip_terms([state] * 3, truth, weighted)
    total = 3 * (0.1 * 7 * 2.5 + 0.2 * 5) + 10 * (tau + 3 * phi)
    assert terms.total(weighted, beta=7.0, rotation=3.0).item() == pytest.approx(total, rel=1e-4)
    sums = {name: value.item() for name, value in terms.sums(weighted).items()}
    assert sums == pytest.approx(
        {"target": 3.0, "flow": 3 * 0.1 * 2.5, "translation": 10 * tau, "rotation": 10 * phi}, rel=1e-4
    )


def test_the_weighted_loss_takes_all_edges_and_the_plain_one_those_nearby():
    truth = truth_of(rendered(0, frames=4, height=64, width=80), 4)
    state = off_by(truth, [0.0, 0.0], 1.0)
    far = (state.graph.ii - state.graph.jj).abs() > 2
    state = replace(state, coords=state.coords + 3.0 * far[:, None, None, None])
    plain, weighted = LossConfig(), LossConfig(weighted=True)
    assert clip_terms([state], truth, plain)[0].sums(plain)["flow"] < 1e-5
    assert clip_terms([state], truth, weighted)[0].sums(weighted)["flow"] > 0.01


def test_depth_that_is_not_known_leaves_the_poses_to_learn_from():
    batch = rendered(0, frames=4, height=64, width=80)
    batch["depth"] = torch.full_like(batch["depth"], torch.nan)
    truth = truth_of(batch, 4)
    whole = truth_of(rendered(0, frames=4, height=64, width=80), 4)
    state = off_by(whole, [3.0, 4.0], 0.5)
    state = replace(state, poses_cw=state.poses_cw.requires_grad_())
    for config in (LossConfig(), LossConfig(weighted=True)):
        terms, _ = clip_terms([state] * 3, truth, config)
        sums = terms.sums(config)
        assert sums["flow"] == 0 and sums["target"] == 0
        assert sums["rotation"] > 0
        terms.total(config).backward()
        assert torch.isfinite(state.poses_cw.grad).all() and state.poses_cw.grad.abs().sum() > 0


@pytest.mark.long
@pytest.mark.parametrize("clips", [pytest.param(20, id="20"), pytest.param(50, id="50", marks=pytest.mark.slow)])
def test_exact_targets_from_identity_find_the_rotation(clips):
    """Inverse depths start at 1: at least 90 % of rendered clips end with a rotation error under 2 % of the motion."""
    graph = full_graph(8, PATCHES, self_edges=False)
    good = 0
    for index in range(clips):
        truth = truth_of(rendered(index), 4)
        _, patches = patches_of(truth, torch.Generator().manual_seed(index))
        coords, valid = true_reprojection(truth, patches, graph, 8, 4.0)
        poses = se3.identity(1, 8)
        h, w = truth.inverse_depth.shape[-2:]
        for update in range(10):
            result = bundle_adjust(
                poses, patches, truth.intrinsics, coords[:, :, 1, 1], valid[:, :, 1, 1, None].float().expand(-1, -1, 2),
                graph.ii, graph.jj, graph.kk, BAOptions(bounds=(w, h), damping=damping_at(update)),
            )  # fmt: skip
            poses, patches = result.poses_cw, result.patches
        error = pose_errors(poses, truth.poses_cw).rotation
        motion = pose_errors(se3.identity(1, 8), truth.poses_cw).rotation
        good += bool(error < 0.02 * motion)
    assert good >= 0.9 * clips


@pytest.mark.slow
def test_the_better_of_two_beginnings_finds_the_rotation():
    """Chosen by the residual alone, at least 19 of 20 rendered clips end within 2 % of the motion."""
    graph = full_graph(8, PATCHES, self_edges=False)
    good = 0
    for index in range(20):
        truth = truth_of(rendered(index), 4)
        _, patches = patches_of(truth, torch.Generator().manual_seed(index))
        coords, valid = true_reprojection(truth, patches, graph, 8, 4.0)
        weights = valid[:, :, 1, 1, None].float().expand(-1, -1, 2)
        given = se3.identity(8), patches[0], truth.intrinsics[0], coords[0, :, 1, 1], weights[0]
        best = multistart(PatchProblem(*given, graph.ii, graph.jj, graph.kk), COLD_STARTS)[0]
        error = pose_errors(best.problem.poses_cw[None].float(), truth.poses_cw).rotation
        good += bool(error < 0.02 * pose_errors(se3.identity(1, 8), truth.poses_cw).rotation)
    assert good >= 19


def test_truth_lies_on_the_feature_grid():
    """Feature (u, v) is centred on image pixel (4u, 4v), and a patch projected to its own frame stays put."""
    batch = rendered(1, frames=3, height=64, width=80)
    truth = truth_of(batch, 4)
    torch.testing.assert_close(1 / truth.inverse_depth[0, 1, 3, 5], batch["depth"][0, 1, 12, 20])
    graph = full_graph(3, PATCHES, self_edges=True)
    centres, patches = patches_of(truth, torch.Generator().manual_seed(0))
    coords, valid = true_reprojection(truth, patches, graph, 3, 4.0)
    own = graph.ii == graph.jj
    torch.testing.assert_close(coords[:, own].movedim(-1, 2), patches[:, graph.kk[own], :2], atol=1e-3, rtol=0)
    assert valid[:, own].all()
    there = reproject(truth.poses_cw, patches, truth.intrinsics, graph.ii, graph.jj, graph.kk).coords
    assert there.shape == coords.shape
