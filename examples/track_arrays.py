"""Track images that are arrays in memory: python examples/track_arrays.py [--frames 60]

Any source will do: a camera, a simulator, a message queue. A frame is an array with its time and its camera.
"""

import argparse

import numpy as np

import dvo


def images(count: int):
    """Stand-in for your own images: a rendered walk. Yields seconds, ``(H, W, 3)`` uint8 RGB, and the camera."""
    from dvo.synth import make_sequence

    for frame in make_sequence(0, frames=count, family="room", kind="handheld", fps=30.0):
        yield frame.timestamp, np.asarray(frame.image), frame.camera


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=60)
    count = parser.parse_args().frames
    odometry = dvo.load("small", device="cpu", seed=0)
    for index, (time, image, camera) in enumerate(images(count)):
        # Your own camera: dvo.Camera(fx, fy, cx, cy, width, height), pixels, pixel centres at integers.
        estimate = odometry.track(dvo.Frame(index, time, image, camera))
        if estimate.status == "tracking" and index % 10 == 0:
            print(f"{time:.2f} s: camera at {np.round(estimate.pose_wc[:3], 3)}, confidence {estimate.confidence:.2f}")
    result = odometry.finish()
    print(f"{len(result.trajectory)} of {result.frames_read} frames, {len(result.map.points)} map points")


if __name__ == "__main__":
    main()
