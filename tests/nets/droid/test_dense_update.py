"""Update operator on maps: the recurrent unit against the published formula, gradients, aggregation, upsampling."""

import pytest
import torch

from dvo.nets.droid.dense_update import ConvGRU, DenseUpdate, GradientGate, GraphAggregation, upsample_map
from dvo.nets.droid.droid import MASK, DroidConfig, preset


def test_the_recurrent_unit_is_the_published_one():
    torch.manual_seed(0)
    gru = ConvGRU(6, 5).double()
    hidden, inputs = torch.randn(3, 6, 4, 5).double().tanh(), torch.randn(3, 5, 4, 5).double()
    context = torch.randn(2, 6, 4, 5).double()
    frame = torch.tensor([0, 1, 0])
    leaves = [x.requires_grad_() for x in (hidden, inputs, context)]
    upstream = torch.randn(3, 6, 4, 5).double()
    found = []
    for value in (
        gru(hidden, gru.context_gates(context)[frame], inputs), gru.forward_plain(hidden, context[frame], inputs),
    ):  # fmt: skip
        found.append((value.detach(), *torch.autograd.grad((value * upstream).sum(), [*leaves, *gru.parameters()])))
    for mine, plain in zip(*found, strict=True):
        torch.testing.assert_close(mine, plain, atol=1e-12, rtol=1e-10)


def test_gradients_of_the_recurrent_unit_are_the_derivatives():
    torch.manual_seed(0)
    gru = ConvGRU(2, 2).double()
    leaves = [torch.randn(1, 2, 2, 3).double().requires_grad_() for _ in range(3)]
    assert torch.autograd.gradcheck(lambda h, c, x: gru(h, gru.context_gates(c), x), leaves)


def test_damping_is_of_the_mean_over_the_edges_of_a_frame():
    torch.manual_seed(0)
    aggregation = GraphAggregation(preset("tiny")).double()
    hidden = torch.randn(2, 4, 24, 3, 4).double()
    damping, mask = aggregation(hidden, torch.tensor([0, 2, 0, 2]), 3)
    assert damping.shape == (2, 3, 3, 4) and (damping > 0).all() and mask is None
    turned, _ = aggregation(hidden[:, [2, 1, 0, 3]], torch.tensor([0, 2, 0, 2]), 3)
    torch.testing.assert_close(damping, turned)
    alone, _ = aggregation(hidden[:, :1], torch.tensor([0]), 1)
    assert not torch.allclose(alone[:, 0], damping[:, 0])
    x = torch.relu(aggregation.conv1(hidden[:, [1, 3]].flatten(0, 1))).unflatten(0, (2, 2)).mean(1)
    torch.testing.assert_close(damping[:, 2], 0.01 * aggregation.eta(torch.relu(aggregation.conv2(x)))[:, 0])


def test_edges_do_not_depend_on_each_other():
    torch.manual_seed(0)
    config = preset("tiny")
    update = DenseUpdate(config)
    d, c = config.hidden_channels, config.correlation_channels
    inputs = [torch.randn(1, 3, n, 3, 4) for n in (d, 3 * d, c, 4)]
    together = update(*inputs)
    alone = update(*(x[:, 1:2] for x in inputs))
    torch.testing.assert_close(together.delta[:, 1:2], alone.delta, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(together.hidden[:, 1:2], alone.hidden, atol=1e-6, rtol=1e-5)
    assert together.delta.shape == (1, 3, 3, 4, 2)
    assert ((together.confidence > 0) & (together.confidence < 1)).all()


def test_motion_beyond_the_limit_is_the_limit():
    torch.manual_seed(0)
    update = DenseUpdate(preset("tiny"))
    d, c = 24, preset("tiny").correlation_channels
    inputs = [torch.zeros(1, 1, n, 3, 4) for n in (d, 3 * d, c)]
    a, b = (update(*inputs, torch.full((1, 1, 4, 3, 4), far)).delta for far in (64.0, 1e6))
    assert torch.equal(a, b)


def test_the_gate_bounds_gradients_alone():
    x = torch.tensor([1.0, 2.0, 3.0, 4.0], requires_grad=True)
    y = GradientGate()(x)
    assert torch.equal(y, x)
    (y * torch.tensor([5.0, -5.0, 0.004, float("nan")])).sum().backward()
    torch.testing.assert_close(x.grad, torch.tensor([0.01, -0.01, 0.004, 0.0]))


def test_upsampling_picks_and_blends_neighbours():
    values = torch.arange(12.0).view(1, 3, 4)
    mask = torch.full((1, MASK, 3, 4), -1e4)
    mask.view(1, 9, 8, 8, 3, 4)[:, 4] = 1e4  # the cell itself
    fine = upsample_map(values, mask)
    assert fine.shape == (1, 24, 32)
    torch.testing.assert_close(fine, values.repeat_interleave(8, 1).repeat_interleave(8, 2))
    mask.view(1, 9, 8, 8, 3, 4)[:, 5, 2, 6] = 1e4  # and, for one pixel of each cell, its right neighbour as much
    blended = upsample_map(values, mask)
    assert blended[0, 8 + 2, 8 + 6] == (values[0, 1, 1] + values[0, 1, 2]) / 2
    assert blended[0, 8 + 2, 8 + 5] == values[0, 1, 1]


def test_gradients_of_upsampling_are_the_derivatives():
    g = torch.Generator().manual_seed(0)
    values = torch.rand(1, 1, 2, generator=g, dtype=torch.float64, requires_grad=True)
    mask = torch.randn(1, MASK, 1, 2, generator=g, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v, m: upsample_map(v, m)[:, ::3, ::3], (values, mask))


@pytest.mark.parametrize(
    "wrong", [{"hidden_channels": 3}, {"levels": 0}, {"radius": 2.5}, {"upsample": 1}, {"depth": 3}]
)
def test_sizes_that_make_no_network_are_named(wrong):
    with pytest.raises(Exception, match=next(iter(wrong))):
        DroidConfig.from_dict(wrong)
