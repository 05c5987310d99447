"""Videos without ground truth: figures of a trajectory, what is right, and the table."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory
from eval.benchmarks.wild.__main__ import judge, main, tasks_of
from eval.benchmarks.wild.measures import Expected, Measures, backward, difference, measure, read_expected
from eval.benchmarks.wild.runs import Run, Task, Video, carry_out


def path(positions, angles=0.0):
    count = len(positions)
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, angles, count), [0, 1, 0]), degrees=True).as_quat()
    return Trajectory(np.arange(count) / 10, np.column_stack([positions, turns]))


def straight(count=51, speed=1.0):
    return np.outer(np.arange(count) * speed, [0.6, 0, 0.8])


def test_a_straight_line_at_constant_speed():
    found = measure(path(straight(), angles=30))
    assert found.rows == 51 and found.straightness == pytest.approx(1) and found.turn == pytest.approx(30)
    assert found.even == pytest.approx((1, 1))


def test_a_way_there_and_back_that_speeds_up():
    there = np.concatenate([straight(26), straight(26)[-2::-1]])
    assert measure(path(there)).straightness == pytest.approx(0, abs=1e-9)
    faster = np.outer(np.arange(51) ** 2, [1, 0, 0])
    low, high = measure(path(faster)).even
    assert low == pytest.approx(0.2) and high == pytest.approx(1.8)


def test_a_camera_that_stands_still_has_no_direction():
    found = measure(path(np.zeros((20, 3))))
    assert found.straightness == 0 and math.isnan(found.even[0]) and measure(path(np.zeros((3, 3)))).rows == 3


def test_differences_do_not_depend_on_world_scale_and_direction_of_time():
    wave = straight() + np.outer(np.sin(np.arange(51) / 5), [0, 2, 0])
    one = path(wave)
    other = Trajectory(one.timestamps, np.column_stack([3 * wave[:, [1, 2, 0]] + 5, one.poses_wc[:, 3:]]))
    assert difference(other, one) == pytest.approx(0, abs=1e-6)
    played = Trajectory(7 - one.timestamps[::-1], one.poses_wc[::-1])
    assert np.allclose(backward(played, 7.0).timestamps, one.timestamps)
    assert difference(backward(played, 7.0), one) == pytest.approx(0, abs=1e-6)
    assert difference(path(straight()), one) > 0.5 and math.isnan(difference(path(straight()[:1]), one))


def test_faults_name_what_is_not_as_expected():
    right = Expected("a.mp4", straightness=(0.9, 1), turn=(0, 5), even=(0.9, 1.1), first_pose=15)
    assert right.faults(Measures(50, 0.95, 2.0, (0.95, 1.05)), 10) == []
    assert len(right.faults(Measures(50, 0.8, 7.0, (0.5, 1.05)), 20)) == 4
    assert len(right.faults(Measures(), None)) == 5 and Expected("a.mp4").faults(Measures(), None) == ["no poses"]


def runs_of(tasks, *positions):
    def run(task, rows):
        found = path(rows)
        poses = np.column_stack([found.timestamps, found.poses_wc])
        return Run(task.key, str(task.video), 51, 3, 1, {"tracking": 1.0}, "-" if len(rows) else "failed", poses=poses)

    return {task.key: run(task, rows) for task, rows in zip(tasks, positions, strict=True)}


@pytest.mark.parametrize(
    ("must", "rows", "outcome"),
    [
        ("good", straight(), "right"),
        ("good", np.concatenate([straight(26), straight(25)[::-1]]), "silent"),
        ("told", np.zeros((0, 3)), "told"),
        ("still", np.zeros((0, 3)), "right"),
        ("still", straight(), "silent"),
    ],
)
def test_runs_are_right_told_or_silent(tmp_path, must, rows, outcome):
    video = Video("clip", tmp_path / "clip.mp4")
    tasks = tasks_of(video, ["dvo-small", "null"], 2)
    assert [(task.system, task.seed, task.backward) for task in tasks] == [
        ("dvo-small", 0, False), ("dvo-small", 1, False), ("dvo-small", 0, True), ("null", 0, False)
    ]  # fmt: skip
    found = judge(video, tasks, runs_of(tasks, rows, rows, rows, straight()), Expected("clip.mp4", must, turn=(0, 1),
                  straightness=(0.9, 1)))  # fmt: skip
    assert found.outcome == (outcome,) * 2 and bool(found.faults) == (outcome != "right")
    assert judge(video, tasks, runs_of(tasks, rows, rows, rows, straight()), None).outcome == ()


def test_verdicts_count(tmp_path):
    """A wrong run that is doubtful is told; one that is right and has to be good is doubted."""
    video = Video("clip", tmp_path / "clip.mp4")
    tasks = tasks_of(video, ["dvo-small"], 1)
    back = np.concatenate([straight(26), straight(25)[::-1]])
    for rows, must, outcome in (
        (straight(), "good", "doubted"), (straight(), "told", "right"), (back, "good", "told"), (back, "told", "told"),
    ):  # fmt: skip
        runs = runs_of(tasks, rows, rows)
        runs = {key: replace(run, verdict="doubtful", reason="waves") for key, run in runs.items()}
        found = judge(video, tasks, runs, Expected("clip.mp4", must, straightness=(0.9, 1)))
        assert found.outcome == (outcome,) and ("waves" in str(found.faults)) == (outcome == "doubted")


def test_a_run_with_an_error_or_few_poses_is_not_right(tmp_path):
    video = Video("clip", tmp_path / "clip.mp4")
    tasks = tasks_of(video, ["dvo-small"], 1)
    for must in ("good", "told", "still"):
        failed = {task.key: Run(task.key, verdict="failed", error="no such file") for task in tasks}
        assert judge(video, tasks, failed, Expected("clip.mp4", must)).outcome == ("error",)
    few = judge(video, tasks, runs_of(tasks, straight(20), straight(20)), Expected("clip.mp4", straightness=(0.9, 1)))
    assert few.outcome == ("silent",) and few.faults == ("poses of 20 of 51 frames",)


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("a: {frames: 3}", "a"),
        ("a: {video: b.mp4, speed: 1}", "speed"),
        ("a: {video: b.mp4, must: fine}", "must"),
        ("a: {video: b.mp4, turn: 3}", "turn"),
        ("a: {video: b.mp4, seeds: x}", "seeds"),
        ("[1, 2]", "no list of videos"),
    ],
)
def test_lists_that_are_not_understood_are_refused(tmp_path, text, field):
    file = tmp_path / "expected.yaml"
    file.write_text(text)
    with pytest.raises(DvoError, match=field):
        read_expected(file)


def noise_video(folder):
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(folder / "clip.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for _ in range(12):
        writer.write(rng.integers(0, 255, (48, 64, 3), np.uint8))
    writer.release()
    (folder / "clip.calib.txt").write_text("50 50 31.5 23.5\n")


UNSURE = """
import numpy as np
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status
from dvo.odometry.quality import Quality

class Unsure:
    name = "unsure"
    def __init__(self, seed, device):
        self.seed, self.times, self.numbers = seed, [], []
    def track(self, frame):
        self.times.append(frame.timestamp)
        self.numbers.append(frame.index)
        return Estimate(frame.timestamp, None, Status.TRACKING)
    def finish(self):
        t = np.array(self.numbers, float)
        poses = np.column_stack([t, (self.seed - 3) * t**2, 0 * t, np.tile([0.0, 0, 0, 1], (len(t), 1))])
        quality = Quality("good", tracked=1.0, agreement=1.0, deviation=0.05, check=1.0, checks=9)
        return Result(Trajectory(np.array(self.times), poses), SparseMap(), len(t), 0, quality=quality)
"""


def test_a_run_that_leaves_doubt_is_compared_with_one_of_the_next_seed(tmp_path):
    noise_video(tmp_path)
    (tmp_path / "unsure.py").write_text(UNSURE)
    video = Video("clip", tmp_path / "clip.avi", tmp_path / "clip.calib.txt")
    run = carry_out(Task(video, f"{tmp_path / 'unsure.py'}:Unsure", seed=3))
    assert (run.error, run.verdict) == ("", "doubtful"), "the second run, of seed 4, is bent"


@pytest.mark.slow
def test_the_command_writes_table_and_page_and_goes_on(tmp_path, capsys):
    out = tmp_path / "out"
    noise_video(tmp_path)
    (tmp_path / "right.yaml").write_text("clip: {video: clip.avi, must: good, straightness: [0.9, 1], seeds: 1}\n")
    command = [str(tmp_path), "--systems", "null", "--seeds", "2", "--out", str(out)]
    main([*command, "--expected", str(tmp_path / "right.yaml")])
    told = capsys.readouterr().out
    assert (
        "clip-null-0-backward: -, 12 of 12 frames" in told
        and "Of 2 runs: right 2, told 0, silent 0, doubted 0, error 0." in told
    )
    assert (out / "clip.png").stat().st_size > 1000 and "clip.png" in (out / "page.html").read_text()
    main(command)
    again = capsys.readouterr().out
    assert "frames" not in again.split("|")[0] and "| clip |" in again, "nothing is run again"
    with pytest.raises(SystemExit, match="no videos"):
        main([str(out)])
    with pytest.raises(SystemExit, match="no video 'b'.*choose from clip|no video 'b'. Choose from clip"):
        main([*command, "--videos", "clip,b"])
    with pytest.raises(SystemExit, match="--seeds"):
        main([*command, "--seeds", "0"])
    with pytest.raises(SystemExit, match="no folder"):
        main([str(tmp_path / "none")])
    (tmp_path / "clip.calib.txt").unlink()
    (tmp_path / "right.yaml").write_text("clip: {video: clip.avi, frames: 6, calib: [50, 50, 31.5, 23.5]}\n")
    main([*command, "--expected", str(tmp_path / "right.yaml")])
    assert "6 of 6 frames" in capsys.readouterr().out, "runs of another number of frames are not taken for these"
    (out / "runs.jsonl").write_text("{")
    with pytest.raises(SystemExit, match="runs.jsonl.*not a run"):
        main(command)
