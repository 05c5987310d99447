"""Mutations of image files: sizes stated in the header, cuts, pixel types and formats."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

Random = np.random.Generator
SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})
SIZES = [(30_000, 30_000), (2**31 - 1, 1), (1, 2**31 - 1), (65_535, 65_535), (0, 0), (0, 48), (20_000, 3_000), (1, 1)]


def png(width: int, height: int, depth: int = 8, colour: int = 2, data: bytes = b"\0" * 100) -> bytes:
    """PNG file with any header; the pixels need not be there.

    Args:
        width, height: pixels, as the header states them.
        depth: bits of a sample.
        colour: type of colour: 0 grey, 2 RGB, 6 RGB with alpha.
        data: pixels, not compressed.
    """

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def headers(width: int, height: int) -> dict[str, bytes]:
    """Beginnings of image files of every format, which state a size and hold next to no pixels.

    Args:
        width, height: pixels; cut to what the format can state.
    """
    w, h = min(width, 65_535), min(height, 65_535)
    tags = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8), (277, 3, 1),
            (278, 4, height), (279, 4, 100)]  # fmt: skip
    tiff = b"II*\0\x08\0\0\0" + struct.pack("<H", len(tags))
    tiff += b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags) + bytes(104)
    return {
        "PNG": png(width, height),
        "PNG of 16 bit": png(width, height, 16, 6),
        "BMP": b"BM" + struct.pack("<IIIIiiHH", 154, 0, 54, 40, width, height, 1, 24) + bytes(124),
        "PGM": b"P5\n%d %d\n255\n" % (width, height) + bytes(100),
        "PPM": b"P6\n# text\n%d\n%d\n65535\n" % (width, height) + bytes(100),
        "PAM": b"P7\nWIDTH %d\nHEIGHT %d\nDEPTH 3\nMAXVAL 255\nENDHDR\n" % (width, height) + bytes(100),
        "TIFF": tiff,
        "WebP": b"RIFF" + struct.pack("<I", 130) + b"WEBPVP8X" + struct.pack("<II", 10, 0)
                + struct.pack("<I", max(w - 1, 0))[:3] + struct.pack("<I", max(h - 1, 0))[:3] + bytes(100),
        "HDR": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width) + bytes(100),
        "Sun raster": struct.pack(">8I", 0x59A66A95, width, height, 24, 100, 1, 0, 0) + bytes(100),
        "PFM": b"PF\n%d %d\n-1.0\n" % (width, height) + bytes(100),
        "GIF": b"GIF89a" + struct.pack("<HH3x", w, h) + b",\0\0\0\0" + struct.pack("<HH", w, h) + b"\0\x08\x01\0\0;",
        "JPEG": _jpeg(w, h),
    }  # fmt: skip


def _jpeg(width: int, height: int) -> bytes:
    """JPEG of 8x8 pixels whose header is overwritten."""
    import cv2

    data = bytearray(cv2.imencode(".jpg", np.full((8, 8, 3), 90, np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def state_size(file: Path, random: Random) -> str:
    """Header of any format with an odd size, and next to no pixels."""
    size = SIZES[int(random.integers(len(SIZES)))]
    found = headers(*size)
    name = list(found)[int(random.integers(len(found)))]
    file.write_bytes(found[name])
    return f"{name} header of {size[0]}x{size[1]}"


def overwrite_size(file: Path, random: Random) -> str:
    """State another size in the header of a PNG with all its pixels."""
    data = bytearray(file.read_bytes())
    if not data.startswith(b"\x89PNG") or len(data) < 33:
        return state_size(file, random)
    size = SIZES[int(random.integers(len(SIZES)))]
    data[16:24] = struct.pack(">II", *size)
    data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    file.write_bytes(bytes(data))
    return f"size {size[0]}x{size[1]} in the header"


def cut_with_end(file: Path, random: Random) -> str:
    """Cut a PNG or JPEG, and put its end mark behind the cut."""
    data = file.read_bytes()
    kept = data[: int(random.integers(len(data) + 1))]
    file.write_bytes(kept + (b"\0\0\0\0IEND\xaeB`\x82" if data.startswith(b"\x89PNG") else b"\xff\xd9"))
    return f"cut after {len(kept)} bytes, with an end mark"


def change_pixels(file: Path, random: Random) -> str:
    """Write an image of another size, number of channels or type of pixel."""
    import cv2

    height, width = [(48, 64), (1, 1), (64, 48), (15, 3), (480, 640), (3000, 4)][int(random.integers(6))]
    channels = [1, 3, 4][int(random.integers(3))]
    kinds = [np.uint8, np.uint16, np.float32, np.int32, np.float64]
    ending, kind = ".tiff", kinds[int(random.integers(len(kinds)))]
    if random.random() < 0.5:
        ending, kind = ".png", kinds[int(random.integers(2))]
    image = (random.random((height, width, channels)) * 300 - 20).astype(kind)
    if np.issubdtype(kind, np.floating) and random.random() < 0.5:
        image[::2] = np.nan
    done, data = cv2.imencode(ending, image)
    file.write_bytes(data.tobytes() if done else b"")
    return f"{width}x{height} with {channels} channels of {np.dtype(kind)} as {ending}"


def inflate(file: Path, random: Random) -> str:
    """PNG that states a small size, and inflates to a hundred megabytes."""
    file.write_bytes(png(64, 48, data=bytes(10**8)))
    return "PNG with 100 MB of pixels for 64x48"


def state_frame_size(file: Path, random: Random) -> str:
    """State another size in the header of a Motion JPEG video, in that of its frames, or in both."""
    data = bytearray(file.read_bytes())
    width, height = SIZES[int(random.integers(len(SIZES)))]
    way = int(random.integers(3))
    at = data.find(b"strf")
    if way != 0 and at >= 0:
        data[at + 12 : at + 20] = struct.pack("<ii", width, height)
    at = data.find(b"\xff\xc0")
    while way != 1 and at >= 0:
        data[at + 5 : at + 9] = struct.pack(">HH", min(height, 65_535), min(width, 65_535))
        at = data.find(b"\xff\xc0", at + 9)
    file.write_bytes(bytes(data))
    return f"frames of {width}x{height} in the header of {('the frames', 'the video', 'both')[way]}"


MUTATIONS: list[Callable[[Path, Random], str]] = [
    state_size, state_size, overwrite_size, cut_with_end, cut_with_end, change_pixels, change_pixels, inflate,
]  # fmt: skip
