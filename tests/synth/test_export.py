"""Sequences and meshes written in the layouts of data sets."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import dvo
from dvo.cli import main
from dvo.core.errors import DvoError
from dvo.data.inertial import NOISE_PRESETS, ImuNoise
from dvo.geometry.poses import look_rotation, pose_from
from dvo.synth import mesh_scene
from dvo.synth.export import OCCLUDED, OUT_OF_VIEW, Layout, export_sequence, mesh_sequence, static_flow
from dvo.synth.sequence import SyntheticSequence, make_sequence
from dvo.synth.specs import SequenceFormat


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    return make_sequence(6, frames=4, height=48, width=64, fps=12, family="street", sensor=False)


def check_read_back(folder: Path, sequence: SyntheticSequence, kind: str) -> None:
    source = dvo.open(folder)
    assert source.kind == kind
    frames = list(source)
    assert len(frames) == len(sequence)
    for frame, original in zip(frames, sequence, strict=True):
        assert np.array_equal(frame.image, original.image)
        assert frame.timestamp == pytest.approx(original.timestamp, abs=1e-6)
        assert np.allclose(frame.camera.intrinsics, sequence.camera.intrinsics, atol=1e-6)
    truth = source.groundtruth
    assert truth is not None and len(truth) == len(sequence)
    assert np.allclose(truth.poses_wc[:, :3], sequence.groundtruth.poses_wc[:, :3], atol=1e-6)
    turn = np.abs((truth.poses_wc[:, 3:] * sequence.groundtruth.poses_wc[:, 3:]).sum(1))
    assert np.allclose(turn, 1, atol=1e-9)


def test_tum_layout_reads_back(sequence: SyntheticSequence, tmp_path: Path) -> None:
    notes = export_sequence(sequence, tmp_path / "tum", "tum")
    check_read_back(tmp_path / "tum", sequence, "tum")
    assert any("13.1 m" in note for note in notes), "the sky is farther than 16 bits reach"
    rows = [row.split() for row in (tmp_path / "tum" / "depth.txt").read_text().splitlines() if row[0] != "#"]
    assert [row[1] for row in rows] == [f"depth/{row[0]}.png" for row in rows] and len(rows) == 4
    for index, (_, name) in enumerate(rows):
        stored = cv2.imread(str(tmp_path / "tum" / name), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16
        depth = sequence.rendering(index).depth[0].numpy()
        near = depth < 13.1
        assert near.any() and np.abs(stored[near] / 5000 - depth[near]).max() <= 0.5 / 5000 + 1e-6
        assert (stored[depth > 13.108] == 0).all()


def test_tartanair_layout_reads_back(sequence: SyntheticSequence, tmp_path: Path) -> None:
    folder = tmp_path / "P000"
    assert export_sequence(sequence, folder, "tartanair") == []
    check_read_back(folder, sequence, "tartanair")
    for index in range(4):
        stored = np.load(folder / "depth_left" / f"{index:06d}_left_depth.npy")
        assert np.array_equal(stored, sequence.rendering(index).depth[0].numpy())
    # NED: a camera that looks along y has its x axis there.
    first = np.loadtxt(folder / "pose_left.txt")[0]
    x, y, z, w = first[3:]
    forward = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
    ours = look_rotation(np.array(forward), np.array([0.0, 0, 1]))
    seen = sequence.path.poses_wc(np.zeros(1))[0, 3:]
    assert np.allclose(pose_from(ours, np.zeros(3))[3:] @ seen, 1, atol=0.02)
    flow, mask = (np.load(folder / "flow" / f"000000_000001_{name}.npy") for name in ("flow", "mask"))
    assert flow.shape == (48, 64, 2) and flow.dtype == np.float32 and set(np.unique(mask)) <= {0, 1, 100}
    assert (mask == 0).mean() > 0.5


def test_flow_knows_what_is_hidden_and_out_of_view() -> None:
    """A board before a wall; the camera steps sideways, by whole pixels of both."""
    first, second = np.full((20, 40), 4.0), np.full((20, 40), 4.0)
    first[5:15, 20:30], second[5:15, 10:20] = 2.0, 2.0
    pose = np.tile([0, 0, 0, 0, 0, 0, 1.0], (2, 1))
    pose[1, 0] = 0.5
    flow, mask = static_flow(first, second, pose, (40.0, 40.0, 19.5, 9.5))
    board = first == 2
    assert np.allclose(flow[board], [-10, 0]) and np.allclose(flow[~board], [-5, 0])
    assert (mask[:, :5] == OUT_OF_VIEW).all() and (mask[board] == 0).all()
    assert (mask[7:13, 17:20] == OCCLUDED).all() and (mask[:4, 5:] == 0).all()


@pytest.mark.long
def test_mesh_sequence_reads_back_with_the_background_as_no_depth(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = mesh_scene(trimesh.creation.icosphere(subdivisions=2), ground=False)
    sequence = mesh_sequence(scene, 1, SequenceFormat(3, 48, 64, fps=10))
    export_sequence(sequence, tmp_path / "ball", "tartanair")
    check_read_back(tmp_path / "ball", sequence, "tartanair")
    depth = np.load(tmp_path / "ball" / "depth_left" / "000001_left_depth.npy")
    assert (depth == 0).any() and (depth > 0).any()
    again = mesh_sequence(scene, 1, SequenceFormat(3, 48, 64, fps=10))
    assert np.array_equal(again.frame(2).image, sequence.frame(2).image)


@pytest.mark.long
@pytest.mark.parametrize(("lens", "noise"), [("radtan", None), ("fisheye", NOISE_PRESETS["phone"])])
def test_euroc_layout_reads_back(lens: str, noise: ImuNoise | None, tmp_path: Path) -> None:
    """Images, camera, times, poses and every inertial sample are those that were rendered."""
    sequence = make_sequence(6, frames=4, height=48, width=64, fps=12, family="street", sensor=False, lens=lens)
    assert export_sequence(sequence, tmp_path / "s", "euroc", noise=noise) == []
    source = dvo.open(tmp_path / "s", undistort=False)
    assert (source.kind, source.warnings, source.camera.model) == ("euroc", [], lens)
    for frame, original in zip(source, sequence, strict=True):
        assert np.array_equal(frame.image, original.image)
        assert frame.timestamp == pytest.approx(original.timestamp, abs=1e-9)
        assert np.allclose(frame.camera.intrinsics, original.camera.intrinsics, atol=1e-12)
        assert np.allclose(frame.camera.coefficients, original.camera.coefficients, atol=1e-12)
    truth, imu, samples = source.groundtruth, sequence.imu(200.0, noise=noise), source.inertial
    assert truth is not None and samples is not None
    assert np.allclose(truth.poses_wc, sequence.groundtruth.poses_wc, atol=1e-9)
    assert np.array_equal(samples.gyro, imu.gyro) and np.array_equal(samples.accel, imu.accel)
    assert samples.timestamps == pytest.approx(imu.timestamps, abs=1e-9)
    assert samples.T_camera_imu == pytest.approx([0, 0, 0, 0, 0, 0, 1])
    stated = None if samples.noise is None else (samples.noise.gyro, samples.noise.accel_walk)
    assert stated == (None if noise is None else (noise.gyro, noise.accel_walk))


def test_states_of_the_euroc_layout(sequence: SyntheticSequence, tmp_path: Path) -> None:
    """Velocities are those of the positions, biases those in the samples."""
    export_sequence(sequence, tmp_path / "s", "euroc", noise=NOISE_PRESETS["phone"])
    file = tmp_path / "s" / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    table = np.loadtxt(file, delimiter=",", comments="#")
    time, p, v = table[:, 0] / 1e9, table[:, 1:4], table[:, 8:11]
    middle = np.diff(p, axis=0) / np.diff(time)[:, None]
    assert np.allclose(middle, (v[1:] + v[:-1]) / 2, atol=1e-3) and np.abs(v).max() > 0.05
    imu = sequence.imu(200.0, noise=NOISE_PRESETS["phone"])
    at = np.searchsorted(time, imu.timestamps - 1e-6)
    assert np.allclose(table[at, 11:14], imu.gyro_bias) and np.allclose(table[at, 14:17], imu.accel_bias)


def test_export_refuses_what_it_cannot_do(sequence: SyntheticSequence, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("precious")
    with pytest.raises(DvoError, match="not an empty folder"):
        export_sequence(sequence, tmp_path / "full", "tum")
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]
    with pytest.raises(DvoError, match="layout"):
        export_sequence(sequence, tmp_path / "new", "kitti")  # type: ignore[arg-type]


@pytest.mark.long
def test_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "P001")
    size = ["--size", "64x48", "--frames", "2"]
    assert main(["synth", "export", "--out", out, "--layout", "tartanair", "--family", "planes", *size]) == 0
    assert len(list((tmp_path / "P001" / "image_left").iterdir())) == 2
    for wrong, said in (
        (["export", "--out", out, *size], "not an empty folder"),
        (["export", "--out", out + "x", "--family", "castle", *size], "family"),
        (["export", "--out", out + "x", "--size", "8x8"], "WIDTHxHEIGHT"),
        (["preview", "--out", str(tmp_path / "none" / "x.png")], "cannot be written"),
        (["preview", "castle", "--out", str(tmp_path / "x.png")], "neither a mesh file nor a family"),
        (["preview", "castle.glb", "--out", str(tmp_path / "x.png")], "no such file"),
        (["preview", "room", "--textures", str(tmp_path / "P001"), "--out", str(tmp_path / "none.png"), "--rows", "1",
          "--size", "x"], "WIDTHxHEIGHT"),
    ):  # fmt: skip
        assert main(["synth", *wrong]) == 2
        assert said in capsys.readouterr().err


def test_preview_of_a_mesh_by_one_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box().export(tmp_path / "box.obj")
    out = tmp_path / "sheet.png"
    given = ["synth", "preview", str(tmp_path / "box.obj"), "--out", str(out), "--rows", "1", "--size", "64x48"]
    assert main(given) == 0
    assert "no texture" in capsys.readouterr().err
    sheet = cv2.imread(str(out))
    assert sheet.shape == (48, 7 * 64, 3)
    assert all(sheet[:, i * 64 : (i + 1) * 64].std() > 1 for i in range(7)), "a cell is empty"


@pytest.mark.parametrize("layout", ["tum", "tartanair"])
def test_the_readout_of_a_rolling_shutter_reads_back(layout: Layout, tmp_path: Path) -> None:
    sequence = make_sequence(6, frames=2, height=48, width=64, fps=12, family="room", rolling_shutter=0.5)
    export_sequence(sequence, tmp_path / "out", layout)
    assert not (tmp_path / "out" / "calib.txt").exists()
    check_read_back(tmp_path / "out", sequence, layout)
    for frame in dvo.open(tmp_path / "out"):
        assert frame.camera.readout == pytest.approx(0.5 / 12, abs=1e-8)
