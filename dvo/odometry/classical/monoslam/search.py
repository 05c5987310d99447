"""Active search: look for each point's patch only where the filter expects it (Davison 2007, section 3.6)."""

from __future__ import annotations

import cv2
import numpy as np

from dvo.odometry.classical.monoslam.models import directions, rotation_matrix

HALF = 5  # of the template that is compared: 11x11
STORE = 11  # of the patch that is kept, larger because a warp may reach outside of the template
LEVELS = 3  # of the image pyramid: 11x11 pixels of the coarsest are a wide and telling piece of the image
NARROW = 8.0  # half side of a search that needs no coarser level, pixels


def image_pyramid(grey: np.ndarray) -> list[np.ndarray]:
    """The image and its halvings; pixel ``u`` of the image lies at ``u / 2^k`` of level k."""
    levels = [grey]
    while len(levels) < LEVELS:
        levels.append(cv2.pyrDown(levels[-1]))
    return levels


class Appearance:
    """Appearance of the points, parallel arrays of length N in the order of the filter's points.

    Attributes:
        patch: ``(N, 3, 23, 23)`` uint8 around the pixel of first sight, in every level.
        uv: ``(N, 2)`` that pixel.
        rotation: ``(N, 3, 3)`` camera to world at first sight.
        tried, found: ``(N,)`` how often the point was looked for and found.
        missed: ``(N,)`` how often in a row it was looked for in vain.
        unseen: ``(N,)`` frames in a row in which it was not in view.
        color: ``(N, 3)`` uint8 RGB.
    """

    _FIELDS = ("patch", "uv", "rotation", "tried", "found", "missed", "unseen", "color")

    def __init__(self) -> None:
        side = 2 * STORE + 1
        self.patch = np.zeros((0, LEVELS, side, side), np.uint8)
        self.uv, self.rotation = np.zeros((0, 2)), np.zeros((0, 3, 3))
        self.tried, self.found, self.missed, self.unseen = (np.zeros(0, int) for _ in range(4))
        self.color = np.zeros((0, 3), np.uint8)

    def keep(self, mask: np.ndarray) -> None:
        """Forget the points where ``mask`` is False."""
        for name in self._FIELDS:
            setattr(self, name, getattr(self, name)[mask])

    def add(self, uv: np.ndarray, pyramid: list[np.ndarray], image: np.ndarray, q: np.ndarray) -> None:
        """Begin points at whole pixels ``(M, 2)`` of an image seen with attitude ``q``."""
        side = 2 * STORE + 1
        patch = np.zeros((len(uv), LEVELS, side, side), np.uint8)
        for level, grey in enumerate(pyramid):
            border = cv2.copyMakeBorder(grey, STORE, STORE, STORE, STORE, cv2.BORDER_REPLICATE)
            for k, (x, y) in enumerate(np.rint(uv / 2**level).astype(int)):
                piece = border[y : y + side, x : x + side]
                patch[k, level, : piece.shape[0], : piece.shape[1]] = piece
        new = {
            "patch": patch,
            "uv": uv,
            "rotation": np.tile(rotation_matrix(q), (len(uv), 1, 1)),
            "color": image[uv[:, 1], uv[:, 0]].reshape(-1, 3),
        }
        for name in self._FIELDS:
            old = getattr(self, name)
            fresh = new[name] if name in new else np.zeros(len(uv), int)
            setattr(self, name, np.concatenate([old, fresh.astype(old.dtype)]))


def affine_warps(
    appearance: Appearance, points: np.ndarray, r: np.ndarray, q: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """``(N, 2, 2)`` how offsets from the pixel of first sight become offsets now.

    The surface is taken to face the first view; nan where it would not be in front of the camera.
    """
    R = rotation_matrix(q)
    ray, _ = directions(points)
    corners = appearance.uv[:, None] + np.array([[0, 0], [4, 0], [0, 4.0]])
    local = np.concatenate([(corners - intrinsics[2:]) / intrinsics[:2], np.ones((*corners.shape[:2], 1))], -1)
    beam = local @ appearance.rotation.transpose(0, 2, 1)
    beam = beam / np.einsum("nki,ni->nk", beam, ray)[..., None]  # to the plane at distance 1 across the ray
    seen = (points[:, None, 5:] * (points[:, None, :3] - r) + beam) @ R
    z = np.where(seen[..., 2] > 1e-3, seen[..., 2], np.nan)
    pixels = seen[..., :2] / z[..., None] * intrinsics[:2]
    return np.stack([pixels[:, 1] - pixels[:, 0], pixels[:, 2] - pixels[:, 0]], -1) / 4


def templates(appearance: Appearance, warps: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(M, 3, 11, 11)`` uint8 patches as they should look now, and ``(M,)`` bool, False where they cannot be told.

    A patch that has grown or shrunk more than twofold is not the same patch any more.
    """
    side, width = 2 * STORE + 1, 2 * HALF + 1
    A = warps[rows]
    area = np.nan_to_num(np.abs(np.linalg.det(A)), nan=0.0)
    usable = (area > 0.3) & (area < 4) & (np.abs(np.nan_to_num(A, nan=9)).max((1, 2), initial=0) < 3)
    if len(rows) == 0:
        return np.zeros((0, LEVELS, width, width), np.uint8), usable
    inverse = np.linalg.inv(np.where(usable[:, None, None], A, np.eye(2)))
    offset = np.arange(-HALF, HALF + 1.0)
    offsets = np.einsum("mij,yxj->myxi", inverse, np.stack(np.meshgrid(offset, offset), -1))
    scale = 2.0 ** np.arange(LEVELS)[:, None]
    centre = appearance.uv[rows, None] / scale
    centre = centre - np.rint(centre) + STORE  # in the patch of each level, which lies on whole pixels
    at = np.clip(centre[:, :, None, None] + offsets[:, None], 0, 2 * STORE)
    at[..., 1] += side * np.arange(len(rows) * LEVELS).reshape(-1, LEVELS, 1, 1)
    atlas, flat = appearance.patch[rows].reshape(-1, side), at.reshape(-1, width, 2).astype(np.float32)
    at_x, at_y = (np.ascontiguousarray(flat[..., axis]) for axis in (0, 1))
    warped = cv2.remap(atlas, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return warped.reshape(len(rows), LEVELS, width, width), usable


def find_point(
    pyramid: list[np.ndarray],
    patches: np.ndarray,
    centre: np.ndarray,
    spread: np.ndarray,
    *,
    sigmas: float,
    reach: float,
) -> tuple[np.ndarray, float] | None:
    """Best place of a point inside its search ellipse; wide ellipses from coarse to fine.

    Args:
        pyramid: of the image.
        patches: ``(3, 11, 11)`` uint8, one a level.
        centre, spread: expected pixel ``(2,)`` and its covariance ``(2, 2)``.
        sigmas: size of the ellipse.
        reach: largest half side of what is searched, pixels.

    Returns:
        The place to a part of a pixel and the smallest score of the levels; None where there is no room in the image.
    """
    widest = min(sigmas * float(np.sqrt(max(spread[0, 0], spread[1, 1]))), reach)
    start = int(np.clip(np.ceil(np.log2(widest / NARROW)), 0, LEVELS - 1))
    for level in range(start, -1, -1):  # near the edge of the image only the finer ones have room
        scale = 2.0**level
        match = find_patch(pyramid[level], patches[level], centre / scale, spread / scale**2, sigmas, reach / scale)
        if match is not None:
            break
    else:
        return None
    score = match[1]
    for finer in range(level - 1, -1, -1):
        match = find_patch(pyramid[finer], patches[finer], 2 * match[0], np.eye(2), 2.5, 2.5)
        if match is None:
            return None
        score = min(score, match[1])
    return match[0], score


def find_patch(
    grey: np.ndarray, template: np.ndarray, centre: np.ndarray, spread: np.ndarray, sigmas: float, reach: float
) -> tuple[np.ndarray, float] | None:
    """Best place of a template inside an ellipse of one level, by normalised cross-correlation, and its score."""
    height, width = grey.shape
    extent = np.clip(sigmas * np.sqrt([spread[0, 0], spread[1, 1]]), 1, reach)
    low = np.maximum(np.ceil(centre - extent), HALF).astype(int)
    high = np.minimum(np.floor(centre + extent), [width - 1 - HALF, height - 1 - HALF]).astype(int)
    if (high < low).any():
        return None
    window = grey[low[1] - HALF : high[1] + HALF + 1, low[0] - HALF : high[0] + HALF + 1]
    scores = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    dx = np.arange(low[0], high[0] + 1) - centre[0]
    dy = (np.arange(low[1], high[1] + 1) - centre[1])[:, None]
    (a, b), (_, c) = spread
    allowed = c * dx**2 - 2 * b * dx * dy + a * dy**2 <= max(sigmas, 1) ** 2 * (a * c - b * b)
    ranked = np.where(allowed, scores, -1)
    y, x = divmod(int(np.argmax(ranked)), ranked.shape[1])
    best = float(ranked[y, x])
    if best <= 0:
        return None
    return low + np.array([x + _peak(scores[y], x), y + _peak(scores[:, x], y)]), best


def contrast(grey: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """``(M,)`` standard deviation of the patch at each whole pixel, in standard deviations of the image's noise.

    The noise is the median answer to a mask that no smooth surface answers to (Immerkaer 1996); two pictures of a patch
    of contrast c correlate to ``1 - 1 / c^2``.
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1.0]])
    noise = float(np.median(np.abs(cv2.filter2D(grey, cv2.CV_32F, mask)))) / (6 * 0.6745)
    floating = grey.astype(np.float32)
    size = (2 * HALF + 1, 2 * HALF + 1)
    variance = cv2.blur(floating**2, size) - cv2.blur(floating, size) ** 2
    return np.sqrt(np.maximum(variance[uv[:, 1], uv[:, 0]], 0)) / max(noise, 0.5)


def self_likeness(grey: np.ndarray, uv: np.ndarray, radius: int = 12) -> np.ndarray:
    """``(M,)`` best score of the patch at each whole pixel somewhere else within ``radius``: near 1 in a pattern that
    repeats itself, whose points are confused with their neighbours."""
    border = HALF + radius
    wide = cv2.copyMakeBorder(grey, border, border, border, border, cv2.BORDER_REFLECT_101)
    likeness = np.zeros(len(uv))
    for k, (x, y) in enumerate(uv):
        window = wide[y : y + 2 * border + 1, x : x + 2 * border + 1]
        scores = cv2.matchTemplate(window, window[radius:-radius, radius:-radius], cv2.TM_CCOEFF_NORMED)
        scores[radius - 3 : radius + 4, radius - 3 : radius + 4] = -1
        likeness[k] = scores.max()
    return likeness


def _peak(scores: np.ndarray, at: int) -> float:
    """Offset in [-0.5, 0.5] of the top of the parabola through three scores."""
    if not 0 < at < len(scores) - 1:
        return 0.0
    left, middle, right = (float(s) for s in scores[at - 1 : at + 2])
    bend = left - 2 * middle + right
    return min(max(0.5 * (left - right) / bend, -0.5), 0.5) if bend < -1e-9 else 0.0
