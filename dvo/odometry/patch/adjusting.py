"""Global adjustment of a patch odometry on request."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from dvo.core.errors import DvoError
from dvo.odometry.global_ba.graph_adjustment import AdjustmentRecord

if TYPE_CHECKING:
    from dvo.odometry.patch.tracker import PatchOdometry


def adjust(odometry: PatchOdometry) -> tuple[AdjustmentRecord, ...]:
    """Adjust everything that has left the window, between two frames: a method of the patch odometry.

    All worlds of the recording are adjusted one after the other, by the measurements of archived keyframes and loops
    (:mod:`dvo.odometry.global_ba.graph_adjustment`); the window moves along. A solution that does not lower the robust
    cost is not taken. Work in progress for loops is waited for. With the setting ``real_time`` nothing is waited for:
    the adjustments are done beside tracking, within bounds, and applied when they are there.

    Args:
        odometry: before, or between, any two frames of its sequence; its poses and depths may change, and the scale.

    Returns:
        One record for each world, with the cost before and after; none for a world with fewer than three archived
        keyframes. Empty with ``real_time``; run.json lists the adjustments later.

    Raises:
        DvoError: the sequence is finished. ``finish`` has adjusted it.

    Example:
        >>> odometry = dvo.load("small")
        >>> for number, frame in enumerate(dvo.open("video.mp4", calib="calib.txt"), 1):
        ...     estimate = odometry.track(frame)
        ...     if number % 500 == 0:
        ...         for record in odometry.adjust():
        ...             print(record.keyframes, record.cost_before, record.cost)
    """
    if odometry.state.finished:
        raise DvoError("the sequence is finished and adjusted", field="adjust()", remedy="adjust before finish()")
    if odometry.state.map is not None:  # which stays as it is
        return ()
    with torch.inference_mode():
        return tuple(odometry.loops.adjust(odometry.state.adjustable, wait=not odometry.config.real_time))
