"""Losses of visual odometry: poses, flow, and the balance between them."""

from dvo.losses.balance import Coefficient
from dvo.losses.flow import flow_error, flow_loss, weighted_flow_error
from dvo.losses.pose import PoseErrors, alignment_scale, pose_errors
from dvo.losses.trend import TrendPenalty

__all__ = [
    "Coefficient", "PoseErrors", "TrendPenalty", "alignment_scale", "flow_error", "flow_loss", "pose_errors",
    "weighted_flow_error",
]  # fmt: skip
