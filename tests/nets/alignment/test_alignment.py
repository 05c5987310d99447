"""Sub-pixel alignment: its twin, its gradients, known shifts, and rendered motion."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.geometry.projection import reproject
from dvo.nets.alignment.alignment import (
    Alignment,
    AlignmentOptions,
    accept,
    align_patches,
    patch_warps,
    sample_images,
    sample_images_plain,
    texture,
)
from dvo.nets.patch.patchifier import patch_coordinates
from dvo.nets.patch.selection import structure_selection
from dvo.synth.clip import make_clip

ONE, TWO = torch.tensor([0]), torch.tensor([1])
PLAIN = AlignmentOptions(iterations=8)


def waves(x, y):
    """Smooth grey levels with structure in every direction, defined between the pixels too."""
    sines = ((0.31, 0.12, 1.0), (-0.17, 0.28, 2.0), (0.05, -0.35, 0.3), (0.4, 0.33, 0.7))
    return 127 + 28 * sum(torch.sin(a * x + b * y + c) for a, b, c in sines)


def grid(height=60, width=80):
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return x, y


@given(seed=st.integers(0, 1000), outside=st.booleans())
@settings(max_examples=30, deadline=None)
def test_the_fast_samples_are_those_of_the_twin(seed, outside):
    torch.manual_seed(seed)
    images = (torch.rand(3, 11, 13, dtype=torch.float64) * 255).requires_grad_()
    low, high = (-5, 20) if outside else (0.5, 9.5)
    points = (torch.rand(6, 5, 2, dtype=torch.float64) * (high - low) + low).requires_grad_()
    frames = torch.randint(0, 3, (6,))
    ours, theirs = (f(images, frames, points) for f in (sample_images, sample_images_plain))
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    wanted = torch.rand_like(ours)
    for a, b in zip(*(torch.autograd.grad(x, (images, points), wanted) for x in (ours, theirs)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)


def test_single_precision_is_enough_for_a_window_of_large_images():
    images = torch.rand(16, 480, 640) * 255
    points = torch.rand(500, 9, 2) * torch.tensor([639.0, 479.0])
    frames = torch.randint(0, 16, (500,))
    error = (sample_images(images, frames, points) - sample_images_plain(images, frames, points)).abs()
    assert error.max() < 0.5 and error.mean() < 0.05  # grey levels, of white noise


@given(
    dx=st.floats(-1.5, 1.5), dy=st.floats(-1.5, 1.5), turn=st.floats(-0.3, 0.3), zoom=st.floats(0.8, 1.25),
    gain=st.floats(0.5, 2), offset=st.floats(-40, 40),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_a_known_warp_is_found(dx, dy, turn, zoom, gain, offset):
    """The second image shows the first turned, zoomed and shifted around a point, under another exposure."""
    centre = torch.tensor([[40.0, 30.0]], dtype=torch.float64)
    angle = torch.tensor(turn, dtype=torch.float64)
    warp = zoom * torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
    there = centre[0] + torch.tensor([dx, dy], dtype=torch.float64)
    x, y = grid()
    back = torch.linalg.inv(warp) @ (torch.stack([x, y], -1) - there)[..., None]
    second = gain * waves(*(back[..., 0] + centre[0]).unbind(-1)) + offset
    images = torch.stack([waves(x, y), second])
    found = align_patches(images, ONE, TWO, centre, centre, warp[None], PLAIN)
    assert (found.positions - there).norm() < 0.03
    assert found.correlation > 0.99 and found.last_step < 0.01


@pytest.mark.slow
def test_it_is_differentiable():
    x, y = grid(24, 24)
    images = torch.stack([waves(x, y), waves(x - 0.4, y + 0.3)])
    options = AlignmentOptions(window=5, iterations=2)

    def positions(images, start, warps):
        return align_patches(images, ONE, TWO, torch.tensor([[11.0, 12.0]]).double(), start, warps, options).positions

    start = torch.tensor([[11.23, 11.64]], dtype=torch.float64, requires_grad=True)
    warps = torch.tensor([[[1.03, 0.02], [-0.03, 0.97]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(positions, (images.requires_grad_(), start, warps), eps=1e-5, atol=1e-4)


@given(
    seed=st.integers(0, 1000), edges=st.integers(0, 6), window=st.sampled_from([5, 7, 13]), reach=st.floats(-30, 60),
    iterations=st.integers(1, 4), special=st.sampled_from([None, math.nan, math.inf, -1e30]), flat=st.booleans(),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_the_kernel_finds_what_the_twin_finds(seed, edges, window, reach, iterations, special, flat):
    """Windows inside, across the border and outside; positions without a value stay without one and harm no other."""
    g = torch.Generator().manual_seed(seed)
    x, y = grid(30, 40)
    images = torch.stack([waves(x, y), waves(x * 1.02 + 0.4, y - 0.3), 90 + 20 * (not flat) * waves(y, x) / 127])
    source, target = torch.randint(3, (2, edges), generator=g)
    centres = torch.rand(edges, 2, generator=g) * 40 - 5 + reach * (seed % 3 == 0)
    start = centres + torch.rand(edges, 2, generator=g) - 0.5
    warps = torch.eye(2) + 0.2 * (torch.rand(edges, 2, 2, generator=g) - 0.5)
    if special is not None and edges:
        start[0, seed % 2] = special
    options = AlignmentOptions(window=window, iterations=iterations)
    with torch.inference_mode():
        ours = align_patches(images.float(), source, target, centres, start, warps, options)
        floats = (x.double() for x in (centres, start, warps))
        theirs = align_patches(images, source, target, *floats, options)
    known = theirs.positions.isfinite().all(1)
    assert torch.equal(ours.positions.isfinite().all(1), known)
    for name in ("positions", "correlation", "last_step"):
        one, other = getattr(ours, name)[known], getattr(theirs, name)[known].float()
        torch.testing.assert_close(one, other, rtol=1e-4, atol=2e-3)
    size = (40, 30)
    taken = [accept(found, at, size, 4.0, options) for found, at in ((ours, start), (theirs, start.double()))]
    assert not any(of[~known].any() for of in taken)


def test_without_texture_nothing_moves_and_nothing_is_accepted():
    images = torch.full((2, 40, 40), 90.0)
    centre = torch.tensor([[20.0, 20.0]])
    found = align_patches(images, ONE, TWO, centre, centre + 0.5, torch.eye(2)[None])
    assert torch.equal(found.positions, centre + 0.5)
    assert not accept(found, centre, (40, 40), 4.0, AlignmentOptions())


def test_along_an_edge_the_start_stands():
    x, _ = grid(40, 40)
    image = 100 + 60 * torch.tanh((x - 20) / 2)
    images = torch.stack([image, image])
    centre = torch.tensor([[20.0, 20.0]], dtype=torch.float64)
    found = align_patches(images, ONE, TWO, centre, centre + 0.6, torch.eye(2).double()[None], PLAIN)
    assert abs(found.positions[0, 0] - 20) < 0.01 and found.positions[0, 1] == 20.6


@pytest.mark.parametrize(
    ("change", "accepted"),
    [
        ({}, True), ({"correlation": 0.79}, False), ({"last_step": 0.11}, False), ({"positions": [30.0, 21.3]}, False),
        ({"positions": [5.9, 20.0]}, False), ({"positions": [33.1, 20.0]}, False), ({"correlation": torch.nan}, False),
    ],
)  # fmt: skip
def test_conditions(change, accepted):
    """All met; each one missed; outside at either side."""
    values = {"positions": [30.0, 20.0], "correlation": 0.81, "last_step": 0.09} | change
    position = torch.tensor([values["positions"]])
    measured = torch.tensor([[30.0, 20.0]]) if "positions" not in change or position[0, 0] == 30 else position
    found = Alignment(position, torch.tensor([values["correlation"]]), torch.tensor([values["last_step"]]))
    assert accept(found, measured, (40, 40), 4.0, AlignmentOptions()).tolist() == [accepted]


def test_warps_of_reprojected_patches():
    ticks = torch.arange(3.0) - 1
    flat = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1)
    warp = torch.tensor([[1.1, 0.2], [-0.1, 0.9]])
    coords = torch.stack([flat @ warp.T + 7, flat * 5, flat * torch.nan])
    torch.testing.assert_close(patch_warps(coords), torch.stack([warp, torch.eye(2), torch.eye(2)]))


def test_options_are_checked():
    with pytest.raises(DvoError, match="window"):
        AlignmentOptions(window=1)


@pytest.mark.long
def test_rendered_motion_is_measured_to_a_tenth_of_a_pixel():
    """Starts of half a feature pixel off are brought to the true flow of a rendered clip."""
    torch.manual_seed(0)
    clip = make_clip(11, 2, frames=3, height=192, width=256, flow_range=(2.0, 6.0))
    generator = torch.Generator().manual_seed(0)
    centres = structure_selection(clip.images[None], 60, generator)
    inverse_depth = 1 / clip.depth[torch.arange(3)[:, None], centres[0, ..., 1] * 4, centres[0, ..., 0] * 4]
    patches = patch_coordinates(centres, inverse_depth.reshape(1, -1), 3)
    kk = torch.arange(60).repeat(2)
    ii, jj = torch.zeros(120, dtype=torch.long), torch.arange(1, 3).repeat_interleave(60)
    coords = reproject(clip.poses_cw[None], patches, clip.intrinsics[None] / 4, ii, jj, kk).coords[0]
    truth = coords[:, 1, 1] * 4
    grey = clip.images.float().mean(1)
    start = truth + torch.randn(120, 2, generator=generator)
    found = align_patches(grey, ii, jj, centres[0, 0, kk].float() * 4, start, patch_warps(coords))
    good = accept(found, start, (256, 192), 4.0, AlignmentOptions(reach=1.0))
    before, after = ((x - truth)[good].norm(dim=-1).median() for x in (start, found.positions))
    assert good.float().mean() > 0.3
    assert after < 0.15 < 1.0 < before


@given(angle=st.floats(0, math.pi), noise=st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_an_edge_has_no_texture_along_itself(angle, noise):
    x, y = grid()
    torch.manual_seed(0)
    across = (x - 40) * math.cos(angle) + (y - 30) * math.sin(angle)
    images = torch.stack([127 + 60 * torch.tanh(across / 3), torch.full_like(x, 90), waves(x, y)])
    images = images + noise * torch.randn_like(images)
    edge, bare, rich = texture(images, torch.arange(3), torch.tensor([[40.0, 30.0]] * 3).double(), 13)
    assert edge < 0.5 + noise and bare < noise + 1e-3 and rich > 4


def test_texture_is_that_of_a_ramp_both_ways():
    x, y = grid()
    images = torch.stack([3 * x, 3 * x + 2 * y])
    found = texture(images, torch.arange(2), torch.tensor([[40.0, 30.0]] * 2).double(), 13)
    assert found.abs().max() < 1e-5  # one gradient alone
    bent = torch.where(x < 40, 3 * x, 3 * 40 + 2 * y)[None]
    assert texture(bent, ONE, torch.tensor([[40.0, 30.0]]).double(), 13)[0] > 1


@given(seed=st.integers(0, 999), side=st.sampled_from([3, 5]), tilted=st.booleans())
@settings(max_examples=30, deadline=None)
def test_warps_decisions_and_texture_by_kernels_are_those_of_the_twins(seed, side, tilted):
    generator = torch.Generator().manual_seed(seed)
    ticks = torch.arange(float(side)) - side // 2
    patch = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1)
    coords = patch @ (torch.eye(2) + torch.randn(40, 1, 2, 2, generator=generator)) + 20
    coords[0] = torch.nan
    tilts = 0.3 * torch.randn(40, 2, 2, generator=generator) if tilted else None
    positions = torch.rand(40, 2, generator=generator) * torch.tensor([90.0, 70.0]) - 5
    quality = torch.rand(2, 40, generator=generator) * torch.tensor([[1.2], [0.2]])
    measured = positions + torch.randn(40, 2, generator=generator)
    positions[1], quality[0, 2], quality[1, 3] = torch.nan, torch.nan, torch.nan
    images = torch.rand(3, 60, 80, generator=generator) * 255
    frames = torch.randint(0, 3, (40,), generator=generator)

    def all_three():
        decided = accept(Alignment(positions, *quality), measured, (80, 60), 4.0, AlignmentOptions())
        return patch_warps(coords, tilts), decided, texture(images, frames, positions[4:], 13)

    frames = frames[4:]
    with pytest.MonkeyPatch.context() as patched:
        found = []
        for kernels in ("numba", "torch"):
            patched.setenv("DVO_KERNELS", kernels)
            found.append(all_three())
    (warps, decided, strength), expected = found
    torch.testing.assert_close(warps, expected[0], rtol=1e-5, atol=1e-5)
    assert torch.equal(decided, expected[1])
    torch.testing.assert_close(strength, expected[2], rtol=1e-3, atol=1e-3)
    assert torch.equal(warps[0], torch.eye(2)) and not decided[1:4].any()
