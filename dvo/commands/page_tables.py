"""Texts and tables of the page of a run, from run.json."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np

from dvo.metrics.table import shown
from dvo.session.frame_table import FrameRow
from dvo.viz.run_page import colour_of

SETTINGS = ("source", "kind", "odometry", "weights", "device", "seed", "stride", "calibration", "readout",
            "groundtruth", "map", "map_file")  # fmt: skip
INFO = ("working_size", "working_intrinsics", "readout", "readout_from", "loop_corrections")


def headline_of(facts: dict[str, Any]) -> str:
    """Write what was tracked, with what.

    Args:
        facts: content of run.json.

    Returns:
        One line.
    """
    system, weights = str(facts.get("odometry") or ""), str(facts.get("weights") or "")
    parts = [system, weights] if weights not in system else [system]
    text = f"tracked with {', '.join(filter(None, parts))}" if any(parts) else ""
    version = (facts.get("versions") or {}).get("dvo")
    text += f" (dvo {version})" if version else ""
    if facts.get("interrupted"):
        text += "; interrupted"
    return text.strip("; ")


def verdict_of(facts: dict[str, Any]) -> tuple[str, str]:
    """Verdict on the result.

    Args:
        facts: content of run.json.

    Returns:
        Its word, and in sentences its reason and what may help; empty texts without one.
    """
    quality = facts.get("quality") or {}
    reason = f"{quality['reason']}." if quality.get("reason") else ""
    advice = f"What may help: {quality['remedy']}." if quality.get("remedy") else ""
    return str(quality.get("verdict") or ""), " ".join(filter(None, (reason, advice)))


def figures(facts: dict[str, Any], rows: Sequence[FrameRow]) -> list[tuple[str, str]]:
    """Figures at the top of the page.

    Args:
        facts: content of run.json.
        rows: of the frames.

    Returns:
        Name and value of each.
    """
    frames, info, metrics = (facts.get(name) or {} for name in ("frames", "info", "metrics"))
    found = [("tracked frames", f"{frames.get('tracked', '?')} of {frames.get('read', '?')}")]
    group = "SE(3)" if metrics.get("alignment") == "se3" else "Sim(3)"
    for metric, text in shown(metrics):
        noun = metric.title.split()[0]
        found.append((f"{noun} after {group}" if noun == "ATE" else noun, f"{text} {metric.unit}"))
    found.append(("segments", str(len(facts.get("segments") or []))))
    found.append(("breaks", str(len(facts.get("breaks") or []))))
    if "loops" in info:
        found.append(("loops", str(len(info["loops"]))))
    keyframes = sum(bool(row.keyframe) for row in rows) or info.get("keyframes")
    if keyframes is not None:
        found.append(("keyframes", str(keyframes)))
    found.append(("map points", str(facts.get("map_points", "?"))))
    if facts.get("fps") is not None:
        found.append(("frames / s", f"{facts['fps']:.3g}"))
    seconds = [row.seconds for row in rows if row.seconds is not None]
    if seconds:
        found.append(("time of a frame", _short(np.median(seconds))))
        found.append(("95 % of frames", f"< {_short(np.quantile(seconds, 0.95))}"))
    if facts.get("peak_memory_mb") is not None:
        found.append(("peak memory", f"{facts['peak_memory_mb']:.0f} MB"))
    return found


def tables(facts: dict[str, Any], start: float) -> str:
    """Tables of segments, breaks, loops, settings and versions.

    Args:
        facts: content of run.json.
        start: time of the first frame, seconds.

    Returns:
        HTML.
    """
    info = facts.get("info") or {}
    parts = [
        _segments(facts.get("segments") or [], start),
        _breaks(facts.get("breaks") or [], start),
        _loop_table(info.get("loops") or [], start),
    ]
    settings = [(name, facts[name]) for name in SETTINGS if facts.get(name) is not None]
    settings += [(name, info[name]) for name in INFO if info.get(name) is not None and name not in dict(settings)]
    calibrated = facts.get("self_calibration")
    if calibrated:
        value = f"{calibrated['focal']:.1f} ± {calibrated['deviation']:.1f} px ({calibrated['source']})"
        settings.append(("focal length", value))
    settings += [
        (f"seconds of {name}", f"{value:.1f}")
        for name, value in (facts.get("seconds") or {}).items()
        if value is not None
    ]
    if start:
        settings.append(("time of the first frame", f"{start:.6f} s; times of this page count from it"))
    parts.append(_section("Run", _pairs(settings)))
    if facts.get("config"):
        parts.append(_details("Settings of the odometry", facts["config"].items()))
    if facts.get("versions"):
        parts.append(_details("Versions", facts["versions"].items()))
    return "\n".join(part for part in parts if part)


def _segments(segments: list[dict[str, Any]], start: float) -> str:
    if not segments:
        return ""
    scored = any(segment.get("matched") is not None for segment in segments)
    titles = ["segment", "start s", "end s", "frames", *(["ATE m", "ATE %"] if scored else []), "world of"]
    rows = []
    for segment in segments:
        number = segment["number"]
        swatch = f'<span class="swatch" style="background: var(--s{colour_of(number)})"></span>'
        cells = [f"{segment['start'] - start:.2f}", f"{segment['end'] - start:.2f}", str(segment["frames"])]
        if scored:
            cells += [_number(segment.get("ate_rmse"), ".3g"), _number(segment.get("ate_percent"), ".2f")]
        joined = segment.get("joined_to")
        own = "the map" if segment.get("in_map") else "its own"
        cells.append(own if joined is None else f"segment {joined}")
        rows.append([swatch + escape(str(number)), *map(escape, cells)])
    return _section("Segments", _table(titles, rows, words={len(titles) - 1}))


def _breaks(breaks: list[dict[str, Any]], start: float) -> str:
    if not breaks:
        return ""
    rows = [
        [
            "the start" if found.get("from") is None else f"{found['from'] - start:.2f}",
            "the end" if found.get("to") is None else f"{found['to'] - start:.2f}",
            str(found["frames"]),
            escape(str(found["reason"])),
            "a new segment" if found["new_segment"] else "the same segment",
        ]
        for found in breaks
    ]
    titles = ["from s", "to s", "frames without a pose", "reason", "after it"]
    return _section("Breaks", _table(titles, rows, words={3, 4}))


def _loop_table(loops: list[dict[str, Any]], start: float) -> str:
    if not loops:
        return ""
    rows = [
        [
            f"{loop['from'] - start:.2f}",
            f"{loop['to']:.2f} of the map" if loop.get("in_map") else f"{loop['to'] - start:.2f}",
            escape(str(loop.get("kind", ""))),
            _number(None if loop.get("inliers") is None else 100 * loop["inliers"], ".0f"),
            escape(str(loop.get("edges", ""))),
            "yes" if loop.get("joins_segments") else "",
        ]
        for loop in loops
    ]
    titles = ["at s", "sees the place of s", "kind", "inliers %", "measurements", "joins segments"]
    return _section("Loops", _table(titles, rows, words={2}))


def _section(title: str, content: str) -> str:
    return f'<section>\n<h2>{escape(title)}</h2>\n<div class="wide">\n{content}</div>\n</section>'


def _details(title: str, pairs: Iterable[tuple[str, Any]]) -> str:
    return f'<details>\n<summary>{escape(title)}</summary>\n<div class="wide">\n{_pairs(pairs)}</div>\n</details>'


def _pairs(pairs: Iterable[tuple[str, Any]]) -> str:
    rows = "".join(
        f"<tr><th>{escape(_name(name))}</th><td>{escape(_value(value))}</td></tr>\n" for name, value in pairs
    )
    return f'<table class="pairs">\n{rows}</table>\n'


def _table(titles: Sequence[str], rows: Iterable[Sequence[str]], words: set[int]) -> str:
    """HTML of a table; ``rows`` hold HTML, the columns ``words`` are aligned to the left."""

    def cell(tag: str, column: int, content: str) -> str:
        kind = ' class="words"' if column in words else ""
        return f"<{tag}{kind}>{content}</{tag}>"

    head = "".join(cell("th", k, escape(title)) for k, title in enumerate(titles))
    body = "".join(f"<tr>{''.join(cell('td', k, text) for k, text in enumerate(row))}</tr>\n" for row in rows)
    return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody>\n</table>\n"


def _name(name: str) -> str:
    return name.replace("_", " ")


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_value, value)) or "–"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_value(item)}" for key, item in value.items())
    return str(value) or "–"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _short(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms" if seconds < 1 else f"{seconds:.2f} s"
