"""Windows in map files of version 2, which held sequences in progress: their keyframes and edges are archived."""

from __future__ import annotations

import numpy as np
import torch

from dvo.data.images.image_header import image_size
from dvo.map.io.map_file import MapReader
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.window import Keyframe

_LAST = 2**31 - 1  # largest number of a keyframe
_SIDE = 2**15  # largest side of a working image, pixels


def archive_old_window(source: MapReader, graph: KeyframeGraph) -> None:
    """Archive the keyframes and edges of a window, with the poses and measurements that they had.

    Args:
        source: map file of version 2.
        graph: whose archive and log have been read; its window is empty, and stays so.

    Raises:
        DvoError: a missing or invalid array.
    """
    window, m, p = graph.window, graph.window.per_frame, graph.window.patches.shape[-1]
    device = window.jj.device

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(device)

    identifiers = source.array("window/keyframes", np.int64, (None,), 0, _LAST)
    n = len(identifiers)
    if not n:  # of a finished sequence
        return
    times = source.array("window/times", np.float64, (n,))
    rising = (np.diff(identifiers) > 0).all() and (np.diff(times) > 0).all()
    source.require(rising, "holds keyframes that are not in order of time", "window/times")
    source.require(not any(int(k) in graph.archive for k in identifiers), "archived already", "window/keyframes")
    poses = source.poses("window/poses_cw", np.float32, n)
    patches = source.array("window/patches", np.float32, (n * m, 3, p, p))
    intrinsics = source.array("window/intrinsics", np.float32, (n, 4))
    source.require((intrinsics[:, :2] > 0).all(), "holds a focal length that is not positive", "window/intrinsics")
    matching = source.array("window/matching", np.float32, (n, m, None, p, p), -65504, 65504)
    context = source.array("window/context", np.float32, (n, m, None), -65504, 65504)
    for frame in graph.archive:
        for name, mine, other in (("matching", matching, frame.matching), ("context", context, frame.context)):
            same = other is None or mine.shape[1:] == other.shape
            source.require(same, "holds features of another size than the archive", f"window/{name}")
    colors = source.array("window/colors", np.uint8, (n, m, 3))
    has_image = source.array("window/has_image", np.uint8, (n,), 0, 1)
    images = source.array("window/images", np.uint8, (int(has_image.sum()), None, None, 3))
    height, width = images.shape[1:3]
    archived = {image_size(frame.jpeg.tobytes()) for frame in graph.archive if frame.jpeg is not None}
    fits = not len(images) or (min(height, width) > 0 and max(height, width) <= _SIDE and archived <= {(width, height)})
    source.require(fits, "holds images of an impossible size, or of another one than the archive", "window/images")
    measured: list[torch.Tensor | None] = [None] * n
    if source.has("window/has_measured"):
        known = source.array("window/has_measured", np.uint8, (n,), 0, 1) > 0
        values = source.array("window/measured", np.float32, (int(known.sum()), m, 2), 0, 1e12)
        for at, value in zip(np.flatnonzero(known).tolist(), values, strict=True):
            measured[at] = tensor(value)
    kk = source.array("window/edge_patches", np.int64, (None,), 0, n * m - 1)
    jj = source.array("window/edge_targets", np.int64, (len(kk),), 0, n - 1)
    targets = source.array("window/targets", np.float32, (len(kk), 2))
    weights = source.array("window/weights", np.float32, (len(kk), 2), 0, 65504)
    row = np.cumsum(has_image, dtype=np.int64) - 1
    for k, identifier in enumerate(identifiers.tolist()):
        image = images[row[k]] if has_image[k] else None
        colours, camera = torch.from_numpy(colors[k]), tensor(intrinsics[k])
        features = tensor(matching[k]), tensor(context[k])
        keyframe = Keyframe(identifier, float(times[k]), k, *features, colours, camera, image, measured=measured[k])
        window.append(keyframe, tensor(poses[k]), tensor(patches[k * m : (k + 1) * m]))
    window.connect(tensor(kk), tensor(jj))
    window.targets, window.weights = tensor(targets), tensor(weights)
    finalise, graph.finalise = graph.finalise, None  # without the images that measurements are aligned in
    graph.archive_window()
    graph.finalise = finalise
