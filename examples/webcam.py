"""Live poses of a webcam, a network camera, or anything else that `dvo run` takes.

    python examples/webcam.py webcam:0 --calib calib.txt
    python examples/webcam.py rtsp://192.168.1.20/stream --calib calib.txt

A thread receives the images; frames that arrive while one is tracked are dropped but for the newest. Ctrl-C ends.
"""

import argparse
import contextlib

import dvo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", nargs="?", default="webcam:0")
    parser.add_argument("--calib", help="without one, the usual angle of view is assumed")
    options = parser.parse_args()
    odometry = dvo.load("small", preset="fast")
    source = dvo.open(options.source, calib=options.calib, guess=True)
    print(*source.warnings, sep="\n")
    with contextlib.suppress(KeyboardInterrupt):
        for frame in source:
            estimate: dvo.Estimate = odometry.track(frame)
            if estimate.pose_wc is None:
                print(f"{frame.timestamp:10.3f} s  {estimate.status} {estimate.reason}")
            else:
                x, y, z = estimate.pose_wc[:3]
                print(f"{frame.timestamp:10.3f} s  {estimate.status}  x {x:7.3f}  y {y:7.3f}  z {z:7.3f}")
    result = odometry.finish()
    print(f"{result.frames_tracked} of {result.frames_read} frames tracked, {len(result.map.points)} map points")


if __name__ == "__main__":
    main()
