"""The pose-regression network, and the product of its steps."""

import re
from pathlib import Path

import pytest
import torch

from dvo.geometry import se3
from dvo.models.deepvo import DeepVO, chain, pose_step, step_pose, true_steps
from dvo.models.registry import build_network
from dvo.models.weights import load_weights, save_weights

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_lists_exactly_the_files_that_name_the_network():
    """docs/add_a_network.md promises that a member touches its own files and one line in each registry."""
    page = (ROOT / "docs" / "add_a_network.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| `([\w/.]+)` \|", page, re.MULTILINE))
    found = {
        path.relative_to(ROOT).as_posix()
        for room in ("dvo", "train", "configs/train")
        for path in (ROOT / room).rglob("*")
        if path.suffix in (".py", ".yaml")
        and path.name != "moved.py"
        and ("deepvo" in str(path.relative_to(ROOT)) or "deepvo" in path.read_text(encoding="utf-8").lower())
    }
    assert listed == found
    for line in re.findall(r"`(\"deepvo\": \"[\w.:]+\")`", page):
        assert sum(line in (ROOT / name).read_text(encoding="utf-8") for name in listed) == 1, line


@pytest.fixture
def model():
    torch.manual_seed(0)
    return DeepVO(DeepVO.presets["tiny"]).eval()


@pytest.fixture
def images():
    return torch.randint(0, 256, (2, 6, 3, 60, 80), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))


def test_number_of_parameters():
    counts = {
        name: sum(p.numel() for p in build_network("deepvo", sizes).parameters())
        for name, sizes in DeepVO.presets.items()
    }
    assert 300_000 <= counts["small"] <= 1_000_000 and counts["tiny"] < 100_000


@torch.no_grad()
def test_a_sequence_in_pieces_gives_the_steps_of_the_whole(model, images):
    whole, end = model(images)
    first, state = model(images[:, :3])
    then, last = model(images[:, 2:], state)
    torch.testing.assert_close(torch.cat([first, then], 1), whole)
    torch.testing.assert_close(last, end)
    without, _ = model(images[:, 2:])
    assert not torch.allclose(without, then)  # the recurrent layers do carry something


def test_every_parameter_gets_a_gradient(model, images):
    model(images)[0].square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.parameters())


def test_chain_and_true_steps_are_inverse():
    steps = 0.4 * torch.randn(3, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    poses_cw = chain(steps)
    assert poses_cw.shape == (3, 6, 7) and torch.equal(poses_cw[:, 0], se3.identity(3, dtype=torch.float64))
    torch.testing.assert_close(true_steps(poses_cw), steps)
    torch.testing.assert_close(pose_step(step_pose(steps)), steps)


def test_a_step_is_in_the_frame_of_the_camera_before():
    """Two steps ahead, with a quarter turn to the right (about y, which points down) after the first."""
    turn = torch.pi / 2
    steps = torch.tensor([[[0.0, 0, 1, 0, turn, 0], [0, 0, 1, 0, 0, 0]]])
    centres = se3.inverse(chain(steps))[0, :, :3]
    torch.testing.assert_close(centres, torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 1]]), atol=1e-6, rtol=0)


@torch.no_grad()
def test_weights_file_names_the_architecture(model, images, tmp_path):
    save_weights(tmp_path / "turns.safetensors", model, {}, half=False)
    loaded = load_weights(tmp_path / "turns.safetensors")
    assert (loaded.architecture, loaded.preset) == ("deepvo", "tiny")
    torch.testing.assert_close(loaded.model(images)[0], model(images)[0], rtol=0, atol=0)
