"""Free space around or within a mesh: a grid of free cells and exact distances to the triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

Array = np.ndarray
View = Literal["auto", "inside", "outside"]
CELLS = 48  # along the longest edge of the mesh's box
RAYS = 12  # horizontal directions in which walls are looked for
ENCLOSED = 0.7  # share of them that must end at a wall


def triangle_distance(points: Array, corners: Array) -> Array:
    """Distance from points to triangles, pair by pair (Ericson, Real-Time Collision Detection, 2005, 5.1.5).

    Args:
        points: ``(M, 3)``.
        corners: ``(M, 3, 3)``.

    Returns:
        ``(M,)``.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    best = np.full(len(points), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        edge, away = q - p, points - p
        share = np.clip((away * edge).sum(1) / np.maximum((edge**2).sum(1), 1e-300), 0, 1)
        best = np.minimum(best, ((away - share[:, None] * edge) ** 2).sum(1))
    ab, ac, ap = b - a, c - a, points - a
    normal = np.cross(ab, ac)
    length = np.maximum((normal**2).sum(1), 1e-300)
    v, w = (np.cross(ap, ac) * normal).sum(1) / length, (np.cross(ab, ap) * normal).sum(1) / length
    above = (v >= 0) & (w >= 0) & (v + w <= 1)
    return np.sqrt(np.where(above, np.minimum(best, (ap * normal).sum(1) ** 2 / length), best))


@dataclass
class FreeSpace:
    """Free cells of a grid, and the triangles.

    Attributes:
        corners: ``(T, 3, 3)``.
        bounds: ``(2, 3)`` box of camera positions.
        low, cell: corner of the grid, edge of its cells.
        free: ``(X, Y, Z)`` bool; inside the bounds and outside the grid all is free if cameras are outside the mesh.
        inside: cameras are within the mesh.
    """

    corners: Array
    bounds: Array
    low: Array
    cell: float
    free: Array
    inside: bool

    def __post_init__(self) -> None:
        self._centre = self.corners.mean(1)
        self._radius = np.linalg.norm(self.corners - self._centre[:, None], axis=-1).max(1)
        self._near = torch.from_numpy(self._centre.astype(np.float32))

    def is_free(self, points: Array) -> Array:
        """Membership in the free space.

        Args:
            points: ``(T, 3)``.

        Returns:
            ``(T,)`` bool.
        """
        points = np.asarray(points, float)
        cell = np.floor((points - self.low) / self.cell).astype(int)
        within = ((cell >= 0) & (cell < self.free.shape)).all(1)
        free = ((points >= self.bounds[0]) & (points <= self.bounds[1])).all(1)
        spot = np.clip(cell, 0, np.array(self.free.shape) - 1)
        return free & np.where(within, self.free[tuple(spot.T)], not self.inside)

    def clearance(self, points: Array) -> Array:
        """Distance from points to the nearest triangle.

        Args:
            points: ``(T, 3)``.

        Returns:
            ``(T,)``; -1 where the space is not free.
        """
        points = np.asarray(points, float)
        distance = np.full(len(points), -1.0)
        where = np.flatnonzero(self.is_free(points))
        for part in np.array_split(where, max(1, len(where) * len(self.corners) // 4_000_000)):
            if not len(part):
                continue
            away = torch.cdist(torch.from_numpy(points[part].astype(np.float32)), self._near).numpy()
            # Bounding spheres leave few candidates; float32 is given a margin.
            limit = (away + self._radius).min(1) * 1.001 + 1e-6
            point, triangle = np.nonzero(away - self._radius <= limit[:, None] * 1.001)
            exact = triangle_distance(points[part][point], self.corners[triangle])
            nearest = np.full(len(part), np.inf)
            np.minimum.at(nearest, point, exact)
            distance[part] = nearest
        return distance


def _samples(corners: Array, spacing: float) -> tuple[Array, Array]:
    """Points on the triangles at most ``spacing`` apart ``(S, 3)`` and the area vector of each ``(S, 3)``."""
    edge = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1)
    steps = np.ceil(edge / spacing).astype(int).clip(1, 400)
    normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    points, normals = [], []
    for n in np.unique(steps):
        at = np.flatnonzero(steps == n)
        i, j = (grid.ravel() for grid in np.mgrid[: n + 1, : n + 1])
        u, v = i[i + j <= n] / n, j[i + j <= n] / n
        share = np.stack([1 - u - v, u, v], -1)
        points.append((share @ corners[at]).reshape(-1, 3))
        normals.append(np.repeat(normal[at] / len(share), len(share), 0))
    return np.concatenate(points), np.concatenate(normals)


def _reach(seed: Array, blocked: Array) -> Array:
    """Cells connected with the seed cells without crossing blocked ones (six neighbours)."""
    found = seed & ~blocked
    count = -1
    while count != (count := int(found.sum())):
        for axis in range(3):
            for cut, paste in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
                source = [slice(None)] * 3
                target = [slice(None)] * 3
                source[axis], target[axis] = cut, paste
                # Masked at once: the flood must not pass through a blocked cell.
                found[tuple(target)] |= found[tuple(source)] & ~blocked[tuple(target)]
    return found


def _enclosed(occupied: Array, normal: Array, cells: Array) -> Array:
    """Share ``(M,)`` of horizontal rays from cells ``(M, 3)`` that end at a surface facing them; 0 without a floor.

    Within a solid, rays meet the backs of surfaces, which do not count.
    """
    score = np.zeros(len(cells))
    angle = np.arange(RAYS) * 2 * np.pi / RAYS + 0.1
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(RAYS)], -1)
    shape = np.array(occupied.shape)
    for direction in [np.array([0.0, 0.0, -1.0]), *directions]:
        hit = np.zeros(len(cells), bool)
        going = np.arange(len(cells))
        for step in range(1, 2 * CELLS):
            at = np.floor(cells[going] + 0.5 + 0.9 * step * direction).astype(int)
            in_grid = ((at >= 0) & (at < shape)).all(1)
            going, at = going[in_grid], at[in_grid]
            if not len(going):
                break
            stop = occupied[tuple(at.T)]
            hit[going[stop]] = normal[tuple(at[stop].T)] @ direction < 0.3
            going = going[~stop]
        score = np.where(hit, score, 0) if direction[2] < 0 else score + hit / RAYS
        if direction[2] < 0:
            floor = hit
    return np.where(floor, score, 0)


def free_space(corners: Array, view: View = "auto") -> FreeSpace:
    """Free space for cameras.

    A mesh is explored from within (a room, a street) if walls face its middle all around, and from outside (an object)
    otherwise; ``view`` overrides this.

    Args:
        corners: ``(T, 3, 3)``, z up.
        view: "auto", "inside" or "outside".

    Returns:
        Cells in which cameras may be.
    """
    low, high = corners.min((0, 1)), corners.max((0, 1))
    extent = high - low
    cell = float(extent.max()) / CELLS
    shape = np.maximum(np.ceil(extent / cell).astype(int), 1) + 2  # a border of empty cells all around
    corner = (low + high - cell * shape) / 2
    points, area = _samples(corners, 0.5 * cell)
    at = tuple(np.floor((points - corner) / cell).astype(int).clip(0, shape - 1).T)
    occupied = np.zeros(shape, bool)
    occupied[at] = True
    total, weight = np.zeros((*shape, 3)), np.zeros(shape)
    np.add.at(total, at, area)
    np.add.at(weight, at, np.linalg.norm(area, axis=1))
    normal = total / np.maximum(weight, 1e-300)[..., None]
    outside = np.ones(shape, bool)
    outside[1:-1, 1:-1, 1:-1] = False
    if view != "outside":
        coarse = np.argwhere(~occupied[::2, ::2, ::2])  # every second cell each way stands for its neighbours
        share = np.zeros([-(-n // 2) for n in shape])
        share[tuple(coarse.T)] = _enclosed(occupied, normal, 2 * coarse)
        fine = share.repeat(2, 0).repeat(2, 1).repeat(2, 2)[: shape[0], : shape[1], : shape[2]]
        walled = (fine >= (ENCLOSED if view == "auto" else 0.3)) & ~occupied & ~outside
        inside = _largest(walled)
        if inside.sum() > (0.04 * inside.size if view == "auto" else 0):
            place = np.argwhere(inside)
            bounds = corner + cell * np.stack([place.min(0), place.max(0) + 1])
            return FreeSpace(corners, bounds, corner, cell, inside, True)
    reach = float(np.linalg.norm(extent[:2])) / 2 + 0.3 * float(extent[2])
    middle = (low + high) / 2
    bounds = np.stack([middle - 2.2 * reach, middle + 2.2 * reach])
    bounds[:, 2] = low[2] + 0.04 * reach, high[2] + 0.9 * reach
    return FreeSpace(corners, bounds, corner, cell, _reach(outside, occupied), False)


def _largest(cells: Array) -> Array:
    """Largest connected part of a set of cells."""
    best, left = np.zeros_like(cells), cells.copy()
    while left.sum() > best.sum():
        seed = np.zeros_like(cells)
        seed[tuple(np.argwhere(left)[len(np.argwhere(left)) // 2])] = True
        part = _reach(seed, ~cells)
        left &= ~part
        if part.sum() > best.sum():
            best = part
    return best
