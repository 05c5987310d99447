"""Intrinsics layer, sizes and pose network of TartanVO."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.geometry import so3
from dvo.geometry.camera import Camera
from dvo.losses.two_frame import true_flow
from dvo.nets.two_frame.tartanvo import PRESETS, PoseNetwork, TartanVOConfig, derotate, intrinsics_layer, preset
from train.data.augment import crop_and_resize


def test_a_pixel_of_the_intrinsics_layer_is_its_ray():
    layer = intrinsics_layer(torch.tensor([[50.0, 40.0, 7.5, 5.5]]), 12, 16)
    assert layer.shape == (1, 2, 12, 16)
    torch.testing.assert_close(layer[0, :, 3, 10], torch.tensor([(10 - 7.5) / 50, (3 - 5.5) / 40]))


def test_gradients_reach_the_intrinsics():
    intrinsics = torch.tensor([[3.0, 4.0, 1.4, 1.1]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda value: intrinsics_layer(value, 3, 4), (intrinsics,))


CAMERA = torch.tensor([[40.0, 42.0, 9.5, 7.0]], dtype=torch.float64)


@given(st.integers(0, 2**31))
def test_what_a_rotation_leaves_of_a_flow_is_that_of_the_translation(seed):
    """With R_ab known, the flow that is left is that of the same translation and no rotation."""
    source = torch.Generator().manual_seed(seed)
    depth = 1 + torch.rand(1, 12, 16, generator=source, dtype=torch.float64)
    motion = 0.2 * torch.randn(1, 6, generator=source, dtype=torch.float64).clamp(-1, 1)
    rotation = so3.exp(motion[:, 3:])
    both, ahead = true_flow(depth, torch.cat([motion[:, :3], rotation], -1), CAMERA)
    alone, _ = true_flow(depth, torch.cat([motion[:, :3], so3.exp(0 * motion[:, 3:])], -1), CAMERA)
    left = derotate(both, rotation, CAMERA)
    where = ahead[:, None].expand_as(left)
    torch.testing.assert_close(left[where], alone[where])


def test_derotation_is_the_homography_of_the_rotation():
    """K R K^-1, applied to each end of the flow."""
    source = torch.Generator().manual_seed(0)
    flow = torch.randn(1, 2, 5, 6, generator=source, dtype=torch.float64)
    rotation = so3.exp(torch.tensor([[0.1, -0.2, 0.05]], dtype=torch.float64))
    fx, fy, cx, cy = CAMERA[0].tolist()
    k = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    h = k @ so3.matrix(rotation)[0] @ k.inverse()
    left = derotate(flow, rotation, CAMERA)
    for v in range(5):
        for u in range(6):
            x, y = flow[0, :, v, u].tolist()
            end = h @ torch.tensor([u + x, v + y, 1.0], dtype=torch.float64)
            place = torch.tensor([u, v], dtype=torch.float64)
            torch.testing.assert_close(left[0, :, v, u], end[:2] / end[2] - place)


def test_gradients_of_derotation():
    source = torch.Generator().manual_seed(0)
    flow = torch.randn(1, 2, 3, 4, generator=source, dtype=torch.float64).requires_grad_()
    turn = torch.tensor([[0.1, -0.2, 0.05]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda f, r: derotate(f, so3.exp(r), CAMERA), (flow, turn))


def test_rays_turned_backwards_stay_finite():
    half_a_turn = so3.exp(torch.tensor([[0.0, 3.1, 0.0]], dtype=torch.float64))
    left = derotate(torch.zeros(1, 2, 12, 16, dtype=torch.float64), half_a_turn, CAMERA)
    assert left.abs().max() < 40 / 0.1 + 16


def test_crop_and_resize_carries_the_rays_along():
    """The ray of a pixel of the enlarged window is the ray of the place in the image that it was taken from."""
    h, w, scale, left, top = 48, 64, 1.6, 10.0, 5.0
    clip = {
        "images": torch.zeros(1, 3, h, w, dtype=torch.uint8), "depth": torch.ones(1, h, w),
        "intrinsics": torch.tensor([[60.0, 62.0, 30.0, 25.0]]),
    }  # fmt: skip
    after = crop_and_resize(clip, scale, left, top)["intrinsics"]
    layer = intrinsics_layer(after, h, w)[0]
    for x, y in ((0, 0), (63, 47), (20, 31)):
        before = (x + 0.5) / scale + left - 0.5, (y + 0.5) / scale + top - 0.5
        ray = torch.tensor([(before[0] - 30) / 60, (before[1] - 25) / 62])
        torch.testing.assert_close(layer[:, y, x], ray)


@pytest.mark.parametrize("size", [(160, 120), (96, 200)])
def test_resizing_a_camera_keeps_the_field_of_view(size):
    """The rays of the border of the image stay where they are, whatever its size."""
    camera = Camera(300.0, 310.0, 161.0, 118.0, 320, 240)

    def edges(c):
        rays = intrinsics_layer(torch.tensor(c.intrinsics)[None], c.height, c.width)[0]
        half = torch.tensor([0.5 / c.fx, 0.5 / c.fy], dtype=rays.dtype)
        return torch.stack([rays[:, 0, 0] - half, rays[:, -1, -1] + half])

    torch.testing.assert_close(edges(camera.resized(*size)), edges(camera))


@pytest.mark.parametrize("units", ["pixels", "rays"])
def test_the_pose_network_takes_every_size(units):
    config = TartanVOConfig.from_dict(PRESETS["tiny"].to_dict() | {"flow_units": units})
    net = PoseNetwork(config)
    for h, w in ((8, 8), (15, 20), (33, 17)):
        translation, rotation = net(torch.zeros(2, 2, h, w), torch.tensor([[80.0, 80, 40, 30]] * 2))
        assert translation.shape == rotation.shape == (2, 3)


def test_the_same_rays_look_the_same_in_units_of_rays():
    """Flow over focal length: with both doubled, the input is that of a camera of twice the resolution."""
    torch.manual_seed(0)
    config = TartanVOConfig.from_dict(PRESETS["tiny"].to_dict() | {"flow_units": "rays"})
    net, flow = PoseNetwork(config), torch.randn(1, 2, 12, 16)
    seen = []
    net.conv1.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    net(flow, torch.tensor([[80.0, 80, 30, 22]]))
    net(2 * flow, torch.tensor([[160.0, 160, 30, 22]]))
    torch.testing.assert_close(seen[0][:, :2], seen[1][:, :2])


@pytest.mark.parametrize(
    "change",
    [
        {"radius": 0}, {"radius": 1.5}, {"feature_channels": ()}, {"feature_channels": (8, -1)}, {"grid": (3,)},
        {"pose_channels": "wide"}, {"flow_units": "metres"}, {"head_channels": True}, {"grid": (3, 4, 5)},
        {"passes": 0}, {"passes": 9},
    ],
)  # fmt: skip
def test_sizes_out_of_range_are_refused(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        TartanVOConfig(**change)


def test_sizes_survive_plain_values():
    for config in PRESETS.values():
        plain = {name: list(v) if isinstance(v, tuple) else v for name, v in config.to_dict().items()}
        assert TartanVOConfig.from_dict(plain) == config
    with pytest.raises(DvoError, match="colour"):
        TartanVOConfig.from_dict({"colour": 1})
    with pytest.raises(DvoError, match="one of small, tiny, full"):
        preset("huge")
