"""Several streams of images in one folder, told apart by their names: colour and depth, left and right."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.text import visible
from dvo.data.images.images import decode, natural_key
from dvo.data.sensors.sensors import Listed

_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_ROLES = {
    "right": {"right", "r", "rgt"},
    "depth": {"depth", "depths", "depthmap", "d", "range", "zmap"},
    "other": {
        "mask", "masks", "seg", "semantic", "semantics", "label", "labels", "instance", "normal", "normals", "flow",
        "ir", "infra", "infrared", "conf", "confidence", "uncertainty", "albedo", "alpha", "thumb", "aligned",
        "disp", "disparity", "nir", "swir", "lwir", "thermal",
    },
    "left": {"left", "l", "lft"},
    "colour": {"color", "colour", "rgb", "image", "images", "img", "im", "frame", "col", "c"},
}  # fmt: skip
_CAMERA = re.compile(
    r"(cam|camera|image|img|view|c|infra|infrared|ir|fisheye|sensor|lens|eye|device|dev|port|channel|ch|stream|stereo|mono|"
    r"gr[ae]y|rgb|colou?r)[_-]?$", re.IGNORECASE
)  # fmt: skip
_STAMP = 13  # digits of a date in milliseconds, or of a finer one: images that share it were taken at once
_FEW = 8  # cameras whose numbers stand in names
_LEAST = 2  # images of a stream
_RECORDING = 4  # images of one of several recordings, at least
_COMMON = 0.5  # of the numbers of the smaller stream, that the other has too
_REMEDY = "put the images of one stream into a folder of their own"


@dataclass(frozen=True)
class Streams:
    """Images of the stream that is tracked, and of those beside it.

    Attributes:
        images: of the stream, in the order given.
        depth, right: files that belong to the images; None for none.
        note: sentence about the choice, or about names that are not those of one recording; None for none.
    """

    images: list[Path]
    depth: Listed | None = None
    right: Listed | None = None
    note: str | None = None


@dataclass
class _Group:
    pattern: str
    role: str
    files: list[Path] = field(default_factory=list)
    numbers: list[tuple[str, ...]] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{self.pattern} ({len(self.files)})"


def split_streams(images: Sequence[Path], folder: Path) -> Streams:
    """Tell the streams of a folder apart.

    Images whose names differ in words or endings beside the same numbers (``frame000001.jpg`` and ``depth000001.png``,
    ``left_001.png`` and ``right_001.png``), or in the number of a camera (``001_0.png`` and ``001_1.png``), are
    different streams. That of colour, the left one and the camera of the lowest number are tracked.

    Args:
        images: of one folder, in order.
        folder: for messages.

    Raises:
        DvoError: several streams, none of which is the one to track.
    """
    groups = _by_words(images) or _by_camera(images)
    if len(groups) < 2:
        return Streams(list(images), note=_odd_names(images) or _begun_anew(images))
    candidates = [group for group in groups if group.role in ("left", "colour", "plain")]
    if len(candidates) > 1:
        candidates = _by_content(candidates)
    if len(candidates) != 1:
        named = ", ".join(map(str, groups))
        raise DvoError(f"several streams of images in one folder: {named}", file=folder, remedy=_REMEDY)
    chosen = candidates[0]
    found: dict[str, Listed] = {}
    parts = []
    for group in groups:
        if group is chosen:
            continue
        files = _pairs(chosen, group) if group.role in ("depth", "right") and group.role not in found else {}
        if files:
            found[group.role] = Listed(files)
        option = "--depth, with --depth-scale UNITS" if group.role == "depth" else f"--{group.role}"
        parts.append(f"{group}" + (f" for {option}" if files else ", which are not used"))
    which = "the left one, " if chosen.role == "left" else ""
    note = f"several streams of images: reading {which}{chosen}; beside them are {'; '.join(parts)}"
    return Streams(chosen.files, found.get("depth"), found.get("right"), note)


def _odd_names(images: Sequence[Path]) -> str | None:
    """Note about the few images whose names are of another kind than the rest, such as ``preview.png``."""
    kinds: dict[str, list[Path]] = {}
    for image in images:
        kinds.setdefault(re.sub(r"[0-9]+(?:\.[0-9]+)?", "*", image.stem), []).append(image)
    usual = max(kinds.values(), key=len, default=[])
    odd = [image for image in images if image not in set(usual)]
    if not odd or len(odd) * _FEW > len(usual):
        return None
    return f"images with names of another kind are read too, in the order of the names: {_names(odd)}"


def _begun_anew(images: Sequence[Path]) -> str | None:
    """Note about names of several recordings, ``take1_0001.png`` and ``take2_0001.png``."""
    fields = [re.findall(r"[0-9]+", image.stem) for image in images]
    shapes = {re.sub(r"[0-9]+", "*", image.stem) for image in images}
    if len(shapes) != 1 or len(fields[0]) != 2 or "*.*" in shapes.pop():  # a number with a decimal point
        return None
    starts = [k for k in range(1, len(fields)) if fields[k][0] != fields[k - 1][0]]
    blocks = [fields[start:end] for start, end in pairwise([0, *starts, len(fields)])]
    same = len({int(block[0][1]) for block in blocks}) == 1
    if not (1 <= len(starts) < _FEW and same and min(map(len, blocks)) >= _RECORDING):
        return None
    names = _names([images[start] for start in starts])
    return f"the numbers of the names begin anew at {names}: several recordings are to be tracked one by one"


def _names(images: Sequence[Path]) -> str:
    shown = ", ".join(visible(image.name) for image in images[:3])
    return shown + (f" and {len(images) - 3} more" if len(images) > 3 else "")


def choose_folder(folders: Sequence[Path]) -> Path | None:
    """The folder of images to read, of several beside each other, by their names.

    Args:
        folders: two or more, in order.

    Returns:
        The only one of colour or of the left camera, or that of the lower number of two cameras (``infra1`` and
        ``infra2``); None if the names do not tell.
    """
    if _are_pair(folders):
        return folders[0]
    found = [folder for folder in folders if _role(folder.name) in ("left", "colour", "plain")]
    return found[0] if len(found) == 1 else None


def others_beside(chosen: Path, others: Sequence[Path]) -> str:
    """Note about folders of images beside the one that is read.

    Args:
        chosen: the one that is read.
        others: those that are not used.
    """
    parts = []
    for folder in others:
        role = "right" if _are_pair([chosen, folder]) else _role(folder.name)
        role = "mask" if "mask" in folder.name.lower() else role
        option = f" (--{role} {visible(str(folder))})" if role in ("depth", "mask", "right") else ""
        parts.append(visible(folder.name) + option)
    return f"several folders of images: reading {visible(chosen.name)}; beside it are {', '.join(parts)}"


def _are_pair(folders: Sequence[Path]) -> bool:
    """True for two names that differ in the number of a camera, the lower one first."""
    names = [folder.name for folder in folders]
    if len(names) != 2 or len({re.sub(r"[0-9]+", "*", name) for name in names}) != 1:
        return False
    return _CAMERA.search(re.split(r"[0-9]", names[0])[0]) is not None and natural_key(names[0]) < natural_key(names[1])


def _by_words(images: Sequence[Path]) -> list[_Group]:
    """Groups of names that differ in words or endings, if they share numbers or their words tell what they are."""
    groups: dict[str, _Group] = {}
    for image in images:
        pattern = re.sub(r"[0-9]+(?:\.[0-9]+)?", "*", image.stem) + image.suffix
        group = groups.setdefault(pattern, _Group(pattern, _role(image.stem)))
        group.files.append(image)
        group.numbers.append(tuple(re.findall(r"[0-9]+", image.stem)))
    found = list(groups.values())
    if not any(group.role == "left" for group in found):  # r_7: a rendering
        for group in found:
            group.role = _role(group.files[0].stem, "r")
    if len(found) < 2 or len(found) > _FEW or any(len(group.files) < _LEAST for group in found):
        return []
    if {group.role for group in found} in ({"left", "right"}, {"colour", "depth"}, {"plain", "depth"}):
        return found
    fewest = min(len(numbers) for group in found for numbers in group.numbers)
    for group in found:
        group.numbers = _varying(group.numbers, fewest)
    first = max(found, key=lambda group: len(group.files))
    numbers = set(first.numbers)
    shared = (
        len(numbers & set(group.numbers)) >= _COMMON * min(len(numbers), len(group.files))
        for group in found
        if group is not first
    )
    return found if all(shared) else []


def _varying(rows: list[tuple[str, ...]], count: int) -> list[tuple[str, ...]]:
    """Numbers of names without those that all names have, if there are more than so many (``r_7_depth_0001``)."""
    kept = [k for k, column in enumerate(zip(*rows, strict=False)) if len(set(column)) > 1]
    return [tuple(row[k] for k in kept) if len(row) > count and len(kept) == count else row for row in rows]


def _by_camera(images: Sequence[Path]) -> list[_Group]:
    """Groups of names that differ in the number of a camera, at the end (``001_0``), behind a word (``cam0_001``), or
    beside a date that they share (AirSim's ``img__5_1700000000000000000``).
    """
    fields = [re.findall(r"[0-9]+", image.stem) for image in images]
    shapes = {re.sub(r"[0-9]+", "*", image.stem) + image.suffix for image in images}
    if len(images) < 2 * _LEAST or len(shapes) != 1 or len(fields[0]) < 2:
        return []
    texts = re.split(r"[0-9]+", images[0].stem)
    last = len(fields[0]) - 1
    for k in (last, *range(last)):
        values = sorted({row[k] for row in fields}, key=int)
        is_end = k == last and texts[-1] == "" and texts[k] in ("_", "-") and values in (["0", "1"], ["1", "2"])
        is_camera = is_end or _CAMERA.search(texts[k]) is not None
        others = [j for j, column in enumerate(zip(*fields, strict=True)) if j != k and len(set(column)) > 1]
        is_simultaneous = bool(others) and all(len(row[j]) >= _STAMP for row in fields for j in others)
        if not 2 <= len(values) <= _FEW or not (is_camera or is_simultaneous):
            continue
        groups = {value: _Group(_with(texts, k, value) + images[0].suffix, "plain") for value in values}
        for image, row in zip(images, fields, strict=True):
            groups[row[k]].files.append(image)
            groups[row[k]].numbers.append((*row[:k], *row[k + 1 :]))
        found = list(groups.values())
        numbers = [set(group.numbers) for group in found]
        if all(len(numbers[0] & other) >= _COMMON * min(len(numbers[0]), len(other)) for other in numbers[1:]):
            found[0].role, found[1].role = ("left", "right") if is_camera else ("plain", "other")
            for group in found[2:]:
                group.role = "other"
            return found
    return []


def _with(texts: list[str], k: int, value: str) -> str:
    """Pattern of the names of a camera."""
    marks = ["*"] * (len(texts) - 1)
    marks[k] = value
    return "".join(text + mark for text, mark in zip(texts, [*marks, ""], strict=True))


def _role(stem: str, without: str = "") -> str:
    words = {word.lower() for word in _WORD.findall(re.sub(r"[0-9]+", " ", stem))} - {without}
    return next((role for role, names in _ROLES.items() if words & names), "plain")


def _by_content(candidates: list[_Group]) -> list[_Group]:
    """Candidates that are no depth by their pixels: one channel of more than 8 bits beside others of 8 bits."""
    images = [decode(group.files[0]) for group in candidates]
    is_deep = [image is not None and image.ndim == 2 and image.dtype != np.uint8 for image in images]
    if any(is_deep) and not all(is_deep):
        for group, deep in zip(candidates, is_deep, strict=True):
            group.role = "depth" if deep else group.role
        return [group for group, deep in zip(candidates, is_deep, strict=True) if not deep]
    return candidates


def _pairs(images: _Group, others: _Group) -> dict[Path, Path]:
    """Files of the same numbers, else those of the same place in the order."""
    by_numbers = dict(zip(others.numbers, others.files, strict=True))
    pairs = {
        image: by_numbers[numbers]
        for image, numbers in zip(images.files, images.numbers, strict=True)
        if numbers in by_numbers
    }
    if not pairs and len(images.files) == len(others.files):
        return dict(zip(images.files, others.files, strict=True))
    return pairs
