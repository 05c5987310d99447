"""Tables of a map file beside its graph: the network, the settings and the metadata of the result, the loops."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from dvo.core.settings import LARGEST_SEED
from dvo.odometry.loops.finder import Loop
from dvo.odometry.patch.config import TrackerConfig

_LAST = 2**31 - 1  # largest number of a keyframe


@dataclass(frozen=True)
class WeightsTable:
    """Network of a map.

    Attributes:
        name: of shipped weights, or a file; empty for a network that was neither.
        digest: see :func:`dvo.models.weights.tensor_digest`.
    """

    name: str
    digest: str


@dataclass(frozen=True)
class MapTable:
    """What a map has beside its graph.

    Attributes:
        name, seed, config: of the tracker.
        initialised: segments that were.
        readout: time that a camera of the last recording takes to read an image, seconds.
        rows: of the feature maps of that camera.
        info: metadata of the result of the last recording, without seed and settings.
    """

    name: str
    seed: int
    config: TrackerConfig
    initialised: tuple[int, ...]
    readout: float
    rows: float
    info: dict[str, Any]

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "seed": (0, LARGEST_SEED), "readout": (0, 1), "rows": (1e-3, 1e6),
    }  # fmt: skip


@dataclass(frozen=True)
class LoopTable:
    """Confirmed loop without its measurement; see :class:`dvo.odometry.loops.finder.Loop`."""

    old: int
    new: int
    kind: str
    inliers: float
    count: int
    joins: bool

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "old": (0, _LAST), "new": (0, _LAST), "inliers": (0, 1), "count": (0, _LAST),
    }  # fmt: skip

    @classmethod
    def of(cls, loop: Loop) -> LoopTable:
        """Table of a loop."""
        return cls(loop.old, loop.new, loop.kind, loop.inliers, loop.count, loop.joins)


@dataclass(frozen=True)
class LoopsTable:
    """Confirmed loops of a map.

    Attributes:
        loops: in the order of their discovery.
    """

    loops: tuple[LoopTable, ...]
