"""A package outside ``dvo``, ``train`` and ``eval`` (``tests/outside``) brings a network, an odometry, a training task,
an update operator, a factor, a reader, a system, a scene family, a trajectory format, a metric, a calibration dialect,
a place descriptor, a selection of patches, a loss term and a sensor of the window. It is announced by entry points, as
an installed package is, and each part is run by the ordinary commands without editing a file."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

from dvo.ba.layer.layer import BADamping, BAOptions, bundle_adjust
from dvo.data.trajectory import Trajectory, write_tum
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.nets.patch.patchifier import patch_coordinates

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = ROOT / "tests" / "outside"
NAME = "distance_vo"


def command(*arguments, cwd=ROOT, told=""):
    """Run ``python ARGUMENTS`` with the package on the path and a text to read; returns what it printed."""
    path = os.pathsep.join([str(OUTSIDE), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=cwd, env={**os.environ, "PYTHONPATH": path}, capture_output=True,
        text=True, timeout=600, input=told,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recording in a layout that only the reader of the package knows."""
    folder = tmp_path_factory.mktemp("outside") / "walk"
    folder.mkdir()
    images = np.random.default_rng(0).integers(0, 255, (6, 48, 64, 3), dtype=np.uint8)
    np.save(folder / "frames.npy", images)
    (folder / "calib.txt").write_text("50 50 31.5 23.5\n")
    times = np.arange(6) / 10
    write_tum(folder / "groundtruth.txt", Trajectory(times, np.column_stack([times, np.zeros((6, 5)), np.ones(6)])))
    return folder


# One process does what the tests below look at, because its start takes most of the time. Each part prints a line.
PARTS = {
    "announced": """
from dvo.models.registry import ARCHITECTURES; from dvo.odometry.registry import ODOMETRIES
from dvo.data.readers.registry import READERS; from dvo.synth.scenes.families import FAMILIES
from train.tasks.registry import TASKS; from eval.systems.registry import SYSTEMS
from eval.scoring.metric_table import METRICS; from dvo.data.calibration.read import DIALECTS
from dvo.odometry.loops.place_descriptors import PLACE_DESCRIPTORS
from train.tasks.patch_vo.objective import LOSS_TERMS
print([n in r for n, r in (('distance_vo', ARCHITECTURES), ('distance_vo', ODOMETRIES), ('array', READERS),
    ('shed', FAMILIES), ('distance_vo', TASKS), ('standing-still', SYSTEMS), ('end_error', METRICS),
    ('focal', DIALECTS), ('mean_colour', PLACE_DESCRIPTORS), ('nearness', LOSS_TERMS))])
""",
    "update operator": """
from dataclasses import replace; from dvo.nets.patch.config import preset
from dvo.models.patch_vo import PatchVO
model = PatchVO(replace(preset('tiny'), update_operator='still'))
intrinsics = torch.tensor([50.0, 50, 32, 24]).expand(1, 3, 4)
state = model(torch.zeros(1, 3, 3, 48, 64, dtype=torch.uint8), intrinsics, updates=2)
print(type(model.update).__name__, float(state.poses_cw[..., :3].abs().max()) < 1e-4)
""",
    "metric": """
from eval.suites.suite import read_suite
print(read_suite(folder / 'a.yaml').sequences[0].judged_by)
""",
    "place descriptor": """
found = dvo.load('small', loop={'descriptor': 'mean_colour'}).loops.finder
print(found.descriptor.name, found.places.dimensions)
""",
    "patch selection": """
odometry = dvo.load('small', selection='middle_row', patches=5)
odometry.track(next(iter(dvo.open(recording))))
print(odometry.window.patches[:, 1, 1, 1].tolist())
""",
    "sensor": """
from dvo.synth.sequence import make_sequence; from dvo.geometry import se3; from dataclasses import replace
size = {'frames': 24, 'height': 96, 'width': 128, 'fps': 10.0}
clip = make_sequence(5, family='room', kind='straight', speed=4.0, **size)
odometry = dvo.load('small', pixels=0, patches=24, sensors='tape')
for frame in clip: odometry.track(frame)
# A frame without content and a repeated one are seen too.
for time in (2.4, 2.5): odometry.track(replace(frame, timestamp=time, image=0 * frame.image))
frames, poses = odometry.window.frames, odometry.window.poses_cw
steps = se3.inverse(poses)[:, :3].diff(dim=0).norm(dim=1)
wanted = 2 * torch.tensor([f.timestamp for f in frames]).diff()
print(odometry.sensors[0].seen, len(frames) > 3, bool((steps / wanted - 1).abs().max() < 0.05),
    all(abs(float(f.states['tape']) - 2 * f.timestamp) < 0.02 for f in frames))
""",
    "loss term": """
from train.tasks.patch_vo.objective import LossConfig, Terms
from train.tasks.patch_vo.task import PatchVOTask; from train.tasks.task import StepContext
found = {}
for weight in (0.0, 2.0):
    loss = LossConfig(terms={'nearness': weight})
    task = PatchVOTask('tiny', updates=2, warmup_until=0.0, patches=4, loss=loss); torch.manual_seed(0)
    net = task.network(); context = StepContext(net, 0, task.buffers())
    g = torch.Generator().manual_seed(0); poses = torch.zeros(1, 8, 7); poses[..., 6] = 1
    poses[..., 0] = 0.1 * torch.arange(8)
    batch = {'images': torch.randint(0, 255, (1, 8, 3, 48, 64), generator=g, dtype=torch.uint8),
        'depth': torch.ones(1, 8, 48, 64), 'poses_cw': poses,
        'intrinsics': torch.tensor([50.0, 50, 32, 24]).expand(1, 8, 4)}
    step = task.accept_loss(context, task.compute_loss(context, batch))
    found[weight] = float(step.loss), float(step.measures['loss_nearness'])
print(found[2.0][1] > 0, abs(found[2.0][0] - found[0.0][0] - found[2.0][1]) < 1e-4 * found[2.0][0])
""",
    "odometry": "print(dvo.load('standing-still', height=2.0).name)",
    "export": "command('export', folder / 'results', folder / 'exported', '--to', 'positions')",
    "run": "command('run', recording, '--system', 'standing-still', '--set', 'height=1.5', '--out', folder / 'out')",
    "dialect": "command('run', recording, '--system', 'standing-still', '--calib', folder / 'camera.txt', "
    "'--out', folder / 'focal')",
    "scene": "command('synth', 'preview', 'shed', '--rows', '1', '--size', '48x32', '--out', folder / 'shed.png')",
}
PROGRAM = """
import contextlib, io, json, sys
from pathlib import Path
import torch, dvo
from dvo.cli import main

def command(*arguments):
    assert main([str(argument) for argument in arguments]) == 0

folder, recording = map(Path, sys.argv[1:])
told = {}
for name, part in json.load(sys.stdin).items():
    with contextlib.redirect_stdout(io.StringIO()) as text:
        exec(part, dict(globals()))
    told[name] = text.getvalue().strip()
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def done(recording, tmp_path_factory):
    """What each of the parts has printed (``told``), and the folder of their files."""
    folder = tmp_path_factory.mktemp("parts")
    times = np.arange(4) / 10
    (folder / "results").mkdir()
    poses = np.column_stack([times, 2 * times, np.zeros((4, 4)), np.ones(4)])
    write_tum(folder / "results" / "trajectory.txt", Trajectory(times, poses))
    (folder / "camera.txt").write_text("FOCAL 60 64 48\n")
    (folder / "a.yaml").write_text("name: a\nlabel: b\nsequences: [{name: c, path: d, judged_by: end_error}]\n")
    told = json.loads(command("-c", PROGRAM, folder, recording, told=json.dumps(PARTS)).splitlines()[-1])
    return SimpleNamespace(told=told, folder=folder)


@pytest.mark.long
def test_export_in_a_format_of_the_package(done):
    assert "4 poses" in done.told["export"]
    times = np.arange(4) / 10
    found = np.loadtxt(done.folder / "exported" / "positions.csv", delimiter=",")
    np.testing.assert_allclose(found, np.column_stack([times, 2 * times, 0 * times]))


@pytest.mark.long
def test_parts_are_announced_without_a_call(done):
    assert done.told["announced"] == str([True] * 10)


@pytest.mark.long
def test_the_update_operator_is_chosen_by_a_word(done):
    assert done.told["update operator"] == "Still True"


@pytest.mark.long
@pytest.mark.slow
def test_train_export_and_run(recording, tmp_path):
    """Task, network, odometry and reader: trained, exported and tracked by the ordinary commands."""
    saver = {"dirpath": str(tmp_path), "save_last": True, "every_n_train_steps": 1, "enable_version_counter": False}
    settings = {
        "task": NAME,
        "trainer": {
            "accelerator": "cpu", "devices": 1, "max_epochs": -1, "max_steps": 2, "log_every_n_steps": 1,
            "enable_progress_bar": False, "enable_model_summary": False, "use_distributed_sampler": False,
            "default_root_dir": str(tmp_path), "logger": False,
            "callbacks": [{"class_path": "lightning.pytorch.callbacks.ModelCheckpoint", "init_args": saver}],
        },
        "model": {"channels": 3},
        "data": {"frames": 2, "sizes": [[48, 64]], "workers": 0},
    }  # fmt: skip
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(settings))
    command("-m", "train", "fit", "--config", tmp_path / "settings.yaml", cwd=ROOT)
    command("-m", "train", "export", tmp_path / "last.ckpt", tmp_path / "distance.safetensors")
    assert NAME in command("-m", "dvo", "weights", "info", tmp_path / "distance.safetensors")
    out = tmp_path / "out"
    command("-m", "dvo", "run", recording, "--weights", tmp_path / "distance.safetensors", "--out", out, "--device",
            "cpu", "--set", "gain=2.0")  # fmt: skip
    facts = json.loads((out / "run.json").read_text())
    assert facts["kind"] == "array" and facts["odometry"] == "dvo-distance" and facts["frames"]["tracked"] == 6


@pytest.mark.long
@pytest.mark.slow
def test_the_system_is_evaluated_beside_the_others(recording, tmp_path):
    sequence = {"name": "walk", "path": "walk", "groundtruth": "groundtruth.txt"}
    suite = {"name": "walks", "label": "a walk", "sequences": [sequence]}
    (tmp_path / "walks.yaml").write_text(yaml.safe_dump(suite))
    command("-m", "eval", "run", "--suite", tmp_path / "walks.yaml", "--systems", "standing-still+height=1.5,null",
            "--data", recording.parent, "--seeds", "1", "--out", tmp_path / "runs", "--threads", "1")  # fmt: skip
    with open(tmp_path / "runs" / "results.csv", newline="") as file:
        rows = {row["system"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"standing-still+height=1.5", "null"}
    # The camera of the truth moves by half a metre; the metric of the package takes the poses as they are.
    assert float(rows["standing-still+height=1.5"]["end_error"]) == pytest.approx(np.hypot(0.5, 1.5), abs=1e-6)
    assert "end error m" in (tmp_path / "runs" / "table.md").read_text()


@pytest.mark.long
def test_a_sequence_is_judged_by_the_metric(done):
    assert done.told["metric"] == "end_error"


@pytest.mark.long
def test_a_calibration_of_the_dialect_is_read(done):
    camera = json.loads((done.folder / "focal" / "run.json").read_text())["camera"]
    assert [camera[name] for name in ("fx", "fy", "cx", "cy")] == [60, 60, 31.5, 23.5]


@pytest.mark.long
def test_places_are_described_by_the_descriptor(done):
    assert done.told["place descriptor"] == "mean colour 3"


@pytest.mark.long
def test_patches_are_where_the_selection_puts_them(done):
    assert done.told["patch selection"] == str([6.0] * 5)


@pytest.mark.long
def test_the_sensor_takes_part_in_the_window(done):
    """It fixes the scale, its own unknowns come and go with the keyframes, and it has seen every frame."""
    assert done.told["sensor"] == "26 True True True"


@pytest.mark.long
def test_the_loss_term_is_in_the_loss_and_in_the_log(done):
    assert done.told["loss term"] == "True True"


@pytest.mark.long
def test_the_odometry_without_weights_tracks_on_the_command_line(done):
    """By its name, with a setting of its own; the reader is that of the package too."""
    poses = np.loadtxt(done.folder / "out" / "trajectory.txt")
    assert len(poses) == 6 and (poses[:, 2] == -1.5).all()
    assert done.told["odometry"] == "standing-still"


@pytest.mark.long
def test_the_scene_family_is_rendered(done):
    assert (done.folder / "shed.png").stat().st_size > 1000


def test_the_factor_fixes_the_scale(monkeypatch):
    """A scene that is 15 % too small is brought to the known distance of two cameras; gradients reach the distance."""
    monkeypatch.syspath_prepend(OUTSIDE)
    from distance_vo.factor import KnownDistance

    g = torch.Generator().manual_seed(0)
    n, m = 4, 12
    poses = se3.exp(0.1 * torch.randn(1, n, 6, generator=g, dtype=torch.float64))
    poses[:, 0] = se3.identity(dtype=torch.float64)
    centres = torch.randint(4, 36, (1, n, m, 2), generator=g)
    depth = 0.5 + torch.rand(1, n * m, generator=g, dtype=torch.float64)
    patches = patch_coordinates(centres, depth, 3)
    intrinsics = torch.tensor([40.0, 40, 20, 20], dtype=torch.float64).expand(1, n, 4)
    kk = torch.arange(n * m).repeat_interleave(n)
    jj = torch.arange(n).repeat(n * m)
    ii = kk // m
    targets = reproject(poses, patches, intrinsics, ii, jj, kk).coords[:, :, 1, 1]
    start, small = poses.clone(), patches.clone()
    start[..., :3] *= 0.85
    small[:, :, 2] /= 0.85
    apart = (se3.inverse(poses)[:, 0, :3] - se3.inverse(poses)[:, 3, :3]).norm(dim=-1, keepdim=True)
    apart.requires_grad_()
    factor = KnownDistance(apart, torch.full_like(apart, 1e4).detach(), torch.tensor([0]), torch.tensor([3]))
    options = BAOptions(iterations=12, damping=BADamping(1e-6, 1e-6, 1e-6), bounds=(40, 40))
    arguments = (start, small, intrinsics, targets, torch.ones_like(targets), ii, jj, kk, options)
    found = bundle_adjust(*arguments, factors=[factor])
    torch.testing.assert_close(found.poses_cw, poses, atol=1e-4, rtol=1e-4)
    assert (bundle_adjust(*arguments).poses_cw - poses).abs().max() > 0.02  # without it the scale stays
    (gradient,) = torch.autograd.grad(found.poses_cw[0, 3, :3].norm(), apart)
    expected = poses[0, 3, :3].norm() / apart.detach()  # the whole scene grows with the distance
    torch.testing.assert_close(gradient, expected, rtol=1e-2, atol=1e-3)
