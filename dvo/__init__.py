"""dvo: learned monocular visual odometry.

    odometry = dvo.load("small")
    for frame in dvo.open("video.mp4", calib="calib.txt"):
        estimate = odometry.track(frame)
    result = odometry.finish()

The names below are imported when first used, so that ``import dvo`` and ``dvo --help`` stay fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dvo.errors import DvoError

if TYPE_CHECKING:
    from dvo.ba.layer import bundle_adjust
    from dvo.data.source import open_source as open
    from dvo.models.weights import load_model
    from dvo.odometry.tracker import load

__version__ = "0.1.0"

__all__ = ["DvoError", "__version__", "bundle_adjust", "load", "load_model", "open"]

_LAZY = {
    "bundle_adjust": ("dvo.ba.layer", "bundle_adjust"),
    "load": ("dvo.odometry.tracker", "load"),
    "load_model": ("dvo.models.weights", "load_model"),
    "open": ("dvo.data.source", "open_source"),
}


def __getattr__(name: str) -> Any:
    """PEP 562: resolve a public name on first use."""
    if name not in _LAZY:
        raise AttributeError(f"module 'dvo' has no attribute '{name}'")
    module, attribute = _LAZY[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
