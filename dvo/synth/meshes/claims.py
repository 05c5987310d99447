"""Numbers and file names in mesh files, checked before memory is taken or another file is read for them."""

from __future__ import annotations

import base64
import json
import os
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from dvo.core.errors import DvoError
from dvo.data.images.image_header import MAX_PIXELS, image_size
from dvo.data.images.images import is_complete

MAX_BYTES = 2 * 1024**3
MAX_TRIANGLES = 4_000_000
MAX_VERTICES = 3 * MAX_TRIANGLES
MAX_JSON = 256 * 1024**2
HEADER = 3 * 1024**2  # bytes of an embedded picture in which its size is looked for
DECIMATE = "decimate it first, for instance by trimesh's simplify_quadric_decimation or in Blender"
AGAIN = "export it again"

_PLY_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}
_GLTF_SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_GLTF_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def check_claims(path: Path) -> None:
    """Compare the counts that a PLY, glTF or GLB file states with its size and with the bounds.

    Args:
        path: the file; other formats state no counts that memory is taken for.

    Raises:
        DvoError: more elements than the file can hold or than the bounds allow; a node with two parents (a tree of
            nodes that repeats itself); a huge embedded picture.
    """
    suffix = path.suffix.lower()
    if suffix == ".ply":
        _check_ply(path)
    elif suffix in (".gltf", ".glb"):
        try:
            tree, begin = _gltf(path)
            _check_accessors(tree, path)
            _check_nodes(tree, path)
            _check_pictures(tree, begin, path)
        except (
            ValueError,
            TypeError,
            KeyError,
            IndexError,
            AttributeError,
            OSError,
            struct.error,
            RecursionError,
        ) as error:
            reason = " ".join(str(error).split())[:100] or type(error).__name__
            raise DvoError(f"cannot be read as a mesh ({reason})", file=path, remedy=AGAIN) from error


def _check_ply(path: Path) -> None:
    with path.open("rb") as file:
        head = file.read(65536)
    text, end, _ = head.partition(b"end_header")
    if not end:
        raise DvoError("cannot be read as a mesh (a header without an end)", file=path, remedy=AGAIN)
    ascii_ = b"format ascii" in text
    needed, element, count, width = 0, "", 0, 0
    for line in [*text.decode("latin-1").splitlines(), "element end 0"]:
        words = line.split()
        if words[:1] == ["element"] and len(words) >= 3:
            needed += count * width
            if needed > path.stat().st_size:
                message = f"states {count:,} elements '{element}', which is more than the file holds"
                raise DvoError(message, file=path, remedy=AGAIN)
            element, width = words[1][:40], 0
            count = int(words[2][:18]) if words[2].isdigit() else 0
            if count > MAX_VERTICES:
                message = f"huge: {count:,} elements '{element}', {MAX_VERTICES:,} at most"
                raise DvoError(message, file=path, remedy=DECIMATE)
        elif words[:1] == ["property"] and len(words) >= 3:
            width += 1 if ascii_ else _PLY_SIZES.get(words[2] if words[1] == "list" else words[1], 1)


def _gltf(path: Path) -> tuple[dict[str, Any], int]:
    """JSON of a glTF or GLB file, and the place in the file where the binary part begins."""
    with path.open("rb") as file:
        length = path.stat().st_size
        if path.suffix.lower() == ".glb":
            magic, _, _, stated, kind = struct.unpack("<4sIIII", file.read(20))
            if magic != b"glTF" or kind != 0x4E4F534A:
                raise ValueError("not a GLB file")
            length = min(stated, length)
        if length > MAX_JSON:
            raise DvoError(f"huge: more than {MAX_JSON // 1024**2} MB of JSON", file=path, remedy=DECIMATE)
        tree = json.loads(file.read(length))
        if not isinstance(tree, dict):
            raise ValueError("no JSON object")
        return tree, file.tell() + 8


def _check_accessors(tree: dict[str, Any], path: Path) -> None:
    views = tree.get("bufferViews", [])
    for number, accessor in enumerate(tree.get("accessors", [])):
        count = accessor["count"]
        place = f"accessors[{number}]"
        if not isinstance(count, int) or not 0 <= count <= MAX_VERTICES:
            message = f"states {str(count)[:20]} elements, {MAX_VERTICES:,} at most"
            raise DvoError(message, file=path, field=place, remedy=DECIMATE)
        if "bufferView" in accessor:
            width = _GLTF_SIZES.get(accessor["componentType"], 1) * _GLTF_WIDTHS.get(accessor["type"], 1)
            view = accessor["bufferView"]
            if not isinstance(view, int) or view < 0 or count * width > views[view]["byteLength"]:
                raise DvoError("states more elements than its buffer holds", file=path, field=place, remedy=AGAIN)


def _check_nodes(tree: dict[str, Any], path: Path) -> None:
    nodes, meshes, accessors = tree.get("nodes", []), tree.get("meshes", []), tree.get("accessors", [])
    parents: dict[int, int] = {}
    triangles = 0
    for number, node in enumerate(nodes):
        for child in node.get("children", []):
            if not isinstance(child, int) or not 0 <= child < len(nodes):
                raise DvoError(f"no node {str(child)[:20]}", file=path, field=f"nodes[{number}]", remedy=AGAIN)
            if child in parents:
                raise DvoError("a node with two parents", file=path, field=f"nodes[{child}]", remedy=AGAIN)
            parents[child] = number
        if "mesh" in node:
            for part in meshes[node["mesh"]]["primitives"]:
                corners = part.get("indices", part["attributes"].get("POSITION"))
                triangles += accessors[corners]["count"] // 3 if corners is not None else 0
    for start in range(len(nodes)):  # a loop has no root; each node is passed once
        seen, node = set(), start
        while node in parents:
            seen.add(node)
            node = parents.pop(node)
            if node in seen:
                raise DvoError("nodes in a loop", file=path, field=f"nodes[{node}]", remedy=AGAIN)
    if triangles > MAX_TRIANGLES:
        message = f"huge: {triangles:,} triangles with all copies, {MAX_TRIANGLES:,} at most"
        raise DvoError(message, file=path, remedy=DECIMATE)


def _check_pictures(tree: dict[str, Any], begin: int, path: Path) -> None:
    views = tree.get("bufferViews", [])
    for number, picture in enumerate(tree.get("images", [])):
        data, uri = b"", picture.get("uri")
        if "bufferView" in picture and path.suffix.lower() == ".glb":
            view = views[picture["bufferView"]]
            with path.open("rb") as file:
                file.seek(begin + view.get("byteOffset", 0))
                data = file.read(min(view["byteLength"], HEADER))
        elif isinstance(uri, str) and uri.startswith("data:"):
            data = base64.b64decode(uri.partition(",")[2][: 4 * (HEADER // 3)] + "==")
        check_picture(image_size(data), path, f"images[{number}]")


def check_picture(size: tuple[int, int] | None, file: object, field: str) -> None:
    """Raise DvoError for a picture above :data:`dvo.data.images.image_header.MAX_PIXELS`.

    Args:
        size: width and height, pixels; None if unknown.
        file, field: for the message.
    """
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        message = f"huge: a picture of {size[0]}x{size[1]} pixels, {MAX_PIXELS // 10**6} million at most"
        raise DvoError(message, file=file, field=field, remedy="make it smaller")


class FolderFiles:
    """Files that a mesh file names, as trimesh asks for them: only those in the folder of the mesh file.

    Args:
        mesh: the mesh file.

    Attributes:
        refused: the first name that was refused; trimesh passes over errors of materials and pictures.
        read: files that were read.
    """

    def __init__(self, mesh: Path) -> None:
        self.folder, self.mesh = mesh.absolute().parent, mesh
        self.file_name, self.file_path = mesh.name, str(mesh)
        self.refused: DvoError | None = None
        self.read: list[Path] = []

    def get(self, name: str) -> bytes:
        """Content of a file.

        Args:
            name: relative to the folder.

        Raises:
            DvoError: a place outside of the folder, no regular file, or a huge one.
            FileNotFoundError: no such file.
        """
        try:
            return self._read(name)
        except DvoError as error:
            self.refused = self.refused or error
            raise

    __getitem__ = get

    def _read(self, name: str) -> bytes:
        text = os.fspath(name).strip().replace("\\", "/")
        place = Path(os.path.normpath(self.folder / text))
        if "\0" in text or len(text) > 1024:
            raise DvoError("names a file that cannot exist", file=self.mesh, field=repr(text[:60]), remedy=AGAIN)
        if not place.is_relative_to(self.folder):
            message, remedy = "names a file outside of its folder", "put the file beside the mesh and name it so"
            raise DvoError(message, file=self.mesh, field=text[:200], remedy=remedy)
        if not place.exists():
            if unquote(text) != text:  # glTF encodes blanks and other characters
                return self._read(unquote(text))
            raise FileNotFoundError(place)
        if not place.is_file():
            raise DvoError("names no regular file", file=self.mesh, field=text[:200], remedy=AGAIN)
        if place.stat().st_size > MAX_BYTES:
            raise DvoError("names a huge file", file=self.mesh, field=text[:200], remedy=DECIMATE)
        size = image_size(place)
        check_picture(size, self.mesh, text[:200])
        if size is not None and place.stat().st_size > MAX_JSON:
            raise DvoError("names a huge picture", file=self.mesh, field=text[:200], remedy="replace the picture")
        data = place.read_bytes()
        self.read.append(place)
        if size is not None and not is_complete(data):
            raise DvoError(
                "a picture that is cut short", file=self.mesh, field=text[:200], remedy="replace the picture"
            )
        return data

    def namespaced(self, namespace: str) -> FolderFiles:
        """Files of a subfolder, which trimesh asks for in archives.

        Args:
            namespace: name of the subfolder.
        """
        return FolderFiles(self.folder / namespace / self.file_name)

    def keys(self) -> list[str]:
        """Names of the files in the folder."""
        return [file.name for file in self.folder.iterdir() if file.is_file()]

    def __contains__(self, name: str) -> bool:
        return (self.folder / name).is_file()
