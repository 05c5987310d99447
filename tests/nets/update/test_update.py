"""The update operator: grouping, neighbours, equivariance."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.map.edges import build_graph, group_edges
from dvo.models.schedule import full_graph, training_schedule
from dvo.nets.correlation.correlation import Correlation
from dvo.nets.patch.config import preset
from dvo.nets.update.update import GradientClamp, SoftAggregation, Update, first_layer


def plain_aggregation(layer: SoftAggregation, x: torch.Tensor, keys: torch.Tensor) -> torch.Tensor:
    """The specification: a loop over the groups."""
    out = torch.zeros_like(x)
    for key in keys.unique():
        members = (keys == key).nonzero()[:, 0]
        value, score = layer.f(x[:, members]), layer.g(x[:, members])
        out[:, members] = layer.h((value * score.softmax(1)).sum(1, keepdim=True)).expand(-1, len(members), -1)
    return out


@given(st.lists(st.integers(0, 5), min_size=1, max_size=20), st.integers(0, 100))
@settings(max_examples=30, deadline=None)
def test_soft_aggregation_equals_a_loop_over_groups(keys, seed):
    torch.manual_seed(seed)
    layer = SoftAggregation(4).double()
    x = torch.randn(2, len(keys), 4, dtype=torch.float64)
    keys = torch.tensor(keys)
    torch.testing.assert_close(layer(x, group_edges(keys)), plain_aggregation(layer, x, keys))


def test_neighbours_follow_the_target_frame_of_the_same_patch():
    kk = torch.tensor([1, 0, 1, 0, 1])
    jj = torch.tensor([5, 2, 0, 4, 3])
    graph = build_graph(torch.zeros_like(kk), jj, kk)
    previous = torch.where(graph.has_previous[:, 0], graph.previous, -1)
    following = torch.where(graph.has_following[:, 0], graph.following, -1)
    assert previous.tolist() == [4, -1, -1, 1, 2]
    assert following.tolist() == [-1, 3, 4, -1, 0]


def run(update, graph, order=None):
    torch.manual_seed(1)
    e = len(graph)
    dim = update.norm.normalized_shape[0]
    channels = update.corr[0].in_features // 2
    inputs = [torch.randn(1, e, dim).double() for _ in range(2)] + [torch.randn(1, e, channels).double() for _ in "ab"]
    if order is not None:
        inputs = [x[:, order] for x in inputs]
    return update(inputs[0], inputs[1], Correlation(inputs[2:]), graph)


def test_edges_in_any_order_give_the_same_revision():
    torch.manual_seed(0)
    update = Update(preset("tiny")).double()
    graph = full_graph(3, 2, self_edges=True)
    order = torch.randperm(len(graph))
    shuffled = build_graph(graph.ii[order], graph.jj[order], graph.kk[order])
    for a, b in zip(run(update, graph), run(update, shuffled, order), strict=True):
        torch.testing.assert_close(a[:, order], b)


def test_a_missing_neighbour_still_contributes_the_bias_path():
    torch.manual_seed(0)
    update = Update(preset("tiny")).double()
    graph = build_graph(torch.tensor([0]), torch.tensor([1]), torch.tensor([0]))
    before = run(update, graph)[0]
    with torch.no_grad():
        update.c1[2].bias += 0.5
    assert not torch.allclose(before, run(update, graph)[0])


def test_first_layer_by_levels_equals_dpvos_interleaved_channels():
    torch.manual_seed(0)
    update = Update(preset("tiny")).double()
    levels = [torch.randn(1, 5, 441).double() for _ in range(2)]
    interleaved = torch.stack(levels, -1).flatten(2)
    torch.testing.assert_close(
        first_layer(update.corr[0], Correlation(levels), update.taps), update.corr[0](interleaved)
    )
    turned = [level.view(1, 5, 7, 7, 9).permute(0, 1, 4, 3, 2).flatten(2) for level in levels]  # pixel, y, x
    torch.testing.assert_close(
        first_layer(update.corr[0], Correlation(turned, "pixels_first"), update.taps), update.corr[0](interleaved)
    )


def test_first_layer_has_the_weights_of_now():
    """Also where these change in ways that torch counts as no version."""
    layer, generator = torch.nn.Linear(8, 3), torch.Generator().manual_seed(0)
    levels = [torch.randn(1, 5, 4, generator=generator) for _ in range(2)]
    interleaved = torch.stack(levels, -1).flatten(2)
    for change in (lambda w: None, lambda w: w.data.mul_(2), lambda w: w.add_(1)):
        with torch.no_grad():
            change(layer.weight)
            torch.testing.assert_close(first_layer(layer, Correlation(levels), 2), layer(interleaved))


def test_gradient_clamp_removes_nan_and_scales_with_the_batch():
    x = torch.zeros(2, 3, 2, requires_grad=True)
    grad = torch.full((2, 3, 2), 5.0)
    grad[0, 0, 0] = torch.nan
    GradientClamp()(x).backward(grad)
    assert x.grad[0, 0, 0] == 0
    assert x.grad[1, 2, 1] == 0.01 / 2


def test_schedule_carries_each_edge_to_its_place():
    stages = training_schedule(5, 2, 6, initial=3, settle=2, self_edges=False)
    assert [s.frames for s in stages] == [3, 3, 4, 5, 5, 5]
    for before, now in zip(stages, stages[1:], strict=False):
        if now.carry is None:
            assert now.graph is before.graph
            continue
        old = now.carry >= 0
        assert int(old.sum()) == len(before.graph)
        assert torch.equal(now.graph.kk[old], before.graph.kk[now.carry[old]])
        assert torch.equal(now.graph.jj[old], before.graph.jj[now.carry[old]])


def test_only_the_learning_edges_send_a_gradient_to_the_correlation():
    """Gradients of the layer are those of all edges."""
    torch.manual_seed(0)
    layer, learn = torch.nn.Linear(12, 5).double(), torch.tensor([4, 1, 7])
    factor = torch.randn(2, 4, 5, dtype=torch.float64)
    found = []
    for chosen in (learn, None):
        levels = [torch.randn(2, 4, 6, generator=torch.Generator().manual_seed(i)).double() for i in range(2)]
        leaves = [x.requires_grad_() for x in levels]
        out = first_layer(layer, Correlation(leaves, learn=chosen), 1)
        found.append([out, *torch.autograd.grad((out.square() * factor).sum(), [*layer.parameters(), *leaves])])
    some = torch.zeros(8, 1, dtype=torch.float64).index_fill(0, learn, 1.0).view(2, 4, 1)
    expected = [*found[1][:3], *(g * some for g in found[1][3:])]
    for x, y in zip(found[0], expected, strict=True):
        torch.testing.assert_close(x, y)
