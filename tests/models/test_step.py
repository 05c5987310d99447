"""The public step: the same for a clip that is unrolled and for a window that is tracked."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.ba.factors import DepthPrior
from dvo.ba.options import BAOptions, damping_at
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.map.window import Keyframe
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import training_schedule
from dvo.models.step import UpdateState, flow_step, recent_depth, revise, step
from dvo.nets.correlation.correlation import Correlation, correlate_reference
from dvo.nets.patch.config import preset
from dvo.nets.patch.patchifier import normalise_images, patch_coordinates
from dvo.nets.patch.selection import random_centres
from dvo.nets.update.update import UPDATE_OPERATORS
from dvo.odometry.window.patch_window import PatchWindow, StepSettings
from dvo.synth.clip import make_clip

FRAMES, PATCHES, UPDATES = 5, 12, 6


@pytest.fixture(scope="module")
def clip():
    return make_clip(3, 1, frames=FRAMES, height=96, width=128, flow_range=(2.0, 4.0))


def network(name):
    torch.manual_seed(0)
    return PatchVO(replace(preset("tiny"), training_patches=PATCHES, update_operator=name)).eval()


@pytest.fixture(scope="module", params=["gated", "mamba"])
def model(request):
    return network(request.param)


def as_window(model, clip, generator):
    """The frames of a clip as the window of a tracker, with all edges."""
    features = model.patchify.encode(normalise_images(clip.images[None]))
    h, w = features.matching.shape[-2:]
    centres = random_centres(FRAMES, PATCHES, h, w, generator, 1)
    matching, context = model.patchify.cut(features, centres)
    patches = patch_coordinates(centres, torch.ones(1, FRAMES * PATCHES), 3)[0]
    found = PatchWindow.empty(model, PATCHES, StepSettings(align="none"), torch.device("cpu"))
    window, image = found.window, np.zeros((4 * h, 4 * w, 3), np.uint8)
    for i in range(FRAMES):
        part = slice(i * PATCHES, (i + 1) * PATCHES)
        slot = window.free_map_slot()
        cut = matching[0, part], context[0, part], torch.zeros(0), clip.intrinsics[i] / 4, image
        found.insert(
            i, Keyframe(i, 0.1 * i, slot, *cut), features.matching[:, i : i + 1], se3.identity(), patches[part]
        )
    graph = training_schedule(FRAMES, PATCHES, 1, self_edges=False)[0].graph
    found.window.connect(graph.kk, graph.jj)
    assert found.bounds == (w, h)
    return window, found


@torch.no_grad()
def test_both_loops_take_the_same_steps_on_one_graph(model, clip):
    """Training's unroll and the tracker's window, from the same patches: equal poses, depths, targets and weights."""
    stages = training_schedule(FRAMES, PATCHES, UPDATES, self_edges=False)
    unrolled = model.unroll(
        clip.images[None], clip.intrinsics[None], stages, poses_cw=se3.identity(1, FRAMES),
        generator=torch.Generator().manual_seed(5),
    )  # fmt: skip
    window, stepper = as_window(model, clip, torch.Generator().manual_seed(5))
    for update, state in enumerate(unrolled):
        stepper.step(1, damping_at(update))
        for ours, theirs in (
            (window.poses_cw, state.poses_cw), (window.patches, state.patches), (window.hidden, state.hidden),
            (window.targets, state.targets), (window.weights, state.confidence),
        ):  # fmt: skip
            torch.testing.assert_close(ours, theirs[0], rtol=1e-3, atol=1e-3)
    assert (window.poses_cw[1:] - se3.identity(FRAMES - 1)).abs().max() > 1e-3  # it did move


@torch.no_grad()
def test_forward_is_the_last_state_of_an_unroll(model, clip):
    stages = training_schedule(FRAMES, PATCHES, 3, self_edges=False)
    states = list(
        model.unroll(clip.images[None], clip.intrinsics[None], stages, poses_cw=se3.identity(1, FRAMES),
                     generator=torch.Generator().manual_seed(2))
    )  # fmt: skip
    found = model(clip.images[None], clip.intrinsics[None], updates=3, generator=torch.Generator().manual_seed(2))
    assert torch.equal(found.poses_cw, states[-1].poses_cw) and torch.equal(found.targets, states[-1].targets)


def reference_lookup(matching, maps):
    def lookup(coords, graph):
        return Correlation(correlate_reference(matching, maps, coords, graph.kk, graph.jj))

    return lookup


def start(model, clip):
    features = model.patchify.encode(normalise_images(clip.images[None]))
    h, w = features.matching.shape[-2:]
    centres = random_centres(FRAMES, PATCHES, h, w, torch.Generator().manual_seed(1), 1)
    matching, context = model.patchify.cut(features, centres)
    graph = training_schedule(FRAMES, PATCHES, 1, self_edges=False)[0].graph
    patches = patch_coordinates(centres, torch.ones(1, FRAMES * PATCHES), 3)
    hidden = torch.zeros(1, len(graph), model.config.hidden_channels)
    state = UpdateState(graph, se3.identity(1, FRAMES), patches, clip.intrinsics[None] / 4, context, hidden)
    lookup = reference_lookup(matching, features.matching)
    return state, lookup, (float(w), float(h))


@torch.no_grad()
def test_modes(model, clip):
    state, lookup, bounds = start(model, clip)
    revision = revise(model, state, lookup)
    flow = flow_step(model, state, lookup)
    assert torch.equal(flow.poses_cw, state.poses_cw) and torch.equal(flow.patches, state.patches)
    torch.testing.assert_close(flow.coords[:, :, 1, 1], revision.targets)
    structure = step(model, state, lookup, BAOptions(structure_only=True, bounds=bounds))
    assert torch.equal(structure.poses_cw, state.poses_cw) and structure.coords is None
    joint = step(model, state, lookup, BAOptions(fixed=2, bounds=bounds))
    assert torch.equal(joint.poses_cw[:, :2], state.poses_cw[:, :2])
    assert not torch.equal(joint.poses_cw[:, 2:], state.poses_cw[:, 2:])


@torch.no_grad()
def test_further_factors_take_part(model, clip):
    """Inverse depths held by a strong prior stay where the prior wants them."""
    state, lookup, bounds = start(model, clip)
    wanted = torch.full((1, FRAMES * PATCHES), 0.7)
    prior = DepthPrior(wanted, torch.full_like(wanted, 1e6))
    after = step(model, state, lookup, BAOptions(bounds=bounds), factors=(prior,))
    torch.testing.assert_close(after.patches[:, :, 2, 1, 1], wanted, atol=1e-3, rtol=0)


class Idle(torch.nn.Module):
    """Update operator that never revises anything."""

    def __init__(self, config):
        super().__init__()

    def forward(self, hidden, context, correlation, graph):
        return hidden, torch.zeros(*hidden.shape[:2], 2), torch.ones(*hidden.shape[:2], 2)


def test_the_update_operator_is_exchanged_by_a_word(clip):
    UPDATE_OPERATORS.register("idle", f"{__name__}:Idle")
    try:
        model = PatchVO(replace(preset("tiny"), training_patches=PATCHES, update_operator="idle"))
        after = model(clip.images[None], clip.intrinsics[None], updates=2)
        torch.testing.assert_close(after.poses_cw, se3.identity(1, FRAMES), atol=1e-5, rtol=0)
    finally:
        UPDATE_OPERATORS.unregister("idle")
    with pytest.raises(DvoError, match="no update operator 'idle'"):
        PatchVO(replace(preset("tiny"), update_operator="idle"))


def test_gradients_reach_encoder_and_operator(model, clip):
    state, lookup, bounds = start(model, clip)
    after = step(model, state, lookup, BAOptions(bounds=bounds))
    loss = after.targets.square().mean() + after.confidence.mean() + after.poses_cw[..., :3].square().sum()
    gradients = torch.autograd.grad(loss, [*model.parameters()], allow_unused=True)
    assert sum(g is not None and bool(g.abs().sum() > 0) for g in gradients) > 0.9 * len(gradients)


def test_depth_of_a_new_frame_is_the_median_of_the_newest():
    depth = torch.tensor([9.0, 9.0, 1.0, 2.0, 3.0, 4.0])
    patches = torch.zeros(1, 6, 3, 3, 3)
    patches[0, :, 2] = depth[:, None, None]
    assert recent_depth(patches, 2, 2).tolist() == [2.0]
    assert recent_depth(patches, 2, 3).tolist() == [3.0]
