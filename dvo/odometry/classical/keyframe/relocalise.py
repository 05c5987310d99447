"""Relocalisation: points of the map found again by descriptors after loss, else around their projections."""

from __future__ import annotations

import cv2
import numpy as np

from dvo.odometry.classical import two_view
from dvo.odometry.classical.keyframe.config import KeyframeConfig
from dvo.odometry.classical.keyframe.map import Keyframe, Map
from dvo.odometry.classical.keyframe.pose import centre
from dvo.odometry.classical.klt import detect, follow

OCTAVES = (2, 0, 4)
"""Levels of ORB's pyramid (1.2 each) at which a lost image is described; keyframes are described at the first."""


def relocalise(
    world: Map, grey: np.ndarray, intrinsics: np.ndarray, config: KeyframeConfig, seed: int
) -> tuple[np.ndarray, Keyframe] | None:
    """Pose of an image against the map, without a prediction.

    The keyframes that look most alike (PTAM's small blurred images) and the last one are tried: ORB descriptors of
    their points are matched, then PnP in RANSAC.

    Args:
        world: map.
        grey: ``(H, W)`` uint8.
        intrinsics: ``(4,)`` fx fy cx cy, pixels.
        config: of the system.
        seed: of RANSAC.

    Returns:
        ``T_cw (4, 4)`` and the keyframe that gave it, or None.
    """
    small = thumbnail(grey)
    if not world.keyframes or small is None:
        return None
    alike = [-float((small * feature(k, "thumbnail")).sum()) for k in world.keyframes]
    order = [world.keyframes[-1]] + [world.keyframes[i] for i in np.argsort(alike, kind="stable")[:3]]
    corners = detect(grey, np.zeros((0, 2)), config.corners, quality=config.quality, spacing=5)
    described = [describe(grey, corners, octave) for octave in OCTAVES]
    for keyframe in dict.fromkeys(order):
        points = world.xyz[keyframe.ids]
        for rows, descriptors in described:
            pairs = match(feature(keyframe, "descriptors"), descriptors)
            known = ~np.isnan(points[feature(keyframe, "rows")[pairs[:, 0]], 0])
            pairs = pairs[known]
            if len(pairs) < config.pose_points:
                continue
            found = two_view.pose_from_points(
                points[feature(keyframe, "rows")[pairs[:, 0]]], corners[rows[pairs[:, 1]]], intrinsics, 4.0, seed
            )
            if found is not None and found[1].sum() >= max(config.pose_points, 0.2 * len(pairs)):
                return found[0], keyframe
    return None


def thumbnail(grey: np.ndarray) -> np.ndarray | None:
    """Small blurred image ``(30, 40)`` of zero mean and unit length; None for an image without contrast."""
    small = cv2.GaussianBlur(cv2.resize(grey, (40, 30), interpolation=cv2.INTER_AREA).astype(np.float32), (0, 0), 2)
    small -= small.mean()
    length = float(np.linalg.norm(small))
    return small / length if length > 40 else None


def describe(grey: np.ndarray, uv: np.ndarray, octave: int) -> tuple[np.ndarray, np.ndarray]:
    """Upright ORB descriptors: rows of ``uv`` that are far enough from the border, and ``(M, 32)`` uint8."""
    scale = 1.2**octave
    orb = cv2.ORB.create(scaleFactor=1.2, nlevels=8)
    points = [cv2.KeyPoint(float(x), float(y), 31 * scale, 0, 0, octave, i) for i, (x, y) in enumerate(uv)]
    kept, descriptors = orb.compute(grey, points)
    if descriptors is None:
        return np.zeros(0, int), np.zeros((0, 32), np.uint8)
    return np.array([point.class_id for point in kept], int), descriptors


def match(one: np.ndarray, two: np.ndarray, limit: int = 64) -> np.ndarray:
    """Pairs of rows ``(M, 2)`` that are each other's nearest within ``limit`` bits.

    Args:
        one, two: ``(N, 32)`` and ``(M, 32)`` uint8 descriptors.
        limit: largest Hamming distance.
    """
    if not len(one) or not len(two):
        return np.zeros((0, 2), int)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(one, two)
    pairs = [(m.queryIdx, m.trainIdx) for m in matches if m.distance <= limit]
    return np.array(pairs, int).reshape(-1, 2)


def search(
    world: Map,
    grey: np.ndarray,
    T_cw: np.ndarray,
    intrinsics: np.ndarray,
    config: KeyframeConfig,
    *,
    sources: list[Keyframe],
    skip: np.ndarray,
    radius: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Search landmarks of some keyframes around their projections.

    Args:
        T_cw: pose of the image.
        sources: keyframes whose points are tried, the first that has a point gives the patch.
        skip: ``(K,)`` landmarks that are not wanted.
        radius: largest distance from the prediction, pixels.

    Returns:
        ids ``(M,)`` and pixels ``(M, 2)`` float32.
    """
    height, width = grey.shape
    wanted = ~np.isnan(world.xyz[:, 0])
    wanted[skip] = False
    here = centre(T_cw)
    ids, uv = [np.zeros(0, int)], [np.zeros((0, 2), np.float32)]
    for keyframe in sources:
        chosen = np.flatnonzero(wanted[keyframe.ids])
        points = world.xyz[keyframe.ids[chosen]]
        guess, depth = two_view.project(points, T_cw, intrinsics)
        there, before = points - centre(keyframe.T_cw), two_view.project(points, keyframe.T_cw, intrinsics)[1]
        cosine = (there * (points - here)).sum(axis=1)
        cosine /= np.maximum(np.linalg.norm(there, axis=1) * np.linalg.norm(points - here, axis=1), 1e-12)
        margin = config.window // 2
        with np.errstate(invalid="ignore"):
            good = (depth > 0) & (before > 0) & (cosine > 0.85) & (depth < 1.5 * before) & (before < 1.5 * depth)
            good &= ((guess > margin) & (guess < np.array([width, height]) - margin)).all(axis=1)
        chosen, guess = chosen[good], guess[good].astype(np.float32)
        if not len(chosen):
            continue
        found, held = follow(
            keyframe.grey,
            grey,
            np.ascontiguousarray(keyframe.uv[chosen]),
            window=config.window,
            levels=1,
            tolerance=config.closed,
            guess=guess,
        )
        held &= np.linalg.norm(found - guess, axis=1) < radius
        wanted[keyframe.ids[chosen[held]]] = False
        ids.append(keyframe.ids[chosen[held]])
        uv.append(found[held])
    return np.concatenate(ids), np.concatenate(uv)


def feature(keyframe: Keyframe, name: str) -> np.ndarray:
    """Thumbnail, descriptors, or the rows that are described; computed on first use.

    Args:
        keyframe: that keeps them.
        name: ``thumbnail`` (zeros for an image without contrast), ``descriptors`` or ``rows``.
    """
    if name not in keyframe.features:
        if name == "thumbnail":
            small = thumbnail(keyframe.grey)
            keyframe.features[name] = np.zeros((30, 40), np.float32) if small is None else small
        else:
            rows, descriptors = describe(keyframe.grey, keyframe.uv, OCTAVES[0])
            keyframe.features |= {"rows": rows, "descriptors": descriptors}
    return keyframe.features[name]
