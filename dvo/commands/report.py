"""Errors and summary of a tracked clip, as numbers and as printed lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dvo.commands.console import say
from dvo.data.trajectory import Trajectory
from dvo.metrics import Metrics, evaluate
from dvo.metrics.table import shown
from dvo.odometry.protocol import Break, Result
from dvo.session import results
from dvo.session.session import Run

_SHOWN = 5  # breaks and segments that are printed one by one
_SCALES = {
    "depth": "depth images", "stereo": "stereo images",
    "height": "the height of the camera", "distance": "known distances", "map": "the map",
    "inertial": "inertial samples",
}  # fmt: skip


@dataclass(frozen=True)
class Scores:
    """Errors against the ground truth after alignment: SE(3) of segments in metres, Sim(3) of others.

    Attributes:
        longest: of the longest segment, which is the trajectory of the run; None without ground truth.
        segments: of each segment, aligned on its own; empty without ground truth or with a single segment.
        scale: factor from the estimate to the ground truth, of a longest segment in metres; None otherwise.
    """

    longest: Metrics | None = None
    segments: tuple[Metrics, ...] = ()
    scale: float | None = None

    @property
    def segment_facts(self) -> list[dict[str, Any]]:
        """Entries of the segments in run.json."""
        return [
            {"ate_rmse": m.ate_rmse, "ate_percent": m.ate_percent, "matched": m.matched, "reason": m.reason}
            for m in self.segments
        ]


def score(run: Run, groundtruth: Trajectory | None) -> Scores:
    """Compare a run with the ground truth.

    Args:
        run: record of the session.
        groundtruth: camera to world, metres; None if there is none.

    Returns:
        The errors.
    """
    if groundtruth is None:
        return Scores()
    result = run.result
    segments = result.segments if len(result.segments) > 1 else ()
    free = evaluate(result.trajectory, groundtruth, align="sim3")
    return Scores(
        evaluate(result.trajectory, groundtruth, align="se3") if result.metric else free,
        tuple(
            evaluate(segment.trajectory, groundtruth, align="se3" if result.is_metric(number) else "sim3")
            for number, segment in enumerate(segments)
        ),
        free.scale if result.metric and free.reason is None else None,
    )


def headline(run: Run, scores: Scores) -> str:
    """Write the error, if there is one, and the number of tracked frames.

    Args:
        run: record of the session.
        scores: its errors.

    Returns:
        One line.
    """
    counts = f"{run.result.frames_tracked} of {run.result.frames_read} frames tracked"
    if len(run.result.segments) > 1:
        counts += f" in {len(run.result.segments)} segments"
    metrics = scores.longest
    return counts if metrics is None or metrics.reason else f"{error_text(metrics)}, {counts}"


def error_text(metrics: Metrics) -> str:
    """Write the absolute trajectory error.

    Args:
        metrics: with a defined error.

    Returns:
        Text such as ``ATE 0.0123 m (0.45 % of 2.7 m)``.
    """
    return f"ATE {metrics.ate_rmse:.3g} m ({metrics.ate_percent:.2f} % of {metrics.path_length:.3g} m)"


_PHASES = {
    "calibrating": "calibration", "reading": "reading", "tracking": "tracking", "finishing": "final",
    "checking": "check",
}  # fmt: skip


def describe_seconds(seconds: Mapping[str, float]) -> str:
    """Describe where the time of a run went.

    Args:
        seconds: by phase, of :class:`dvo.session.session.Run`.

    Returns:
        A line such as ``96 s: calibration 61, reading 7, tracking 22, final 6``.
    """
    total = sum(seconds.values())
    digits = 0 if total >= 10 else 1
    parts = [
        f"{name} {seconds[phase]:.{digits}f}"
        for phase, name in _PHASES.items()
        if phase in seconds and f"{seconds[phase]:.{digits}f}" != f"{0:.{digits}f}"
    ]
    return f"{total:.{digits}f} s" + (f": {', '.join(parts)}" if parts else "")


def describe_breaks(breaks: tuple[Break, ...]) -> str:
    """Describe the breaks of a trajectory.

    Args:
        breaks: one or more.

    Returns:
        One line, such as ``1 break: 2.00-7.03 s black image (150 frames), new segment at 7.03 s``.
    """
    parts = [_describe_break(found) for found in breaks[:_SHOWN]]
    if len(breaks) > _SHOWN:
        parts.append(f"{len(breaks) - _SHOWN} more in {results.SUMMARY}")
    return f"{len(breaks)} {'break' if len(breaks) == 1 else 'breaks'}: {'; '.join(parts)}"


def _describe_break(found: Break) -> str:
    if found.start is None and found.end is None:
        when = "all of the time"
    elif found.start is None:
        when = f"until {found.end:.2f} s"
    elif found.end is None:
        when = f"from {found.start:.2f} s to the end"
    else:
        when = f"{found.start:.2f}-{found.end:.2f} s"
    text = f"{when} {found.reason} ({found.frames} {'frame' if found.frames == 1 else 'frames'})"
    return f"{text}, new segment at {found.end:.2f} s" if found.new_segment and found.end is not None else text


def advice_for_segments(result: Result) -> str:
    """Advice for segments that stay apart although places are searched for.

    Args:
        result: with any number of segments.

    Returns:
        One sentence; empty if all share a world, or if no loops were searched for.
    """
    apart = sum(segment.joined_to is None and not segment.in_map for segment in result.segments)
    if apart < 2 or "loops" not in result.info:
        return ""
    return "film with overlap, or return to a place seen before: segments that show the same place are joined"


def describe_localisation(loop: Mapping[str, Any]) -> str:
    """Describe the loop by which a recording was recognised in a map.

    Args:
        loop: ``localised`` of the metadata of a result.

    Returns:
        Text such as ``localised at 1.20 s (61 % of 432 measurements are inliers) in the world``.
    """
    share = f"{100 * loop['inliers']:.0f} % of {loop['edges']} measurements are inliers"
    return f"localised at {loop['from']:.2f} s ({share}) in the world"


def describe_scale(scale: Mapping[str, Any]) -> str:
    """Describe the source of the scale.

    Args:
        scale: of the metadata of a result, see :func:`dvo.odometry.scale.metric_scale.settle_scale`.

    Returns:
        Text such as ``poses and map are in metres, from depth images (scale known to 0.21 %)``.
    """
    entries = scale["segments"]
    problems = "; ".join(f"segment {e['segment']}: {e['problem']}" for e in entries if e.get("problem"))
    known = [e for e in entries if e["source"] != "none"]
    if not known:
        return f"no metric scale from {_SCALES[scale['source']]}: {problems or 'no segment was tracked'}"
    deviations = [e["deviation"] for e in known if e["deviation"] is not None]
    sure = f" (scale known to {100 * max(deviations):.2g} %)" if deviations else ""
    sources = " and ".join(dict.fromkeys(_SCALES[e["source"]] for e in known))
    return f"poses and map are in metres, from {sources}{sure}" + (f"; but {problems}" if problems else "")


def describe_inertial(result: Result) -> list[str]:
    """Describe what inertial samples were of use for.

    Args:
        result: with ``inertial`` in its metadata.

    Returns:
        Sentences, none where poses are in metres and all by images.
    """
    told, said = result.info["inertial"], []
    if told.get("state") in ("none", "initialising"):
        reason = f": {told['reason']}" if told.get("reason") else ""
        check = "" if told["state"] == "none" else "; `dvo imu check` looks at the sensor"
        said.append(f"inertial samples give no metres{reason}{check}")
    if result.inertial:
        count = len(result.inertial)
        said.append(f"{count} frames without a pose by their images have one by inertial samples, marked in frames.csv")
    return said


def print_report(folder: Path, run: Run, scores: Scores, more: Sequence[str] = ()) -> None:
    """Print verdict, counts, breaks, segments, errors and the names of the files.

    Args:
        folder: of the results.
        run: record of the session.
        scores: its errors.
        more: names of other files that the run has written into the folder.
    """
    result, metrics = run.result, scores.longest
    several = len(result.segments) > 1
    if result.quality is not None:
        say(f"verdict: {result.quality}")
        if result.quality.remedy:
            say(f"what may help: {result.quality.remedy}")
    say(
        f"tracked {result.frames_tracked} of {result.frames_read} frames, {run.frames_per_second:.1f} frames/s, "
        f"{len(result.map.points)} map points"
    )
    if result.breaks:
        say(describe_breaks(result.breaks))
    if several:
        joined = sum(segment.joined_to is not None for segment in result.segments)
        worlds = f"{joined} of them joined to an earlier one" if joined else "each with a world and a scale of its own"
        whole = ", and those that share its world" if joined else ""
        say(
            f"{len(result.segments)} segments, {worlds}; {results.TRAJECTORY} and "
            f"{results.MAP} hold the longest, segment {result.longest}{whole}"
        )
        if advice := advice_for_segments(result):
            say(f"what may help: {advice}")
    if "localised" in result.info:
        found = result.info["localised"]
        outside = "not recognised in the map: the poses have a world and a scale of their own"
        say(outside if found is None else f"{describe_localisation(found)} of the map")
    if result.info.get("readout_from") == "images":
        say(f"rolling shutter with a readout of {1000 * result.info['readout']:.1f} ms, estimated from the images")
    if "scale" in result.info:
        say(describe_scale(result.info["scale"]))
    if "inertial" in result.info:
        for line in describe_inertial(result):
            say(line)
    if metrics is not None and metrics.reason:
        say(f"no error against ground truth: {metrics.reason}")
    elif metrics is not None:
        relative = " and ".join(
            f"{text} {metric.unit}" for metric, text in shown(metrics, ("rpe_trans", "rpe_rot_deg"))
        )
        relative = f"RPE {relative} a frame"
        group = "SE(3)" if metrics.alignment == "se3" else "Sim(3)"
        wrong = "" if scores.scale is None else f", scale wrong by {100 * abs(1 / scores.scale - 1):.2f} %"
        longest = " of the longest segment" if several else ""
        say(f"{error_text(metrics)} after {group} alignment{longest}, {relative}{wrong}")
    views = [name for name in (results.PICTURE, results.PAGE) if (folder / name).exists()]  # without them after SIGTERM
    files = [results.TRAJECTORY, results.MAP, *views, results.FRAMES, results.SUMMARY]
    files += [*more, *(name for name in (results.CLOUD, results.MESH, results.BASE) if (folder / name).exists())]
    if several:
        last = len(result.segments) - 1
        files.insert(1, f"{results.segment_file(0)}{',' if last == 1 else ' ...'} {results.segment_file(last)}")
    say(f"results in {folder}/: {', '.join(files)}")
