"""Long sequences, rendered frame by frame: for the demo, for tests of the tracker, for evaluation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.synth.families import random_scene
from dvo.synth.renderer import Rendering, render
from dvo.synth.scene import Scene
from dvo.synth.sensor import Sensor, expose, random_intrinsics, random_sensor
from dvo.synth.textures import texture_pool
from dvo.synth.walks import SplinePath, long_path


@dataclass
class SyntheticSequence:
    """A source of frames with ground truth: iterate it, as often as you like; every pass gives the same bytes.

    Attributes:
        name: says family, kind and seed.
        camera: of every frame.
        groundtruth: camera-to-world poses in metres, one a frame.
        scene, path: what is rendered.
        sensor: None for clean frames.
        warnings: always empty (kept because every source of frames has it).
    """

    name: str
    camera: Camera
    groundtruth: Trajectory
    scene: Scene
    path: SplinePath
    sensor: Sensor | None
    seed: int
    supersample: int = 1
    device: torch.device | str = "cpu"
    warnings: list[str] = field(default_factory=list)

    @property
    def frame_count(self) -> int | None:
        """Number of frames."""
        return len(self.groundtruth)

    def __len__(self) -> int:
        return len(self.groundtruth)

    def rendering(self, index: int) -> Rendering:
        """Clean picture, depth, surfaces and texture coordinates of one frame (batch of 1)."""
        pose, size = self.groundtruth.poses_wc[index : index + 1], (self.camera.height, self.camera.width)
        return render(self.scene, pose, self.camera.intrinsics, *size, supersample=self.supersample, device=self.device)

    def frame(self, index: int) -> Frame:
        """One frame as a camera would deliver it."""
        images = self.rendering(index).images
        if self.sensor is not None:
            images = expose(images, self.sensor, np.random.default_rng([self.seed, 7402, index]))
        image = (images[0] * 255).round_().to(torch.uint8).permute(1, 2, 0).contiguous().cpu().numpy()
        return Frame(index, float(self.groundtruth.timestamps[index]), image, self.camera)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in range(len(self)))


def make_sequence(
    seed: int,
    *,
    frames: int = 300,
    height: int = 240,
    width: int = 320,
    fps: float = 30.0,
    family: str | None = None,
    kind: str | None = None,
    speed: float = 1.0,
    sensor: bool = True,
    supersample: int = 1,
    device: torch.device | str = "cpu",
    textures: str | None = None,
) -> SyntheticSequence:
    """A smooth, realistic sequence through one scene.

    Args:
        seed: same seed and arguments, same bytes (on one machine).
        frames, height, width, fps: length and format.
        family: scene family, drawn if None.
        kind: kind of path (``dvo.synth.KINDS``); if None a drive in streets and corridors, else a hand-held walk.
        speed: 1 is a relaxed pace.
        sensor: False for clean frames.
        supersample: rays per pixel edge.
        device: where to render.
        textures: folder of photographs to paint with; None: those that scikit-image ships.

    Raises:
        DvoError: no such family or kind, or sizes out of order.
    """
    if frames < 1 or height < 16 or width < 16 or fps <= 0:
        raise DvoError("a sequence needs a frame or more of 16x16 pixels or more and fps > 0", field="frames, fps")
    rng = np.random.default_rng([seed, 7401])
    scene = random_scene(int(rng.integers(2**31)), family, pool=texture_pool(seed, folder=textures))
    name = kind or ("forward" if scene.hints.get("heading") is not None else "handheld")
    times = np.arange(frames) / fps
    path = long_path(scene, int(rng.integers(2**31)), name, frames / fps, speed=speed)
    fx, fy, cx, cy = random_intrinsics(rng, height, width).tolist()
    camera = Camera(fx, fy, cx, cy, width, height)
    drawn = random_sensor(rng)
    # One exposure for all frames: measured on a few, fixed as a gain.
    chosen = fixed_exposure(drawn, scene, path.poses_wc(times[:: max(1, frames // 6)]), camera) if sensor else None
    truth = Trajectory(times, path.poses_wc(times))
    return SyntheticSequence(
        f"{scene.family}-{name}-{seed}", camera, truth, scene, path, chosen, seed, supersample, device
    )


def fixed_exposure(sensor: Sensor, scene: Scene, poses_wc: np.ndarray, camera: Camera) -> Sensor:
    """The sensor with its automatic exposure frozen at the mean brightness of some views."""
    small = camera.resized(40, 30)
    bright = float(render(scene, poses_wc, small.intrinsics, 30, 40).images.mean())
    gain = (sensor.exposure / max(bright, 0.02)) ** 0.8 if sensor.exposure is not None else 1.0
    red, green, blue = sensor.balance
    return replace(sensor, exposure=None, flicker=0.0, balance=(red * gain, green * gain, blue * gain))
