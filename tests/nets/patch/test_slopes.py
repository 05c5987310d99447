"""Slopes of surfaces from windows of grey levels."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.nets.alignment.alignment import align_patches
from dvo.nets.patch.slopes import slope_equations

RATE = 12.0  # pixels that the centre moves by a doubled inverse depth, about the disparity of a near wall
CENTRE = torch.tensor([[48.0, 36.0]], dtype=torch.float64)
ONE = torch.tensor([0])


def waves(x, y, seed, turns=(0.2, 0.7), sine=np.sin):
    """Smooth texture at any place."""
    rng = np.random.default_rng(seed)
    turns, phases = rng.uniform(*turns, (20, 2)) * rng.choice([-1, 1], (20, 2)), rng.uniform(0, 7, 20)
    return 128 + 10 * sum(sine(a * x + b * y + c) for (a, b), c in zip(turns, phases, strict=True))


def pair(slopes, direction, seed, gain=1.0, **texture):
    """Image of a plane whose inverse depth has relative slopes around the centre, and one by a camera beside it."""
    x, y = np.meshgrid(np.arange(96.0), np.arange(72.0))
    u, v = x.copy(), y.copy()
    for _ in range(50):  # places in the first image of the pixels of the second
        move = RATE * (1 + slopes[0] * (u - 48) + slopes[1] * (v - 36))
        u, v = x - move * direction[0], y - move * direction[1]
    return torch.from_numpy(np.stack([waves(x, y, seed, **texture), gain * waves(u, v, seed, **texture)]))


def found_slopes(images, rates, rounds=4):
    slopes = torch.zeros(1, 2, dtype=torch.float64)
    for _ in range(rounds):
        warps = torch.eye(2, dtype=torch.float64) + rates[..., None] * slopes[:, None]
        aligned = align_patches(images, ONE, ONE + 1, CENTRE, CENTRE + rates, warps)
        found = slope_equations(images, ONE, ONE + 1, CENTRE, aligned.positions, warps, rates)
        slopes = slopes + torch.linalg.solve(found.matrix + 1e-3 * torch.eye(2), found.vector)
    return slopes, found


@given(
    st.tuples(st.floats(-0.015, 0.015), st.floats(-0.015, 0.015)), st.floats(0, 6.28), st.integers(0, 50),
    st.sampled_from([0.8, 1.0, 1.2]),
)  # fmt: skip
@settings(max_examples=25, deadline=None)
def test_the_slopes_of_a_plane_are_found(slopes, angle, seed, gain):
    """Whatever the direction of the parallax and the exposure."""
    direction = np.cos(angle), np.sin(angle)
    images = pair(slopes, direction, seed, gain)
    found, _ = found_slopes(images, RATE * torch.tensor([direction], dtype=torch.float64))
    np.testing.assert_allclose(found[0].numpy(), slopes, atol=2e-3)


def test_without_parallax_nothing_is_told():
    images = pair((0.01, 0.0), (1.0, 0.0), 0)
    zero = torch.zeros(1, 2, dtype=torch.float64)
    found = slope_equations(images, ONE, ONE + 1, CENTRE, CENTRE + 3, torch.eye(2, dtype=torch.float64)[None], zero)
    assert not found.matrix.any() and not found.vector.any()


def test_the_information_is_that_of_least_squares():
    """Twin by automatic differentiation of a texture that is known at any place, coarse for its differences."""
    texture = {"turns": (0.05, 0.25)}
    images, rates = pair((0.008, -0.004), (1.0, 0.0), 3, **texture), RATE * torch.tensor([[1.0, 0.0]]).double()
    _, found = found_slopes(images, rates)
    x, y = torch.meshgrid(*[torch.arange(-6.0, 7.0, dtype=torch.float64)] * 2, indexing="xy")

    def seen(slope_x, slope_y, right, down, gain):
        """The second image shows the texture stretched by 1 + 0.008 RATE in the direction of the parallax."""
        u = 48 + right + x + RATE * (slope_x * x + slope_y * y) / (1 + 0.008 * RATE)
        grey = waves(u, 36 + down + y, 3, **texture, sine=torch.sin)
        return ((1 + gain) * (grey - grey.mean())).flatten()

    columns = torch.stack(torch.autograd.functional.jacobian(seen, (torch.zeros((), dtype=torch.float64),) * 5), 1)
    normal = columns.T @ columns
    noise = 4.0 * 169 * torch.eye(3, dtype=torch.float64)
    reduced = normal[:2, :2] - normal[:2, 2:] @ torch.linalg.solve(normal[2:, 2:] + noise, normal[2:, :2])
    torch.testing.assert_close(4 * found.matrix[0], reduced, rtol=0.05, atol=0.02 * float(reduced.max()))
