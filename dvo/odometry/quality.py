"""Verdict on the result of a sequence: good, doubtful or failed, with what it rests on.

A trajectory that is wrong is often as smooth, and its measurements are as confident, as one that is right: the network
may follow what moves before the camera, or what is fixed to it. What tells is whether measurements agree that have no
part in it: corners that another method has followed (:mod:`dvo.odometry.checks.check_pairs`), and measurements between
frames that are far apart. The thresholds come from runs that were made to fail (``python -m eval.benchmarks.verdict``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

Verdict = Literal["good", "doubtful", "failed"]

MOST_DEVIATION = 0.075
"""Median distance of followed corners from the epipolar lines of the poses, over their displacement, above which a
result is doubtful by that alone. Half of the corners may follow something that moves."""
LEAST_AGREEMENT = 0.835
"""Share of the confident measurements that agree with each other below which a result is doubtful by that alone. What
the two lack adds up (:func:`lacks`)."""
LEAST_TRACKED = 0.5
"""Share of frames with a pose below which a result is doubtful."""
RUN_AGAIN = 0.25
"""Lack of agreement, of what makes a result doubtful, above which the sequence is run again."""
MAX_SHIFT_GAIN = 0.4
"""Share of the cost of the followed corners of a pair of images that a shift explains, upper quartile of the pairs,
above which the crop of the picture floats (:mod:`dvo.odometry.checks.floating_crop`)."""
MOST_FIXED = 0.2
"""Share of the image that is fixed to the camera: some of it may take part, and what is left may be little."""
WRONG_FOCAL = 0.12
"""Logarithm of the focal length that the measurements ask for over the one that is given."""
WRONG_BEND = 0.1
"""Barrel distortion that the measurements ask for beyond what is given: alpha of the lens model ``eucm``, beta 1."""
FEWEST_CHECKS = 3
"""Pairs of images with followed corners that a verdict needs."""
MOST_STILL = 1 / 3
"""Share of the frames through which corners hardly move though the poses do: cars ahead, reflections or a bonnet are
most of what is seen, and little holds the scale."""
LEAST_RELIEF = 0.03
"""Relief of the corners (:attr:`Quality.relief`) below which the picture moves as a whole: 0.12 to 0.99 in twelve
recordings of cameras that move through a scene, 0.01 in one of a camera that turns and zooms on a tripod."""
LEAST_PARALLAX = 0.4
"""Share of the corners' motion that is parallax by the poses (:attr:`Quality.turn_parallax`), where a turn explains all
of it, below which the camera may turn in its place: 0.05 to 0.33 in recordings and renderings of cameras that do."""
MOST_JUMPS = 2
"""Jumps in a hundred frames."""

MASK = "mask what moves or is fixed to the camera (--mask), or film so that most of the picture stands still"
CALIBRATE = "give a calibration of this camera and this resolution (--calib FILE; dvo calibrate makes one)"
FILM = "film textured surfaces at a few metres while the camera moves sideways, or use --preset accurate"
STEADY = "turn electronic stabilisation off"
SENSOR = "see what `dvo imu check` finds, or leave the samples out (--imu none)"
MOVE = "move the camera sideways while filming; a tripod or a single picture has no trajectory"


@dataclass(frozen=True)
class Quality:
    """What tells if a result can be trusted, and the verdict.

    Attributes:
        verdict: ``good``; ``doubtful``: poses that may be wrong; ``failed``: none.
        reason: of a verdict that is not good, in words.
        remedy: what to do about it.
        initialised_at: timestamp of the first pose that was measured, seconds; None if there is none.
        tracked: share of the frames that have a pose, of the longest world.
        inliers: share of all measurements that are confident and agree with the poses.
        spread: share of twelve fields of the image with such measurements, median over the keyframes.
        agreement: share of the confident measurements that agree with the poses; NaN without one.
        residual: median distance of confident measurements from the reprojection, pixels of the working image.
        deviation: median distance of the followed corners from the epipolar lines of the poses, over the median
            displacement of the corners of their pair; NaN without pairs.
        check: share of these corners within a pixel of the lines; NaN without pairs.
        crop: share of the cost of the corners of a pair that a shift of the image explains, upper quartile of the
            pairs; NaN with few.
        checks: number of pairs of images with followed corners.
        still: share of the frames through which followed corners hardly move though the poses do.
        relief: how far the followed corners of a pair are from moving as a whole (shift, turn and zoom of the picture),
            over the parallax that the poses give them, median of the pairs; NaN without parallax.
        turn_parallax: share of the motion of these corners that is parallax by the poses, though a turn of the camera
            in its place, perhaps with another focal length, explains all of it; median of the pairs, NaN where none
            does.
        jumps: number of frames between which the camera moved far more than before and after.
        fixed: share of the image that is fixed to the camera, is in no mask that was given, and was left out.
        second: difference of a second run, backward with another seed, percent of the path; NaN if there was none.

    Example:
        >>> result = dvo.run(dvo.load("small"), dvo.open("video.mp4", calib="calib.txt")).result
        >>> if result.quality.verdict != "good":
        ...     print(result.quality)
        doubtful: corners that were followed do not agree with the poses (off by 16% of their motion)
    """

    verdict: Verdict
    reason: str = ""
    remedy: str = ""
    initialised_at: float | None = None
    tracked: float = 0.0
    inliers: float = 0.0
    spread: float = 0.0
    agreement: float = float("nan")
    residual: float = float("nan")
    deviation: float = float("nan")
    check: float = float("nan")
    crop: float = float("nan")
    checks: int = 0
    still: float = 0.0
    relief: float = float("nan")
    turn_parallax: float = float("nan")
    jumps: int = 0
    fixed: float = 0.0
    second: float = float("nan")

    def __str__(self) -> str:
        return self.verdict if not self.reason else f"{self.verdict}: {self.reason}"


def lacks(quality: Quality) -> tuple[float, float]:
    """How far followed corners and measurements are from agreeing with the poses; together 1 is doubtful.

    Args:
        quality: of a result.

    Returns:
        Deviation over :data:`MOST_DEVIATION`, and the share of measurements that do not agree over that of
        :data:`LEAST_AGREEMENT`; NaN for what is not known.
    """
    return quality.deviation / MOST_DEVIATION, (1 - quality.agreement) / (1 - LEAST_AGREEMENT)


def leaves_doubt(quality: Quality | None) -> bool:
    """Tell if a result is worth a closer look.

    Args:
        quality: of the result; None if it is not known.

    Returns:
        True for a good result that is not far from a doubtful one.
    """
    return quality is not None and quality.verdict == "good" and sum(lacks(quality)) > RUN_AGAIN


def judge(quality: Quality, frames: int, cause: str = "") -> tuple[Verdict, str, str]:
    """Find the verdict of what was measured.

    Args:
        quality: of a result; its verdict is not looked at.
        frames: number of frames that were read.
        cause: of the loss of the frames, if none has a pose.

    Returns:
        Verdict, reason and remedy; the last two are empty for a good result.
    """
    if not quality.tracked:
        few = f"; {frames} {'frame is' if frames == 1 else 'frames are'} too few" if frames < 5 else ""
        return "failed", f"no frame has a pose ({cause or 'nothing was tracked'}{few})", MOVE
    if quality.crop > MAX_SHIFT_GAIN:
        return "doubtful", "the picture is shifted from image to image, as in stabilised video", STEADY
    doubts = [lack if math.isfinite(lack) else 0.0 for lack in lacks(quality)]
    if sum(doubts) > 1 and doubts[0] > doubts[1]:
        off = f"off by {quality.deviation:.0%} of their motion"
        return "doubtful", f"corners that were followed do not agree with the poses ({off})", MASK
    if sum(doubts) > 1 or not math.isfinite(quality.agreement):
        share = f"{quality.agreement:.1%} of them agree" if math.isfinite(quality.agreement) else "there are none"
        return "doubtful", f"the measurements contradict each other ({share})", CALIBRATE
    if quality.checks < FEWEST_CHECKS:
        return "doubtful", "too little of the picture moves to check the poses by", FILM
    if quality.still > MOST_STILL:
        return "doubtful", f"too little of the picture moves for {quality.still:.0%} of the time", FILM
    if quality.fixed > MOST_FIXED:
        return "doubtful", f"{quality.fixed:.0%} of the picture are fixed to the camera", MASK
    if quality.tracked < LEAST_TRACKED:
        return "doubtful", f"{quality.tracked:.0%} of the frames have a pose", FILM
    if quality.jumps > MOST_JUMPS * max(frames / 100, 1):
        return "doubtful", f"the camera jumps {quality.jumps} times", FILM
    return "good", "", ""


def without_scale(quality: Quality, reason: str) -> Quality:
    """Quality of a result in metres by inertial samples, that these do not confirm in the end.

    Args:
        quality: of the result by its images.
        reason: why; empty where they do.

    Returns:
        The same; doubtful where it was good and there is a reason.
    """
    if quality.verdict != "good" or not reason:
        return quality
    return replace(quality, verdict="doubtful", reason=f"the scale is in doubt: {reason}", remedy=SENSOR)


def without_calibration(quality: Quality, guessed: bool = True) -> Quality:
    """Quality of a result whose focal length was not given.

    A camera that turns or zooms on a tripod, with a lens longer than the guess, looks like one that moves before a flat
    picture: no focal length is told, and the motion may be none. One that turns in its place with another focal length
    looks like one that also moves sideways, and the measurements may tell that focal length for sure.

    Args:
        quality: of the result.
        guessed: the focal length is a guess; False: it was found in the images.

    Returns:
        The same; doubtful where it was good and the picture moves as a whole, or as that of a camera that turns.
    """
    if quality.verdict != "good":
        return quality
    if guessed and quality.relief < LEAST_RELIEF:
        reason = (
            "the picture moves as a whole: without a calibration a turn or a zoom looks like a motion before a flat "
            "scene"
        )
    elif quality.turn_parallax < LEAST_PARALLAX:
        reason = (
            "the picture moves as if the camera turned in its place: without a calibration that looks like a motion"
        )
    else:
        return quality
    return replace(quality, verdict="doubtful", reason=reason, remedy=CALIBRATE)
