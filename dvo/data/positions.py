"""Positions of a satellite receiver that a recording carries: read for comparison, they take no part in poses."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

EARTH = 6_371_008.8
"""Mean radius of the Earth, metres."""


@dataclass(frozen=True)
class Positions:
    """Fixes of a satellite receiver.

    Attributes:
        timestamps: ``(K,)`` float64 seconds on the clock of the frames.
        degrees: ``(K, 2)`` float64 latitude and longitude, WGS 84.
        altitude: ``(K,)`` float64 metres.
        has_fix: ``(K,)`` bool.
        fix: ``(K,)`` text, the quality as the receiver states it, such as ``3D``.
        precision: ``(K,)`` float64 in :attr:`precision_unit`; NaN where it is not stated.
        precision_unit: ``DOP`` (dilution of precision) or ``m``.
        origin: for messages.
    """

    timestamps: np.ndarray
    degrees: np.ndarray
    altitude: np.ndarray
    has_fix: np.ndarray
    fix: tuple[str, ...]
    precision: np.ndarray
    precision_unit: str
    origin: str

    def __len__(self) -> int:
        return len(self.timestamps)

    def metres(self) -> np.ndarray:
        """East, north and up of the samples with a fix, from the first of them, ``(M, 3)`` float64, on the sphere that
        touches there: within a kilometre as good as the receiver."""
        degrees, altitude = self.degrees[self.has_fix], self.altitude[self.has_fix]
        if not len(degrees):
            return np.zeros((0, 3))
        north, east = np.radians(degrees - degrees[0]).T
        east = (east + np.pi) % (2 * np.pi) - np.pi
        scale = EARTH + altitude[0]
        return np.column_stack(
            [scale * np.cos(np.radians(degrees[0, 0])) * east, scale * north, altitude - altitude[0]]
        )

    def summary(self) -> dict[str, Any]:
        """Entries of run.json.

        Returns:
            ``origin``; ``count``; ``with_fix``; ``fix``: number of samples by quality; ``length``: metres of the way
            over the ground, one position a second, so that noise does not add up (None with fewer than two);
            ``precision``: its median, and ``precision_unit``.
        """
        places, times = self.metres(), self.timestamps[self.has_fix]
        kept = [0] if len(times) else []
        for k in range(1, len(times)):
            if times[k] - times[kept[-1]] >= 1.0 - 1e-6 or k == len(times) - 1:
                kept.append(k)
        steps = np.diff(places[kept, :2], axis=0)
        stated = self.precision[np.isfinite(self.precision)]
        return {
            "origin": self.origin,
            "count": len(self),
            "with_fix": int(self.has_fix.sum()),
            "fix": dict(sorted(Counter(self.fix).items())),
            "length": float(np.linalg.norm(steps, axis=1).sum()) if len(kept) > 1 else None,
            "precision": float(np.median(stated)) if len(stated) else None,
            "precision_unit": self.precision_unit,
        }

    def describe(self) -> str:
        """One line for people."""
        facts = self.summary()
        text = f"positions: {facts['count']} of {self.origin}, {facts['with_fix']} with a fix"
        text += f", {facts['length']:.4g} m of way" if facts["length"] is not None else ""
        precision = facts["precision"]
        text += f", median precision {precision:.3g} {self.precision_unit}" if precision is not None else ""
        return f"{text}; they are for comparison only"
