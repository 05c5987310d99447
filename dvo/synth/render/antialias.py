"""Antialiasing of outlines by coverage: a pixel at an outline is a mix of its neighbours' colours."""

from __future__ import annotations

import torch
from torch import Tensor

OFFSETS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))  # rotated grid, pixels


def smooth_outlines(images: Tensor, surface: Tensor, functions: Tensor, slack: float, *, by_row: bool = False) -> None:
    """Blend the pixels at outlines, in place.

    At four samples of each such pixel the nearest surface is determined among those of the pixel and of its neighbours;
    the sample takes the colour of this surface at the neighbour's centre. Depth and surfaces stay those of pixel
    centres.

    Args:
        images: ``(N, 3, H, W)``.
        surface: ``(N, H, W)`` int32 row of the functions of the visible surface, -1 for none.
        functions: ``(N, Q, 5, 3)`` inverse depth and four edge functions, linear in (x, y, 1).
        slack: edge functions above ``-slack`` are inside.
        by_row: functions are ``(N, H, Q, 5, 3)``, one set per row, in which the row is y = 0.
    """
    for frame in range(len(images)):  # one at a time: small enough for the processor's cache
        _smooth_frame(images[frame], surface[frame], functions[frame], slack, by_row)


def _smooth_frame(image: Tensor, surface: Tensor, functions: Tensor, slack: float, by_row: bool) -> None:
    height, width = surface.shape
    across, down = surface[:, 1:] != surface[:, :-1], surface[1:] != surface[:-1]
    outline = torch.zeros_like(surface, dtype=torch.bool)
    outline[:, 1:] |= across
    outline[:, :-1] |= across
    outline[1:] |= down
    outline[:-1] |= down
    at = outline.view(-1).nonzero()[:, 0]
    if at.numel() == 0:
        return
    y, x = at // width, at % width
    left, right = at - (x > 0).long(), at + (x < width - 1).long()
    up, below = at - width * (y > 0).long(), at + width * (y < height - 1).long()
    places = torch.stack([at, left, right, up, below])  # (5, M) where each candidate's colour comes from
    names = surface.view(-1)[places].long()
    index = names.clamp_min(0)
    if by_row:
        index, y = index + y * functions.shape[1], torch.zeros_like(y)
    rows = functions.view(-1, 15).index_select(0, index.view(-1))
    rows = rows.t().contiguous().view(5, 3, *places.shape)  # function, coefficient, candidate, pixel
    centre = rows[:, 0] * x.float() + rows[:, 1] * y.float() + rows[:, 2]
    colours = image.view(3, -1)
    total = torch.zeros(3, at.numel(), device=image.device)
    for dx, dy in OFFSETS:
        value = centre + dx * rows[:, 0] + dy * rows[:, 1]
        inside = (value[1:].amin(0) >= -slack) & (names >= 0)
        # Hidden surfaces do not count; if no candidate covers the sample, the pixel's own colour stays.
        score = torch.where(inside, value[0], -1.0)
        score[0].clamp_min_(-0.5)
        best, chosen = score[0], places[0]
        for k in range(1, len(places)):  # an argmax over five rows, which torch is slow at
            better = score[k] > best
            best, chosen = torch.where(better, score[k], best), torch.where(better, places[k], chosen)
        total += colours[:, chosen]
    colours[:, at] = total / len(OFFSETS)
