"""The sliding window of a graph as arrays, and back."""

from __future__ import annotations

import numpy as np
import torch

from dvo.graph.map_file import MapReader
from dvo.graph.window import Keyframe, Window

_LAST = 2**31 - 1  # largest number of a keyframe
_SLOTS = 2**12  # map slots at most, far above those of the longest window
_SIDE = 2**15  # largest side of a working image, pixels


def window_arrays(window: Window) -> dict[str, np.ndarray]:
    """Window as arrays.

    Args:
        window: keyframes with images of one size, or without.

    Returns:
        Arrays by name.
    """
    frames, m, p = window.frames, window.per_frame, window.patches.shape[-1]
    images = [frame.image for frame in frames if frame.image is not None]
    fine = [_array(frame.fine) for frame in frames if frame.fine is not None]
    visible = {} if window.visible is None else {"window/visible": _array(window.visible).astype(np.uint8)}
    return visible | {
        "window/keyframes": np.array([frame.identifier for frame in frames], np.int64),
        "window/times": np.array([frame.timestamp for frame in frames], np.float64),
        "window/map_slots": np.array([frame.map_slot for frame in frames], np.int64),
        "window/poses_cw": _array(window.poses_cw),
        "window/patches": _array(window.patches),
        "window/intrinsics": _stacked([_array(f.intrinsics) for f in frames], (4,)),
        "window/matching": _stacked([_array(f.matching) for f in frames], (m, 0, p, p)),
        "window/context": _stacked([_array(f.context) for f in frames], (m, 0)),
        "window/fine": _stacked(fine, (m, 0, p, p)),
        "window/colors": _stacked([_array(f.colors) for f in frames], (m, 3)).astype(np.uint8),
        "window/has_image": np.array([frame.image is not None for frame in frames], np.uint8),
        "window/images": _stacked(images, (0, 0, 3)).astype(np.uint8),
        "window/edge_patches": _array(window.kk),
        "window/edge_targets": _array(window.jj),
        "window/hidden": _array(window.hidden),
        "window/targets": _array(window.targets),
        "window/weights": _array(window.weights),
        "window/confidence": _array(window.confidence),
    }


def read_window(source: MapReader, window: Window) -> None:
    """Fill an empty window; edge slots are numbered in order.

    Args:
        source: map file.
        window: without frames.

    Raises:
        DvoError: a missing or invalid array.
    """
    m, p, device = window.per_frame, window.patches.shape[-1], window.jj.device

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(device)

    identifiers = source.array("window/keyframes", np.int64, (None,), 0, _LAST)
    n = len(identifiers)
    times = source.array("window/times", np.float64, (n,))
    rising = (np.diff(identifiers) > 0).all() and (np.diff(times) > 0).all()
    source.require(rising, "holds keyframes that are not in order of time", "window/times")
    slots = source.array("window/map_slots", np.int64, (n,), 0, _SLOTS - 1)
    source.require(len(set(slots.tolist())) == n, "gives a slot twice", "window/map_slots")
    poses = source.poses("window/poses_cw", np.float32, n)
    patches = source.array("window/patches", np.float32, (n * m, 3, p, p))
    intrinsics = source.array("window/intrinsics", np.float32, (n, 4))
    source.require((intrinsics[:, :2] > 0).all(), "holds a focal length that is not positive", "window/intrinsics")
    matching = source.array("window/matching", np.float32, (n, m, None, p, p))
    context = source.array("window/context", np.float32, (n, m, None))
    colors = source.array("window/colors", np.uint8, (n, m, 3))
    fine = source.array("window/fine", np.float32, (None, m, None, p, p))
    source.require(len(fine) in (0, n), "is not there for all keyframes", "window/fine")
    has_image = source.array("window/has_image", np.uint8, (n,), 0, 1)
    images = source.array("window/images", np.uint8, (int(has_image.sum()), None, None, 3))
    source.require(max(images.shape[1:3]) <= _SIDE, "holds images that are too large", "window/images")
    visible = None
    if source.has("window/visible"):  # of frames with masks
        visible = tensor(source.array("window/visible", np.uint8, (n, None, None), 0, 1) > 0)
    row = np.cumsum(has_image, dtype=np.int64) - 1

    for i, identifier in enumerate(identifiers.tolist()):
        window.frames.append(
            Keyframe(
                identifier,
                float(times[i]),
                int(slots[i]),
                tensor(matching[i]),
                tensor(context[i]),
                torch.from_numpy(colors[i]),
                tensor(intrinsics[i]),
                images[row[i]] if has_image[i] else None,
                tensor(fine[i]) if len(fine) else None,
                None if visible is None else visible[i],
            )  # fmt: skip
        )
    window.poses_cw, window.patches = tensor(poses), tensor(patches)
    kk = source.array("window/edge_patches", np.int64, (None,), 0, n * m - 1)
    e = len(kk)
    window.kk, window.jj = tensor(kk), tensor(source.array("window/edge_targets", np.int64, (e,), 0, n - 1))
    window.hidden = tensor(source.array("window/hidden", np.float32, (e, window.hidden.shape[1])))
    window.targets = tensor(source.array("window/targets", np.float32, (e, 2)))
    window.weights = tensor(source.array("window/weights", np.float32, (e, 2), 0))
    window.confidence = tensor(source.array("window/confidence", np.float32, (e, 2), 0))
    window.edge_slots = torch.arange(e, device=device)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _stacked(parts: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Arrays along a new first axis; none of ``shape`` if there is none."""
    return np.stack(parts) if parts else np.zeros((0, *shape), np.float32)
