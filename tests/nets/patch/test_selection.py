"""Patch selections: where they place the patches, and that the seed decides."""

import cv2
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import dvo
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import training_schedule
from dvo.models.weights import load_weights, save_weights
from dvo.nets.patch.config import ModelConfig, preset
from dvo.nets.patch.selection import SELECTIONS, random_centres, score_at, structure_score
from dvo.odometry.load import build_odometry
from dvo.odometry.patch.config import TRACKER_PRESETS

NAMES = list(SELECTIONS)


def noise(height, width, frames=2, batch=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (batch, frames, 3, height, width), dtype=torch.uint8, generator=generator)


def chosen(name, images, patches, seed=0):
    return SELECTIONS.resolve(name)(images, patches, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", NAMES)
@given(patches=st.integers(1, 60), height=st.integers(16, 100), width=st.integers(16, 150), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_patches_lie_inside_and_the_seed_decides(name, patches, height, width, seed):
    images = noise(height, width)
    centres = chosen(name, images, patches, seed)
    assert centres.shape == (1, 2, patches, 2) and centres.dtype == torch.int64
    limit = torch.tensor([-(-width // 4) - 2, -(-height // 4) - 2])
    assert (centres >= 1).all() and (centres <= limit).all()
    assert torch.equal(centres, chosen(name, images, patches, seed))


@pytest.mark.parametrize("name", ["grid", "structure"])
@pytest.mark.parametrize("size", [(232, 320), (152, 504), (320, 240)])
def test_no_two_patches_share_a_cell(name, size):
    """24 patches of 232x320 lie in 4 rows of 6; more cells than patches leave some empty, elsewhere in each frame."""
    centres = chosen(name, noise(*size), 24)[0]
    assert all(len(set(map(tuple, frame.tolist()))) == 24 for frame in centres)
    if size == (232, 320):
        cells = (centres - 1) * torch.tensor([6, 4]) // torch.tensor([78, 56])
        numbers = (cells[..., 1] * 6 + cells[..., 0]).sort(-1).values
        assert torch.equal(numbers, torch.arange(24).expand(2, -1))


def test_random_patches_are_those_of_dvo_0_1():
    generator = torch.Generator().manual_seed(3)
    assert torch.equal(chosen("random", noise(96, 128), 7, 3), random_centres(2, 7, 24, 32, generator))


def test_structure_takes_corners_and_grid_does_not():
    """A checkerboard of large fields has its corners at few feature positions; texture is drawn to them."""
    y, x = torch.meshgrid(torch.arange(240), torch.arange(320), indexing="ij")
    board = ((((y + 20) // 40 + (x + 20) // 40) % 2) * 200).to(torch.uint8).expand(1, 1, 3, -1, -1)
    score = structure_score(board)[0, 0]

    def mean_score(name):
        centres = torch.cat([chosen(name, board, 24, seed)[0, 0] for seed in range(10)])
        return float(score[centres[:, 1], centres[:, 0]].mean())

    assert mean_score("structure") > 2 * mean_score("grid") > 0


def test_the_score_is_that_of_opencv():
    image = noise(64, 80, 1)[0, 0].float().mean(0)
    smooth = cv2.GaussianBlur(image.numpy(), (0, 0), 2)
    # OpenCV's derivative of aperture 1 is the plain difference, twice ours, and its eigenvalue that of a mean.
    theirs = cv2.cornerMinEigenVal(smooth, 7, ksize=1, borderType=cv2.BORDER_REPLICATE)
    ours = structure_score(torch.from_numpy(smooth).expand(1, 1, 3, -1, -1))[0, 0]
    inner = (slice(2, -2), slice(2, -2))
    there = torch.from_numpy(theirs[::4, ::4])[inner]
    ratio = ours[inner] / there
    torch.testing.assert_close(ratio, ratio.median().expand_as(ratio), rtol=1e-3, atol=0)


def test_no_texture_has_no_score_and_an_edge_hardly_any():
    assert structure_score(torch.full((1, 1, 3, 32, 32), 80.0)).abs().max() == 0
    edge = torch.zeros(1, 1, 3, 32, 32)
    edge[..., 16:] = 200
    corner = edge.clone()
    corner[..., :16, :] = 0
    assert structure_score(edge)[0, 0, 2:-2].max() < 1e-2 < 1 < structure_score(corner).max()


def test_a_network_carries_its_selection_to_the_tracker(tmp_path):
    config = ModelConfig.from_dict({**preset("tiny").to_dict(), "selection": "grid"})
    save_weights(tmp_path / "mine.safetensors", PatchVO(config), {})
    loaded = load_weights(tmp_path / "mine.safetensors")
    assert loaded.preset == "tiny" and build_odometry(loaded).config == TRACKER_PRESETS["tiny"]
    assert build_odometry(loaded).select.func is SELECTIONS.resolve("grid")
    assert build_odometry(loaded, selection="structure").select.func is SELECTIONS.resolve("structure")


def test_an_unknown_selection_is_named():
    with pytest.raises(DvoError, match="no patch selection 'corners'.*random, grid, structure"):
        dvo.load("small", selection="corners")
    with pytest.raises(DvoError, match="no patch selection 'corners'"):
        PatchVO(ModelConfig(selection="corners"))


def test_each_clip_of_a_batch_draws_from_its_own_generator():
    torch.manual_seed(0)
    model = PatchVO(ModelConfig.from_dict({**preset("tiny").to_dict(), "selection": "structure"}))
    images = noise(48, 64, 4, batch=2)
    intrinsics = torch.tensor([50.0, 50, 32, 24]).expand(2, 4, 4)
    stages = training_schedule(4, 12, 1)

    def centres(clips, seeds):
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        start = se3.identity(len(clips), 4)
        state = next(model.unroll(images[clips], intrinsics[clips], stages, poses_cw=start, generator=generators))
        return state.patches[:, :, :2]

    both = centres([0, 1], [5, 6])
    assert torch.equal(both[:1], centres([0], [5])) and torch.equal(both[1:], centres([1], [6]))


@given(height=st.integers(8, 40), width=st.integers(8, 40), seed=st.integers(0, 99), last=st.booleans())
@settings(max_examples=25, deadline=None)
def test_scores_by_the_kernel_are_those_of_the_twin(height, width, seed, last):
    images = noise(height, width, seed=seed)
    images = images.permute(0, 1, 3, 4, 2).contiguous().permute(0, 1, 4, 2, 3) if last else images
    places = [torch.arange(-(-size // 4)) for size in (width, height)]
    points = torch.stack(torch.meshgrid(*places, indexing="xy"), -1).reshape(1, 1, -1, 2).expand(1, 2, -1, 2)
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("DVO_KERNELS", "numba")
        found = score_at(images, points)
        patched.setenv("DVO_KERNELS", "torch")
        expected = score_at(images, points)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(expected, structure_score(images).flatten(2))
