"""Alignment of the edges that leave a window, and what the tracker makes of it."""

import itertools

import numpy as np
import pytest
import torch

import dvo
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.map.window import Keyframe, Window
from dvo.metrics import evaluate
from dvo.nets.alignment.alignment import AlignmentOptions, patch_warps
from dvo.nets.patch.patchifier import patch_coordinates
from dvo.odometry.depth.patch_depth import followed_planes
from dvo.odometry.window.alignment import WindowAlignment
from dvo.session.session import run
from dvo.synth.sequence import make_sequence

SIZE, SHIFT = (96, 128), 3  # the second image is the first, shifted to the right by so many pixels
ERROR = torch.tensor([0.15, -0.1])  # of the measurements, feature pixels


def picture():
    generator = np.random.default_rng(0)
    coarse = generator.uniform(0, 255, (32, 48))
    return np.kron(coarse, np.ones((4, 4)))[:96, :160].astype(np.uint8)


@pytest.fixture
def two_frames():
    """A window of two frames of a plane, with the true shift measured with an error, and its alignment."""
    wide = picture()
    images = [np.repeat(wide[:, at : at + 128, None], 3, -1) for at in (16, 16 - SHIFT)]
    window = Window.empty(4, 3, 8, torch.device("cpu"))
    alignment = WindowAlignment(window, AlignmentOptions(), torch.device("cpu"))
    centres = torch.tensor([[[[8, 6], [16, 12], [24, 16], [0, 12]]]])
    patches = patch_coordinates(centres, torch.ones(1, 4), 3)[0]
    for i, image in enumerate(images):
        slot = window.free_map_slot()
        alignment.keep_image(slot, image)
        frame = Keyframe(i, float(i), slot, torch.zeros(4, 1), torch.zeros(4, 8), torch.zeros(4, 3), torch.ones(4))
        window.append(frame, se3.identity(), patches)
    kk = torch.arange(4)
    window.connect(kk, torch.ones_like(kk))
    window.targets = patches[:, :2, 1, 1] + torch.tensor([SHIFT / 4, 0.0]) + ERROR
    window.weights = torch.full((4, 2), 0.5)
    return window, alignment


@pytest.fixture(scope="module")
def clip():
    return make_sequence(77, frames=24, height=192, width=256, fps=15.0, family="street", kind="handheld", apart=True)


def tracked(clip, **settings):
    done = run(dvo.load("small", seed=0, selection="structure", **settings), clip)
    return done.result.trajectory


@pytest.mark.slow
def test_the_tracker_is_more_exact_with_it_and_repeats_itself(clip):
    plain, aligned, again = (tracked(clip, align=align) for align in ("none", "final", "final"))
    assert np.array_equal(aligned.poses_wc, again.poses_wc)
    errors = [evaluate(x, clip.groundtruth, rpe_gap=2).rpe_rot_deg for x in (plain, aligned)]
    assert len(aligned) == 24 and errors[1] < 0.75 * errors[0]


@pytest.mark.slow
def test_slopes_of_surfaces_are_found_from_all_edges_of_a_patch():
    """In a hall, mostly seen at an angle: the slopes are those of the rendered depth, and the poses more exact."""
    walk = make_sequence(77003, frames=60, height=240, width=320, fps=15.0, family="hall", kind="handheld", apart=True)
    images, errors = list(walk), {0.0: [], 0.03: []}
    for slope, seed in itertools.product(errors, range(3)):
        odometry = dvo.load("small", seed=seed, loops=False, align_slope=slope, network_motion=0.0)
        for frame in images:
            odometry.track(frame)
        window = odometry.window
        if slope == 0:
            assert window.slopes is None
        else:
            found, true = [], []
            for k, frame in enumerate(window.frames[:-4]):  # the newest have been seen from about one place only
                if frame.slopes is not None:
                    centres = window.patches[k * window.per_frame : (k + 1) * window.per_frame, :2, 1, 1].numpy() * 4
                    depth = walk.rendering(round(frame.timestamp * 15)).depth[0].numpy()
                    metres, slopes = followed_planes(depth, frame.image.mean(2), centres.astype(float))
                    told = np.isfinite(metres) & (frame.slopes != 0).any(1).numpy()
                    found.append(frame.slopes.numpy()[told])
                    true.append(4 * slopes[told])
            found, true = np.concatenate(found), np.concatenate(true)
            wrong, none = (np.median(np.abs(x).max(1)) for x in (found - true, true))
            assert len(found) > 30 and none > 0.04 and wrong < 0.3 * none
        errors[slope].append(evaluate(odometry.finish().trajectory, walk.groundtruth).ate_rmse)
    assert sum(errors[0.03]) < 0.8 * sum(errors[0.0]), errors


def test_measurements_that_leave_the_window_are_replaced_once(two_frames):
    window, alignment = two_frames
    alignment.finalise(torch.tensor([0, 2, 3]))
    truth = window.patches[:4, :2, 1, 1] + torch.tensor([SHIFT / 4, 0.0])
    found = (window.targets - truth).norm(dim=-1)
    assert (found[[0, 2]] < 0.01).all() and torch.allclose(found[[1, 3]], ERROR.norm())
    assert window.weights[:, 0].tolist() == [5.0, 0.5, 5.0, 0.5]  # edge 3: its window is not inside the image


def test_the_warp_of_a_slanted_surface_is_that_of_its_plane():
    """By reprojection of the corners of a window with the inverse depths of the plane."""
    slopes = torch.tensor([[0.03, -0.02], [0.0, 0.0]])
    window = Window.empty(2, 3, 8, torch.device("cpu"))
    alignment = WindowAlignment(window, AlignmentOptions(), torch.device("cpu"))
    focal = torch.tensor([20.0, 21.0, 16.0, 12.0])
    patches = patch_coordinates(torch.tensor([[[[9.0, 7.0], [20.0, 15.0]]]]), torch.tensor([[0.5, 0.25]]), 3)[0]
    for i in range(2):
        none = torch.zeros(2, 1)
        frame = Keyframe(i, float(i), i, none, torch.zeros(2, 8), none, focal, slopes=slopes if i == 0 else None)
        window.append(frame, se3.exp(i * torch.tensor([0.3, 0.1, -0.2, 0.02, -0.03, 0.05])), patches)
    window.connect(torch.arange(2), torch.ones(2, dtype=torch.long))
    at = window.poses_cw[None], window.intrinsics[None], window.ii, window.jj, window.kk
    flat = reproject(at[0], window.patches[None], *at[1:]).coords[0]
    found = patch_warps(flat, alignment.tilts(torch.arange(2)))
    tilted = window.patches.clone()
    offsets = tilted[:, :2] - tilted[:, :2, 1:2, 1:2]
    tilted[:, 2] *= 1 + torch.einsum("kc,kcpq->kpq", window.slopes, offsets)
    torch.testing.assert_close(found, patch_warps(reproject(at[0], tilted[None], *at[1:]).coords[0]), atol=1e-4, rtol=0)
    assert (found - patch_warps(flat)).abs().amax((1, 2)).tolist() == [pytest.approx(0.09, abs=0.06), 0]
    for frame in window.frames:
        frame.slopes = None
    assert alignment.tilts(torch.arange(2)) is None
