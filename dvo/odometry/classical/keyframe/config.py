"""Settings of the keyframe system."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class KeyframeConfig:
    """Pixels are those of the images given, angles degrees.

    Attributes:
        corners: number of tracks that a keyframe is filled up to.
        quality, window, levels, closed: corner strength, patch side, pyramid levels and forward-backward tolerance.
        start_parallax: rotation-compensated parallax that starts the map, as part of the focal length; while the
            camera waits, half of it comes to be enough.
        start_wait: frames after which half is enough.
        start_wait: int = 15
    start_points: points that the first two views must give.
        planar: part of the homography's score from which it is preferred to the essential matrix (ORB-SLAM: 0.45).
        angle: smallest angle between two views from which a point is triangulated.
        epipolar, reprojection: inlier thresholds, pixels.
        pose_points: inliers below which a pose is not believed.
        pose_part: the same as a part of the points seen.
        keyframe_parallax: parallax since the last keyframe from which another is made, as part of the focal length.
        keyframe_points: part of the last keyframe's points still seen below which another is made.
        adjusted: keyframes that local bundle adjustment moves.
        anchors: older keyframes that see the same points and hold it in place.
        iterations: of local bundle adjustment.
        redundant: a keyframe goes when this part of its points is seen by three others or more.
        patience: lost frames after which a new map may be started; relocalisation goes on until it is.
        loops: close loops, see :mod:`dvo.odometry.classical.keyframe.loops`.
        loop_seconds: smallest time between the two visits of a place.
        loop_every: keyframes after a loop until the next search.
        loop_points: smallest number of points by which a loop is verified.
    """

    corners: int = 700
    quality: float = 0.001
    window: int = 15
    levels: int = 4
    closed: float = 0.7
    start_parallax: float = 0.045
    start_wait: int = 15
    start_points: int = 40
    planar: float = 0.45
    angle: float = 1.0
    epipolar: float = 1.0
    reprojection: float = 2.0
    pose_points: int = 15
    pose_part: float = 0.25
    keyframe_parallax: float = 0.035
    keyframe_points: float = 0.75
    adjusted: int = 8
    anchors: int = 4
    iterations: int = 8
    redundant: float = 0.92
    patience: int = 10
    loops: bool = False
    loop_seconds: float = 10.0
    loop_every: int = 4
    loop_points: int = 30
