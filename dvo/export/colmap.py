"""COLMAP's sparse model: cameras, images and points3D, as binary or text files (https://colmap.github.io/format.html).

Poses are world to camera, ``QW QX QY QZ TX TY TZ``, with x right, y down, z forward: dvo's own. COLMAP counts pixels
from the corner of the first one, so 0.5 is added to principal points and observations. Binary files are little endian.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from dvo.data.calibration.calibration import FOUND
from dvo.export.reconstruction import CORNER, Reconstruction
from dvo.geometry.poses import matrix_to_quaternion

_PINHOLE = 1  # number of the camera model
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_TRACK = np.dtype([("image", "<i4"), ("index", "<i4")])


def write_colmap(reconstruction: Reconstruction, folder: Path) -> None:
    """Write ``images/``, ``masks/``, ``sparse/0/`` with cameras.bin, images.bin and points3D.bin, and times.txt.

    Args:
        reconstruction: of one world.
        folder: an empty folder.

    Raises:
        OSError: a file cannot be written.
    """
    model = _folders(reconstruction, folder)
    (model / "cameras.bin").write_bytes(_cameras_bin(reconstruction))
    (model / "images.bin").write_bytes(_images_bin(reconstruction))
    (model / "points3D.bin").write_bytes(_points_bin(reconstruction))


def write_colmap_text(reconstruction: Reconstruction, folder: Path) -> None:
    """Write ``images/``, ``masks/``, ``sparse/0/`` with cameras.txt, images.txt and points3D.txt, and times.txt.

    Args:
        reconstruction: of one world.
        folder: an empty folder.

    Raises:
        OSError: a file cannot be written.
    """
    model = _folders(reconstruction, folder)
    texts = {
        "cameras.txt": _cameras_txt(reconstruction),
        "images.txt": _images_txt(reconstruction),
        "points3D.txt": _points_txt(reconstruction),
    }
    for name, lines in texts.items():
        (model / name).write_text("".join(f"{line}\n" for line in lines), encoding="ascii", newline="\n")


def write_images(reconstruction: Reconstruction, folder: Path) -> None:
    """Write the image files, their masks, and a file of their times.

    Args:
        reconstruction: of one world.
        folder: takes ``images/``, ``masks/`` if there are masks, and ``times.txt``, rows ``seconds name``.

    Raises:
        OSError: a file cannot be written.
    """
    (folder / "images").mkdir()
    for name, jpeg in zip(reconstruction.names, reconstruction.jpegs, strict=True):
        (folder / "images" / name).write_bytes(jpeg)
    if reconstruction.masks:
        (folder / "masks").mkdir()
        for name, mask in zip(reconstruction.names, reconstruction.masks, strict=True):
            (folder / mask_file(name)).write_bytes(mask)
    times = zip(reconstruction.timestamps.tolist(), reconstruction.names, strict=True)
    rows = "".join(f"{time:.9f} {name}\n" for time, name in times)
    (folder / "times.txt").write_text("# seconds name\n" + rows, encoding="ascii", newline="\n")


def mask_file(name: str) -> str:
    """Place of the mask of an image, as ``--ImageReader.mask_path masks`` of COLMAP looks for it.

    Args:
        name: of the image file.

    Returns:
        Path within the folder of the export.
    """
    return f"masks/{name}.png"


def _folders(reconstruction: Reconstruction, folder: Path) -> Path:
    write_images(reconstruction, folder)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    return model


def _image_ids(reconstruction: Reconstruction) -> np.ndarray:
    """``(N,)`` from 1 in the order of the names: the numbers that the database of COLMAP gives to these images."""
    return np.arange(1, len(reconstruction.identifiers) + 1)


def _poses(reconstruction: Reconstruction) -> np.ndarray:
    """``(N, 7)`` QW QX QY QZ TX TY TZ, world to camera."""
    quaternions = matrix_to_quaternion(reconstruction.T_cw[:, :3, :3])
    return np.column_stack([quaternions[:, 3], quaternions[:, :3], reconstruction.T_cw[:, :3, 3]])


def _parameters(reconstruction: Reconstruction) -> list[tuple[int, int, list[float]]]:
    """Width, height and ``fx fy cx cy`` of each camera, counted from the corner of the first pixel."""
    return [(c.width, c.height, [c.fx, c.fy, c.cx + CORNER, c.cy + CORNER]) for c in reconstruction.cameras]


def _observations(reconstruction: Reconstruction) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Observations of each image, and track of each point: its images, and its position among their observations."""
    r = reconstruction
    table = np.zeros(len(r.image_of), _OBSERVATION)
    table["x"], table["y"] = (r.positions + CORNER).T
    table["point"] = r.point_of + 1
    ends = np.searchsorted(r.image_of, np.arange(1, len(r.jpegs)))
    starts = np.searchsorted(r.image_of, np.arange(len(r.jpegs)))
    track = np.zeros(len(r.image_of), _TRACK)
    track["image"] = _image_ids(r)[r.image_of]
    track["index"] = np.arange(len(track)) - starts[r.image_of]
    order = np.argsort(r.point_of, kind="stable")
    cuts = np.searchsorted(r.point_of[order], np.arange(1, len(r.points)))
    return np.split(table, ends), np.split(track[order], cuts) if len(r.points) else []


# -- binary files ------------------------------------------------------------------------------------------------


def _cameras_bin(reconstruction: Reconstruction) -> bytes:
    parts = [struct.pack("<Q", len(reconstruction.cameras))]
    for number, (width, height, values) in enumerate(_parameters(reconstruction), start=1):
        parts.append(struct.pack("<iiQQ4d", number, _PINHOLE, width, height, *values))
    return b"".join(parts)


def _images_bin(reconstruction: Reconstruction) -> bytes:
    observations, _ = _observations(reconstruction)
    ids, cameras = _image_ids(reconstruction).tolist(), (reconstruction.camera_of + 1).tolist()
    poses = _poses(reconstruction)
    parts = [struct.pack("<Q", len(ids))]
    for row, name in enumerate(reconstruction.names):
        parts.append(struct.pack("<i7di", ids[row], *poses[row], cameras[row]) + name.encode("ascii") + b"\0")
        parts.append(struct.pack("<Q", len(observations[row])) + observations[row].tobytes())
    return b"".join(parts)


def _points_bin(reconstruction: Reconstruction) -> bytes:
    _, tracks = _observations(reconstruction)
    r = reconstruction
    parts = [struct.pack("<Q", len(r.points))]
    rows = zip(r.points.tolist(), r.colors.tolist(), r.errors.tolist(), tracks, strict=True)
    for number, (point, color, error, track) in enumerate(rows, start=1):
        parts.append(struct.pack("<Q3d3BdQ", number, *point, *color, error, len(track)) + track.tobytes())
    return b"".join(parts)


# -- text files --------------------------------------------------------------------------------------------------


def _row(*values: object) -> str:
    return " ".join(str(value) for value in values)


def _cameras_txt(reconstruction: Reconstruction) -> list[str]:
    lines = [f"# {FOUND}: not measured, and maybe a guess"] if reconstruction.was_found else []
    lines += ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines.append(f"# Number of cameras: {len(reconstruction.cameras)}")
    for number, (width, height, values) in enumerate(_parameters(reconstruction), start=1):
        lines.append(_row(number, "PINHOLE", width, height, *values))
    return lines


def _images_txt(reconstruction: Reconstruction) -> list[str]:
    observations, _ = _observations(reconstruction)
    ids, cameras = _image_ids(reconstruction).tolist(), (reconstruction.camera_of + 1).tolist()
    poses = _poses(reconstruction).tolist()
    lines = ["# Image list with two lines of data per image:"]
    lines.append("#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME")
    lines.append("#   POINTS2D[] as (X, Y, POINT3D_ID)")
    mean = len(reconstruction.image_of) / max(len(ids), 1)
    lines.append(f"# Number of images: {len(ids)}, mean observations per image: {mean}")
    for row, name in enumerate(reconstruction.names):
        lines.append(_row(ids[row], *poses[row], cameras[row], name))
        lines.append(" ".join(_row(*observation) for observation in observations[row].tolist()))
    return lines


def _points_txt(reconstruction: Reconstruction) -> list[str]:
    _, tracks = _observations(reconstruction)
    r = reconstruction
    lines = ["# 3D point list with one line of data per point:"]
    lines.append("#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)")
    mean = len(r.image_of) / max(len(r.points), 1)
    lines.append(f"# Number of points: {len(r.points)}, mean track length: {mean}")
    rows = zip(r.points.tolist(), r.colors.tolist(), r.errors.tolist(), tracks, strict=True)
    for number, (point, color, error, track) in enumerate(rows, start=1):
        lines.append(_row(number, *point, *color, error, *(value for pair in track.tolist() for value in pair)))
    return lines
