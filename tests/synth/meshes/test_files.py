"""Reading of mesh files: colours, textures, defects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.geometry.poses import look_rotation, pose_from
from dvo.synth import load_mesh, mesh_scene, render
from dvo.synth.meshes import files as mesh_files
from dvo.synth.render.quality import Quality

trimesh = pytest.importorskip("trimesh")
H, W = 60, 80
K = np.array([66.0, 65.0, 39.2, 29.7])
UP = np.array([0.0, 0.0, 1.0])


def looking(eye: list[float], at: list[float]) -> np.ndarray:
    """Poses ``(1, 7)`` of a camera at ``eye`` that looks at ``at``."""
    spot = np.array(eye, float)
    return pose_from(look_rotation(np.array(at, float) - spot, UP), spot)[None]


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A GLB: a box with a picture, a cylinder with vertex colours, a bare torus."""
    from PIL import Image

    rng = np.random.default_rng(0)
    picture = Image.fromarray(rng.integers(0, 255, (32, 48, 3), dtype=np.uint8))
    box = trimesh.creation.box((1, 0.6, 0.8))
    box = trimesh.Trimesh(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2] + 0.5, material=material)
    tube = trimesh.creation.cylinder(0.2, 1.2)
    tube.apply_translation([0.9, 0.2, 0])
    colours = rng.integers(0, 255, (len(tube.vertices), 4), dtype=np.uint8)
    colours[:, 3] = 255
    tube.visual = trimesh.visual.ColorVisuals(tube, vertex_colors=colours)
    torus = trimesh.creation.torus(0.4, 0.12)
    torus.apply_translation([-0.9, 0, 0])
    path = tmp_path_factory.mktemp("mesh") / "things.glb"
    trimesh.Scene([box, tube, torus]).export(path)
    return path


def test_vertex_colours_of_a_ply(tmp_path: Path) -> None:
    colours = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255]], np.uint8)
    mesh = trimesh.Trimesh([[-1, 0, -1], [1, 0, -1], [0, 0, 1]], [[0, 1, 2]], vertex_colors=colours, process=False)
    mesh.export(tmp_path / "t.ply")
    scene = load_mesh(tmp_path / "t.ply", light=False, ground=False)
    assert not scene.warnings
    frames = render(scene, looking([0, -2, 0], [0, 0, 0]), K, H, W, quality=Quality(antialias=False))
    hit = frames.surface[0].numpy() == 0
    second, third = frames.uv[0].numpy()[hit].T
    expected = np.stack([1 - second - third, second, third])
    assert np.allclose(frames.images[0].numpy()[:, hit], expected, atol=1e-5)


@pytest.mark.long
def test_untextured_mesh_is_painted_and_says_so(tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "ball.ply")
    scene = load_mesh(tmp_path / "ball.ply")
    assert any("no texture" in warning and "procedural" in warning for warning in scene.warnings)
    assert any("ground plane" in warning for warning in scene.warnings)
    frames = render(scene, looking([2.5, 0, 0.8], [0, 0, 0]), 2 * K, 2 * H, 2 * W)
    ball = frames.surface[0] < len(scene) - 2
    assert 0.1 < ball.float().mean() < 0.8
    assert frames.images[0][:, ball].std() > 0.05
    again = render(load_mesh(tmp_path / "ball.ply"), looking([2.5, 0, 0.8], [0, 0, 0]), 2 * K, 2 * H, 2 * W)
    assert torch.equal(again.images, frames.images) and torch.equal(again.depth, frames.depth)


def test_partly_textured_mesh_says_how_much(things: Path) -> None:
    assert any("no texture on" in warning for warning in load_mesh(things).warnings)


def test_defects_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    with pytest.raises(DvoError, match="no such file"):
        load_mesh(tmp_path / "none.glb")
    with pytest.raises(DvoError, match="format"):
        load_mesh(write("a.txt", "hello"))
    for name in ("a.glb", "a.ply", "a.gltf"):
        with pytest.raises(DvoError, match=f"{name}.*(cannot be read|empty)"):
            load_mesh(write(name, b"\x00\x01garbage" * 9))
    with pytest.raises(DvoError, match="empty"):
        load_mesh(write("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"))
    with pytest.raises(DvoError, match="not finite"):
        load_mesh(write("nan.obj", "v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n"))
    with pytest.raises(DvoError, match="empty.*no area"):
        load_mesh(write("line.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"))
    with pytest.raises(DvoError, match="broken|cannot be read"):
        load_mesh(write("index.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"))
    ball = trimesh.creation.icosphere(subdivisions=1)
    monkeypatch.setattr(mesh_files, "MAX_TRIANGLES", 50)
    with pytest.raises(DvoError, match="huge: 80 triangles.*[Dd]ecimate"):
        mesh_scene(ball)
    monkeypatch.setattr(mesh_files, "MAX_BYTES", 10)
    with pytest.raises(DvoError, match="huge"):
        load_mesh(write("big.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"))


def test_broken_triangles_are_left_out_and_counted() -> None:
    mesh = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2], [0, 0, 1], [0, 1, 3]], process=False
    )
    scene = mesh_scene(mesh, ground=False)
    assert len(scene) == 2 and any("left out 1 of 3" in warning for warning in scene.warnings)
