"""Entries of a camera in a tree of mappings, and which of them were used."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import EXPECTED
from dvo.data.calibration.lens_names import bare, looks_like_a_lens, says_nothing

# Mappings whose entries count as those of the mapping that they stand in.
_GROUPS = frozenset(
    [
        "intrinsics",
        "intrinsic",
        "intrinsicparameters",
        "projectionparameters",
        "distortionparameters",
        "mirrorparameters",
        "distortion",
        "dist",
        "distortioncoefficients",
        "distortioncoeffs",
        "distcoeffs",
        "resolution",
        "imagesize",
        "size",
        "imageresolution",
        "image",
        "k",
        "cameramatrix",
        "kmatrix",
        "rgbd",
        "stereo",
        "lens",
        "projection",
        "camera.intrinsics",
        "cameraintrinsics",
        "distortionparams",
        "lensdistortion",
        "imagedimension",
    ]
)
_VAGUE = frozenset(
    ["type", "model", "name", "parameters", "params", "data", "values", "coefficients", "coeffs", "coefs"]
)
_AFFIX = re.compile(r"^(?:camera|cam)_?(?=[a-z])|^image_?(?=(?:width|height)$)", re.IGNORECASE)
_MATRICES = ("k", "cameramatrix", "intrinsics", "intrinsic", "intrinsicmatrix", "mtx", "m", "cameraintrinsics", 
             "kmatrix", "cam", "camk", "intrinsicsmatrix", "calibrationmatrix", "matrix", "intrinsicparameters", "kmat",
             "intrinsicsparameters", "intrinsicsdata", "newcameramatrix", "camerakmatrix", "cameramat", "cammatrix",
             "cameraintrinsic", "cameraintrinsicmatrix", "projectionparameters", "intrinsicsvector")  # fmt: skip
FX = ("fx", "flx", "focalx", "focallengthx", "fu", "gamma1", "mu", "fxpx", "fxpixels", "alphax")
FY = ("fy", "fly", "focaly", "focallengthy", "fv", "gamma2", "mv", "fypx", "fypixels", "alphay")
CX = ("cx", "ppx", "u0", "principalx", "principalpointx", "cu", "px", "x0", "opticalcenterx", "centerx")
CY = ("cy", "ppy", "v0", "principaly", "principalpointy", "cv", "py", "y0", "opticalcentery", "centery")
FOCAL = ("f", "focal", "focallength", "fl", "fc", "focallengths", "focalpx", "focallengthpx")
CENTRE = ("principalpoint", "pp", "cc", "c", "principal", "centre", "center", "opticalcenter")


_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?"
_ROW = re.compile(rf"[\[(]?\s*{_NUMBER}(?:(?:\s*[,;]\s*|\s+){_NUMBER})+\s*[\])]?")  # a list written as a text
_OF_MATRICES = frozenset(["rows", "cols", "dt", "data", "type_id", "type", "size", "sizes", "step"])


@dataclass
class Entry:
    """Value of a file, with its full name and how it may be called."""

    name: str
    key: str
    value: Any
    calls: tuple[str, ...]
    used: bool = False


@dataclass
class Entries:
    """Entries of one camera, the nearest mapping first.

    Attributes:
        file: for messages.
        found: the entries.
        index: position of the camera in a list of cameras, None outside of one.
        elsewhere: names of what stands in other parts of the file.
    """

    file: Path
    found: list[Entry]
    index: int | None = None
    elsewhere: list[str] = field(default_factory=list)

    def entry(self, *names: str, shape: str = "any") -> Entry | None:
        """The first entry of one of these names, marked as used together with its equal namesakes.

        Args:
            names: as :func:`dvo.data.calibration.lens_names.bare` gives them, in the order of preference.
            shape: ``scalar`` or ``list`` looks for such values only.
        """
        chosen = None
        for name in names:
            for entry in self.found:
                if name not in entry.calls or entry.value is None or not _has_shape(entry.value, shape):
                    continue
                if chosen is None or entry.value == chosen.value:
                    entry.used = True
                    chosen = chosen or entry
        return chosen

    def take(self, *names: str, shape: str = "any") -> Any:
        """Value of :meth:`entry`, None if there is none.

        Args:
            names, shape: see there.
        """
        entry = self.entry(*names, shape=shape)
        return None if entry is None else entry.value

    def numbers(self, *names: str, shape: str = "any") -> np.ndarray | None:
        """Value of :meth:`entry` as float64.

        Args:
            names, shape: see there.

        Raises:
            DvoError: the value is no number and no list of numbers.
        """
        entry = self.entry(*names, shape=shape)
        return None if entry is None else as_numbers(entry.value, self.file, entry.name)

    def refuse_unread(self) -> None:
        """Refuse a file that says something about the lens that was not used.

        Raises:
            DvoError: an entry that looks like a lens.
        """
        for entry in self.found:
            if not entry.used and looks_like_a_lens(entry.key, entry.value):
                raise DvoError(
                    f"{entry.name} may be lens distortion, and was not understood",
                    file=self.file,
                    field=entry.name,
                    remedy="give it as distortion_model and distortion_coefficients, or remove it if it is none",
                )

    @property
    def ignored(self) -> tuple[str, ...]:
        """Names of what was not used."""
        return (*(entry.name for entry in self.found if not entry.used), *self.elsewhere)


def as_numbers(value: Any, file: Path, name: str) -> np.ndarray:
    """A value as float64.

    Args:
        value: of an entry.
        file, name: for messages.

    Raises:
        DvoError: no number and no list of numbers.
    """
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DvoError("not numbers", file=file, field=name, remedy=EXPECTED) from None


def _has_shape(value: Any, shape: str) -> bool:
    is_list = isinstance(value, list) and not (len(value) == 1 and not isinstance(value[0], list | dict))
    return shape == "any" or (shape == "list") == is_list


def plain(value: Any) -> Any:
    """The tree with matrices ``{rows, cols, data}`` and texts of numbers as lists, and ``Camera.fx`` within ``Camera``.

    Args:
        value: documents of a file.
    """
    if isinstance(value, list):
        return [plain(item) for item in value]
    if isinstance(value, str) and _ROW.fullmatch(value):
        return [float(word) for word in re.split(r"[,;\s]+", value.strip(" []()"))]
    if not isinstance(value, dict):
        return value
    if "data" in value and set(map(str, value)) <= _OF_MATRICES:
        return plain(value["data"])
    found: dict[str, Any] = {}
    for key, item in value.items():
        head, dot, tail = str(key).partition(".")
        inner = found.get(head)
        if (
            dot
            and tail
            and not isinstance(value.get(head), str | int | float | list)
            and isinstance(inner, dict | None)
        ):
            found[head] = {**(inner or {}), tail: item}
        elif isinstance(inner, dict) and isinstance(item, dict):
            found[head] = {**inner, **item}
        else:
            found[str(key)] = item
    return {key: plain(item) for key, item in found.items()}


def cameras(tree: Any, file: Path) -> list[tuple[str, Entries]]:
    """Cameras in a tree: the mappings that hold intrinsics.

    Args:
        tree: of :func:`plain`.
        file: for messages.

    Returns:
        The name of each, and its entries with those of the mappings around it.
    """
    places = list(_walk(tree, ()))
    holders = [path for path, value in places if _holds_intrinsics(value)]
    holders = [path for path in holders if not any(_is_within(path, other) for other in holders)]
    return [(name_of(path), _entries(tree, path, holders, file)) for path in holders]


def name_of(path: tuple[Any, ...]) -> str:
    """Name of a place in a tree.

    Args:
        path: keys and indices.
    """
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _is_within(path: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """True for a group of another camera, and for what stands anywhere within one."""
    return len(other) < len(path) and path[: len(other)] == other and bare(str(path[len(other)])) in _GROUPS


def _walk(value: Any, path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], dict[str, Any]]]:
    if isinstance(value, dict):
        yield path, value
        for key, item in value.items():
            yield from _walk(item, (*path, key))
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        for index, item in enumerate(value):
            yield from _walk(item, (*path, index))


def _own(mapping: dict[str, Any], prefix: str, groups: frozenset[str]) -> list[Entry]:
    """Entries of a mapping and of its groups."""
    found = []
    for key, value in mapping.items():
        name, short = f"{prefix}{key}", bare(key)
        if isinstance(value, dict):
            if short in groups:
                for entry in _own(value, f"{name}.", groups):
                    calls = tuple(call for call in entry.calls if call not in _VAGUE)
                    found.append(Entry(entry.name, entry.key, entry.value, (*calls, short + bare(entry.key))))
            continue
        if isinstance(value, list) and any(isinstance(item, dict) for item in value):
            continue
        without = bare(_AFFIX.sub("", key))
        found.append(Entry(name, key, value, (short,) if without == short else (short, without)))
    return found


def _holds_intrinsics(mapping: dict[str, Any]) -> bool:
    own = Entries(Path(), _own(mapping, "", _GROUPS))
    if own.entry(*FX, shape="scalar") and own.entry(*FY, shape="scalar"):
        return True
    if own.entry(*FOCAL) and (own.entry(*CX, shape="scalar") or own.entry(*CENTRE)):
        return True
    return matrix_entry(own) is not None


def matrix_entry(entries: Entries) -> Entry | None:
    """The entry of K, or of a list ``fx fy cx cy``, of some Kalibr models with their parameters before.

    Args:
        entries: of a camera.
    """
    for name in _MATRICES:
        for entry in entries.found:
            if name in entry.calls and _has_shape(entry.value, "list"):
                try:
                    size = np.array(entry.value, dtype=np.float64).size
                except (TypeError, ValueError, OverflowError):
                    size = 4 if isinstance(entry.value, list) and len(entry.value) == 4 else 0  # refused by name
                if size in (4, 5, 6, 9, 12, 16):
                    return entry
    return None


def _entries(tree: Any, path: tuple[Any, ...], holders: list[tuple[Any, ...]], file: Path) -> Entries:
    """Entries of the mapping at a path, then of those around it."""
    index = next((part for part in reversed(path) if isinstance(part, int)), None)
    entries = Entries(file, [], index)
    around = [path[:length] for length in range(len(path), -1, -1)]
    value_at = dict(_walk(tree, ()))
    for place in around:
        mapping = value_at.get(place)
        if mapping is None or (place in holders and place != path):
            continue
        groups = _GROUPS | {"camera"}  # that holds no camera: ORB-SLAM3's "Camera" speaks of "Camera1"
        within = {key: value for key, value in mapping.items() if (*place, key) not in holders}
        within = {key: value for key, value in within.items() if (*place, key) not in around}
        entries.found += _own(within, f"{name_of(place)}." if place else "", groups)
        for where, value in _unread(within, place, groups):
            _look_elsewhere(value, where, holders, entries)
    entries.elsewhere += [name_of(holder) for holder in holders if holder != path]
    return entries


def _unread(
    mapping: dict[str, Any], place: tuple[Any, ...], groups: frozenset[str]
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Mappings and lists of mappings, also those in groups, that are no groups themselves."""
    for key, value in mapping.items():
        if isinstance(value, dict | list) and not _is_read(key, value, groups):
            yield (*place, key), value
        elif isinstance(value, dict):
            yield from _unread(value, (*place, key), groups)


def _is_read(key: str, value: Any, groups: frozenset[str]) -> bool:
    if isinstance(value, list):
        return not any(isinstance(item, dict) for item in value)
    return bare(key) in groups


def _look_elsewhere(value: Any, path: tuple[Any, ...], holders: list[tuple[Any, ...]], entries: Entries) -> None:
    """Refuse a part of the file that is no camera and speaks of a lens; note others."""
    for place, mapping in _walk(value, path):
        if any(place[: len(holder)] == holder and holder != path[: len(holder)] for holder in holders):
            continue
        for key, item in mapping.items():
            known = says_nothing(item) or not looks_like_a_lens(key, item)
            if isinstance(item, dict) or known:
                continue
            if bare(key) in ("alpha", "beta", "omega", "d") or not (isinstance(item, list) or _speaks(key)):
                continue  # of another matter as likely as not
            entries.found.append(Entry(name_of((*place, key)), key, item, ()))
    if all(path != holder[: len(path)] for holder in holders):
        entries.elsewhere.append(name_of(path))


def _speaks(key: str) -> bool:
    return re.search(r"distor|fisheye|lens|skew|radial|tangential|^[kp]_?[1-6]$|^xi$", key.lower()) is not None
