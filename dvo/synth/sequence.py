"""Films: long sequences, rendered frame by frame, with their ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.errors import DvoError
from dvo.geometry.camera import Camera, DistortionModel
from dvo.synth.motion.walks import long_path
from dvo.synth.render.lens import random_lens
from dvo.synth.render.renderer import Rendering, render
from dvo.synth.render.shot import Shot
from dvo.synth.scenes.bodies import Motion, Stage
from dvo.synth.scenes.families import random_scene
from dvo.synth.scenes.movers import random_bodies
from dvo.synth.scenes.scene import Scene
from dvo.synth.sensors.imu import Imu, ImuNoise, measure_imu
from dvo.synth.sensors.sensor import (
    Sensor,
    expose,
    exposure_changes,
    in_the_dark,
    random_intrinsics,
    random_sensor,
)
from dvo.synth.textures.pool import texture_pool
from dvo.synth.textures.repaint import plainer
from dvo.synth.truth import Flow, Tracks, dynamic_mask, optical_flow, tracks

APART = 2**31  # seeds of scenes from here on are never drawn by training clips


@dataclass
class SyntheticSequence:
    """A source of frames with ground truth: iterate it, as often as you like; every pass gives the same bytes.

    Timestamps and poses are those of the middle of the exposure, with a rolling shutter of the middle row; what that
    means for depth and flow stands in :mod:`dvo.synth.render.shot`.

    Attributes:
        name: says family, kind and seed.
        camera: of every frame.
        groundtruth: camera-to-world poses in metres, one a frame.
        scene, path: what is rendered.
        sensor: None for clean frames; its exposure is fixed, its shutter and readout are shares of ``interval``.
        seed: of noise.
        interval: seconds between frames (where none was lost).
        warnings: always empty (kept because every source of frames has it).
    """

    name: str
    camera: Camera
    groundtruth: Trajectory
    scene: Scene | Stage
    path: Motion
    sensor: Sensor | None
    seed: int
    supersample: int = 1
    device: torch.device | str = "cpu"
    warnings: list[str] = field(default_factory=list)
    interval: float = 1 / 30

    @property
    def frame_count(self) -> int | None:
        """Number of frames."""
        return len(self.groundtruth)

    def __len__(self) -> int:
        return len(self.groundtruth)

    @property
    def shot(self) -> Shot:
        """Scene, path and shutter, for ground truth at any time."""
        sensor = self.sensor or Sensor()
        return Shot(
            self.scene, self.path, self.camera, sensor.shutter * self.interval, sensor.readout * self.interval,
            self.supersample, self.device,
        )  # fmt: skip

    def time(self, index: int) -> float:
        """Timestamp of a frame, seconds."""
        return float(self.groundtruth.timestamps[index])

    def rendering(self, index: int) -> Rendering:
        """Clean picture, depth, surfaces and texture coordinates of one frame (batch of 1)."""
        return self.shot.rendering(self.time(index), self.groundtruth.poses_wc[index : index + 1])

    def frame(self, index: int) -> Frame:
        """One frame as a camera would deliver it."""
        images = self.rendering(index).images
        if self.sensor is not None:
            rng = np.random.default_rng([self.seed, 7402, index])
            images = expose(images, self.sensor, rng, times=self.groundtruth.timestamps[index : index + 1])
        image = (images[0] * 255).round_().to(torch.uint8).permute(1, 2, 0).contiguous().cpu().numpy()
        return Frame(index, self.time(index), image, self.camera)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in range(len(self)))

    def flow(self, start: int, end: int) -> Flow:
        """Optical flow and visibility from one frame to another, see :func:`dvo.synth.truth.optical_flow`."""
        return optical_flow(self.shot, self.time(start), self.time(end))

    def dynamic_mask(self, index: int) -> np.ndarray:
        """``(H, W)`` bool: pixels that show a moving body."""
        return dynamic_mask(self.shot, self.time(index))

    def tracks(self, count: int = 200, *, seed: int = 0) -> Tracks:
        """Surface points followed through all frames, see :func:`dvo.synth.truth.tracks`."""
        return tracks(self.shot, self.groundtruth.timestamps, count, seed=seed)

    def imu(self, rate: float = 200.0, *, noise: ImuNoise | None = None, seed: int | None = None) -> Imu:
        """Inertial measurements from the first frame to the last; ``noise=None`` for exact ones."""
        first, last = self.time(0), self.time(-1)
        times = first + np.arange(int(np.floor((last - first) * rate + 1e-9)) + 1) / rate
        return measure_imu(self.path, times, noise=noise, seed=self.seed if seed is None else seed)

    def stereo(self, baseline: float) -> SyntheticSequence:
        """The second camera of a rectified pair, ``baseline`` metres to the right, with noise of its own."""
        second = self.shot.beside(baseline).path
        truth = Trajectory(self.groundtruth.timestamps, second.poses_wc(self.groundtruth.timestamps))
        return replace(
            self, name=f"{self.name}-right", path=second, groundtruth=truth, seed=self.seed + 2**32, warnings=[]
        )


def film(
    scene: Scene | Stage, path: Motion, camera: Camera, sensor: Sensor | None = None, seed: int = 0,
    device: torch.device | str = "cpu", *, times: np.ndarray, supersample: int = 1, name: str = "film",
) -> SyntheticSequence:  # fmt: skip
    """Film a scene: frames and ground truth of a camera that moves along a path.

    Args:
        scene: what to film; a :class:`Stage` has bodies that move.
        path: anything with ``poses_wc(times)``, camera to world: :class:`Path`, :class:`SplinePath`, your own.
        camera: pinhole intrinsics and size.
        sensor: None for clean frames. An automatic exposure is measured on a few frames and then fixed.
        seed: of noise and lost frames: same arguments, same bytes (on one machine).
        device: where to render.
        times: ``(N,)`` seconds at which frames are taken, increasing.
        supersample: rays per pixel edge.

    Raises:
        DvoError: times that do not increase.
    """
    times = np.asarray(times, float)
    if times.ndim != 1 or len(times) == 0 or not (np.diff(times) > 0).all():
        raise DvoError("times of frames must increase", field="times", remedy="give np.arange(N) / fps")
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 1 / 30
    if sensor is not None:
        bare = scene.scene if isinstance(scene, Stage) else scene
        sensor = fixed_exposure(sensor, bare, path.poses_wc(times[:: max(1, len(times) // 6)]), camera)
        if sensor.drop > 0:
            kept = np.random.default_rng([seed, 7403]).random(len(times)) >= sensor.drop
            kept[0] = True
            times = times[kept]
    truth = Trajectory(times, path.poses_wc(times))
    return SyntheticSequence(name, camera, truth, scene, path, sensor, seed, supersample, device, interval=interval)


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
    shake: float = 1.0,
    shutter: float = 0.0,
    rolling_shutter: float = 0.0,
    movers: int = 0,
    texture: float = 1.0,
    lighting: float = 0.0,
    light: float = 1.0,
    blackout: float = 0.0,
    drop: float = 0.0,
    jpeg: int = 0,
    apart: bool = False,
    textures: str | None = None,
    lens: DistortionModel = "none",
) -> SyntheticSequence:
    """A smooth, realistic sequence through one scene.

    Args:
        seed: same seed and arguments, same bytes (on one machine).
        frames, height, width, fps: length and format.
        family: scene family, drawn if None.
        kind: kind of path (``dvo.synth.LONG_KINDS``); if None a drive in streets and corridors, else a hand-held walk.
        speed: 1 is a relaxed pace.
        sensor: False for clean frames.
        supersample: rays per pixel edge.
        device: where to render.
        shake: multiplies the shake of the hand.
        shutter: share of the frame interval that is exposed: motion blur along the path.
        rolling_shutter: share of the frame interval that reading the rows takes.
        movers: number of bodies that move through the view.
        texture: share of the textures' contrast that is left; small values make walls bare.
        lighting: strength of exposure changes in stops: drifts and sudden jumps.
        light: share of the usual light that arrives; the camera amplifies it, and the noise.
        blackout: seconds in the middle during which nothing is seen.
        drop: chance that a frame is lost.
        jpeg: quality of compression, 0 for none.
        apart: take a scene that no training clip can show (a seed of ``APART`` or above).
        textures: folder of photographs to paint with; None: those that scikit-image ships.
        lens: ``radtan`` or ``fisheye`` draws a lens with distortion; frames come as it bends them, with its camera.

    ``shutter`` to ``jpeg`` are effects and need the sensor, except ``movers`` and ``texture``.

    Raises:
        DvoError: no such family or kind, or numbers out of order.
    """
    if frames < 1 or height < 16 or width < 16 or fps <= 0:
        raise DvoError("a sequence needs a frame or more of 16x16 pixels or more and fps > 0", field="frames, fps")
    shares = {"shutter": shutter, "rolling_shutter": rolling_shutter, "texture": texture, "drop": drop}
    for field_name, share in (*shares.items(), ("light", light)):
        if not 0 <= share <= 1 or (field_name == "light" and share == 0):
            raise DvoError(f"not a share: {share}", field=field_name, remedy="give a number from 0 to 1")
    if not 0 <= jpeg <= 100 or movers < 0 or lighting < 0 or not 0 <= blackout < frames / fps:
        raise DvoError("out of range", field="jpeg, movers, lighting, blackout", remedy="see make_sequence")
    rng = np.random.default_rng([seed, 7401])
    pool = texture_pool(seed, folder=textures)
    scene = random_scene(int(rng.integers(2**31)) + (APART if apart else 0), family, pool=pool)
    name = kind or ("forward" if scene.hints.get("heading") is not None else "handheld")
    duration, path_seed = frames / fps, int(rng.integers(2**31))
    path = long_path(scene, path_seed, name, duration, speed=speed, shake=shake)
    fx, fy, cx, cy = random_intrinsics(rng, height, width).tolist()
    camera = random_lens(np.random.default_rng([seed, 7405]), Camera(fx, fy, cx, cy, width, height), lens)
    drawn = replace(random_sensor(rng), shutter=shutter, readout=rolling_shutter, drop=drop, jpeg=jpeg)
    if lighting > 0:
        drawn = replace(drawn, stops=exposure_changes(np.random.default_rng([seed, 7404]), duration, lighting))
    if light < 1:
        drawn = in_the_dark(drawn, light)
    if blackout > 0:
        drawn = replace(drawn, blackout=(((duration - blackout) / 2, (duration + blackout) / 2),))
    if texture < 1:
        scene = plainer(scene, texture, seed)
    stage = Stage(scene, random_bodies(scene, path, duration, seed, movers)) if movers else scene
    return film(
        stage, path, camera, drawn if sensor else None, seed, device,
        times=np.arange(frames) / fps, supersample=supersample, name=f"{scene.family}-{name}-{seed}",
    )  # fmt: skip


def fixed_exposure(sensor: Sensor, scene: Scene, poses_wc: np.ndarray, camera: Camera) -> Sensor:
    """The sensor with its automatic exposure frozen at the mean brightness of some views."""
    small = camera.resized(40, 30)
    bright = float(render(scene, poses_wc, small.intrinsics, 30, 40).images.mean())
    gain = (sensor.exposure / max(bright, 0.02)) ** 0.8 if sensor.exposure is not None else 1.0
    red, green, blue = sensor.balance
    return replace(sensor, exposure=None, flicker=0.0, balance=(red * gain, green * gain, blue * gain))
