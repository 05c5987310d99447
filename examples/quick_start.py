"""Render a clip, track it, plot the trajectory: python examples/quick_start.py [--frames 60] [--out plot.png]."""

import argparse

import dvo
from dvo.metrics import align_trajectory
from dvo.synth import make_sequence
from dvo.viz.plot import plot_trajectory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--out", default="plot.png")
    arguments = parser.parse_args()

    # A walk through a furnished room, 320x240, with its true poses. Your own video: dvo.open("video.mp4").
    clip = make_sequence(0, frames=arguments.frames, family="room", kind="handheld", fps=30.0)
    odometry = dvo.load("small", device="cpu", seed=0)
    for frame in clip:
        estimate = odometry.track(frame)
        if frame.index % 10 == 0:
            print(f"{frame.timestamp:.2f} s: {estimate.status.value}, confidence {estimate.confidence:.2f}")
    result = odometry.finish()
    print(f"{len(result.trajectory)} of {result.frames_read} frames, {len(result.map.points)} map points")

    # Lengths are known up to one factor: the trajectory is aligned with the true one by a similarity.
    errors = dvo.evaluate(result.trajectory, clip.groundtruth)
    print(f"ATE {errors.ate_percent:.2f} % of the path, rotation {errors.rpe_rot_deg:.3f} degrees a frame")
    aligned = align_trajectory(result.trajectory, clip.groundtruth)
    plot_trajectory(arguments.out, aligned, reference=clip.groundtruth, title="Quick start", subtitle="rendered clip")
    print(f"plot: {arguments.out}")


if __name__ == "__main__":
    main()
