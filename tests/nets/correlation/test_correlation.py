"""Each fast correlation equals the plain one, in value and gradient."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.core.kernels import CHOICES, VARIABLE, available
from dvo.nets.correlation.correlation import CorrelationVolume, correlate_reference
from dvo.nets.correlation.edge_correlation import EdgeCorrelation
from dvo.nets.patch.patchifier import pool_levels


def problem(batch=2, seed=0, spread=2.0):
    g = torch.Generator().manual_seed(seed)
    patches = torch.randn(batch, 6, 8, 3, 3, generator=g, dtype=torch.float64, requires_grad=True)
    maps = torch.randn(batch, 3, 8, 12, 14, generator=g, dtype=torch.float64, requires_grad=True)
    kk = torch.randint(6, (11,), generator=g)
    jj = torch.randint(3, (11,), generator=g)
    # Inside, across the border, and far outside the 14 x 12 map.
    coords = torch.rand(batch, 11, 1, 1, 2, generator=g, dtype=torch.float64) * 34 - 10
    coords = coords + spread * torch.rand(batch, 11, 3, 3, 2, generator=g, dtype=torch.float64)
    return patches, maps, coords, kk, jj


def test_channel_order_against_a_hand_computed_case():
    """One feature channel that is 1 at map pixel (5, 4): the only hit is where offset + position meet it."""
    patches = torch.zeros(1, 1, 1, 3, 3)
    patches[0, 0, 0, 2, 1] = 1.0  # patch row 2, column 1
    maps = torch.zeros(1, 1, 1, 9, 10)
    maps[0, 0, 0, 4, 5] = 1.0
    coords = torch.zeros(1, 1, 3, 3, 2)
    coords[0, 0, 2, 1] = torch.tensor([3.0, 5.0])  # so the offsets that hit are x +2, y -1
    index = torch.tensor([0])
    fine, coarse = correlate_reference(patches, maps, coords, index, index)
    # idx = ((((x_off*7 + y_off)*3 + row)*3 + col), offsets counted from -3
    expected = ((5 * 7 + 2) * 3 + 2) * 3 + 1
    assert fine.flatten().nonzero().flatten().tolist() == [expected]
    assert coarse.shape == fine.shape


def test_volume_equals_reference_in_value_and_gradient():
    patches, maps, coords, kk, jj = problem()
    slow = torch.cat(correlate_reference(patches, maps, coords, kk, jj), -1)
    fast = torch.cat(CorrelationVolume(patches, maps).lookup(coords, kk, jj), -1)
    torch.testing.assert_close(fast, slow)
    weight = torch.randn(slow.shape, generator=torch.Generator().manual_seed(1), dtype=slow.dtype)
    for a, b in zip(
        torch.autograd.grad((slow * weight).sum(), (patches, maps)),
        torch.autograd.grad((fast * weight).sum(), (patches, maps)),
        strict=True,
    ):
        torch.testing.assert_close(a, b)


def test_gradients_of_many_lookups_add_up():
    patches, maps, coords, kk, jj = problem()
    volume = CorrelationVolume(patches, maps)
    fast = sum((step + 1) * torch.cat(volume.lookup(coords + step, kk, jj), -1).sum() for step in range(3))
    slow = sum((s + 1) * torch.cat(correlate_reference(patches, maps, coords + s, kk, jj), -1).sum() for s in range(3))
    for a, b in zip(
        torch.autograd.grad(slow, (patches, maps)), torch.autograd.grad(fast, (patches, maps)), strict=True
    ):
        torch.testing.assert_close(a, b)


def test_only_the_chosen_edges_train_the_features():
    patches, maps, coords, kk, jj = problem(batch=1, seed=3)
    learn = torch.tensor([2, 7])
    chosen = torch.autograd.grad(sum(c.sum() for c in CorrelationVolume(patches, maps).lookup(coords, kk, jj, learn)),
                                 (patches, maps))  # fmt: skip
    few = correlate_reference(patches, maps, coords[:, learn], kk[learn], jj[learn])
    expected = torch.autograd.grad(sum(c.sum() for c in few), (patches, maps))
    for a, b in zip(chosen, expected, strict=True):
        torch.testing.assert_close(a, b)


def as_dpvo(channels):
    """Channels ordered pixel, y, x -> x, y, pixel."""
    return channels.view(-1, 9, 7, 7).permute(0, 3, 2, 1).flatten(1)


def looked_up(patches, maps, coords, kk, jj, radius):
    """Channels of both levels as the tracker looks them up."""
    found = []
    for scale, level in zip((1, 4), pool_levels(maps, (1, 4)), strict=True):
        of_level = EdgeCorrelation(scale, radius, "cpu")
        of_level.maps = of_level.maps.to(maps)
        for frame in range(maps.shape[1]):
            of_level.keep_map(frame, level[0, frame])
        found.append(of_level.lookup(coords[0], patches[0].flatten(2).mT, kk, jj))
    return found


@pytest.mark.parametrize("spread", [2.0, 30.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_windows_of_edges_equal_reference(seed, spread):
    patches, maps, coords, kk, jj = problem(batch=1, seed=seed, spread=spread)
    slow = [c[0] for c in correlate_reference(patches, maps, coords, kk, jj)]
    for a, b in zip(slow, looked_up(patches.detach(), maps.detach(), coords, kk, jj, 3), strict=True):
        torch.testing.assert_close(as_dpvo(b), a)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 1000),
    edges=st.integers(0, 12),
    channels=st.sampled_from([1, 3, 8, 64]),
    side=st.sampled_from([1, 3]),
    radius=st.integers(1, 7),
    spread=st.sampled_from([0.0, 2.0, 30.0]),
    special=st.sampled_from([None, math.nan, math.inf, -math.inf, 1e30, -3.5e9]),
)
def test_kernel_equals_twin(seed, edges, channels, side, radius, spread, special):
    g = torch.Generator().manual_seed(seed)
    patches, maps = (
        torch.randn(1, 6, channels, side, side, generator=g),
        torch.randn(1, 3, channels, 12, 14, generator=g),
    )
    kk, jj = torch.randint(6, (edges,), generator=g), torch.randint(3, (edges,), generator=g)
    coords = torch.rand(1, edges, 1, 1, 2, generator=g) * 34 - 10
    coords = coords + spread * torch.rand(1, edges, side, side, 2, generator=g)
    if special is not None and edges:
        coords[0, edges // 2, 0, side - 1, seed % 2] = special
    found = []
    for choice in CHOICES:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(VARIABLE, choice)
            found.append(looked_up(patches, maps, coords, kk, jj, radius))
    for kernel, twin in zip(*found, strict=True):
        torch.testing.assert_close(kernel, twin, rtol=1e-5, atol=1e-5 * channels**0.5, equal_nan=True)
        assert kernel.isnan().any() == (special is not None and math.isnan(special) and edges > 0)


def trained(choice, maps, patches, coords, kk, jj, learn, radius, again=False):
    """Channels of two look-ups and the gradients by patches and maps, or those of the squares of these gradients."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, choice)
        leaves = [x.clone().requires_grad_() for x in (patches, maps)]
        volume = CorrelationVolume(*leaves, (1, 2), radius)
        assert (volume.levels[0].volume is None) == (choice == "numba")
        found = [c for move in (0.0, 0.3) for c in volume.lookup(coords + move, kk, jj, learn)]
        total = sum((c * torch.linspace(-1, 1, c.shape[-1])).sum() + 1e-3 * c.square().sum() for c in found)
        gradients = torch.autograd.grad(total, leaves, create_graph=again)
        if again:
            gradients = torch.autograd.grad(sum(g.square().sum() for g in gradients), leaves)
        return [*(c.detach() for c in found), *gradients]


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 1000),
    batch=st.integers(1, 2),
    edges=st.integers(1, 12),
    channels=st.sampled_from([1, 3, 8, 24]),
    side=st.sampled_from([1, 3]),
    radius=st.sampled_from([1, 2, 3]),
    spread=st.sampled_from([0.0, 2.0, 30.0]),
    special=st.sampled_from([None, None, math.nan, math.inf, 1e30, -3.5e9]),
    share=st.sampled_from([None, 0.0, 0.5]),
    again=st.booleans(),
)
def test_kernel_of_training_equals_volume(
    seed, batch, edges, channels, side, radius, spread, special, share, again
):  # fmt: skip
    g = torch.Generator().manual_seed(seed)
    patches = torch.randn(batch, 4, channels, side, side, generator=g)
    maps = torch.randn(batch, 3, channels, 20, 24, generator=g)
    kk, jj = torch.randint(4, (edges,), generator=g), torch.randint(3, (edges,), generator=g)
    coords = torch.rand(batch, edges, 1, 1, 2, generator=g) * 40 - 10
    coords = coords + spread * torch.rand(batch, edges, side, side, 2, generator=g)
    learn = None if share is None else torch.randperm(batch * edges, generator=g)[: round(share * batch * edges)]
    nan = special is not None and math.isnan(special)
    if special is not None:
        coords[0, edges // 2, 0, side - 1, seed % 2] = special
    given = maps, patches, coords, kk, jj, learn, radius, again
    kernel, twin = trained("numba", *given), trained("torch", *given)
    for x, y in zip(kernel[:4], twin[:4], strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-5 * channels**0.5, equal_nan=True)
        assert x.isnan().any() == nan
    for x, y in zip(kernel[4:], twin[4:], strict=True):
        if y.isnan().any():  # which cells are spoilt does not matter
            assert x.isnan().any()
        else:
            torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-5 * float(y.abs().max()) + 1e-6)


@pytest.mark.skipif(not available(), reason="kernels are not wanted")
@pytest.mark.parametrize(("name", "value"), [("kk", 4), ("jj", 3), ("jj", -1), ("learn", 5)])
def test_kernel_of_training_reads_nothing_beside_the_arrays(name, value):
    given = {"kk": torch.arange(4), "jj": torch.tensor([0, 1, 2, 0]), "learn": torch.arange(2)}
    given[name] = torch.cat((given[name][1:], torch.tensor([value])))
    volume = CorrelationVolume(torch.zeros(1, 4, 8, 3, 3), torch.zeros(1, 3, 8, 20, 24))
    with pytest.raises(DvoError, match="out of range"):
        volume.lookup(torch.zeros(1, 4, 3, 3, 2), **given)


def test_far_away_positions_are_zero_not_an_overflow():
    patches, maps, coords, kk, jj = problem(batch=1)
    for channels in CorrelationVolume(patches, maps).lookup(coords + 1e18, kk, jj):
        assert torch.equal(channels, torch.zeros_like(channels))
