"""Alignment of training clips: the measurements of the tracker's alignment, and gradients through it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.map.edges import build_graph
from dvo.models.clip_alignment import ClipAlignment
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import training_schedule
from dvo.models.step import Revision, UpdateState
from dvo.nets.alignment.alignment import AlignmentOptions
from dvo.nets.patch.config import preset
from dvo.nets.patch.patchifier import patch_coordinates
from dvo.nets.patch.selection import structure_selection
from dvo.odometry.window.alignment import WindowAlignment
from dvo.synth.clip import make_clip

PER_FRAME = 6


@pytest.fixture(scope="module")
def measured():
    """Clips with true geometry, and measurements a tenth of a feature pixel off."""
    clips = [make_clip(11, i, frames=3, height=96, width=128, flow_range=(1.0, 4.0), sensor=False) for i in range(2)]
    images = torch.stack([clip.images for clip in clips])
    centres = structure_selection(images, PER_FRAME, torch.Generator().manual_seed(0)).long()
    stride = PatchVO.config_type.STRIDE
    depth = torch.stack([clip.static_depth[:, ::stride, ::stride] for clip in clips])
    b, n, m, _ = centres.shape
    at = (torch.arange(b)[:, None, None], torch.arange(n)[None, :, None], centres[..., 1], centres[..., 0])
    patches = patch_coordinates(centres, (1 / depth[at]).reshape(b, n * m), 3)
    kk, jj = torch.meshgrid(torch.arange(n * m), torch.arange(n), indexing="ij")
    keep = (kk // m != jj).flatten()
    kk, jj = kk.flatten()[keep], jj.flatten()[keep]
    graph = build_graph(kk // m, jj, kk)
    poses = torch.stack([clip.poses_cw for clip in clips])
    intrinsics = torch.stack([clip.intrinsics for clip in clips]) / stride
    coords = reproject(poses, patches, intrinsics, graph.ii, graph.jj, graph.kk).coords
    empty = torch.zeros(b, n * m, 1), torch.zeros(b, len(kk), 1)
    state = UpdateState(graph, poses, patches, intrinsics, *empty, coords)
    off = 0.1 * torch.randn(b, len(kk), 2, generator=torch.Generator().manual_seed(1))
    revision = Revision(coords, empty[1], off.requires_grad_(), torch.full_like(off, 0.5).requires_grad_())
    return images, state, revision, coords[:, :, 1, 1]


def test_measurements_come_nearer_to_the_truth_and_weigh_more(measured):
    images, state, revision, truth = measured
    found = ClipAlignment(images)(state, revision)
    good = found.weights[..., 0] > 1
    assert good.float().mean() > 0.3
    before, after = ((x.detach() - truth)[good].norm(dim=-1).median() for x in (revision.targets, found.targets))
    assert after < 0.5 * before
    assert torch.equal(found.targets[~good], revision.targets[~good])


def test_gradients_pass_through_the_alignment(measured):
    images, state, revision, _ = measured
    found = ClipAlignment(images, AlignmentOptions(iterations=1))(state, revision)
    good = (found.weights[..., 0] > 1)[..., None]
    ours, weights = torch.autograd.grad(
        (found.targets * good).sum() + found.weights.sum(), (revision.delta, revision.weights)
    )
    assert torch.isfinite(ours).all() and (ours * good).abs().sum() > 0 and (ours * ~good).abs().sum() == 0
    assert torch.equal(weights, torch.where(good, 10.0, 1.0).expand_as(weights))


def test_it_is_the_alignment_of_the_tracker(measured):
    images, state, revision, _ = measured
    found = ClipAlignment(images)(state, revision)
    graph = state.graph
    for clip in range(len(images)):
        window = SimpleNamespace(
            patches=state.patches[clip], kk=graph.kk, ii=graph.ii, jj=graph.jj, map_slots=torch.arange(3),
            edge_slots=torch.arange(len(graph.kk)), slopes=None,
        )  # fmt: skip
        tracker = WindowAlignment(window, AlignmentOptions(), torch.device("cpu"))
        for frame, image in enumerate(images[clip]):
            tracker.keep_image(frame, np.ascontiguousarray(image.permute(1, 2, 0).numpy()))
        tracker.forget(torch.arange(len(graph.kk)))
        part = replace(
            revision, **{k: getattr(revision, k)[clip : clip + 1] for k in ("coords", "hidden", "delta", "weights")}
        )
        theirs = tracker(state, part)
        same = (theirs.weights[0] > 1) == (found.weights[clip] > 1)
        assert same.float().mean() > 0.95  # OpenCV rounds grey levels to whole numbers
        close = (theirs.targets[0] - found.targets[clip]).norm(dim=-1)[same.all(-1)]
        assert close.median() < 0.005


def test_the_last_updates_of_a_clip_are_aligned():
    clip = make_clip(3, 0, frames=4, height=64, width=96, flow_range=(1.0, 4.0))
    torch.manual_seed(0)
    net = PatchVO(replace(preset("tiny"), selection="structure"))
    stages = training_schedule(4, net.config.training_patches, 3)

    def states(**options):
        given = {"poses_cw": se3.identity(1, 4), "generator": torch.Generator().manual_seed(0)}
        return list(net.unroll(clip.images[None], clip.intrinsics[None], stages, **given, **options))

    plain, aligned = states(), states(align_last=1)
    assert all(torch.equal(a.poses_cw, b.poses_cw) for a, b in zip(plain[:2], aligned[:2], strict=True))
    assert not torch.equal(plain[2].targets, aligned[2].targets)
    assert torch.equal(plain[2].confidence, aligned[2].confidence)
    aligned[2].poses_cw.sum().backward()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in net.parameters())
