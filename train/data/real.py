"""Training clips from recorded sequences: TartanAir with depth, and whatever dvo reads that has ground truth.

Where a data set has depth (TartanAir v1 and v2) the whole loss applies; elsewhere the depth is nan, and only the poses
count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from dvo.data.clips import fit
from dvo.data.source import Source, open_source
from dvo.data.trajectory import interpolate
from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.synth.clip import induced_flow

STEP = 0.15
"""Mean motion between frames of a clip without depth, in the unit of training (rendered clips, whose unit is the median
depth, have about this)."""


@dataclass
class RealData:
    """Which recordings to train on.

    Attributes:
        folders: sequence folders with ground truth.
        share: of the batches; the others are rendered.
        hops: frame gaps, one drawn a clip.
        flow_low, flow_high: mean induced flow between neighbouring frames, pixels, that a clip with depth should have.
    """

    folders: list[str] = field(default_factory=list)
    share: float = 1.0
    hops: list[int] = field(default_factory=lambda: [1, 2, 3])
    flow_low: float = 1.0
    flow_high: float = 20.0


class RealClips(Dataset[dict[str, Tensor]]):
    """Clips drawn from recordings; the same index, the same clip.

    Args:
        seed: of the draws.
        data: which recordings.
        frames, height, width: of a clip.

    Items are as those of :class:`dvo.synth.dataset.ClipDataset`; unknown depths are nan.

    Raises:
        DvoError: no ground truth, or too few frames with it for a clip.
    """

    def __init__(self, seed: int, data: RealData, frames: int, height: int, width: int) -> None:
        self.seed, self.data, self.frames, self.size = seed, data, frames, (height, width)
        self.sources = [open_source(folder) for folder in data.folders]
        self.poses: list[np.ndarray] = []
        self.starts: list[tuple[int, int, int]] = []
        for number, source in enumerate(self.sources):
            poses = poses_at_frames(source)
            known = np.isfinite(poses).all(1)
            self.poses.append(poses)
            for hop in data.hops:
                span = (frames - 1) * hop + 1
                ok = [s for s in range(len(poses) - span + 1) if known[s : s + span : hop].all()]
                self.starts += [(number, s, hop) for s in ok]
        if not self.starts:
            raise DvoError(
                f"no {frames} frames with ground truth in a row",
                file=data.folders[0] if data.folders else None,
                field="data.real.folders",
                remedy="name sequences with ground truth, or ask for fewer frames",
            )

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        rng = np.random.default_rng([self.seed, 9107, index])
        for _ in range(8):
            clip = self.read(*self.starts[int(rng.integers(len(self.starts)))])
            if self._moves_enough(clip):
                break
        return {name: torch.from_numpy(value) for name, value in clip.items()}

    def read(self, number: int, start: int, hop: int) -> dict[str, np.ndarray]:
        """The clip of one recording from a frame on, every ``hop``-th frame."""
        height, width = self.size
        indices = range(start, start + (self.frames - 1) * hop + 1, hop)
        images, depths, intrinsics = [], [], []
        for frame, file in self.sources[number].frames_at(indices):
            image, camera = fit(frame.image, frame.camera, width, height)
            images.append(image)
            intrinsics.append(camera.intrinsics)
            depths.append(_fit_depth(read_depth(file), frame.camera, camera))
        poses = torch.from_numpy(self.poses[number][indices.start : indices.stop : hop])
        relative = se3.compose(se3.inverse(poses), poses[:1])  # world := first camera
        depth = np.stack(depths).astype(np.float32)
        scale = float(np.nanmedian(depth)) if np.isfinite(depth).any() else _scale_of_motion(poses.numpy())
        relative[:, :3] /= scale
        relative[0] = torch.tensor([0.0, 0, 0, 0, 0, 0, 1])
        return {
            "images": np.stack(images).transpose(0, 3, 1, 2).copy(),
            "depth": depth / np.float32(scale),
            "poses_cw": relative.float().numpy(),
            "intrinsics": np.stack(intrinsics).astype(np.float32),
        }

    def _moves_enough(self, clip: dict[str, np.ndarray]) -> bool:
        depth = clip["depth"]
        if not np.isfinite(depth).all():
            return True
        poses_wc = se3.inverse(torch.from_numpy(clip["poses_cw"]).double()).numpy()
        flow, _ = induced_flow(depth, poses_wc, clip["intrinsics"][0].astype(float))
        return bool(self.data.flow_low <= flow.mean() <= self.data.flow_high)


def poses_at_frames(source: Source) -> np.ndarray:
    """Camera-to-world poses ``(N, 7)`` of all images of a recording, rows of nan where there is no ground truth.

    Raises:
        DvoError: a video, or no ground truth at all.
    """
    times = source.timestamps
    if times is None or source.groundtruth is None:
        raise DvoError("no ground truth, or a video", file=source.path, remedy="name folders with ground truth")
    found = interpolate(source.groundtruth, times)
    poses = np.full((len(times), 7), np.nan)
    poses[np.isin(times, found.timestamps)] = found.poses_wc
    return poses


def depth_files(image: Path) -> Sequence[Path]:
    """Where TartanAir keeps the depth of an image: v1 ``depth_left``, v2 ``depth_lcam_front``."""
    sequence, stem = image.parent.parent, image.stem
    if image.parent.name == "image_left":
        return [sequence / "depth_left" / f"{stem}_depth{end}" for end in (".npy", ".npz")]
    if image.parent.name == "image_lcam_front":
        return [sequence / "depth_lcam_front" / f"{stem}_depth.png"]
    return []


def read_depth(image: Path) -> np.ndarray | None:
    """Depth ``(H, W)`` in metres that belongs to an image, nan where it is not known, or None if there is none.

    Raises:
        DvoError: a file that is not what TartanAir writes.
    """
    import cv2

    file = next((f for f in depth_files(image) if f.is_file()), None)
    if file is None:
        return None
    if file.suffix == ".png":  # the four bytes of a pixel are one float
        packed = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if packed is None or packed.dtype != np.uint8 or packed.shape[2:] != (4,):
            raise DvoError("not a depth map of TartanAir v2", file=file, remedy="download it again")
        depth = np.ascontiguousarray(packed).view("<f4")[..., 0]
    else:
        loaded = np.load(file)
        depth = loaded["depth"] if isinstance(loaded, np.lib.npyio.NpzFile) else loaded
    return np.where((depth > 0) & np.isfinite(depth), depth, np.nan).astype(np.float32)


def _fit_depth(depth: np.ndarray | None, camera: Camera, fitted: Camera) -> np.ndarray:
    """Depth as the fitted camera sees it, the nearest pixel along each ray."""
    if depth is None:
        return np.full((fitted.height, fitted.width), np.nan, np.float32)
    columns = (np.arange(fitted.width) - fitted.cx) / fitted.fx * camera.fx + camera.cx
    rows = (np.arange(fitted.height) - fitted.cy) / fitted.fy * camera.fy + camera.cy
    nearest = (np.clip(np.rint(x), 0, n - 1).astype(int) for x, n in zip((rows, columns), depth.shape, strict=True))
    return depth[np.ix_(*nearest)]


def _scale_of_motion(poses_wc: np.ndarray) -> float:
    """What to divide translations by when no depth is known: the mean step becomes :data:`STEP`. A camera that does
    not move keeps its unit."""
    step = float(np.linalg.norm(np.diff(poses_wc[:, :3], axis=0), axis=1).mean())
    return step / STEP if step > 1e-4 else 1.0
