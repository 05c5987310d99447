"""Training clips: determinism, free space, flow, normalisation, sensor."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from dvo.core.errors import DvoError
from dvo.geometry.poses import compose_rodrigues, invert_rodrigues, split
from dvo.synth.clip import Clip, induced_flow, make_clip
from dvo.synth.conditions import draw_conditions
from dvo.synth.dataset import ClipDataset

SMALL = {"frames": 4, "height": 60, "width": 80, "flow_range": (1.0, 8.0)}
SEED = 5


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    return [make_clip(SEED, i, **SMALL) for i in range(12)]


def digest(tensors: list[torch.Tensor]) -> str:
    return hashlib.sha256(b"".join(t.numpy().tobytes() for t in tensors)).hexdigest()


def parts(clip: Clip) -> list[torch.Tensor]:
    return [clip.images, clip.depth, clip.poses_cw, clip.intrinsics]


def test_shapes_and_types(clips: list[Clip]) -> None:
    clip = clips[0]
    assert clip.images.shape == (4, 3, 60, 80) and clip.images.dtype == torch.uint8
    assert clip.depth.shape == (4, 60, 80) and clip.depth.dtype == torch.float32
    assert clip.poses_cw.shape == (4, 7) and clip.intrinsics.shape == (4, 4)
    assert clip.poses_cw[0].tolist() == [0, 0, 0, 0, 0, 0, 1]


def test_same_bytes_for_same_seed_and_index(clips: list[Clip]) -> None:
    for index in (7, 2):  # out of order, so that what was drawn before does not matter
        assert digest(parts(make_clip(SEED, index, **SMALL))) == digest(parts(clips[index]))
    assert len({digest(parts(clip)) for clip in clips}) == len(clips)


def test_workers_do_not_change_bytes(clips: list[Clip]) -> None:
    dataset = ClipDataset(SEED, 4, start=2, **SMALL)
    loader = DataLoader(dataset, batch_size=2, num_workers=2)
    keys = ("images", "depth", "poses_cw", "intrinsics")
    rows = [[batch[key][b] for key in keys] for batch in loader for b in range(2)]
    assert [digest(row) for row in rows] == [digest(parts(clip)) for clip in clips[2:6]]


def test_depth_is_normalised_and_complete(clips: list[Clip]) -> None:
    for clip in clips:
        assert float(clip.depth.median()) == pytest.approx(1, rel=1e-5)
        assert (clip.depth > 0.02).all(), "the camera is inside something"
        assert torch.isfinite(clip.poses_cw).all()
        assert np.quantile(clip.depth.numpy(), 0.02) > 0.05


def test_flow_is_in_range_and_neighbours_overlap(clips: list[Clip]) -> None:
    means = []
    for clip in clips:
        poses_wc = invert_rodrigues(clip.poses_cw.numpy().astype(float))
        flow, overlap = induced_flow(clip.depth.numpy(), poses_wc, clip.intrinsics[0].numpy().astype(float))
        means.append(flow.mean())
        assert 0.8 < flow.mean() < 9.5
        assert overlap.min() > 0.4
    assert max(means) > 2 * min(means), "the range is not used"


def test_frames_carry_the_motion(clips: list[Clip]) -> None:
    """Warping by depth and pose explains the pictures better than standing still does."""
    better = 0
    for clip in clips:
        depth, k = clip.depth[1].numpy().astype(float), clip.intrinsics[1].numpy().astype(float)
        y, x = np.mgrid[:60, :80]
        ray = np.stack([(x - k[2]) / k[0], (y - k[3]) / k[1], np.ones_like(depth)], -1)

        r, t = split(
            compose_rodrigues(
                clip.poses_cw[0].numpy().astype(float), invert_rodrigues(clip.poses_cw[1].numpy().astype(float))
            )
        )
        points = (ray * depth[..., None]) @ r.T + t
        u, v = (points[..., i] / points[..., 2] * k[i] + k[2 + i] for i in (0, 1))
        grid = torch.from_numpy(np.stack([u / 39.5 - 1, v / 29.5 - 1], -1).astype(np.float32))[None]
        warped = torch.nn.functional.grid_sample(clip.images[:1].float(), grid, align_corners=True)[0]
        mask = torch.from_numpy((points[..., 2] > 0) & (abs(u / 39.5 - 1) < 1) & (abs(v / 29.5 - 1) < 1))
        moved, still = ((a - clip.images[1]).abs().mean(0)[mask].mean() for a in (warped, clip.images[0].float()))
        better += int(moved < still)
    assert better >= 11


def test_sensor_changes_pictures_only() -> None:
    noisy, clean = (make_clip(SEED, 3, sensor=on, **SMALL) for on in (True, False))
    assert not torch.equal(noisy.images, clean.images)
    assert torch.equal(noisy.depth, clean.depth) and torch.equal(noisy.poses_cw, clean.poses_cw)


def test_brightness_is_sensible(clips: list[Clip]) -> None:
    for clip in clips:
        image = clip.images.float() / 255
        assert 0.08 < image.mean() < 0.9
        assert image.std() > 0.01


def test_bad_options() -> None:
    with pytest.raises(DvoError, match="flow_range"):
        make_clip(SEED, 0, flow_range=(3.0, 1.0))
    with pytest.raises(DvoError, match="frames"):
        make_clip(SEED, 0, frames=1)


def test_bad_probabilities() -> None:
    for name in ("movers", "low_light", "surroundings", "bare", "blurred"):
        for value in (-0.1, 1.1, float("nan")):
            with pytest.raises(DvoError, match=f"{name}: not a share"):
                make_clip(SEED, 0, **{name: value})


def test_clips_that_are_not_chosen_keep_their_bytes(clips: list[Clip]) -> None:
    chosen = [draw_conditions(SEED, i, 0.3, 0.3) for i in range(12)]
    usual = [i for i, c in enumerate(chosen) if c.bodies == 0 and c.light == 1]
    assert 0 < len(usual) < 12
    for index in usual[:2]:
        clip = make_clip(SEED, index, movers=0.3, low_light=0.3, **SMALL)
        assert digest(parts(clip)) == digest(parts(clips[index])) and clip.moving is None
    changed = next(i for i in range(12) if i not in usual)
    clip = make_clip(SEED, changed, movers=0.3, low_light=0.3, **SMALL)
    assert digest(parts(clip)) != digest(parts(clips[changed]))


@pytest.mark.long
@pytest.mark.parametrize("index", [1, 4, 7])
def test_depth_is_nan_where_a_body_is_seen(index: int) -> None:
    """The static scene shows through everywhere else, and is farther away where a body is seen."""
    options = {"sensor": False, **SMALL}
    clip, static = (make_clip(SEED, index, movers=share, **options) for share in (1.0, 0.0))
    moving = clip.moving
    assert moving is not None and static.moving is None and 0 < moving.float().mean() < 0.6
    assert torch.isfinite(clip.depth).all() and torch.isfinite(clip.poses_cw).all()
    scale = float((clip.depth / static.depth)[~moving].median())  # both have a median of 1, over other pixels
    known = clip.depth / scale
    torch.testing.assert_close(known[~moving], static.depth[~moving])
    assert (known[moving] < static.depth[moving]).all()
    torch.testing.assert_close(clip.poses_cw[:, :3] / scale, static.poses_cw[:, :3])
    item = ClipDataset(SEED, 1, start=index, movers=1.0, **options)[0]["depth"]
    assert torch.equal(torch.isnan(item), moving) and torch.equal(item[~moving], clip.depth[~moving])
    assert float(item.nanmedian()) == pytest.approx(1, rel=1e-5)
    # Bodies are in the pictures too, and but for the smoothed outlines nothing else is.
    change = (clip.images.int() - static.images.int()).abs().sum(1)
    assert (change[moving] > 0).float().mean() > 0.9 and (change[~moving] > 0).float().mean() < 0.1


def test_bodies_move_and_are_the_same_for_the_same_seed() -> None:
    clip, again = (make_clip(SEED, 6, movers=1.0, low_light=1.0, **SMALL) for _ in range(2))
    assert digest(parts(clip)) == digest(parts(again))
    assert clip.moving is not None and again.moving is not None and torch.equal(clip.moving, again.moving)
    assert not torch.equal(clip.moving[0], clip.moving[-1])


@pytest.mark.long
def test_depth_is_nan_where_surroundings_are_seen() -> None:
    """Nothing else changes, and clips that are not chosen keep their bytes."""
    options = {"sensor": False, **SMALL}
    chosen = [draw_conditions(SEED, i, 0.0, 0.0, 0.8) for i in range(8)]
    shown = 0
    for index in range(8):
        clip, again, bare = (make_clip(SEED, index, surroundings=share, **options) for share in (0.8, 0.8, 0.0))
        assert digest(parts(clip)) == digest(parts(again))
        video = chosen[index].h264 or chosen[index].stabilised
        if clip.moving is None:
            assert video or digest(parts(clip)) == digest(parts(bare))
            continue
        moving, shown = clip.moving, shown + 1
        assert chosen[index].surroundings
        if video or "night" in chosen[index].surroundings:
            continue
        change = (clip.images.int() - bare.images.int()).abs().sum(1)
        assert (change[moving] > 0).float().mean() > 0.5 and not (change[~moving] > 0).any()
        assert torch.equal(torch.isnan(clip.static_depth), moving)
        assert float(clip.static_depth.nanmedian()) == pytest.approx(1, rel=1e-5)
        factors = clip.depth / bare.depth
        torch.testing.assert_close(factors, factors.flatten()[0].expand_as(factors), rtol=1e-4, atol=0)
    assert 0 < shown < 8


@pytest.mark.long
def test_the_crop_of_some_clips_floats_and_their_intrinsics_say_so() -> None:
    """Pixels of one frame, carried by depth, pose and intrinsics, have the same colours in another."""
    options = {"sensor": False, "height": 120, "width": 160, "frames": 4, "flow_range": (1.0, 3.0)}
    drawn = {i: draw_conditions(SEED, i, 0.0, 0.0, 1.0) for i in range(80)}
    floating = [i for i, one in drawn.items() if one.stabilised > 0.008 and not one.h264][:3]
    assert len(floating) == 3 and len([one for one in drawn.values() if one.h264]) > 10
    for index in floating:
        clip = make_clip(SEED, index, surroundings=1.0, **options)
        assert clip.intrinsics[:, 2:].std(0).min() > 0.1 and clip.intrinsics[:, :2].std(0).max() == 0
        differences = []
        for k in (clip.intrinsics, clip.intrinsics.mean(0).expand(4, 4)):
            flow, inside = induced_between(clip, k)
            y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
            place = torch.stack([(x + flow[..., 0]) / 159, (y + flow[..., 1]) / 119], -1)[None] * 2 - 1
            seen = torch.nn.functional.grid_sample(clip.images[3:].float(), place, align_corners=True)[0]
            static = inside if clip.moving is None else inside & ~clip.moving[0]
            differences.append(float((seen - clip.images[0]).abs().mean(0)[static].median()))
        assert differences[0] < 0.6 * differences[1]


def induced_between(clip: Clip, intrinsics: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Flow ``(H, W, 2)`` from the first frame to the last with intrinsics of each, and the pixels that stay."""
    _, height, width = clip.depth.shape
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    fx, fy, cx, cy = intrinsics[0]
    rays = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], -1) * clip.depth[0][..., None]
    r, t = (torch.from_numpy(part).float() for part in split(clip.poses_cw[3].numpy().astype(float)))
    there = rays @ r.T + t
    fx, fy, cx, cy = intrinsics[3]
    u, v = fx * there[..., 0] / there[..., 2] + cx, fy * there[..., 1] / there[..., 2] + cy
    inside = (there[..., 2] > 0) & (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)
    return torch.stack([u - x, v - y], -1), inside


@pytest.mark.slow
def test_what_would_cover_everything_is_left_out() -> None:
    clips = [make_clip(SEED, index, surroundings=1.0, **SMALL) for index in range(30)]
    shown = [clip.moving for clip in clips if clip.moving is not None]
    assert 0 < len(shown) < 30 and all(float(moving.float().mean((1, 2)).max()) <= 0.8 for moving in shown)


@pytest.mark.long
def test_bare_and_blurred_clips_show_less_of_the_same_scene() -> None:
    def contrast(images: torch.Tensor) -> float:
        return float(images.float().diff(dim=-1).abs().mean())

    for option in ("bare", "blurred"):
        ratios = []
        for index in range(4):
            less, usual = (make_clip(SEED, index, **{option: share}, **SMALL) for share in (1.0, 0.0))
            assert torch.equal(less.depth, usual.depth) and torch.equal(less.poses_cw, usual.poses_cw)
            ratios.append(contrast(less.images) / contrast(usual.images))
        assert np.median(ratios) < 0.9, (option, ratios)


def test_low_light_is_noise_in_the_pictures_alone() -> None:
    def roughness(images: torch.Tensor) -> float:
        x = images.float()
        return float((x[..., 1:-1] - (x[..., 2:] + x[..., :-2]) / 2).abs().mean() / x.mean())

    ratios = []
    for index in range(4):
        dark, usual = (make_clip(SEED, index, low_light=share, **SMALL) for share in (1.0, 0.0))
        assert torch.equal(dark.depth, usual.depth) and torch.equal(dark.poses_cw, usual.poses_cw)
        ratios.append(roughness(dark.images) / roughness(usual.images))
    assert np.median(ratios) > 1.2, ratios
    clean, same = (make_clip(SEED, 1, low_light=share, sensor=False, **SMALL) for share in (1.0, 0.0))
    assert torch.equal(clean.images, same.images)
