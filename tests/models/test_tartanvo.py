"""The two-frame network: shapes, conventions, weights files."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.geometry import se3, so3
from dvo.losses.two_frame import true_flow
from dvo.models.registry import build_network, network_class
from dvo.models.tartanvo import TartanVO, TwoFrameMotion
from dvo.models.weights import save_weights
from dvo.nets.two_frame.tartanvo import PRESETS, preset


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return TartanVO(preset("tiny")).eval()


def images(*shape, seed=0):
    return torch.randint(0, 256, shape, generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


def test_sizes_of_the_presets():
    count = {name: sum(p.numel() for p in TartanVO(preset(name)).parameters()) for name in ("tiny", "small")}
    assert 300_000 <= count["small"] <= 1_000_000 and count["tiny"] < 150_000


@pytest.mark.parametrize(("height", "width"), [(48, 64), (33, 47), (240, 320), (32, 32)])
def test_flow_is_at_a_quarter_of_any_size(model, height, width):
    a, b = images(2, 2, 3, height, width)
    with torch.no_grad():
        flow = model.flow(a, b)
        assert flow.shape == (2, 2, math.ceil(height / 4), math.ceil(width / 4))
        motion = model(a, b, torch.tensor([[50.0, 50, 20, 20]] * 2))
    torch.testing.assert_close(motion.flows.flow * 4, flow)  # feature pixels and image pixels
    assert len(motion.flows.levels) == len(model.config.feature_channels)
    assert motion.translation.shape == motion.rotation.shape == (2, 3)


def test_pairs_do_not_depend_on_their_neighbours(model):
    a, b = images(2, 3, 3, 48, 64)
    intrinsics = torch.tensor([[50.0, 50, 32, 24], [60.0, 60, 30, 20], [40.0, 40, 32, 24]])
    with torch.no_grad():
        together = model(a, b, intrinsics)
        alone = model(a[1:2], b[1:2], intrinsics[1:2])
    torch.testing.assert_close(together.translation[1:2], alone.translation, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(together.flows.flow[1:2], alone.flows.flow, atol=1e-4, rtol=1e-4)


def test_bad_images_are_refused(model):
    with pytest.raises(DvoError, match="differ"):
        model.flow(images(1, 3, 48, 64), images(1, 3, 64, 48))
    with pytest.raises(DvoError, match="at least 32x32"):
        model.flow(images(1, 3, 24, 64), images(1, 3, 24, 64))


def test_a_motion_is_a_pose_of_the_second_camera():
    translation, phi = torch.tensor([[0.0, 0.0, 3.0]]), torch.tensor([[0.0, 0.1, 0.0]])
    pose = TwoFrameMotion(translation, phi, None).poses_ab(torch.tensor([2.0]))
    torch.testing.assert_close(pose, torch.cat([torch.tensor([[0.0, 0, 2]]), so3.exp(phi)], -1))
    # A point two units ahead of the first camera is where the second camera stands.
    torch.testing.assert_close(se3.act(se3.inverse(pose), translation / 1.5), torch.zeros(1, 3), atol=1e-6, rtol=0)


def test_every_parameter_gets_a_gradient():
    torch.manual_seed(0)
    net = TartanVO(preset("tiny"))
    a, b = images(2, 1, 3, 64, 96)
    motion = net(a, b, torch.tensor([[50.0, 50, 32, 24]]))
    total = sum(level.square().mean() for level in motion.flows.levels)
    (total + motion.translation.square().sum() + motion.rotation.square().sum()).backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()] == []


def test_the_pose_loss_reaches_the_matching_network():
    torch.manual_seed(0)
    net = TartanVO(preset("tiny"))
    a, b = images(2, 1, 3, 64, 96)
    net(a, b, torch.tensor([[50.0, 50, 32, 24]])).rotation.sum().backward()
    assert net.matching.encoder.conv1.weight.grad.abs().sum() > 0


def test_weights_files_name_the_network(model, tmp_path):
    file = tmp_path / "two-frame.safetensors"
    save_weights(file, model, {}, half=False)
    loaded = dvo.load_model(file)
    assert isinstance(loaded, TartanVO) and loaded.config == model.config
    a, b = images(2, 1, 3, 48, 64)
    with torch.no_grad():
        assert torch.equal(loaded.flow(a, b), model.flow(a, b))
    assert network_class("tartanvo") is TartanVO
    assert isinstance(build_network("tartanvo", preset("tiny")), TartanVO)


def test_each_pass_corrects_the_rotation_of_the_one_before():
    """With a pose network that finds half of a rotation each time, the error halves from pass to pass."""
    model = TartanVO(replace(PRESETS["tiny"], passes=4))
    intrinsics = torch.tensor([[200.0, 200.0, 79.5, 59.5]])
    true = torch.tensor([[0.02, -0.05, 0.03]])
    depth = torch.ones(1, 30, 40)
    poses_ab = torch.cat([torch.zeros(1, 3), so3.exp(true)], -1)
    flow, _ = true_flow(depth, poses_ab, intrinsics / 4)

    class Half(torch.nn.Module):
        """Half of the small rotation that a flow of the far scene shows, by least squares."""

        def forward(self, flow, intrinsics):
            columns = []
            for axis in torch.eye(3):
                turn = torch.cat([torch.zeros(3), so3.exp(1e-3 * axis)])[None]
                columns.append(true_flow(depth, turn, intrinsics / 4)[0].flatten() / 1e-3)
            found = torch.linalg.lstsq(torch.stack(columns, 1), flow.flatten()[:, None]).solution
            return torch.ones(1, 3), 0.5 * found.T

    model.pose = Half()
    passes = model.motions(flow, intrinsics)
    errors = [float((rotation - true).norm()) for _, rotation in passes]
    assert len(passes) == 4 and errors[0] == pytest.approx(float(true.norm()) / 2, rel=0.1)
    for before, after in pairwise(errors):
        assert after == pytest.approx(before / 2, rel=0.1)
    torch.testing.assert_close(
        model.motion(flow, intrinsics)[1], passes[-1][1]
    )  # LAPACK may round the last bit otherwise
