"""Odometry of the dense network: around a network that knows the flow, with a random one, and on bad input."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import dvo
from dvo.ba.layer.dense import dense_patches
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.geometry.projection import reproject
from dvo.metrics import evaluate
from dvo.models.droid import DroidVO
from dvo.models.weights import LoadedWeights, save_weights
from dvo.nets.droid.dense_update import DenseRevision
from dvo.nets.droid.droid import preset
from dvo.odometry.droid import frame as dense_frame
from dvo.odometry.droid import window as dense_window
from dvo.odometry.droid.config import DenseConfig
from dvo.odometry.droid.droid import DroidOdometry
from dvo.odometry.frames.content import NO_MATCH
from dvo.odometry.load import build_odometry
from dvo.odometry.protocol import Interim, Odometry, Status
from dvo.session.results import write_results
from dvo.session.session import run
from dvo.synth.clip import make_clip

SIZE = (96, 128)
EVERY = DenseConfig(
    pixels=0, filter_flow=0.0, keyframe_flow=0.0, warm_up=4, window=5, max_edges=12, initial_updates=2, restart=False,
)  # fmt: skip
CONFIG = DenseConfig(pixels=0, filter_flow=0.3, keyframe_flow=0.2, depth_confidence=0.2)


def frames_of(clip, start=0):
    fx, fy, cx, cy = clip.intrinsics[0].tolist()
    camera = Camera(fx, fy, cx, cy, SIZE[1], SIZE[0])
    images = [image.permute(1, 2, 0).contiguous().numpy() for image in clip.images]
    return [Frame(start + i, 0.1 * (start + i), image, camera) for i, image in enumerate(images)]


@pytest.fixture(scope="module")
def clip():
    return make_clip(21, 0, frames=24, height=SIZE[0], width=SIZE[1], flow_range=(2.0, 4.0), sensor=False)


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return DroidVO(preset("tiny")).eval()


def black(number, camera):
    return Frame(number, 0.1 * number, np.zeros((*SIZE, 3), np.uint8), camera)


class Knowing(DroidVO):
    """Its features are the number of the frame in a clip, its revisions what the look-up found."""

    def __init__(self, clip):
        super().__init__(preset("tiny"))
        self.clip, self.update = clip, Copy()

    def match_features(self, images):
        same = (self.clip.images == images[0]).flatten(1).all(1)
        number = float(same.nonzero()[0, 0]) if bool(same.any()) else -1.0
        return torch.full((1, 1, 1, SIZE[0] // 8, SIZE[1] // 8), number)

    def context(self, images):
        return torch.zeros(1, 1, 1, SIZE[0] // 8, SIZE[1] // 8), torch.zeros(1, 1, 3, SIZE[0] // 8, SIZE[1] // 8)


class Copy(torch.nn.Module):
    """Update operator that hands on what the look-up found."""

    def forward(self, hidden, gates, correlation, motion):
        found = correlation.permute(0, 1, 3, 4, 2)
        return DenseRevision(hidden, found[..., :2], found[..., 2:].expand(-1, -1, -1, -1, 2))

    def agg(self, hidden, ii, frames):
        return torch.full((1, frames, *hidden.shape[-2:]), 1e-6), None


def true_volume(clip):
    """Class of look-ups that give the true displacement from the present positions, and whether it is in view."""

    class TrueVolume:
        def __init__(self, source, target, pyramid, radius):
            self.pair = [int(source[0, 0, 0]), int(target[0, 0, 0])]

        def __call__(self, coords):
            if min(self.pair) < 0:  # another scene
                return torch.zeros(3, *coords.shape[:2])
            depth = clip.depth[self.pair][None, :, ::8, ::8]
            where = torch.tensor([0]), torch.tensor([1])
            poses, intrinsics = clip.poses_cw[self.pair][None], clip.intrinsics[self.pair][None] / 8
            there = reproject(poses, dense_patches(1 / depth), intrinsics, *where, where[0])
            target = there.coords[0, 0]
            h, w = coords.shape[:2]
            inside = (target >= 0).all(-1) & (target[..., 0] < w) & (target[..., 1] < h) & there.valid[0, 0]
            return torch.cat([target - coords, inside[..., None].float()], -1).permute(2, 0, 1)

    return TrueVolume


@pytest.fixture
def knowing(clip, monkeypatch):
    for module in (dense_window, dense_frame):
        monkeypatch.setattr(module, "PairVolume", true_volume(clip))
    return Knowing(clip)


@pytest.fixture(scope="module")
def tracked(clip):
    """The run of the clip with the network that knows the flow."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (dense_window, dense_frame):
            patch.setattr(module, "PairVolume", true_volume(clip))
        return run(DroidOdometry(Knowing(clip), CONFIG), frames_of(clip))


@pytest.mark.long
def test_true_flow_gives_the_true_trajectory_and_depth(clip, tracked):
    done = tracked.result
    assert done.frames_lost == 0 and len(done.trajectory) == len(clip.images) and len(done.segments) == 1
    truth = se3.inverse(clip.poses_cw.double()).numpy()
    scores = evaluate(done.trajectory, Trajectory(done.trajectory.timestamps, truth))
    assert scores.ate_percent < 1.0
    assert 4 <= len(done.depth) < len(clip.images)
    ratios = []
    for found in done.depth:
        number = round(found.timestamp * 10)
        true = clip.depth[number, ::8, ::8].numpy()
        ratios.append(found.depth[found.reliable] / true[found.reliable])
        assert found.depth.shape == true.shape
    ratios = np.concatenate(ratios)
    assert np.mean([found.reliable.mean() for found in done.depth]) > 0.3
    assert np.mean(np.abs(ratios / np.median(ratios) - 1) < 0.03) > 0.9
    assert len(done.map.points) == sum(int(found.reliable.sum()) for found in done.depth) == len(done.map.colors)


@pytest.mark.slow
def test_a_moving_body_does_not_pull_the_camera(clip, monkeypatch):
    volume = true_volume(clip)

    class Moving(volume):
        """A tenth of the map shows a body that swings by up to 3 feature pixels."""

        def __call__(self, coords):
            found = super().__call__(coords)
            h, w = coords.shape[:2]
            (x, y), (u, v) = ((3 * np.sin(1.7 * number), 3 * np.cos(2.3 * number)) for number in self.pair)
            found[:2, : h // 3, : w // 3] += torch.tensor([[[u - x]], [[v - y]]])
            return found

    for module in (dense_window, dense_frame):
        monkeypatch.setattr(module, "PairVolume", Moving)
    truth, errors = se3.inverse(clip.poses_cw.double()).numpy(), []
    for robust in (1.0, 0.0):
        done = run(DroidOdometry(Knowing(clip), replace(CONFIG, robust=robust)), frames_of(clip)).result
        times = done.trajectory.timestamps
        rows = [round(time * 10) for time in times]
        errors.append(evaluate(done.trajectory, Trajectory(times, truth[rows])).ate_percent)
    assert errors[0] < 0.5 * errors[1] and errors[1] > 2


@pytest.mark.long
def test_more_updates_than_an_edge_lives_for(clip, knowing):
    settings = replace(CONFIG, initial_updates=6, updates=8, max_age=4)
    done = run(DroidOdometry(knowing, settings), frames_of(clip)[:14]).result
    truth = se3.inverse(clip.poses_cw[:14].double()).numpy()
    assert len(done.trajectory) == 14
    assert evaluate(done.trajectory, Trajectory(done.trajectory.timestamps, truth)).ate_percent < 2


@pytest.mark.long
def test_another_scene_is_lost_and_then_begins_a_segment(clip, knowing):
    odometry = DroidOdometry(knowing, replace(CONFIG, patience=3))
    first = frames_of(clip)[:14]
    rng = np.random.default_rng(0)
    other = [rng.integers(0, 255, (12, 16, 3), np.uint8).repeat(8, 0).repeat(8, 1) for _ in range(4)]
    foreign = [Frame(14 + i, 0.1 * (14 + i), image, first[0].camera) for i, image in enumerate(other)]
    done = [odometry.track(frame) for frame in (*first, *foreign)]
    assert done[13].status is Status.TRACKING
    assert [(e.status, e.reason) for e in done[14:16]] == [(Status.LOST, NO_MATCH)] * 2
    assert done[16].status is Status.INITIALISING and done[16].segment == 1
    assert odometry.finish().segments[0].trajectory.timestamps[-1] == first[-1].timestamp


@pytest.mark.long
def test_black_images_are_lost_and_bridged(clip, knowing):
    odometry = DroidOdometry(knowing, CONFIG)
    frames = frames_of(clip)[:18]
    frames[15] = black(15, frames[0].camera)
    done = [odometry.track(frame) for frame in frames]
    assert (done[15].status, done[15].reason, done[15].pose_wc) == (Status.LOST, "black image", None)
    assert done[16].status is Status.TRACKING
    result = odometry.finish()
    assert len(result.segments) == 1 and result.frames_lost == 1
    (gap,) = result.breaks
    assert (gap.frames, gap.reason, gap.new_segment) == (1, "black image", False)


@pytest.mark.long
def test_a_random_network_tracks_a_clip(model, clip):
    """The images support no pose here: every stage of the odometry is run, and memory stays bounded."""
    odometry = build_odometry(LoadedWeights.of(model, "dense"), config=replace(EVERY, restart=True))
    assert isinstance(odometry, Odometry) and isinstance(odometry, Interim) and odometry.name == "dvo-dense"
    for number, frame in enumerate(frames_of(clip)[:12]):
        estimate = odometry.track(frame)
        assert (estimate.pose_wc is not None) == (estimate.status is Status.TRACKING)
        assert estimate.status is (Status.TRACKING if number >= 3 else Status.INITIALISING)
        window = odometry.mapper.window
        assert len(window) <= EVERY.window and len(window.edges) <= EVERY.max_edges
        assert len(window.held) <= EVERY.max_held
    before = odometry.current()
    result = odometry.finish()
    assert len(result.trajectory) == 12 and np.isfinite(result.trajectory.poses_wc).all()
    assert np.array_equal(before.trajectory.poses_wc, result.trajectory.poses_wc)
    assert len(result.depth) == 12 == result.info["keyframes"]


@pytest.mark.long
def test_the_same_frames_give_the_same_bytes(model, clip):
    a, b = (run(DroidOdometry(model, EVERY), frames_of(clip)[:6]).result for _ in range(2))
    assert a.trajectory.poses_wc.tobytes() == b.trajectory.poses_wc.tobytes()
    assert a.map.points.tobytes() == b.map.points.tobytes() and len(a.depth) == 6
    assert all(x.depth.tobytes() == y.depth.tobytes() for x, y in zip(a.depth, b.depth, strict=True))


def test_frames_without_motion_stay_at_their_keyframe(model, clip):
    """Nothing is solved; every frame has the pose of the first one, repeated images included."""
    first = frames_of(clip)[:5]
    first[2] = replace(first[2], image=first[1].image)
    result = run(DroidOdometry(model, replace(EVERY, filter_flow=1e4)), first).result
    assert len(result.trajectory) == 5 and result.frames_lost == 0 and result.depth == ()
    assert np.array_equal(result.trajectory.poses_wc, np.tile([0.0, 0, 0, 0, 0, 0, 1], (5, 1)))


@pytest.mark.long
def test_few_keyframes_are_initialised_at_the_end(clip, knowing):
    result = run(DroidOdometry(knowing, replace(CONFIG, warm_up=8)), frames_of(clip)[:9]).result
    assert len(result.trajectory) == 9 and 2 <= len(result.depth) < 8
    truth = se3.inverse(clip.poses_cw[:9].double()).numpy()
    assert np.ptp(result.trajectory.poses_wc[:, :3], axis=0).max() > 0.01
    scores = evaluate(result.trajectory, Trajectory(result.trajectory.timestamps, truth))
    assert scores.ate_percent < 10


def test_depth_maps_are_bounded(model, clip):
    result = run(DroidOdometry(model, replace(EVERY, max_depth_maps=2)), frames_of(clip)[:6]).result
    assert len(result.depth) == 2 and len(result.trajectory) == 6


def test_finish_after_any_number_of_frames(model, clip):
    nothing = DroidOdometry(model, EVERY).finish()
    assert len(nothing.trajectory) == 0 and nothing.segments == () and nothing.depth == ()
    dark = DroidOdometry(model, EVERY)
    first, second = frames_of(clip)[:2]
    dark.track(black(0, first.camera))
    assert dark.finish().frames_lost == 1
    one = DroidOdometry(model, EVERY)
    one.track(first)
    assert len(one.finish().trajectory) == len(one.finish().trajectory) == 1
    with pytest.raises(DvoError, match="finished"):
        one.track(second)


@pytest.mark.long
def test_the_cloud_is_written_as_the_map(tracked, tmp_path):
    write_results(tmp_path, tracked, {})
    header = (tmp_path / "map.ply").read_bytes().split(b"end_header")[0].decode()
    points = tracked.result.map.points
    assert f"element vertex {len(points)}" in header and len(points) > 100


@pytest.mark.parametrize(
    ("settings", "name"),
    [({"patches": 3}, "patches"), ({"window": 2}, "window"), ({"warm_up": 60}, "warm_up"),
     ({"preset": "best"}, "preset"), ({"seed": -1}, "seed"), ({"filter_flow": -1.0}, "filter_flow")],
)  # fmt: skip
def test_bad_settings_are_named(model, settings, name):
    with pytest.raises(DvoError, match=name):
        build_odometry(LoadedWeights.of(model, "dense"), **settings)


def test_weights_files_give_the_odometry(model, tmp_path):
    file = tmp_path / "dense.safetensors"
    save_weights(file, model, {}, half=False)
    odometry = dvo.load(str(file), preset="fast", window=9)
    assert isinstance(odometry, DroidOdometry) and odometry.config.window == 9 and odometry.config.updates == 2
