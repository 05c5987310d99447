"""Readers of what is rendered: mesh files with their textures, and folders of photographs."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np

from tests.fuzz.readers_data import images, lines
from tests.fuzz.target import Target, chance, require

MODULES = ("trimesh", "PIL.Image", "dvo.synth.meshes.files", "dvo.synth.textures.photographs", "dvo.synth.sequence")


def _obj(folder: Path) -> None:
    images(folder, ["t.png"])
    lines(folder / "m.mtl", ["newmtl a", "Ka 1 1 1", "Kd 0.8 0.7 0.6", "map_Kd t.png"])
    corners = [(x, y, z) for x in (0, 4) for y in (0, 3) for z in (0, 5)]
    faces = [(1, 3, 4), (1, 4, 2), (5, 6, 8), (5, 8, 7), (1, 2, 6), (1, 6, 5), (3, 7, 8), (3, 8, 4), (1, 5, 7),
             (1, 7, 3), (2, 4, 8), (2, 8, 6)]  # fmt: skip
    lines(folder / "m.obj", [
        "mtllib m.mtl", *(f"v {x} {y} {z}" for x, y, z in corners), "vt 0 0", "vt 1 0", "vt 1 1", "usemtl a",
        *("f " + " ".join(f"{corner}/{i + 1}" for i, corner in enumerate(face)) for face in faces),
    ])  # fmt: skip


def _exported(folder: Path, name: str, binary: bool = True) -> None:
    import trimesh

    box = trimesh.creation.box((4.0, 3.0, 5.0)).subdivide()
    if name.endswith(".ply"):
        box.export(folder / name, encoding="binary" if binary else "ascii")
        return
    if name.endswith((".glb", ".gltf")):
        from PIL import Image

        uv = np.asarray(box.vertices)[:, :2]
        picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (32, 32, 3), dtype=np.uint8))
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, baseColorFactor=[1.0, 0.9, 0.8, 1.0])
        box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    if name.endswith(".gltf"):
        for file, data in trimesh.Scene(box).export(file_type="gltf").items():
            (folder / ("m.gltf" if file == "model.gltf" else file)).write_bytes(data)
        return
    box.export(folder / name)


def _mesh(folder: Path, random: np.random.Generator | None, name: str) -> None:
    from dvo.synth.meshes.files import load_mesh

    scene = load_mesh(folder / name, light=not chance(random, 0.2))
    require(np.isfinite(scene.corners).all() and np.isfinite(scene.texture_uv).all(), "mesh that is not finite")
    require(all(np.isfinite(picture).all() for picture in scene.textures.pictures), "texture that is not finite")


def _photographs(folder: Path) -> None:
    images(folder / "t" / "wall", ["a.png", "b.jpg", "c.webp"])
    images(folder / "t", ["d.bmp", "e.tiff", "f.ppm", "g.pgm"])


def _textures(folder: Path, random: np.random.Generator | None) -> None:
    from dvo.synth.textures.photographs import folder_photographs

    cv2.setNumThreads(1)
    for picture, tag in folder_photographs(folder / "t", 0):
        require(picture.dtype == np.float32 and picture.ndim == 3 and picture.shape[2] == 3, "picture of odd type")
        require(np.isfinite(picture).all() and picture.min() >= 0 and picture.max() <= 1, "picture out of range")
        require(isinstance(tag, str), "tag")


FILES = {"obj": "m.obj", "glb": "m.glb", "gltf": "m.gltf", "ply": "m.ply", "ply_text": "m.ply", "stl": "m.stl",
         "off": "m.off"}  # fmt: skip
TARGETS = (
    *(
        Target(
            f"mesh_{kind}",
            _obj if kind == "obj" else partial(_exported, name=name, binary=kind == "ply"),
            partial(_mesh, name=name),
            modules=MODULES,
        )
        for kind, name in FILES.items()
    ),
    Target("textures", _photographs, _textures, modules=MODULES),
)
