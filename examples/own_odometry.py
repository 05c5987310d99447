"""An odometry of your own beside the others in the evaluation (from a checkout, with `.[eval]`):

    python -m eval run --suite validation --systems examples/own_odometry.py:PhaseOdometry,null --seeds 1

An odometry is any class with `name`, `track(frame)` and `finish()`. This one turns the camera by the shift between two
images (phase correlation) and moves it ahead at constant speed.

It never loses track. One that does returns `Estimate(time, None, Status.LOST, reason=...)` for such a frame, and gives
`Result` the parts with a world of their own as `segments`; the evaluation aligns each on its own.
"""

import cv2
import numpy as np
import torch

import dvo


class PhaseOdometry:
    """Rotation from the shift of the whole image, straight ahead at constant speed.

    Args:
        speed: length of a step; settings come from the name, `...:PhaseOdometry+speed=2`.
    """

    name = "phase-odometry"

    def __init__(self, speed: float = 1.0) -> None:
        self.step = torch.tensor([0.0, 0.0, -speed])  # the world moves towards the camera
        self.before: np.ndarray | None = None
        self.pose_cw = dvo.se3.identity(dtype=torch.float64)
        self.rows: list[tuple[float, np.ndarray]] = []

    def track(self, frame: dvo.Frame) -> dvo.Estimate:
        """Add the motion since the last frame."""
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        if self.before is not None:
            (dx, dy), _ = cv2.phaseCorrelate(self.before, grey)
            turn = torch.tensor([-dy / frame.camera.fy, dx / frame.camera.fx, 0.0])
            motion = dvo.se3.exp(torch.cat([self.step, turn]).double())
            self.pose_cw = dvo.se3.compose(motion, self.pose_cw)
        self.before = grey
        pose_wc = dvo.se3.inverse(self.pose_cw).numpy()
        self.rows.append((frame.timestamp, pose_wc))
        return dvo.Estimate(frame.timestamp, pose_wc, dvo.Status.TRACKING, 1.0)

    def finish(self) -> dvo.Result:
        """Everything tracked."""
        times = np.array([time for time, _ in self.rows])
        trajectory = dvo.Trajectory(times, np.array([pose for _, pose in self.rows]).reshape(-1, 7))
        return dvo.Result(trajectory, dvo.SparseMap(), frames_read=len(times), frames_lost=0)


def main() -> None:
    """Track a rendered clip with it, without the evaluation."""
    from dvo.synth import make_sequence

    clip = make_sequence(3, frames=30, family="corridor", fps=15.0, height=120, width=160)
    run = dvo.run(PhaseOdometry(), clip)
    metrics = dvo.evaluate(run.result.trajectory, clip.groundtruth)
    print(f"ATE {metrics.ate_percent:.1f} %, rotation error over rotation {metrics.rotation_error_ratio:.2f}")


if __name__ == "__main__":
    main()
