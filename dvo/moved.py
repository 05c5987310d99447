"""Modules that the documentation once named elsewhere: importing the old name gives the names of the new module."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

_CORE, _SESSION, _FRAMES = "dvo.core", "dvo.session", "dvo.odometry.frames"
MOVED = {
    "dvo.errors": f"{_CORE}.errors",
    "dvo.registry": f"{_CORE}.registry",
    "dvo.settings": f"{_CORE}.settings",
    "dvo.threads": f"{_CORE}.threads",
    "dvo.relative_pose": "dvo.metrics.relative_pose",
    "dvo.segment_metrics": "dvo.metrics.segment_metrics",
    "dvo.data.depth_source": "dvo.data.companions.depth_source",
    "dvo.data.right_source": "dvo.data.companions.right_source",
    "dvo.data.live": "dvo.data.streams.live",
    "dvo.graph": "dvo.map",
    "dvo.graph.keyframe_graph": "dvo.map.keyframe_graph",
    "dvo.graph.places": "dvo.map.places",
    "dvo.graph.serialisation": "dvo.map.io.serialisation",
    "dvo.nets.config": "dvo.nets.patch.config",
    "dvo.odometry.calibrate": "dvo.odometry.calibration.calibrate",
    "dvo.odometry.config": "dvo.odometry.patch.config",
    "dvo.odometry.deepvo": "dvo.odometry.two_frame.deepvo",
    "dvo.odometry.evidence": f"{_FRAMES}.content",
    "dvo.odometry.frame_sequence": f"{_FRAMES}.gate",
    "dvo.odometry.frames.frame_sequence": f"{_FRAMES}.gate",
    "dvo.odometry.frames.working_image": f"{_FRAMES}.gate",
    "dvo.odometry.observer": f"{_SESSION}.observer",
    "dvo.odometry.place_descriptors": "dvo.odometry.loops.place_descriptors",
    "dvo.odometry.results": f"{_SESSION}.results",
    "dvo.odometry.scale_options": "dvo.odometry.depth.scale_options",
    "dvo.odometry.session": f"{_SESSION}.session",
    "dvo.odometry.tracker": "dvo.odometry.patch.tracker",
    "dvo.odometry.working_image": f"{_FRAMES}.gate",
}
"""Old name to new name."""


class _Moved(MetaPathFinder, Loader):
    """Finder and loader of the old names."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(name, self, is_package=name == "dvo.graph") if name in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        new = MOVED[module.__name__]
        warnings.warn(f"{module.__name__} is now {new}", DeprecationWarning, stacklevel=2)
        names = vars(import_module(new))
        module.__dict__.update({name: value for name, value in names.items() if not name.startswith("__")})


def find_moved() -> None:
    """Let old names be imported, in this process."""
    if not any(isinstance(finder, _Moved) for finder in sys.meta_path):
        sys.meta_path.append(_Moved())
