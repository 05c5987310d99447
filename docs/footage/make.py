"""Pictures of docs/footage.md, and what tracking makes of them: python docs/footage/make.py [--only NAME] [--pictures].

Each clip is rendered from one scene and differs from the first in one condition. A picture shows two frames of it; the
printed table has the frames with a pose, the segments and the errors against the exact ground truth.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2
import numpy as np

import dvo
from dvo.core.command_line import OneLineParser
from dvo.metrics import evaluate
from dvo.synth import make_sequence
from dvo.synth.sequence import SyntheticSequence

FOLDER = Path(__file__).resolve().parent
SEED, SIZE = 7, (320, 240)
COMMON = {"family": "room", "kind": "handheld", "frames": 45, "fps": 15.0, "width": SIZE[0], "height": SIZE[1]}
CLIPS: dict[str, dict[str, object]] = {
    "good": {},
    "bare": {"texture": 0.0},
    "dark": {"light": 0.01},
    "blur": {"kind": "fast", "shutter": 1.0, "speed": 5.0},
    "moving": {"movers": 80},
    "turning": {"kind": "rotation", "speed": 12.0},
    "still": {"speed": 0.01, "shake": 0.0},
    "exposure": {"lighting": 4.0},
    "shutter": {"rolling_shutter": 1.0, "shake": 4.0, "speed": 1.5},
    "blackout": {"blackout": 1.0},
    "water": {"family": "street", "kind": "forward", "surroundings": "sky+water"},
    "leaves": {"surroundings": "foliage"},
    "people": {"surroundings": "crowd"},
    "traffic": {"family": "street", "kind": "forward", "surroundings": "traffic"},
    "bonnet": {"family": "street", "kind": "forward", "speed": 2.0, "surroundings": "bonnet"},
    "rain": {"family": "street", "kind": "forward", "surroundings": "rain"},
    "snow": {"family": "street", "kind": "forward", "surroundings": "snow"},
    "border": {"surroundings": "border"},
    "glass": {"surroundings": "glass"},
    "screens": {"surroundings": "screen"},
    "night": {"family": "street", "kind": "forward", "surroundings": "night"},
    "coded": {"h264": 38},
    "floating": {"stabilised": 0.01},
}
"""Rendering options of each clip that differ from :data:`COMMON`; see :func:`dvo.synth.sequence_spec`."""
SHOWN = (20, 32)  # frames of a picture


def sequence(name: str) -> SyntheticSequence:
    """Make a clip.

    Args:
        name: in :data:`CLIPS`.

    Returns:
        The clip, with ground truth; its frames are rendered when they are read.
    """
    return make_sequence(SEED, **{**COMMON, **CLIPS[name]})


def write_picture(images: list[np.ndarray], path: Path) -> None:
    """Write two images side by side.

    Args:
        images: ``(H, W, 3)`` uint8 RGB.
        path: PNG file.
    """
    gap = np.full((images[0].shape[0], 6, 3), 255, np.uint8)
    picture = np.concatenate([images[0], gap, images[1]], axis=1)
    small = cv2.resize(picture, None, fx=0.65, fy=0.65, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])


def measure(name: str, frames: list[dvo.Frame], truth: dvo.Trajectory) -> str:
    """Track a clip with the shipped weights.

    Args:
        name: of the clip.
        frames: of the clip.
        truth: camera-to-world poses, metres.

    Returns:
        A line of the table.
    """
    odometry = dvo.load("small", device="cpu", seed=0)
    for frame in frames:
        odometry.track(frame)
    result = odometry.finish()
    posed = result.frames_read - result.frames_lost
    errors = evaluate(result.trajectory, truth) if len(result.trajectory) > 2 else None
    ate, turn = (errors.ate_percent, errors.rpe_rot_deg) if errors else (float("nan"), float("nan"))
    count = f"{posed} of {result.frames_read} | {len(result.segments)}"
    return f"| {name} | {count} | {ate:.2f} | {turn:.3f} | {result.quality} |"


def main() -> None:
    parser = OneLineParser(description=__doc__)
    parser.add_argument("--only", choices=list(CLIPS), help="one clip")
    parser.add_argument("--pictures", action="store_true", help="render the pictures alone, track nothing")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder of the pictures")
    arguments = parser.parse_args()
    print("| clip | frames with a pose | segments | ATE % | RPE ° | verdict |\n|---|--:|--:|--:|--:|---|")
    for name in [arguments.only] if arguments.only else CLIPS:
        clip = sequence(name)
        frames = list(islice(clip, SHOWN[-1] + 1 if arguments.pictures else None))
        write_picture([np.asarray(frames[index].image) for index in SHOWN], arguments.out / f"{name}.png")
        if not arguments.pictures:
            print(measure(name, frames, clip.groundtruth), flush=True)


if __name__ == "__main__":
    main()
