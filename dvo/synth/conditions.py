"""Hard conditions of training clips: moving bodies, low light and surroundings, drawn from streams of their own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dvo.synth import salts
from dvo.synth.motion.movers import random_bodies
from dvo.synth.protocols import Motion
from dvo.synth.scenes.bodies import Stage
from dvo.synth.scenes.scene import Scene
from dvo.synth.surroundings import SURROUNDINGS

Array = np.ndarray
MOST_BODIES = 8
LIGHT = (0.03, 0.3)  # share of the usual light that arrives in a clip with little of it
PACE = (0.4, 2.0)  # motion of bodies against that of the camera, in pixels a frame
CONTRAST = (0.05, 0.5)  # share of the textures' contrast that is kept in a clip with bare surfaces
SHUTTER = (0.3, 0.8)  # share of the frame interval that a long exposure takes
BODY_SPEED = 0.4  # of a body of random_bodies: share of its distance to the camera that it moves in a second, about
SURROUNDINGS_STEP = (0.015, 0.15)  # seconds between frames under the clock of the surroundings
CODED, CRF = 0.3, (22, 38)  # share of the clips with surroundings that are H.264 video, and its rate factors
FLOATING, OFFSET = 0.15, (0.002, 0.02)  # share of them that are stabilised, and the offset in shares of the width
LONGEST_STEP = 0.6  # seconds of the bodies' clock; a quarter of the shortest period of their sway


@dataclass(frozen=True)
class Conditions:
    """Conditions of one clip.

    Attributes:
        bodies: number of moving bodies, 0 for none.
        seed: of their shapes and motions, and of the surroundings.
        pace: their motion against that of the camera, in pixels a frame.
        light: share of the usual light that arrives, in (0, 1].
        surroundings: names of what is drawn over the scene, joined by ``+``.
        step: seconds between frames, in mean, under the clock of the surroundings.
        h264: constant rate factor of the video; 0 for images.
        stabilised: offset of the crop of a stabilised video, share of the width.
        texture: share of the textures' contrast that is kept, in (0, 1].
        shutter: share of the frame interval of a long exposure; 0 for that of the sensor.
    """

    bodies: int = 0
    seed: int = 0
    pace: float = 1.0
    light: float = 1.0
    surroundings: str = ""
    step: float = 0.05
    h264: int = 0
    stabilised: float = 0.0
    texture: float = 1.0
    shutter: float = 0.0


@dataclass(frozen=True)
class Clocked:
    """Motion under a clock that runs at another rate.

    Attributes:
        motion: under its own clock.
        start: time of that clock at second 0, seconds.
        rate: seconds of that clock in a second.
    """

    motion: Motion
    start: float
    rate: float

    def poses_wc(self, times: Array) -> Array:
        """Poses ``(T, 7)`` at ``times (T,)`` seconds.

        Args:
            times: ``(T,)`` seconds.

        Returns:
            ``(T, 7)``.
        """
        return self.motion.poses_wc(self.start + self.rate * np.asarray(times, float))


def draw_conditions(
    seed: int, index: int, movers: float, low_light: float, surroundings: float = 0.0, bare: float = 0.0,
    blurred: float = 0.0,
) -> Conditions:  # fmt: skip
    """Draw the conditions of a clip.

    Args:
        seed: of the stream of clips.
        index: of the clip.
        movers: probability of moving bodies.
        low_light: probability of little light.
        surroundings: probability of one or two kinds of them, and of a video that is coded or stabilised.
        bare: probability of bare surfaces.
        blurred: probability of a long exposure.

    Returns:
        The conditions; a clip that is chosen at some probability is chosen, with the same bodies and the same light,
        at every greater one.
    """
    rng = np.random.default_rng([seed, salts.CLIP_CONDITIONS, index])
    # All numbers are drawn in any case, so that neither option changes the draws of the other.
    with_bodies, dark = rng.random(2)
    bodies = int(rng.integers(1, MOST_BODIES + 1))
    body_seed = int(rng.integers(2**31))
    pace = float(np.exp(rng.uniform(*np.log(PACE))))
    light = float(np.exp(rng.uniform(*np.log(LIGHT))))
    conditions = Conditions(bodies if with_bodies < movers else 0, body_seed, pace, light if dark < low_light else 1.0)
    rng = np.random.default_rng([seed, salts.CLIP_BARE, index])
    with_bare, with_blur = rng.random(2)
    contrast, shutter = float(np.exp(rng.uniform(*np.log(CONTRAST)))), float(rng.uniform(*SHUTTER))
    conditions = replace(
        conditions, texture=contrast if with_bare < bare else 1.0, shutter=shutter if with_blur < blurred else 0.0
    )
    rng = np.random.default_rng([seed, salts.CLIP_SURROUNDINGS, index])
    if rng.random() >= surroundings:
        return conditions
    names = rng.choice(list(SURROUNDINGS), int(rng.integers(1, 3)), replace=False)
    step = float(np.exp(rng.uniform(*np.log(SURROUNDINGS_STEP))))
    coded, floating = rng.random(2)
    crf, offset = int(rng.integers(*CRF)), float(np.exp(rng.uniform(*np.log(OFFSET))))
    return replace(
        conditions, surroundings="+".join(sorted(names, key=list(SURROUNDINGS).index)), step=step,
        h264=crf if coded < CODED else 0, stabilised=offset if floating < FLOATING else 0.0,
    )  # fmt: skip


def stage_clip(
    scene: Scene, path: Motion, times: Array, conditions: Conditions, flow: float, focal: float
) -> tuple[Stage, Array]:
    """Put moving bodies into the view of a clip.

    The time of a clip's path is no measure of speed: a path may be slow and its frames far apart, or its motion scaled.
    So the bodies have a clock of their own, which runs as fast as makes their motion in the image ``pace`` times that
    of the camera, but not so fast that frames would miss their swings.

    Args:
        scene: static.
        path: camera to world.
        times: ``(N,)`` of the frames, in the time of the path, seconds.
        conditions: number, seed and pace of the bodies.
        flow: mean induced flow between neighbouring frames, pixels.
        focal: focal length, pixels.

    Returns:
        Scene with bodies, and the times ``(N,)`` of the frames under the bodies' clock, seconds.
    """
    step = min(conditions.pace * flow / (BODY_SPEED * focal), LONGEST_STEP)  # mean over the frames, seconds
    rate = (times[-1] - times[0]) / (step * (len(times) - 1))
    seconds = (times - times[0]) / rate
    view = Clocked(path, float(times[0]), rate)
    bodies = random_bodies(scene, view, float(seconds[-1]), conditions.seed, conditions.bodies)
    return Stage(scene, bodies), seconds
