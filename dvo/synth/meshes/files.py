"""Mesh files through trimesh: glTF, GLB, OBJ, PLY, STL and OFF, with their textures, colours and defects."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.synth import salts
from dvo.synth.meshes.claims import (
    DECIMATE,
    MAX_BYTES,
    MAX_TRIANGLES,
    FolderFiles,
    check_claims,
    check_picture,
)
from dvo.synth.meshes.mesh import MeshScene
from dvo.synth.meshes.space import View, free_space
from dvo.synth.meshes.textures import TextureSet
from dvo.synth.textures.patterns import PATTERNS

Array = np.ndarray
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")
MAX_EDGE = 4096  # of a texture, pixels
FARTHEST, MOST_REPEATS = 1e12, 1e6  # largest coordinate of a vertex, and of a texture
SUN = np.array([0.45, -0.35, 0.82])  # direction of the light on meshes, whose files have none
CREASE = np.cos(np.radians(50))  # corners bent more than this are shaded flat


def load_mesh(
    path: Path | str,
    *,
    up: Literal["y", "z"] | None = None,
    view: View = "auto",
    ground: bool = True,
    light: bool = True,
    seed: int = 0,
) -> MeshScene:
    """Read a mesh file as a scene.

    Args:
        path: glTF, GLB, OBJ, PLY, STL or OFF; textures are read from the files that it names.
        up: axis of the file that points up; None: z for PLY, STL and OFF, y for the others.
        view: cameras within ("inside") or around the mesh ("outside"); "auto" decides by its shape.
        ground: put a mesh that is seen from outside on a textured plane.
        light: shade by one distant light; False if light is part of the textures (scans).
        seed: of the replacement for missing textures.

    Returns:
        The mesh, z up.

    Raises:
        DvoError: trimesh is not installed; no such file, or not a mesh; empty, broken or huge; it names
            files outside of its folder.
    """
    path = Path(path)
    if not path.is_file():
        raise DvoError("no such file", file=path, field="mesh", remedy="give a glTF, GLB, OBJ or PLY file")
    if path.suffix.lower() not in SUFFIXES:
        raise DvoError("not a mesh format that dvo reads", file=path, remedy=f"give one of {', '.join(SUFFIXES)}")
    if path.stat().st_size > MAX_BYTES:
        raise DvoError(f"huge: {path.stat().st_size / 1024**3:.1f} GB", file=path, remedy=DECIMATE)
    try:
        import trimesh
    except ImportError:
        raise DvoError("meshes need trimesh", field="mesh", remedy="pip install 'dvo[synth]'") from None
    check_claims(path)
    files: Any = FolderFiles(path)  # has the methods of a Resolver of trimesh
    with _reading(path):
        loaded = trimesh.load_scene(str(path), resolver=files, process=False)  # processing would hide defects
    if files.refused is not None:
        raise files.refused
    rotate = (up or ("z" if path.suffix.lower() in (".ply", ".stl", ".off") else "y")) == "y"
    scene = mesh_scene(loaded, rotate=rotate, view=view, ground=ground, light=light, seed=seed, file=path)
    scene.files = (path, *files.read)
    return scene


def mesh_scene(
    loaded: Any, *, rotate: bool = False, view: View = "auto", ground: bool = True, light: bool = True, seed: int = 0,
    file: Path | None = None,
) -> MeshScene:  # fmt: skip
    """Scene from a ``trimesh.Trimesh`` or ``trimesh.Scene``.

    Args:
        loaded: the mesh.
        rotate: the y axis points up, and is turned onto z.
        view, ground, light, seed: see :func:`load_mesh`.
        file: for messages.

    Returns:
        The mesh, z up.

    Raises:
        DvoError: empty, broken or huge.
    """
    with _reading(file):
        parts = loaded.dump() if hasattr(loaded, "dump") else [loaded]
    meshes = [part for part in parts if hasattr(part, "faces") and len(part.faces)]
    if not meshes:
        what = "points but no triangles" if any(len(getattr(p, "vertices", ())) for p in parts) else "no triangles"
        raise DvoError(f"empty: {what} in it", file=file, remedy="export a mesh with faces")
    total = sum(len(mesh.faces) for mesh in meshes)
    if total > MAX_TRIANGLES:
        raise DvoError(f"huge: {total:,} triangles, {MAX_TRIANGLES:,} at most", file=file, remedy=DECIMATE)
    warnings: list[str] = []
    pictures = [_fallback(seed, 0), _fallback(seed, 1)]
    with _reading(file):
        gathered = [_gather(mesh, pictures, light, rotate, file, warnings) for mesh in meshes]
    corners, tint, texture, uv = (np.concatenate([part[i] for part in gathered]) for i in range(4))
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    extent = corners.max((0, 1)) - corners.min((0, 1))
    good = area > 1e-14 * float(extent.max()) ** 2
    if not good.any():
        raise DvoError("empty: all its triangles have no area", file=file, remedy="export it again, with its real size")
    if not good.all():
        warnings.append(f"left out {int((~good).sum())} of {len(good)} triangles, which have no area")
    corners, tint, texture, uv = corners[good], tint[good], texture[good], uv[good]
    space = free_space(corners, view)
    low, high = corners.min((0, 1)), corners.max((0, 1))
    scale = 0.35 * float(np.sort(space.bounds[1] - space.bounds[0])[1]) if space.inside else float(extent.max())
    bare = np.isnan(uv).any((1, 2))
    if bare.any():
        share = "no texture" if bare.all() else f"no texture on {bare.mean():.0%} of the triangles"
        warnings.append(f"{share}: painted with a procedural one")
        uv[bare] = _projected(corners[bare], 0.9 * scale)
    if not space.inside and ground:
        reach = 12 * float(np.linalg.norm(extent[:2]) + extent[2])
        middle = (low + high) / 2
        square = middle + reach * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        square[:, 2] = low[2] - 1e-3 * float(extent.max())
        floor = square[[[0, 1, 2], [0, 2, 3]]]
        corners, uv = np.concatenate([corners, floor]), np.concatenate([uv, _projected(floor, 0.8 * scale)])
        tint = np.concatenate([tint, np.full((2, 3, 3), 0.9, np.float32)])
        texture = np.concatenate([texture, [1, 1]])
        space = type(space)(corners, space.bounds, space.low, space.cell, space.free, False)
        warnings.append("stands on a textured ground plane that is not in the file")
    focus = (
        (space.bounds[0], space.bounds[1]) if space.inside else (low + 0.35 * (high - low), low + 0.65 * (high - low))
    )
    hints: dict[str, Any] = {"heading": None, "focus": focus, "inside": space.inside}
    # Unused textures would only cost memory.
    used = np.unique(texture[texture >= 0])
    renumbered = np.searchsorted(used, texture)
    texture = np.where(texture >= 0, renumbered, -1)
    textures = TextureSet([pictures[i] for i in used])
    return MeshScene(corners, tint, texture, uv, textures, space, scale, hints, warnings=warnings)


@contextmanager
def _reading(file: Path | None) -> Iterator[None]:
    """Turn the errors of trimesh and Pillow, which are of many types, into one."""
    try:
        yield
    except DvoError:
        raise
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise DvoError(
            f"cannot be read as a mesh ({reason[:200]})",
            file=file,
            remedy="export it again; keep the files that it refers to",
        ) from error


def _fallback(seed: int, kind: int) -> Array:
    """Tileable procedural texture: stains for meshes, a rough one for the ground."""
    rng = np.random.default_rng([seed, salts.MESH_TEXTURE, kind])
    picture = PATTERNS["stains" if kind == 0 else "fractal"][0](rng, 512)
    picture = 0.4 * picture + 0.6 * picture.mean(2, keepdims=True)  # muted colours
    return np.clip(picture * (0.55 / max(float(picture.mean()), 0.1)), 0, 1).astype(np.float32)


def _projected(corners: Array, metres: float) -> Array:
    """Texture coordinates ``(T, 3, 2)`` of a projection along the axis that each triangle faces most, in ``metres``."""
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axes = np.array([[1, 2], [0, 2], [0, 1]])[normal.argmax(1)]
    return np.take_along_axis(corners, axes[:, None].repeat(3, 1), 2) * [1, -1] / metres


def _gather(
    mesh: Any, pictures: list[Array], light: bool, rotate: bool, file: Path | None, warnings: list[str]
) -> tuple[Array, Array, Array, Array]:
    """Corners, tint, texture and texture coordinates of one part.

    Coordinates are NaN where it has neither texture nor colours (texture 0 is then the replacement).
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise DvoError("broken: a face names a vertex that is not there", file=file, remedy="export it again")
    if not np.isfinite(vertices[np.unique(faces)]).all():
        raise DvoError("broken: a vertex is not finite", file=file, remedy="export it again")
    if np.abs(vertices[np.unique(faces)]).max() > FARTHEST:
        raise DvoError(f"broken: a vertex beyond {FARTHEST:g}", file=file, remedy="export it again")
    if mesh.visual.kind is None:  # smooth shading needs corners that are shared
        mesh = mesh.copy()
        mesh.merge_vertices()
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    tint: Array = np.ones((len(faces), 3, 3), np.float32)
    texture = np.zeros(len(faces), np.int64)
    uv = np.full((len(faces), 3, 2), np.nan)
    kind, material = mesh.visual.kind, getattr(mesh.visual, "material", None)
    coordinates = getattr(mesh.visual, "uv", None)
    image = _image(material)
    if kind == "texture" and image is not None and coordinates is not None and len(coordinates) == len(vertices):
        found = np.asarray(coordinates, np.float64)[:, :2]
        if not np.isfinite(found).all():
            raise DvoError("broken: a texture coordinate is not finite", file=file, remedy="export it again")
        if np.abs(found).max() > MOST_REPEATS:
            raise DvoError(f"broken: a texture coordinate beyond {MOST_REPEATS:g}", file=file, remedy="export it again")
        uv = (found * [1, -1] + [0, 1])[faces]  # trimesh counts v from the bottom
        texture[:] = len(pictures)
        pictures.append(_picture(image, file, warnings))
        if getattr(material, "alphaMode", None) in ("MASK", "BLEND"):
            warnings.append("transparent textures are drawn opaque")
    elif kind in ("vertex", "face"):
        if kind == "vertex":
            colours = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(np.float32)[faces] / 255
        else:
            colours = np.asarray(mesh.visual.face_colors)[:, None, :3].astype(np.float32).repeat(3, 1) / 255
        tint = tint * colours
        if np.ptp(colours, axis=(0, 1)).max() > 0.02:  # colours that vary
            texture[:], uv = -1, np.zeros((len(faces), 3, 2))
    tint = tint * _factor(material)
    if light:
        tint = tint * _light(mesh, vertices, faces, rotate)[..., None]
    if rotate:
        vertices = vertices[:, [0, 2, 1]] * [1, -1, 1]
    return vertices[faces], tint, texture, uv


def _image(material: Any) -> Any:
    """Image of a material (PIL), or None."""
    found = getattr(material, "baseColorTexture", None)
    return found if found is not None else getattr(material, "image", None)


def _factor(material: Any) -> Array:
    """Colour factor of a material, as sRGB in [0, 1]; glTF states it in linear light."""
    factor = getattr(material, "baseColorFactor", None)
    if factor is not None:
        linear = np.asarray(factor, float)[:3] / (255 if np.max(factor) > 1 else 1)
        return (linear ** (1 / 2.2)).astype(np.float32)
    if material is not None and getattr(material, "image", None) is None and hasattr(material, "diffuse"):
        return np.asarray(material.main_color[:3], np.float32) / 255
    return np.ones(3, np.float32)


def _picture(image: Any, file: Path | None, warnings: list[str]) -> Array:
    check_picture(image.size, file, "texture")
    try:
        picture: Array = np.asarray(image.convert("RGB"), np.float32) / 255
    except Exception as error:  # Pillow's decoders raise errors of many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise DvoError(
            f"cannot be decoded ({reason[:200]})", file=file, field="texture", remedy="replace the picture"
        ) from error
    shrink = MAX_EDGE / max(picture.shape[:2])
    if shrink < 1:
        warnings.append(f"a texture of {picture.shape[1]}x{picture.shape[0]} was reduced to {MAX_EDGE} pixels")
        picture = cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return picture


def _light(mesh: Any, vertices: Array, faces: Array, rotate: bool) -> Array:
    """Light on each corner ``(T, 3)``: ambient and one distant lamp, smooth over bends and flat at creases."""
    corners = vertices[faces]
    flat: Array = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
    smooth: Array = np.nan_to_num(np.asarray(mesh.vertex_normals, np.float64))[faces]
    bent = np.einsum("tcd,td->tc", smooth, flat) < CREASE
    normal: Array = np.where(bent[..., None], flat[:, None], smooth)
    sun = SUN[[0, 2, 1]] * [1, 1, -1] if rotate else SUN
    up = normal[..., 1] if rotate else normal[..., 2]
    return (0.55 + 0.5 * np.maximum(normal @ sun, 0) + 0.12 * up).astype(np.float32)
