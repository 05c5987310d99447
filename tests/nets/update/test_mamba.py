"""The state-space update operator: groups, order, the recurrence over the updates, gradients, both loops."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.map.edges import build_graph, group_edges
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import full_graph
from dvo.nets.correlation.correlation import Correlation
from dvo.nets.patch.config import ModelConfig, preset
from dvo.nets.update.mamba import HISTORY_STATES, STEPS, GroupScan, History, MambaUpdate, initial_step_bias, places
from dvo.nets.update.selective_scan import selective_loop

TINY = replace(preset("tiny"), update_operator="mamba")


def drawn_graph(seed, frames=4, patches=3, share=0.6):
    """Some of the edges of a full graph, in random order: groups of different sizes."""
    full = full_graph(frames, patches, self_edges=True)
    g = torch.Generator().manual_seed(seed)
    kept = torch.randperm(len(full), generator=g)[: max(2, round(share * len(full)))]
    return build_graph(full.ii[kept], full.jj[kept], full.kk[kept])


def inputs_of(graph, config=TINY, seed=1, dtype=torch.float64):
    g = torch.Generator().manual_seed(seed)
    channels = config.correlation_channels // len(config.pyramid)
    sizes = [config.hidden_channels] * 2 + [channels] * len(config.pyramid)
    return [torch.randn(2, len(graph), size, generator=g, dtype=dtype) for size in sizes]


def run(update, graph, inputs, order=slice(None)):
    hidden, context, *levels = (x[:, order] for x in inputs)
    return update(hidden, context, Correlation(levels), graph)


@pytest.fixture(scope="module")
def update():
    torch.manual_seed(0)
    return MambaUpdate(TINY).double()


@given(st.lists(st.integers(0, 4), min_size=1, max_size=20))
@settings(max_examples=30)
def test_every_edge_has_its_place_in_the_padded_groups(keys):
    groups = group_edges(torch.tensor(keys))
    mask = groups.mask[..., 0]
    place = places(groups.members, mask, len(keys))
    assert torch.equal(groups.members.flatten()[place], torch.arange(len(keys)))
    assert mask.flatten()[place].all()


@pytest.mark.parametrize("seed", range(4))
def test_edges_in_any_order_give_the_same_revision(update, seed):
    graph = drawn_graph(seed)
    inputs = inputs_of(graph)
    order = torch.randperm(len(graph), generator=torch.Generator().manual_seed(seed + 9))
    shuffled = build_graph(graph.ii[order], graph.jj[order], graph.kk[order])
    for a, b in zip(run(update, graph, inputs), run(update, shuffled, inputs, order), strict=True):
        torch.testing.assert_close(a[:, order], b)


def test_a_group_scan_equals_loops_over_the_groups():
    """Specification: each group on its own, sorted, without padding; both ways by the loop."""
    torch.manual_seed(0)
    block = GroupScan(6, convolution=False).double()
    graph = drawn_graph(3)
    x = torch.randn(2, len(graph), 6, dtype=torch.float64)
    found = block(x, graph.by_patch, graph.jj, graph)
    inputs, gate = block.enter(block.norm(x)).chunk(2, -1)
    inputs = torch.nn.functional.silu(inputs)
    step, (write, write_back, read, read_back) = block.select(inputs)
    mixed = block.select.skip * inputs
    for patch in graph.kk.unique():
        at = (graph.kk == patch).nonzero()[:, 0]
        at = at[graph.jj[at].argsort()]
        for part, line, b, c in ((slice(3), at, write, read), (slice(3, 6), at.flip(0), write_back, read_back)):
            y, _ = selective_loop(
                inputs[:, line, part], step[:, line, part], block.select.rate[:, part], b[:, line], c[:, line]
            )
            mixed[:, line, part] += y
    torch.testing.assert_close(found, x + block.leave(mixed * torch.nn.functional.silu(gate)))


def test_an_edge_sees_its_patch_and_its_frame_pair_and_nothing_else(update):
    graph = drawn_graph(5)
    inputs = inputs_of(graph)
    changed = [x.clone() for x in inputs]
    changed[1][:, 0, :5] += 1  # not all channels: the norm removes a common shift
    moved = (run(update, graph, inputs)[1] - run(update, graph, changed)[1]).abs().amax((0, 2)) > 1e-12
    patch = graph.kk == graph.kk[0]
    pairs = {(int(graph.ii[e]), int(graph.jj[e])) for e in patch.nonzero()[:, 0]}
    reached = torch.tensor([(int(i), int(j)) in pairs for i, j in zip(graph.ii, graph.jj, strict=True)])
    assert moved[patch].all() and moved[0]
    assert not moved[~reached].any()


def test_the_recurrence_over_updates_is_the_selective_recurrence():
    """Updates one after another equal one scan over the sequence of their inputs."""
    torch.manual_seed(0)
    block = History(8).double()
    tokens = torch.randn(6, 1, 3, 8, dtype=torch.float64)  # update, clip, edge, channel
    hidden = torch.zeros(1, 3, 8, dtype=torch.float64)
    for token in tokens:
        _, hidden = block(token, hidden)
    inputs, step, write, read, _ = block.inputs(tokens.permute(1, 2, 0, 3)[0])
    _, last = selective_loop(inputs, step, block.select.rate, write, read)
    torch.testing.assert_close(hidden[0].unflatten(-1, (HISTORY_STATES, -1)), last)


@pytest.mark.long
def test_the_state_stays_bounded_over_many_updates(update):
    graph = drawn_graph(1)
    inputs = inputs_of(graph)
    hidden = torch.zeros_like(inputs[0])
    with torch.no_grad():
        for _ in range(300):
            hidden, delta, _ = run(update, graph, [hidden, *inputs[1:]])
    assert torch.isfinite(delta).all() and hidden.abs().max() < 100


@pytest.mark.long
def test_gradcheck():
    torch.manual_seed(0)
    config = replace(TINY, hidden_channels=4, patch_size=1, radius=1, pyramid=(1,))
    update, graph = MambaUpdate(config).double(), drawn_graph(2, 3, 2)
    update.d[2] = update.w[2] = torch.nn.Identity()  # the clamp changes the gradient on purpose
    inputs = [x[:1].requires_grad_() for x in inputs_of(graph, config)]
    assert torch.autograd.gradcheck(lambda *x: run(update, graph, x), inputs, atol=1e-4)


def test_every_parameter_learns(update):
    graph = drawn_graph(1)
    outputs = run(update, graph, inputs_of(graph))
    loss = sum(x.square().sum() for x in outputs)
    gradients = torch.autograd.grad(loss, list(update.parameters()))
    assert all(g.abs().sum() > 0 and torch.isfinite(g).all() for g in gradients)


def test_no_edges_give_no_revision(update):
    empty = torch.zeros(0, dtype=torch.long)
    hidden, delta, weights = run(update, graph := build_graph(empty, empty, empty), inputs_of(graph))
    assert hidden.shape == (2, 0, 48) and delta.shape == weights.shape == (2, 0, 2)


def test_initial_steps_are_spread_over_their_range():
    steps = torch.nn.functional.softplus(initial_step_bias(5).double())
    torch.testing.assert_close(steps[[0, -1]], torch.tensor(STEPS).double(), rtol=1e-5, atol=0)
    assert (steps.diff() > 0).all()
    forwards, backwards = GroupScan(10, convolution=True).select.step.bias.chunk(2)
    assert torch.equal(forwards, backwards)


def test_sizes():
    assert preset("mamba") == replace(preset("small"), update_operator="mamba")
    assert 300_000 < sum(p.numel() for p in PatchVO(preset("mamba")).parameters()) < 1_000_000
    with pytest.raises(DvoError, match="hidden_channels: must be even"):
        PatchVO(ModelConfig(hidden_channels=47, update_operator="mamba"))
