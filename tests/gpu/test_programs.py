"""A training step and the tracker on an accelerator do what they do on the CPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dvo.models.weights import load_weights
from dvo.odometry.load import build_odometry
from dvo.synth.clip import make_clip
from dvo.synth.sequence import make_sequence

pytestmark = pytest.mark.gpu


def step(device, batch):
    from train.engine.build import make_program  # takes seconds, which the other tests do not need

    torch.manual_seed(0)
    program = make_program("patch_vo", model="tiny", updates=3, initial=2, warmup_until=0.0).to(device)
    program.log_dict = program.log = lambda *_, **__: None
    loss = program.training_step({name: value.to(device) for name, value in batch.items()}, 0)
    loss.backward()
    gradients = [p.grad.flatten().cpu() for p in program.net.parameters() if p.grad is not None]
    return loss.item(), torch.cat(gradients)


@pytest.mark.slow
def test_training_step(device):
    clip = make_clip(0, 1, frames=4, height=48, width=64)
    batch = {name: getattr(clip, name)[None] for name in ("images", "depth", "poses_cw", "intrinsics")}
    expected, gradient = step(torch.device("cpu"), batch)
    found, there = step(device, batch)
    assert found == pytest.approx(expected, rel=1e-3)
    assert torch.nn.functional.cosine_similarity(there, gradient, dim=0) > 0.99


@pytest.mark.long
def test_rendering(device):
    here, there = (make_clip(0, 1, frames=2, height=48, width=64, device=where) for where in ("cpu", device))
    assert there.images.device.type == device.type
    different = (here.images.int() - there.images.cpu().int()).abs() > 2
    assert different.float().mean() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", "fast"])
def test_tracker(device, preset):
    frames = list(make_sequence(1, frames=14, height=96, width=128))
    paths = []
    for where in (device, torch.device("cpu")):
        odometry = build_odometry(load_weights("small"), device=where, preset=preset, loops=False, restart=False)
        poses = [odometry.track(frame).pose_wc for frame in frames]
        paths.append(np.array([[np.nan] * 7 if pose is None else pose for pose in poses]))
    found, expected = (path[:, :3] for path in paths)
    assert np.array_equal(np.isnan(found), np.isnan(expected)) and np.isfinite(expected[-6:]).all()
    length = np.linalg.norm(np.diff(expected[-6:], axis=0), axis=1).sum()
    assert length > 0 and np.nanmax(np.abs(found - expected)) < 0.03 * length
