"""Image files: listing in natural order, and decoding to 8-bit RGB."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.text import visible
from dvo.data.files.files import read_image_file
from dvo.data.images.image_header import MAX_PIXELS, image_size, white_value
from dvo.data.images.orientation import oriented
from dvo.data.images.reduction import Reduction

SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".bmp", ".dib", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".pnm"}
)

UNREAD = frozenset(
    {".heic", ".heif", ".avif", ".jxl", ".jp2", ".exr", ".hdr", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf",
     ".rw2", ".gif", ".tga", ".pcx", ".mpo", ".dpx", ".psd"}
)  # fmt: skip
"""Endings of images that are not read: of phones, of cameras, and moving ones."""
_NARROW = 16  # of the range of 16 bits, a part in which pixels have little contrast
_LAST, _WRAPPED = 9999, 4  # number behind which cameras begin anew; files among which that is looked for
_HEXADECIMAL = re.compile(r"[0-9a-f]+")


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts ``img_2`` before ``img_10``.

    Args:
        name: of a file.
    """
    parts = re.split(r"([0-9]+)", name)
    # "²" is a digit to str.isdigit, but no number to int
    key = [(0, int(part), "") if part[0] in "0123456789" else (1, 0, part.lower()) for part in parts if part]
    return [*key, (2, 0, name)]  # 1.png and 01.png have one place, whatever the order of the folder


def in_order(files: Sequence[Path]) -> list[Path]:
    """Files in natural order; hexadecimal numbers of one length (``0009``, ``000a``) in theirs.

    Args:
        files: of one folder.
    """
    stems = {path.stem.lower() for path in files}
    if len({len(stem) for stem in stems}) == 1 and all(_HEXADECIMAL.fullmatch(stem) for stem in stems):
        return sorted(files, key=lambda path: (path.stem.lower(), path.name))
    return sorted(files, key=lambda path: natural_key(path.name))


def _counted_on(files: list[Path], warnings: list[str] | None) -> list[Path]:
    """Files whose numbers begin anew behind 9999, as those of cameras do, in the order in which they were taken."""
    found = [re.fullmatch(r"(.*?)0?([0-9]{4})", path.stem) for path in files]
    if len(files) < _WRAPPED or not all(found) or len({one[1] for one in found if one}) != 1:
        return files
    numbers = np.array([int(one[2]) for one in found if one])
    steps = np.diff(numbers)
    k = int(steps.argmax()) + 1
    others = np.delete(steps, k - 1).max()
    if numbers[0] > 1 or numbers[-1] != _LAST or steps[k - 1] <= max(10 * others, len(files)):
        return files
    if warnings is not None:
        warnings.append(f"the names count from {visible(files[-1].name)} on with {visible(files[0].name)}")
    return files[k:] + files[:k]


def list_images(folder: Path, warnings: list[str] | None = None) -> list[Path]:
    """List the image files directly in a folder, in natural order; hidden ones left out.

    Args:
        folder: need not exist.
        warnings: receives a sentence about images of formats that are not read, beside others.

    Raises:
        DvoError: with ``warnings``, images of such formats alone.
    """
    if not folder.is_dir():
        return []
    files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    found = _counted_on(in_order([path for path in files if path.suffix.lower() in SUFFIXES]), warnings)
    unread = [] if warnings is None else [path for path in files if path.suffix.lower() in UNREAD]
    if unread and warnings is not None:
        kinds = ", ".join(sorted({path.suffix.lower()[1:].upper() for path in unread}))
        message = f"{len(unread)} images of a format that is not read ({kinds})"
        if not found:
            raise DvoError(message, file=folder, remedy="convert them to JPEG or PNG, in the order of their names")
        warnings.append(f"{message} are left out")
    return found


def has_images(folder: Path) -> bool:
    """True if at least one image file lies directly in the folder; does not list a large folder to its end.

    Args:
        folder: need not exist.
    """
    return folder.is_dir() and any(
        path.suffix.lower() in SUFFIXES and not path.name.startswith(".") for path in folder.iterdir()
    )


def used_bits(images: Iterable[np.ndarray | None]) -> int:
    """Bits that images of 16 bits use: cameras write 10, 12 or 14 of them into the lower ones, programs 8.

    Args:
        images: some of a recording, as decoded; None and others are passed over.

    Returns:
        8, 10, 12, 14 or 16; the fewest that hold every pixel.
    """
    largest = max((int(image.max()) for image in images if image is not None and image.dtype == np.uint16), default=0)
    return next((bits for bits in (8, 10, 12, 14) if 0 < largest < 2**bits), 16)


def few_bits(bits: int) -> str:
    """Note about images of 16 bits that use fewer.

    Args:
        bits: of :func:`used_bits`.
    """
    return f"the images of 16 bits hold {bits} bits: they are divided by {2 ** (bits - 8)}, not by 257"


def narrow_range(images: Iterable[np.ndarray | None], bits: int) -> str | None:
    """Note about images of 16 bits with little contrast, such as temperatures.

    Args:
        images: some of a recording, as decoded; None and others are passed over.
        bits: that they use.

    Returns:
        A sentence; None where the pixels spread over more than a sixteenth of the range.
    """
    deep = [image for image in images if image is not None and image.dtype == np.uint16]
    low = min((float(np.quantile(image, 0.01)) for image in deep), default=0.0)
    high = max((float(np.quantile(image, 0.99)) for image in deep), default=0.0)
    if not 0 < high - low < 2**bits / _NARROW:
        return None
    return (
        f"most pixels of the images have levels from {low:.0f} to {high:.0f} of {2**bits - 1}, as of temperatures: "
        "give images of 8 bits in which this range is stretched, in all of them alike"
    )


def to_rgb8(image: np.ndarray, bits: int = 16) -> np.ndarray:
    """Convert an image as OpenCV decodes it.

    Grey is repeated, alpha dropped, 16 bit divided by 257 (a fixed factor: brightness stays comparable over frames).

    Args:
        image: ``(H, W)`` or ``(H, W, 1|3|4)`` uint8 or uint16, BGR order.
        bits: that pixels of uint16 use; fewer than 16 have a smaller factor, and what is brighter is white.

    Returns:
        ``(H, W, 3)`` uint8 RGB.

    Raises:
        DvoError: another type of pixel (a depth map in float, say).
    """
    if image.dtype == np.uint16:
        if bits < 16:
            image = np.minimum(image >> (bits - 8), 255).astype(np.uint8)
        else:
            image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if image.dtype != np.uint8:
        raise DvoError(f"pixels of type {image.dtype}", remedy="convert the images to 8 bit")
    if image.ndim == 2 or image.shape[2] == 1:
        return np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2)
    return np.ascontiguousarray(image[..., 2::-1])


def read_image(
    path: Path, reduction: Reduction | None = None, orientation: int = 1, bits: int = 16
) -> np.ndarray | None:
    """Decode an image file.

    Args:
        path: the file.
        reduction: of the image, after it is turned; None for none.
        orientation: by which it is turned, see :func:`dvo.data.images.orientation.oriented`; that of its own EXIF data
            is not looked at.
        bits: see :func:`to_rgb8`.

    Returns:
        ``(H, W, 3)`` uint8 RGB, or None if the file is missing, corrupt or cut short.

    Raises:
        DvoError: an image of more than :data:`dvo.data.images.image_header.MAX_PIXELS`, or a readable one with pixels
            that are no colours (float).
    """
    image = decode(path, reduction, orientation)
    return None if image is None else converted(image, path, bits)


def converted(image: np.ndarray, path: Path, bits: int = 16) -> np.ndarray:
    """Convert the decoded image of a file, see :func:`to_rgb8`; of a PGM or PPM by the value of white that it states.

    Args:
        image: as OpenCV decodes it.
        path: of the file, for messages.
        bits: see :func:`to_rgb8`.

    Returns:
        ``(H, W, 3)`` uint8 RGB.

    Raises:
        DvoError: pixels that are no colours (float).
    """
    white = white_value(path)
    if white is not None:
        image = np.minimum(image.astype(np.float32) * (255 / white) + 0.5, 255).astype(np.uint8)
    try:
        return to_rgb8(image, bits)
    except DvoError as error:
        raise DvoError(error.message, file=path, remedy=error.remedy) from None


def decode(path: Path, reduction: Reduction | None = None, orientation: int = 1) -> np.ndarray | None:
    """Decode an image file as it is; its size is taken from the header before.

    Args:
        path: the file.
        reduction, orientation: as :func:`read_image`.

    Returns:
        ``(H, W)`` or ``(H, W, C)`` in OpenCV's order of channels; None if the file is missing, no regular file, of an
        unknown format, corrupt or cut short.

    Raises:
        DvoError: an image of more than :data:`dvo.data.images.image_header.MAX_PIXELS`.
    """
    data = read_image_file(path)
    return None if data is None else decode_bytes(data, path, reduction, orientation)


def decode_bytes(
    data: bytes, name: object, reduction: Reduction | None = None, orientation: int = 1
) -> np.ndarray | None:
    """Decode the bytes of an image file; see :func:`decode`.

    Args:
        data: the file.
        name: of it, for messages.
        reduction, orientation: as :func:`read_image`.

    Returns:
        As :func:`decode`.

    Raises:
        DvoError: as :func:`decode`.
    """
    import cv2

    if not is_complete(data):
        return None
    size = image_size(data)
    if size is None:
        return None
    if size[0] * size[1] > MAX_PIXELS:
        raise DvoError(
            f"image of {size[0]}x{size[1]} pixels, more than {MAX_PIXELS:,}", file=name, remedy="reduce the images"
        )
    mode = cv2.IMREAD_UNCHANGED
    upright = size[::-1] if orientation > 4 else size
    if reduction is not None and reduction.is_exact and reduction.recorded == upright and data.startswith(b"\xff\xd8"):
        mode = _reduced_modes().get(reduction.factor, mode)  # the decoder of JPEG files does less work then
    if data[:2] in (b"P1", b"P2", b"P3"):  # the last number ends with the file
        data += b"\n"
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), mode)
    except cv2.error:
        return None
    if image is None or image.size == 0:
        return None
    image = oriented(image, orientation)
    return image if reduction is None else reduction(image)


def _reduced_modes() -> dict[int, int]:
    """Modes of decoding by factors, without the orientation of EXIF data, which IMREAD_UNCHANGED ignores too."""
    import cv2

    modes = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8}
    return {factor: mode | cv2.IMREAD_IGNORE_ORIENTATION for factor, mode in modes.items()}


def is_complete(data: bytes) -> bool:
    """True if the end mark of a PNG or JPEG file is there, and every chunk of a PNG lies inside the file.

    The decoders return a cut file with its lower part grey, and no error; OpenCV allocates what a chunk states as its
    length. What follows the end mark is ignored: phones append videos, recorders the rest of their buffers.

    Args:
        data: the bytes of an image file; of other formats any byte will do.
    """
    if data.startswith(b"\x89PNG"):
        return _chunks_inside(data)
    if data.startswith(b"\xff\xd8"):
        return _has_end(data)
    return len(data) > 0


def _chunks_inside(data: bytes) -> bool:
    at, kind = 8, b""
    while kind != b"IEND" and at < len(data):
        kind = data[at + 4 : at + 8]
        at += int.from_bytes(data[at : at + 4], "big") + 12
    return kind == b"IEND" and at <= len(data)


def _has_end(data: bytes) -> bool:
    """True if a JPEG file has an end mark behind its scans; segments, which may hold a thumbnail, are passed over."""
    at, is_scan = 2, False
    for _ in range(_SEGMENTS):
        found = (_MARK_IN_SCAN if is_scan else _MARK).search(data, at)
        if found is None:
            return False
        kind, at = data[found.end() - 1], found.end()
        if kind == 0xD9:
            return is_scan
        if kind in _BARE:
            continue
        at += max(int.from_bytes(data[at : at + 2], "big"), 2)
        is_scan = is_scan or kind == 0xDA
    return False


_MARK, _MARK_IN_SCAN = re.compile(rb"\xff[^\x00\xff]", re.DOTALL), re.compile(rb"\xff[^\x00\xff\xd0-\xd7]", re.DOTALL)
_BARE = (0x01, *range(0xD0, 0xD9))  # marks without a segment
_SEGMENTS = 2**14
