"""dvo: learned monocular visual odometry.

    odometry = dvo.load("small")
    for frame in dvo.open("video.mp4", calib="calib.txt"):
        estimate = odometry.track(frame)
    result = odometry.finish()

The names below are imported when first used, so that ``import dvo`` and ``dvo --help`` stay fast. It
also decides how the threads of a torch that is imported later wait, see :mod:`dvo.core.threads`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dvo.core.errors import DvoError
from dvo.core.threads import wait_passively
from dvo.moved import find_moved

if TYPE_CHECKING:
    from dvo import losses
    from dvo.ba.layer.layer import bundle_adjust
    from dvo.ba.options import BADamping, BAOptions, BAResult
    from dvo.data.extrinsics import base_trajectory
    from dvo.data.frame import Frame
    from dvo.data.open import open_source as open
    from dvo.data.streams.live import LiveFrames
    from dvo.data.streams.live_source import open_stream
    from dvo.data.streams.streams import stream
    from dvo.data.trajectory import Trajectory
    from dvo.export.formats import export_map, export_trajectory
    from dvo.geometry import se3
    from dvo.geometry.camera import Camera
    from dvo.metrics import Metrics, evaluate
    from dvo.models.weights import load_model
    from dvo.nets.patch.config import ModelConfig
    from dvo.odometry.calibration.calibrate import calibrate
    from dvo.odometry.calibration.camera_estimate import SelfCalibration
    from dvo.odometry.load import load
    from dvo.odometry.load_map import load_map
    from dvo.odometry.patch.config import TrackerConfig
    from dvo.odometry.protocol import Break, Estimate, Odometry, Result, Segment, SparseMap, Status
    from dvo.session.session import run
    from dvo.synth.dataset import ClipDataset

wait_passively()
find_moved()

__version__ = "0.3.0"

_LAZY = {
    "BADamping": ("dvo.ba.options", "BADamping"),
    "BAOptions": ("dvo.ba.options", "BAOptions"),
    "BAResult": ("dvo.ba.options", "BAResult"),
    "Break": ("dvo.odometry.protocol", "Break"),
    "Camera": ("dvo.geometry.camera", "Camera"),
    "ClipDataset": ("dvo.synth.dataset", "ClipDataset"),
    "Estimate": ("dvo.odometry.protocol", "Estimate"),
    "Frame": ("dvo.data.frame", "Frame"),
    "LiveFrames": ("dvo.data.streams.live", "LiveFrames"),
    "Metrics": ("dvo.metrics", "Metrics"),
    "ModelConfig": ("dvo.nets.patch.config", "ModelConfig"),
    "Odometry": ("dvo.odometry.protocol", "Odometry"),
    "Result": ("dvo.odometry.protocol", "Result"),
    "SelfCalibration": ("dvo.odometry.calibration.camera_estimate", "SelfCalibration"),
    "Segment": ("dvo.odometry.protocol", "Segment"),
    "SparseMap": ("dvo.odometry.protocol", "SparseMap"),
    "Status": ("dvo.odometry.protocol", "Status"),
    "TrackerConfig": ("dvo.odometry.patch.config", "TrackerConfig"),
    "Trajectory": ("dvo.data.trajectory", "Trajectory"),
    "base_trajectory": ("dvo.data.extrinsics", "base_trajectory"),
    "bundle_adjust": ("dvo.ba.layer.layer", "bundle_adjust"),
    "calibrate": ("dvo.odometry.calibration.calibrate", "calibrate"),
    "evaluate": ("dvo.metrics", "evaluate"),
    "export_map": ("dvo.export.formats", "export_map"),
    "export_trajectory": ("dvo.export.formats", "export_trajectory"),
    "load": ("dvo.odometry.load", "load"),
    "load_map": ("dvo.odometry.load_map", "load_map"),
    "load_model": ("dvo.models.weights", "load_model"),
    "losses": ("dvo.losses", ""),
    "open": ("dvo.data.open", "open_source"),
    "open_stream": ("dvo.data.streams.live_source", "open_stream"),
    "run": ("dvo.session.session", "run"),
    "se3": ("dvo.geometry.se3", ""),
    "stream": ("dvo.data.streams.streams", "stream"),
}

__all__ = [
    "BADamping", "BAOptions", "BAResult", "Break", "Camera", "ClipDataset", "DvoError", "Estimate", "Frame",
    "LiveFrames", "Metrics", "ModelConfig", "Odometry", "Result", "Segment", "SelfCalibration", "SparseMap", "Status",
    "TrackerConfig", "Trajectory", "__version__", "base_trajectory", "bundle_adjust", "calibrate", "evaluate",
    "export_map", "export_trajectory", "load", "load_map", "load_model", "losses", "open", "open_stream", "run", "se3",
    "stream",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Resolve a public name on first use (PEP 562)."""
    if name not in _LAZY:
        raise AttributeError(f"module 'dvo' has no attribute '{name}'")
    module, attribute = _LAZY[name]
    found = import_module(module)
    value = getattr(found, attribute) if attribute else found
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
