"""Paths, long sequences, contact sheets."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvo.cli import main
from dvo.errors import DvoError
from dvo.synth import FAMILIES, KINDS, random_path, random_scene
from dvo.synth.clip import make_sequence
from dvo.synth.motion.walks import long_path
from dvo.synth.poses import compose, inverse, matrix_to_quaternion, quaternion_to_matrix, se3_exp, so3_exp, split
from dvo.synth.scenes.scene import Scene
from dvo.synth.textures.pool import TexturePool, texture_pool

vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array)


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {family: random_scene(2, family, pool=texture_pool(11, count=24, size=64)) for family in FAMILIES}


@given(vectors, vectors)
def test_rotations_round_trip(phi: np.ndarray, tau: np.ndarray) -> None:
    r = so3_exp(phi)
    assert np.allclose(r @ r.T, np.eye(3), atol=1e-12) and np.linalg.det(r) == pytest.approx(1)
    q = matrix_to_quaternion(r)
    assert np.allclose(quaternion_to_matrix(q), r, atol=1e-12)
    pose = np.concatenate([tau, q])
    assert np.allclose(compose(pose, inverse(pose)), [0, 0, 0, 0, 0, 0, 1], atol=1e-9)
    half, whole = (se3_exp(np.concatenate([tau, phi]) * s) for s in (0.5, 1.0))
    assert np.allclose(half[0] @ half[0], whole[0], atol=1e-9)  # one-parameter subgroup
    assert np.allclose(half[0] @ half[1] + half[1], whole[1], atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_paths_are_smooth_and_start_in_free_space(scenes: dict[str, Scene], kind: str) -> None:
    for family, scene in scenes.items():
        path = random_path(scene, 3, kind)
        times = np.arange(0, 0.1, 0.01)
        poses = path.poses_wc(times)
        assert scene.clearance(poses[:1, :3])[0] > 0.02 * scene.scale, family
        r, t = split(compose(inverse(poses[:-1]), poses[1:]))
        turn = np.arccos(np.clip((np.trace(r, axis1=1, axis2=2) - 1) / 2, -1, 1))
        assert turn.max() < 0.05 and np.linalg.norm(t, axis=1).max() < 0.05 * path.depth
        # Steps change little from one to the next: no jumps.
        assert np.linalg.norm(np.diff(t, axis=0), axis=1).max() < 0.01 * path.depth
    assert np.array_equal(random_path(scene, 3, kind).poses_wc(times), poses)


@pytest.mark.parametrize("kind", KINDS)
def test_long_paths_stay_in_free_space(scenes: dict[str, Scene], kind: str) -> None:
    for family in ("room", "corridor", "street"):
        scene = scenes[family]
        path = long_path(scene, 1, kind, 6.0)
        positions = path.poses_wc(np.linspace(0, 6, 90))[:, :3]
        assert scene.clearance(positions).min() > 0.02 * scene.scale
        assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() < 0.2 * scene.scale


def test_clearance_knows_surfaces_and_solids(scenes: dict[str, Scene]) -> None:
    scene = scenes["room"]
    low, high = scene.bounds
    assert scene.clearance(np.array([(low + high) / 2 + 100]))[0] == -1
    solid = scene.solids[0]
    assert scene.clearance(solid[None, :3])[0] == -1
    near_floor = np.array([[0.0, 0.0, low[2] + 0.01]])
    assert scene.clearance(near_floor)[0] <= 0.0101


def test_sequence_is_a_source_of_frames() -> None:
    sequence = make_sequence(4, frames=5, height=48, width=64, fps=10, family="room")
    frames = list(sequence)
    assert len(frames) == len(sequence) == sequence.frame_count == 5
    assert [frame.index for frame in frames] == list(range(5))
    assert [frame.timestamp for frame in frames] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert all(frame.image.shape == (48, 64, 3) and frame.image.dtype == np.uint8 for frame in frames)
    assert np.array_equal(sequence.frame(3).image, frames[3].image), "frames depend on the order of reading"
    assert np.array_equal(sequence.groundtruth.timestamps, [frame.timestamp for frame in frames])
    assert sequence.groundtruth.path_length > 0.01
    again = make_sequence(4, frames=5, height=48, width=64, fps=10, family="room")
    assert np.array_equal(again.frame(2).image, frames[2].image)
    with pytest.raises(DvoError, match="frames"):
        make_sequence(0, frames=0)
    with pytest.raises(DvoError, match="kind"):
        make_sequence(4, frames=5, height=48, width=64, family="room", kind="teleport")


def test_contact_sheet_is_written(tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    assert main(["synth", "preview", "clips", "--out", str(out), "--seed", "5", "--rows", "1", "--size", "64x48"]) == 0
    sheet = cv2.imread(str(out))
    assert sheet.shape == (48, 7 * 64, 3)
    assert all(sheet[:, i * 64 : (i + 1) * 64].std() > 1 for i in range(7)), "a cell is empty"


def test_without_photographs_the_pool_is_procedural(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dvo.synth.textures.pool.importlib.util.find_spec", lambda name: None)
    pool = TexturePool(0, 20, 32)
    assert "photo" not in pool.tags
    colours = np.stack([pool.use(i) for i in range(20)])
    assert np.isfinite(colours).all() and colours.std(0).min() > 0.05
    top, left = pool.cell(7)
    levels = pool.atlas[:, top : top + 48, left : left + 32]
    assert levels[:, :32].mean() == pytest.approx(float(levels[:, 32:48, :16].mean()), abs=1e-4), (
        "level 1 is not the mean"
    )
