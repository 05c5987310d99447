"""Mesh files that state more than they hold, name files elsewhere, or are cut: one error, and no memory for them."""

from __future__ import annotations

import base64
import io
import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.synth import load_mesh

trimesh = pytest.importorskip("trimesh")
Image = pytest.importorskip("PIL.Image")

TRIANGLE = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0.5]], "<f4")
OBJ = "mtllib m.mtl\nusemtl m\nv -1 -1 0\nv 1 -1 0\nv 0 1 0.5\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"


def picture(size: tuple[int, int] = (16, 24), kind: str = "PNG") -> bytes:
    stream = io.BytesIO()
    values = np.random.default_rng(0).integers(0, 255, (*size, 3), dtype=np.uint8)
    Image.fromarray(values).save(stream, kind)
    return stream.getvalue()


def huge_png() -> bytes:
    """Header of 30,000 x 30,000 pixels."""
    chunks = b""
    for name, data in (
        (b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)),
        (b"IDAT", b""),
        (b"IEND", b""),
    ):
        chunks += struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    return b"\x89PNG\r\n\x1a\n" + chunks


def gltf(**changes: Any) -> dict[str, Any]:
    """A textured triangle."""
    uv = np.array([[0, 0], [1, 0], [0, 1]], "<f4")
    data = TRIANGLE.tobytes() + uv.tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    tree: dict[str, Any] = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}], "images": [{"uri": "t.png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [-1, -1, 0], "max": [1, 1, 1]},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}],
        "buffers": [{"uri": uri, "byteLength": 60}],
    }  # fmt: skip
    return tree | changes


def write(folder: Path, tree: dict[str, Any]) -> Path:
    (folder / "t.png").write_bytes(picture())
    file = folder / "mesh.gltf"
    file.write_text(json.dumps(tree))
    return file


def with_view(count: int, **more: Any) -> dict[str, Any]:
    tree = gltf()
    tree["accessors"][0] |= {"count": count, **more}
    return tree


def without_view(count: Any) -> dict[str, Any]:
    tree = gltf()
    tree["accessors"][0] = {"componentType": 5126, "count": count, "type": "VEC3"}
    return tree


def tree_of_nodes(levels: int) -> list[dict[str, Any]]:
    """Every node of a level has all of the next one's for children: ten to the levels copies."""
    nodes: list[dict[str, Any]] = [{"children": [1]}]
    for level in range(levels):
        nodes.append({"children": [level + 2] * 10})
    return [*nodes, {"mesh": 0}]


def test_a_sound_gltf_is_read_with_its_picture(tmp_path: Path) -> None:
    scene = load_mesh(write(tmp_path, gltf()), ground=False)
    assert len(scene) == 1 and not scene.warnings and scene.textures.pictures[0].shape == (16, 24, 3)
    (tmp_path / "my t.png").write_bytes(picture((8, 8)))
    assert (
        load_mesh(write(tmp_path, gltf(images=[{"uri": "my%20t.png"}])), ground=False).textures.pictures[0].shape[0]
        == 8
    )


GLTF: dict[str, tuple[dict[str, Any], str]] = {
    "count beyond the buffer": (with_view(10**6), r"accessors\[0\]: states more elements than its buffer holds"),
    "count beyond any bound": (with_view(10**12), r"accessors\[0\]: states 1000000000000 elements"),
    "count without a buffer": (without_view(10**12), r"accessors\[0\]: states 1000000000000 elements"),
    "count below 0": (with_view(-3), r"accessors\[0\]: states -3 elements"),
    "text for a count": (without_view("many"), r"accessors\[0\]: states many elements"),
    "buffer view that is not there": (with_view(3, bufferView=9), "cannot be read as a mesh"),
    "mesh that is not there": (gltf(nodes=[{"mesh": 5}]), "cannot be read as a mesh"),
    "node that is not there": (gltf(nodes=[{"mesh": 0, "children": [7]}]), "no node 7"),
    "node in itself": (gltf(nodes=[{"mesh": 0, "children": [0]}]), "nodes in a loop"),
    "nodes in a loop": (gltf(nodes=[{"children": [1]}, {"mesh": 0, "children": [0]}]), "nodes in a loop"),
    "nodes in nodes": (gltf(nodes=tree_of_nodes(9)), "a node with two parents"),
    "very many copies": (
        with_view(3) | {"nodes": [{"mesh": 0} for _ in range(40)], "accessors": [without_view(10**6)["accessors"][0]]},
        r"huge: 13,333,320 triangles",
    ),
    "lists for tables": (gltf(nodes=[[]]), "cannot be read as a mesh"),
    "a list": ([], "cannot be read as a mesh .no JSON object"),  # type: ignore[dict-item]
    "picture outside": (gltf(images=[{"uri": "../secret.png"}]), "secret.png: names a file outside of its folder"),
    "picture outside, encoded": (gltf(images=[{"uri": "%2e%2e/secret.png"}]), "names a file outside of its folder"),
    "picture at an absolute path": (gltf(images=[{"uri": "/etc/passwd"}]), "etc/passwd: names a file outside"),
    "picture of a device": (gltf(images=[{"uri": "/dev/zero"}]), "/dev/zero: names a file outside"),
    "buffer outside": (gltf(buffers=[{"uri": "../../x.bin", "byteLength": 60}]), "names a file outside of its folder"),
    "buffer of a device": (gltf(buffers=[{"uri": "/dev/urandom", "byteLength": 60}]), "names a file outside"),
    "buffer of a pipe": (gltf(buffers=[{"uri": "pipe", "byteLength": 60}]), "pipe: names no regular file"),
    "buffer that is a folder": (gltf(buffers=[{"uri": ".", "byteLength": 60}]), "names no regular file"),
    "buffer that is missing": (gltf(buffers=[{"uri": "x.bin", "byteLength": 60}]), "cannot be read as a mesh"),
    "buffer of the network": (gltf(buffers=[{"uri": "http://host/x", "byteLength": 60}]), "cannot be read as a mesh"),
    "a name of 5,000 characters": (gltf(buffers=[{"uri": "x" * 5000, "byteLength": 60}]), "cannot exist"),
    "huge picture beside it": (gltf(images=[{"uri": "huge.png"}]), "huge: a picture of 30000x30000 pixels"),
    "huge picture within": (
        gltf(images=[{"uri": "data:image/png;base64," + base64.b64encode(huge_png()).decode()}]),
        r"images\[0\]: huge: a picture of 30000x30000 pixels",
    ),
    "cut picture": (gltf(images=[{"uri": "cut.png"}]), "cut.png: a picture that is cut short"),
    "cut JPEG": (gltf(images=[{"uri": "cut.jpg"}]), "cut.jpg: a picture that is cut short"),
}


@pytest.mark.parametrize("case", GLTF)
def test_gltf(tmp_path: Path, case: str) -> None:
    tree, message = GLTF[case]
    folder = tmp_path / "folder"
    folder.mkdir()
    os.mkfifo(folder / "pipe")
    (tmp_path / "secret.png").write_bytes(picture())
    (folder / "huge.png").write_bytes(huge_png())
    (folder / "cut.png").write_bytes(picture((64, 64))[:3000])
    (folder / "cut.jpg").write_bytes(picture((64, 64), "JPEG")[:1500])
    file = write(folder, tree)
    with pytest.raises(DvoError, match=message) as error:
        load_mesh(file)
    assert str(error.value).startswith(f"{file}: ") and "\n" not in str(error.value) and error.value.remedy


def glb(tree: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def test_cut_picture_in_a_glb(tmp_path: Path) -> None:
    tree = gltf(images=[{"bufferView": 2, "mimeType": "image/jpeg"}])
    cut = picture((64, 64), "JPEG")[:1500]
    binary = base64.b64decode(tree["buffers"][0]["uri"].partition(",")[2]) + cut
    tree["bufferViews"].append({"buffer": 0, "byteOffset": 60, "byteLength": len(cut)})
    tree["buffers"] = [{"byteLength": len(binary)}]
    (tmp_path / "mesh.glb").write_bytes(glb(tree, binary))
    with pytest.raises(DvoError, match="image file is truncated"):
        load_mesh(tmp_path / "mesh.glb")


def test_huge_picture_in_a_glb(tmp_path: Path) -> None:
    tree = gltf(images=[{"bufferView": 2, "mimeType": "image/png"}])
    binary = base64.b64decode(tree["buffers"][0]["uri"].partition(",")[2]) + huge_png()
    tree["bufferViews"].append({"buffer": 0, "byteOffset": 60, "byteLength": len(huge_png())})
    tree["buffers"] = [{"byteLength": len(binary)}]
    (tmp_path / "mesh.glb").write_bytes(glb(tree, binary))
    with pytest.raises(DvoError, match=r"images\[0\]: huge: a picture of 30000x30000 pixels"):
        load_mesh(tmp_path / "mesh.glb")


@pytest.mark.parametrize("kept", [0, 3, 11, 20, 60, 0.3, 0.7, 0.95])
def test_cut_glb(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "mesh.glb"
    trimesh.creation.icosphere(2).export(path)
    data = path.read_bytes()
    path.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    with pytest.raises(DvoError, match="cannot be read as a mesh"):
        load_mesh(path)


PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n{}"
LIST = "property list uchar int vertex_indices\n"


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [(10**12, 1, "huge: 1,000,000,000,000 elements 'vertex'"), (10**6, 1, "states 1,000,000 elements 'vertex'"),
     (3, 10**12, "huge: 1,000,000,000,000 elements 'face'"), (3, 10**6, "states 1,000,000 elements 'face'"),
     (10**30, 1, "huge")],
)  # fmt: skip
def test_counts_of_a_ply(tmp_path: Path, form: str, vertices: int, faces: int, message: str) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes((PLY.format(form, vertices, faces, LIST) + "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n").encode())
    with pytest.raises(DvoError, match=message):
        load_mesh(path)


def test_a_ply_without_an_end_of_its_header(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    path.write_text(PLY.format("ascii", 3, 1, LIST))
    with pytest.raises(DvoError, match="a header without an end"):
        load_mesh(path)


BROKEN = {
    "corner that is not there": ("f 1/1 2/2 3/3", "f 1/1 2/2 9/3", "mesh|broken"),
    "huge corner": ("f 1/1 2/2 3/3", "f 1/1 2/2 99999999999999999999/3", "mesh|broken"),
    "two corners": ("f 1/1 2/2 3/3", "f 1/1 2/2", "mesh|empty"),
    "text for a corner": ("f 1/1 2/2 3/3", "f a/1 2/2 3/3", "mesh|broken"),
    "text for a vertex": ("v 0 1 0.5", "v 0 one 0.5", "mesh|broken"),
    "two numbers of a vertex": ("v 0 1 0.5", "v 0 1", "mesh|broken"),
    "NaN vertex": ("v 0 1 0.5", "v 0 nan 0.5", "broken: a vertex is not finite"),
    "infinite vertex": ("v 0 1 0.5", "v 0 inf 0.5", "broken: a vertex is not finite"),
    "far vertex": ("v 0 1 0.5", "v 0 1e200 0.5", r"broken: a vertex beyond 1e\+12"),
    "NaN texture coordinate": ("vt 0 1", "vt nan 1", "broken: a texture coordinate is not finite"),
    "far texture coordinate": ("vt 0 1", "vt 1e20 1", r"broken: a texture coordinate beyond 1e\+06"),
    "cut in a face": ("f 1/1 2/2 3/3", "f 1/1 2", "mesh|empty"),
}


@pytest.mark.long
@pytest.mark.parametrize("case", BROKEN)
def test_broken_obj(tmp_path: Path, case: str) -> None:
    (tmp_path / "m.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    (tmp_path / "t.png").write_bytes(picture())
    path = tmp_path / "mesh.obj"
    path.write_text(OBJ)
    assert load_mesh(path, ground=False).textures.pictures[0].shape == (16, 24, 3)
    old, new, message = BROKEN[case]
    assert old in OBJ
    path.write_text(OBJ.replace(old, new))
    with pytest.raises(DvoError, match=message):
        load_mesh(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [("../secret.png", "names a file outside"), ("/dev/zero", "names a file outside"), ("cut.jpg", "jpg: a picture"),
     ("huge.png", "huge: a picture of 30000x30000 pixels"), ("pipe", "names no regular file")],
)  # fmt: skip
def test_pictures_of_an_obj(tmp_path: Path, name: str, message: str) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    os.mkfifo(folder / "pipe")
    (tmp_path / "secret.png").write_bytes(picture())
    (folder / "huge.png").write_bytes(huge_png())
    (folder / "cut.jpg").write_bytes(picture((64, 64), "JPEG")[:1500])
    (folder / "m.mtl").write_text(f"newmtl m\nmap_Kd {name}\n")
    (folder / "mesh.obj").write_text(OBJ)
    with pytest.raises(DvoError, match=message):
        load_mesh(folder / "mesh.obj")


def test_a_material_file_outside(tmp_path: Path) -> None:
    (tmp_path / "mesh.obj").write_text(OBJ.replace("mtllib m.mtl", "mtllib ../m.mtl"))
    with pytest.raises(DvoError, match="../m.mtl: names a file outside"):
        load_mesh(tmp_path / "mesh.obj")
