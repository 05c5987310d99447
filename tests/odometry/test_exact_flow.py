"""The tracker around a perfect network: what it loses then is its own fault."""

import numpy as np
import pytest
import torch

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.geometry.projection import reproject
from dvo.metrics import evaluate
from dvo.models.patch_vo import PatchVO
from dvo.nets.correlation.correlation import Correlation
from dvo.nets.patch.config import preset
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.odometry.protocol import Status
from dvo.synth.clip import make_clip

CONFIG = TrackerConfig(
    pixels=0, initial_motion=0.3, initial_parallax=0.3, keyframe_motion=2.0, network_motion=0, align="none"
)


class TrueFlow:
    """Correlation look-up that gives, as its only level, the true flow of every edge, and whether it is visible."""

    def __init__(self, odometry, clip):
        self.odometry, self.clip = odometry, clip

    def keep(self, keyframe, maps):
        pass

    def __call__(self, coords, graph):
        window = self.odometry.window
        edges = (graph.ii, graph.jj, graph.kk)
        at = torch.tensor([round(f.timestamp * 10) for f in window.frames])
        exact = window.patches[None].clone()
        x, y = exact[0, :, 0, 1, 1].long() * 4, exact[0, :, 1, 1, 1].long() * 4
        frame = at.repeat_interleave(self.odometry.config.patches)
        exact[0, :, 2] = 1 / self.clip.depth[frame, y, x][:, None, None]
        true = reproject(self.clip.poses_cw[at][None], exact, window.intrinsics[None], *edges)
        target, centre = true.coords[:, :, 1, 1], coords[:, :, 1, 1]
        w, h = coords.new_tensor(self.odometry.patch_window.bounds)
        inside = (target >= 0).all(-1) & (target[..., 0] < w) & (target[..., 1] < h)
        seen = true.valid[:, :, 1, 1] & inside
        return Correlation([torch.cat([target - centre, seen[..., None].float()], -1)])


class Copy(torch.nn.Module):
    """Update operator that hands on what the look-up found."""

    def forward(self, hidden, context, correlation, graph):
        found = correlation.levels[0]
        return hidden, found[..., :2], found[..., 2:].expand(-1, -1, 2)


def perfect(clip, config):
    """A tracker whose operator and correlation are exchanged for ones that know the truth."""
    torch.manual_seed(0)
    model = PatchVO(preset("tiny"))
    model.update = Copy()
    odometry = PatchOdometry(model, config)
    odometry.patch_window.correlation = TrueFlow(odometry, clip)
    return odometry


@pytest.mark.long
@pytest.mark.parametrize("index", [0, *(pytest.param(index, marks=pytest.mark.slow) for index in (2, 6))])
def test_exact_flow_gives_the_exact_trajectory(index):
    clip = make_clip(21, index, frames=40, height=96, width=128, flow_range=(2.0, 4.0), sensor=False)
    fx, fy, cx, cy = clip.intrinsics[0].tolist()
    camera = Camera(fx, fy, cx, cy, 128, 96)
    odometry = perfect(clip, CONFIG)
    states = []
    for i, image in enumerate(clip.images):
        frame = Frame(i, 0.1 * i, image.permute(1, 2, 0).contiguous().numpy(), camera)
        states.append(odometry.track(frame).status)
    result = odometry.finish()
    truth = se3.inverse(clip.poses_cw.double()).numpy()
    m = evaluate(result.trajectory, Trajectory(0.1 * np.arange(40), truth), rpe_gap=1)
    assert states[-1] is Status.TRACKING
    assert m.matched == 40
    assert m.ate_percent < 0.1
    assert m.rotation_error_ratio < 1e-3
