"""Content of run.json as it is read: every entry that somebody computes with is checked."""

from __future__ import annotations

import json
import math
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.core.text import redacted, visible
from dvo.data.files.files import MAX_NUMBER

REMEDY = "give a folder that dvo run has written"
_LIMIT = 64 * 2**20  # bytes
_DEPTH = 24  # of tables in tables
_MAX_FRAMES = 10**7


@dataclass(frozen=True)
class _Kind:
    """Kind of a value.

    Attributes:
        name: for messages.
        holds: whether a value is of the kind.
        parts: kinds of the entries of a table; ``*`` for those of a list, or of a table of any names.
        required: names of entries that a table must have; others may be missing or null.
    """

    name: str
    holds: Callable[[Any], bool]
    parts: dict[str, _Kind] | None = None
    required: tuple[str, ...] = ()


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _MAX_FRAMES


def _table(parts: dict[str, _Kind], required: tuple[str, ...] = ()) -> _Kind:
    return _Kind("a table", lambda value: isinstance(value, dict), parts, required)


def _named(part: _Kind) -> _Kind:
    return _Kind("a table", lambda value: isinstance(value, dict), {"*": part})


def _listed(part: _Kind) -> _Kind:
    return _Kind("a list", lambda value: isinstance(value, list), {"*": part})


_TEXT = _Kind("a text", lambda value: isinstance(value, str))
_FLAG = _Kind("true or false", lambda value: isinstance(value, bool))
_NUMBER = _Kind(f"a number within ±{MAX_NUMBER:g}", _is_number)
_COUNT = _Kind(f"a whole number from 0 to {_MAX_FRAMES}", _is_count)
_ANY = _Kind("a value", lambda value: True)

_METRICS = {name: _NUMBER for name in ("ate_rmse", "ate_percent", "rpe_trans", "rpe_rot_deg", "matched")}
_SEGMENT = {
    "number": _COUNT, "start": _NUMBER, "end": _NUMBER, "frames": _COUNT, "joined_to": _COUNT, "in_map": _FLAG,
    "file": _TEXT, **_METRICS,
}  # fmt: skip
_BREAK = {"from": _NUMBER, "to": _NUMBER, "frames": _COUNT, "reason": _TEXT, "new_segment": _FLAG}
_LOOP = {
    "from": _NUMBER, "to": _NUMBER, "kind": _TEXT, "inliers": _NUMBER, "in_map": _FLAG, "joins_segments": _FLAG,
}  # fmt: skip
_QUALITY = {"verdict": _TEXT, "reason": _TEXT, "remedy": _TEXT}
_FRAMES = {"read": _COUNT, "fed": _COUNT, "tracked": _COUNT, "lost": _COUNT}
_CAMERA = {name: _NUMBER for name in ("fx", "fy", "cx", "cy")} | {"width": _COUNT, "height": _COUNT}
_LENS = {"model": _TEXT, "coefficients": _listed(_NUMBER)}
_FOCAL = {"focal": _NUMBER, "deviation": _NUMBER, "source": _TEXT}
_METRIC_SEGMENT = _table({"segment": _COUNT, "source": _TEXT}, ("segment", "source"))
_INFO = {
    "loops": _listed(_table(_LOOP, ("from", "to"))),
    "scale": _table({"segments": _listed(_METRIC_SEGMENT)}, ("segments",)),
}
_RUN = _table(
    {
        "source": _TEXT,
        "odometry": _TEXT,
        "weights": _TEXT,
        "quality": _table(_QUALITY, ("verdict",)),
        "frames": _table(_FRAMES, ("read", "lost")),
        "segments": _listed(_table(_SEGMENT, ("number", "start", "end", "frames", "file"))),
        "breaks": _listed(_table(_BREAK, ("frames", "reason", "new_segment"))),
        "info": _table(_INFO),
        "metrics": _table({"alignment": _TEXT, **_METRICS}),
        "camera": _table(_CAMERA | _LENS, tuple(_CAMERA | _LENS)),
        "self_calibration": _table(_FOCAL, ("focal", "deviation", "source")),
        "seconds": _named(_NUMBER),
        "fps": _NUMBER,
        "peak_memory_mb": _NUMBER,
        "map_points": _COUNT,
        "interrupted": _FLAG,
        "warnings": _listed(_TEXT),
        "config": _named(_ANY),
        "options": _named(_ANY),
        "inputs": _named(_table({"path": _TEXT, "bytes": _NUMBER, "sha256": _TEXT})),
        "versions": _named(_ANY),
    },
    ("frames", "segments", "breaks", "info"),
)


def read_facts(file: Path) -> dict[str, Any]:
    """Read run.json.

    Args:
        file: the file.

    Returns:
        Its content; texts without secrets of addresses and without characters that steer a terminal.

    Raises:
        DvoError: it cannot be read, or an entry is missing or of another kind, with its name.
    """
    facts = _plain(read_json(file), file, "")
    _check(facts, _RUN, file, "")
    facts["info"] = {name: value for name, value in facts["info"].items() if value is not None}
    for number, segment in enumerate(facts["segments"]):
        joined = segment.get("joined_to")
        if joined is not None and joined >= len(facts["segments"]):
            raise DvoError("no such segment", file=file, field=f"segments: {number}: joined_to", remedy=REMEDY)
    if sum(found["frames"] for found in facts["breaks"]) > _MAX_FRAMES:
        raise DvoError(f"more than {_MAX_FRAMES} frames", file=file, field="breaks", remedy=REMEDY)
    return facts


def read_json(file: Path) -> dict[str, Any]:
    """Read run.json without a look at its entries.

    Args:
        file: the file.

    Raises:
        DvoError: it cannot be read, or is no table in JSON.
    """
    try:
        about = file.stat()
        if not stat.S_ISREG(about.st_mode):  # a pipe would not end
            raise DvoError("not a regular file", file=file, remedy=REMEDY)
        if about.st_size > _LIMIT:
            raise DvoError("too large", file=file, remedy=REMEDY)
        facts = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DvoError(error.strerror or str(error), file=file, remedy=REMEDY) from error
    except (ValueError, RecursionError):
        raise DvoError("not JSON", file=file, remedy=REMEDY) from None
    if not isinstance(facts, dict):
        raise DvoError("not the description of a run", file=file, remedy=REMEDY)
    return facts


def _plain(value: Any, file: Path, place: str, depth: int = 0) -> Any:
    """Value whose numbers are finite and whose texts can be shown."""
    if depth > _DEPTH:
        raise DvoError("nested too deeply", file=file, field=_shown(place), remedy=REMEDY)
    if isinstance(value, dict):
        entries = ((visible(key), item) for key, item in value.items())
        return {key: _plain(item, file, _below(place, key), depth + 1) for key, item in entries}
    if isinstance(value, list):
        return [_plain(item, file, _below(place, str(k)), depth + 1) for k, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise DvoError("not a finite number", file=file, field=_shown(place), remedy=REMEDY)
    return redacted(visible(value, lines=True)) if isinstance(value, str) else value


def _check(value: Any, kind: _Kind, file: Path, place: str) -> None:
    if not kind.holds(value):
        raise DvoError(f"has no valid value: expected {kind.name}", file=file, field=_shown(place), remedy=REMEDY)
    if kind.parts is None:
        return
    for name in kind.required:
        if value.get(name) is None:
            raise DvoError(
                "has no valid value: it is missing", file=file, field=_shown(_below(place, name)), remedy=REMEDY
            )
    items = enumerate(value) if isinstance(value, list) else value.items()
    for key, item in items:
        part = kind.parts.get("*") or kind.parts.get(str(key))
        # A list holds no null; an entry of a table that is null is as one that is missing.
        if part is not None and (item is not None or isinstance(value, list)):
            _check(item, part, file, _below(place, str(key)))


def _below(place: str, name: str) -> str:
    return f"{place}: {name}" if place else name


def _shown(place: str) -> str:
    return place if len(place) <= 120 else f"{place[:117]}..."
