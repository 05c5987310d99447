"""Masks: pixels of the images that are used; what a bonnet, a watermark or a rim covers is not."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.images.images import decode, list_images
from dvo.data.images.reduction import Reduction
from dvo.data.recording import Recording
from dvo.geometry.undistort import Undistorter

_HALF = 128  # grey level from which a pixel of a JPEG file is white: its black is not exactly 0
_REMEDY = "give an image of the size of the recorded ones, white where they are used and black elsewhere"


def read_mask(file: Path, invert: bool = False) -> np.ndarray:
    """Read a mask.

    Args:
        file: image of any format that OpenCV reads. Pixels other than black are used; of a JPEG file those brighter
            than mid-grey, because compression leaves no exact black. Of an image with transparent pixels these are
            ignored, and its colours count only if they are black and white.
        invert: the other way round.

    Returns:
        ``(H, W)`` bool.

    Raises:
        DvoError: no image.
    """
    image = decode(file)
    if image is None:
        raise DvoError("cannot be read as an image", file=file, field="mask", remedy=_REMEDY)
    levels = image if image.ndim == 2 else _levels(image)
    least = _HALF if file.suffix.lower() in (".jpg", ".jpeg") else 1e-12
    return (levels >= least) != invert


def _levels(image: np.ndarray) -> np.ndarray:
    """Grey levels of an image with channels; what is transparent is black, and alone decides beside colours."""
    colours = image[..., : min(3, image.shape[2])].max(axis=2)
    if image.shape[2] != 4 or image[..., 3].all():
        return colours
    is_drawn = len(np.unique(colours)) == 2 and colours.min() == 0  # black and white, besides
    return np.minimum(colours, image[..., 3]) if is_drawn else image[..., 3]


class Masks:
    """Masks of the images of a recording.

    Args:
        files: one for all images, or one for each of them by position.
        size: width and height of the recorded images.
        invert: white pixels are ignored, black ones used.
        reduction: of the images; None for none.
    """

    def __init__(
        self, files: list[Path], size: tuple[int, int], invert: bool, reduction: Reduction | None = None
    ) -> None:
        self.files, self.size, self.invert, self.reduction = files, size, invert, reduction
        self._read = lru_cache(maxsize=1)(self._load)

    def at_recorded_size(self) -> Masks:
        """The same masks for images that are not reduced."""
        return Masks(self.files, self.size, self.invert)

    def __call__(self, index: int, undistorter: Undistorter | None) -> np.ndarray:
        """Mask of an image.

        Args:
            index: position of the image in the recording.
            undistorter: of the images; None if they are not undistorted.

        Returns:
            ``(H, W)`` bool, False also where the lens sees nothing.

        Raises:
            DvoError: no such mask, or one of another size than the image.
        """
        if len(self.files) > 1 and index >= len(self.files):
            message = f"{len(self.files)} masks, none for the image {index}"
            raise DvoError(message, file=self.files[0].parent, field="mask", remedy="give a mask for every image")
        return self._read(self.files[index if len(self.files) > 1 else 0], undistorter)

    def _load(self, file: Path, undistorter: Undistorter | None) -> np.ndarray:
        mask = read_mask(file, self.invert)
        if mask.shape[::-1] != self.size:
            found, wanted = (f"{width}x{height}" for width, height in (mask.shape[::-1], self.size))
            raise DvoError(f"is {found}, the images are {wanted}", file=file, field="mask", remedy=_REMEDY)
        if self.reduction is not None:
            mask = self.reduction.mask(mask)
        return mask if undistorter is None else undistorter.mask(mask)


def open_masks(
    path: Path, recording: Recording, size: tuple[int, int], invert: bool, reduction: Reduction | None = None
) -> Masks:
    """Masks of a recording.

    Args:
        path: an image, or a folder with one for each image of the recording: of the same stem (or ``NAME.jpg.png``), or
            else as many as there are images, in natural order.
        recording: of the images.
        size: width and height of its images.
        invert: white pixels are ignored, black ones used.
        reduction: of the images; None for none.

    Raises:
        DvoError: nothing there, another number of masks than of images, a first mask that cannot be used, or a single
            one that leaves no pixel.
    """
    if not path.is_dir():
        files = [path]
    else:
        found = list_images(path)
        images = recording.images or []
        by_stem = {file.stem: file for file in found}
        count = recording.frame_count
        named = [by_stem.get(image.stem, by_stem.get(image.name)) for image in images]  # COLMAP: NAME.jpg.png
        if named and all(named):
            files = [file for file in named if file is not None]
        elif len(found) == count:
            files = found
        else:
            images_text = "an unknown number of" if count is None else str(count)
            message = f"{len(found)} masks for {images_text} images, and not of the same names"
            raise DvoError(message, file=path, field="mask", remedy="give one mask, or one for every image")
    masks = Masks(files, size, invert, reduction)
    first = masks(0, None)
    if len(files) == 1 and not first.any():
        remedy = "white is used and black ignored, with --mask-invert the other way round"
        raise DvoError("hides all of the image", file=files[0], field="mask", remedy=remedy)
    return masks
