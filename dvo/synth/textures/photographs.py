"""Photographs as textures: those of an installed scikit-image, or those of a folder."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.data.images.image_header import MAX_PIXELS, image_size
from dvo.data.images.images import is_complete
from dvo.synth import salts
from dvo.synth.textures.patterns import PATTERNS, SPECIAL

# Photographs inside the scikit-image wheel (read from its folder, so nothing is ever downloaded) and what they suit.
PHOTOGRAPHS = {
    "astronaut.png": "photo", "brick.png": "wall", "camera.png": "photo", "chelsea.png": "photo",
    "coffee.png": "photo", "coins.png": "photo", "grass.png": "ground", "gravel.png": "stone",
    "hubble_deep_field.jpg": "photo", "ihc.png": "busy", "moon.png": "stone", "motorcycle_left.png": "photo",
    "retina.jpg": "photo", "rocket.jpg": "photo",
    "cell.png": "stone", "clock_motion.png": "photo",
}  # fmt: skip


def photographs() -> list[tuple[np.ndarray, str]]:
    """Photographs that an installed scikit-image ships.

    Returns:
        ``(H, W, 3)`` float32 RGB in [0, 1] with their tags; empty without the package.
    """
    spec = importlib.util.find_spec("skimage")
    if spec is None or spec.origin is None:
        return []
    found = []
    for name, tag in PHOTOGRAPHS.items():
        image = cv2.imread(str(Path(spec.origin).parent / "data" / name), cv2.IMREAD_COLOR)
        if image is not None:
            found.append((cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.float32) / 255, tag))
    return found


SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
MOST_PHOTOGRAPHS, EDGE = 96, 1024  # of a folder: how many a pool takes, and their longer edge in pixels
MOST_BYTES = 256 * 1024**2  # of a photograph
TAGS = {tag for _, tag in (*PATTERNS.values(), *SPECIAL.values())} | {"photo"}


def folder_photographs(folder: Path | str, seed: int) -> list[tuple[np.ndarray, str]]:
    """Photographs of a folder and its subfolders, up to ``MOST_PHOTOGRAPHS``.

    A subfolder named after a tag ("wall", "floor", "ground", ...) gives its images that tag; others have "photo".

    Args:
        folder: with image files.
        seed: draws the images of a larger folder.

    Returns:
        ``(H, W, 3)`` float32 RGB in [0, 1] with their tags; the longer edge is ``EDGE`` at most.

    Raises:
        DvoError: no such folder, no images in it, or one that cannot be read.
    """
    folder = Path(folder)
    remedy = f"give a folder with pictures ({', '.join(SUFFIXES[:3])}, ...)"
    if not folder.is_dir():
        raise DvoError("no such folder", file=folder, field="textures", remedy=remedy)
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in SUFFIXES and file.is_file())
    if not files:
        raise DvoError("no pictures in it", file=folder, field="textures", remedy=remedy)
    if len(files) > MOST_PHOTOGRAPHS:
        chosen = np.random.default_rng([seed, salts.FOLDER]).choice(len(files), MOST_PHOTOGRAPHS, replace=False)
        files = [files[i] for i in sorted(chosen)]
    found = []
    for file in files:
        image = _read(file)
        if min(image.shape[:2]) < 16:
            raise DvoError("smaller than 16 pixels", file=file, field="textures", remedy="remove the file")
        shrink = EDGE / max(image.shape[:2])
        if shrink < 1:
            image = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        tag = file.parent.name if file.parent.name in TAGS else "photo"
        found.append((cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.float32) / 255, tag))
    return found


def _read(file: Path) -> np.ndarray:
    """Picture ``(H, W, 3)`` uint8 BGR of a file that is whole and not huge.

    Raises:
        DvoError: it is not.
    """
    size = image_size(file)
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise DvoError(
            f"huge: {size[0]}x{size[1]} pixels, {MAX_PIXELS // 10**6} million at most",
            file=file,
            field="textures",
            remedy="make it smaller",
        )
    image = None
    try:
        data = file.read_bytes() if size is not None and file.stat().st_size <= MOST_BYTES else b""
        if is_complete(data):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except (OSError, cv2.error):
        pass
    if image is None:
        remedy = "replace or remove the file"
        raise DvoError("cannot be read as a picture, or cut short", file=file, field="textures", remedy=remedy)
    return image
