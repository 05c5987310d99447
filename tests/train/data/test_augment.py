import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from train.data.augment import Augmentation, augment, crop_and_resize


def ramp(h=24, w=32):
    """A clip whose red and green channels are the column and the row, seven times; depth is the column."""
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    image = torch.stack([7 * x, 7 * y, torch.zeros_like(x)]).to(torch.uint8)
    return {
        "images": image[None].repeat(2, 1, 1, 1),
        "depth": (1.0 + x.float())[None].repeat(2, 1, 1),
        "intrinsics": torch.tensor([[30.0, 28.0, 15.5, 11.5]]).repeat(2, 1),
        "poses_cw": torch.zeros(2, 7),
    }


@given(st.floats(1.0, 2.0), st.floats(0, 1), st.floats(0, 1))
@settings(max_examples=25, deadline=None)
def test_the_intrinsics_follow_the_window(scale, left, top):
    """A ray keeps its colour: the column that a pixel came from is written in its red."""
    clip = ramp()
    h, w = 24, 32
    new = crop_and_resize(clip, scale, left * (w - w / scale), top * (h - h / scale))
    fx, fy, cx, cy = clip["intrinsics"][0].tolist()
    gx, gy, dx, dy = new["intrinsics"][0].tolist()
    for u, v in ((8, 9), (16, 12), (23, 15)):
        column, row = (u - dx) / gx * fx + cx, (v - dy) / gy * fy + cy
        assert new["images"][0, 0, v, u] == pytest.approx(7 * column, abs=1.6)
        assert new["images"][0, 1, v, u] == pytest.approx(7 * row, abs=1.6)
        assert new["depth"][0, v, u] == pytest.approx(1 + column, abs=0.501)


def test_a_window_of_the_whole_image_is_the_image():
    clip = ramp()
    new = crop_and_resize(clip, 1.0, 0.0, 0.0)
    for name in ("images", "depth", "intrinsics"):
        torch.testing.assert_close(new[name], clip[name])


def test_unknown_depth_stays_unknown_and_does_not_spread():
    clip = ramp()
    clip["depth"][:, 8:16, 8:16] = torch.nan
    new = crop_and_resize(clip, 1.5, 2.0, 3.0)
    x, y = ((torch.arange(n) + 0.5) / 1.5 + start - 0.5 for n, start in ((32, 2.0), (24, 3.0)))
    column, row = x.round(), y.round()
    hidden = ((row >= 8) & (row < 16))[:, None] & ((column >= 8) & (column < 16))
    assert torch.equal(torch.isnan(new["depth"][0]), hidden) and hidden.any()


def test_one_draw_for_all_frames_and_the_same_for_the_same_step():
    pytest.importorskip("kornia")
    batch = {name: value[None].repeat(3, *[1] * value.dim()) for name, value in ramp().items()}
    always = Augmentation(colour=1.0, zoom=1.0)
    a, b, c = augment(batch, always, 0, 5), augment(batch, always, 0, 5), augment(batch, always, 0, 6)
    assert torch.equal(a["images"], b["images"]) and not torch.equal(a["images"], c["images"])
    assert torch.equal(a["images"][:, 0], a["images"][:, 1])
    assert not torch.equal(a["images"][0], a["images"][1])  # clips of a batch differ
    assert a["images"].dtype == torch.uint8 and a["images"].shape == batch["images"].shape
    never = augment(batch, Augmentation(colour=0.0, zoom=0.0), 0, 5)
    assert all(torch.equal(never[name], batch[name]) for name in batch)


def test_the_exposure_jumps_once_and_drifts():
    clip = ramp()
    images = torch.full((1, 8, 3, 24, 32), 100, dtype=torch.uint8)
    batch = {"images": images, "depth": clip["depth"][None, :1].repeat(1, 8, 1, 1)}
    only = Augmentation(colour=0.0, zoom=0.0, exposure=1.0, exposure_range=(-1.5, 0.8))
    steps = []
    for step in range(40):
        new = augment(batch, only, 0, step)["images"][0].float()
        assert (new == new[:, :1, :1, :1]).all()  # the whole frame alike
        steps.append((new[:, 0, 0, 0] / 100).log2().diff())
    jumps = torch.stack(steps)
    assert (jumps.abs() > 0.15).sum(1).max() == 1 and (jumps.abs() > 0.15).any(1).float().mean() > 0.7
    assert jumps.min() > -1.7 and jumps.max() < 1.0 and jumps.min() < -0.8 and jumps.max() > 0.4
    assert augment(batch, only, 0, 3)["images"].equal(augment(batch, only, 0, 3)["images"])
