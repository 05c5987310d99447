"""Training clips from recorded sequences: TartanAir with depth, and every format that dvo reads with ground truth.

Where a data set has depth (TartanAir v1 and v2) the whole loss applies; elsewhere the depth is nan, and only the poses
count.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from dvo.core.errors import DvoError
from dvo.data.images.fit import fit, fit_depth
from dvo.data.open import open_source
from dvo.data.readers.tartanair import depth_file
from dvo.data.sensors.depth import read_depth
from dvo.data.source import Source
from dvo.data.trajectory import interpolate
from dvo.geometry import se3
from dvo.synth.clip import induced_flow
from train.data.tartanair import with_trajectories

STEP = 0.15
"""Mean motion between frames of a clip without depth, in the unit of training (rendered clips, whose unit is the median
depth, have about this)."""


@dataclass
class RealData:
    """Selection of recordings to train on.

    Attributes:
        folders: sequence folders with ground truth, or folders with TartanAir's trajectories below; a single one may
            stand without a list.
        share: of the batches; the others are rendered.
        hops: frame gaps, one drawn a clip.
        flow_low, flow_high: mean induced flow between neighbouring frames, pixels, that a clip with depth should have.
    """

    folders: list[str] | str = field(default_factory=list)
    share: float = 1.0
    hops: list[int] = field(default_factory=lambda: [1, 2, 3])
    flow_low: float = 1.0
    flow_high: float = 20.0

    def __post_init__(self) -> None:
        if isinstance(self.folders, str):
            self.folders = [self.folders]

    def check(self) -> None:
        """Check the settings, which the command line does not do.

        Raises:
            DvoError: no folder, a share outside of 0 to 1, or a gap below 1.
        """
        if not self.folders:
            raise DvoError(
                "no recordings are named",
                field="data.real.folders",
                remedy="name a folder, or leave out data.real to train on renderings",
            )
        if not 0 <= self.share <= 1:
            raise DvoError(f"{self.share:g} is no share", field="data.real.share", remedy="give a number from 0 to 1")
        if not self.hops or min(self.hops) < 1:
            raise DvoError(f"{self.hops} are no gaps", field="data.real.hops", remedy="give numbers of 1 or more")


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
        self.sources = [open_source(folder) for folder in with_trajectories(data.folders)]
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
        """Read a clip of one recording.

        Args:
            number: index of the recording.
            start: first frame.
            hop: gap between frames.

        Returns:
            arrays as those of an item; the world is the first camera, the unit the median depth.
        """
        height, width = self.size
        indices = range(start, start + (self.frames - 1) * hop + 1, hop)
        images, depths, intrinsics = [], [], []
        for frame, file in self.sources[number].frames_at(indices):
            image, camera = fit(frame.image, frame.camera, width, height)
            images.append(image)
            intrinsics.append(camera.intrinsics)
            depths.append(fit_depth(_depth(file), frame.camera, camera))
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


def _depth(image: Path) -> np.ndarray | None:
    """Depth of an image in metres where it is exact and whole, which only TartanAir's is."""
    file = depth_file(image)
    if file is None:
        return None
    depth = read_depth(file)
    if depth is None:
        raise DvoError("cannot be decoded", file=file, remedy="download it again")
    return depth


def _scale_of_motion(poses_wc: np.ndarray) -> float:
    """Divisor of translations when no depth is known: the mean step becomes :data:`STEP`. A camera that does not move
    keeps its unit."""
    step = float(np.linalg.norm(np.diff(poses_wc[:, :3], axis=0), axis=1).mean())
    return step / STEP if step > 1e-4 else 1.0
