"""The command line, with an odometry that knows the answer in place of the learned one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import dvo
from dvo.cli import build_parser, main
from dvo.commands.run import load_odometry
from dvo.data.trajectory import read_tum
from dvo.odometry.quality import Quality
from dvo.synth.sequence import make_sequence

FILES = ["frames.csv", "map.ply", "run.json", "summary.html", "trajectory.png", "trajectory.txt"]


def arguments(images: Path, out: Path, *more: str) -> list[str]:
    beside = images.parent
    return ["run", str(images), "--calib", str(beside / "calib.txt"), "--times", str(beside / "times.txt"),
            "--out", str(out), "--device", "cpu", *more]  # fmt: skip


def summary(out: Path) -> dict:
    return json.loads((out / "run.json").read_text())


def test_settings_reach_the_odometry(given, image_folder, tmp_path, capsys):
    """``--config`` gives settings, ``--set`` wins over it; an unknown or wrong one is bad input."""
    odometry = given()
    file = tmp_path / "tracker.yaml"
    file.write_text("patches: 12\nupdates: 2\n")
    line = arguments(image_folder, tmp_path / "out", "--config", str(file), "--set", "patches=48")
    assert main(line) == 0
    assert odometry.asked["patches"] == 48 and odometry.asked["updates"] == 2
    assert main(arguments(image_folder, tmp_path / "other", "--set", "seed=3")) == 2
    assert "use the option of that name" in capsys.readouterr().err.lower()


@pytest.mark.parametrize("setting", ["patches=-3", "colour=1", "patches=many", "patches"])
def test_a_wrong_setting_is_bad_input(setting, image_folder, tmp_path, capsys):
    assert main(arguments(image_folder, tmp_path / "out", "--set", setting)) == 2
    assert "patches" in capsys.readouterr().err


@pytest.mark.long
def test_an_odometry_without_weights(tmp_path, capsys):
    """``--system`` in place of ``--weights``, with settings of its own."""
    sequence = make_sequence(4, frames=12, family="room", kind="sideways", height=120, width=160, fps=15.0)
    images, camera = tmp_path / "images", sequence.camera
    images.mkdir()
    for frame in sequence:
        cv2.imwrite(str(images / f"{frame.index:03d}.png"), frame.image[..., ::-1])
    (tmp_path / "calib.txt").write_text(f"{camera.fx} {camera.fy} {camera.cx} {camera.cy}")
    line = ["run", str(images), "--calib", str(tmp_path / "calib.txt"), "--fps", "15", "--no-loops"]
    assert main([*line, "--out", str(tmp_path / "out"), "--system", "klt-pnp", "--set", "corners=300"]) == 0
    assert summary(tmp_path / "out")["odometry"] == "klt-pnp" and summary(tmp_path / "out")["weights"] is None
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 12
    assert main([*line, "--out", str(tmp_path / "other"), "--system", "klt"]) == 2
    assert "Use one of klt-pnp, keyframe" in capsys.readouterr().err
    assert main([*line, "--out", str(tmp_path / "other"), "--system", "klt-pnp", "--map", "room.dvo"]) == 2
    assert main([*line, "--system", "klt-pnp", "--weights", "tiny"]) == 2
    assert "not allowed with" in capsys.readouterr().err
    assert main([*line, "--system", "klt-pnp", "--device", "meta"]) == 2
    assert "--device: an odometry without weights computes on the CPU" in capsys.readouterr().err


@pytest.mark.parametrize(("given", "loops"), [([], True), (["--no-loops"], False)])
def test_no_loops_wins_without_weights_too(given, loops):
    arguments = build_parser().parse_args(["run", "clip", "--system", "keyframe", "--set", "loops=true", *given])
    assert load_odometry(arguments, torch.device("cpu")).config.loops is loops


def test_run_writes_the_results_folder(given, image_folder, tmp_path, capsys):
    odometry = given(plots=True)
    out = tmp_path / "out"
    assert main(arguments(image_folder, out, "--seed", "5", "--weights", "tiny")) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES
    assert odometry.asked == {"weights": "tiny", "device": torch.device("cpu"), "seed": 5}
    trajectory = read_tum(out / "trajectory.txt")
    np.testing.assert_allclose(trajectory.timestamps, 10 + 0.1 * np.arange(20), atol=1e-9)
    np.testing.assert_allclose(trajectory.poses_wc, [odometry.motion(t) for t in trajectory.timestamps], atol=1e-8)
    written = summary(out)
    assert written["frames"] == {"read": 20, "fed": 20, "tracked": 20, "lost": 0}
    assert (written["seed"], written["stride"], written["device"], written["odometry"]) == (5, 1, "cpu", "fake")
    assert written["metrics"] is None and written["config"] == {"patches": 3} and written["readout"] == 0
    printed = capsys.readouterr().out
    assert "tracked 20 of 20 frames" in printed and str(out) in printed


def test_the_largest_seed_seeds_every_generator(given, image_folder, tmp_path):
    given()
    assert main(arguments(image_folder, tmp_path / "out", "--seed", str(2**63 - 1))) == 0
    assert torch.initial_seed() == 2**63 - 1


def test_default_results_folder_is_named_after_the_clip(given, image_folder, tmp_path, monkeypatch):
    given()
    monkeypatch.chdir(tmp_path)
    command = [part for part in arguments(image_folder, tmp_path) if part not in ("--out", str(tmp_path))]
    assert main(command) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("images-") and (folder / "run.json").is_file()


def test_groundtruth_gives_the_metrics_that_evo_gives(given, image_folder, tmp_path, capsys):
    from evo.core import metrics, sync
    from evo.tools import file_interface

    noise = np.random.default_rng(2)
    exact = given().motion
    given(motion=lambda t: exact(t) + np.r_[noise.normal(0, 0.02, 3), np.zeros(4)])
    truth, out = image_folder.parent / "truth.txt", tmp_path / "out"
    assert main(arguments(image_folder, out, "--groundtruth", str(truth))) == 0
    reference = file_interface.read_tum_trajectory_file(truth)
    estimate = file_interface.read_tum_trajectory_file(out / "trajectory.txt")
    reference, estimate = sync.associate_trajectories(reference, estimate)
    estimate.align(reference, correct_scale=True)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    rpe = metrics.RPE(metrics.PoseRelation.translation_part, delta=1, delta_unit=metrics.Unit.frames)
    rpe.process_data((reference, estimate))
    written = summary(out)["metrics"]
    assert written["ate_rmse"] == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
    assert written["rpe_trans_rmse"] == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
    assert 0.01 < written["ate_rmse"] < 0.2
    assert "ATE" in capsys.readouterr().out


def test_stride_tracks_every_nth_and_writes_every_frame(given, image_folder, tmp_path):
    odometry = given()
    assert main(arguments(image_folder, tmp_path / "out", "--stride", "3")) == 0
    assert [frame.index for frame in odometry.frames] == [0, 3, 6, 9, 12, 15, 18, 19]
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 20


def test_lost_frames_have_no_row(given, image_folder, tmp_path):
    given(lost=(4, 5, 6))
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    assert summary(tmp_path / "out")["frames"]["lost"] == 3
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 17


def test_the_verdict_comes_first(given, image_folder, tmp_path, capsys):
    odometry = given()
    finish = odometry.finish
    told = Quality("doubtful", "waves, most likely", "film the coast", check=0.4, checks=7)
    odometry.finish = lambda: replace(finish(), quality=told)
    out = tmp_path / "out"
    assert main(arguments(image_folder, out)) == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first == "verdict: doubtful: waves, most likely" and second == "what may help: film the coast"
    written = summary(out)["quality"]
    assert (written["verdict"], written["remedy"], written["check"], written["second"]) == (
        "doubtful", "film the coast", 0.4, None
    )  # fmt: skip
    page = (out / "summary.html").read_text()
    assert "<strong>verdict: doubtful</strong> waves, most likely. What may help: film the coast.</p>" in page


def test_nothing_tracked_says_so(given, image_folder, tmp_path, capsys):
    given(lost=tuple(range(20)))
    truth = image_folder.parent / "truth.txt"
    assert main(arguments(image_folder, tmp_path / "out", "--groundtruth", str(truth))) == 1
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    assert "tracked 0 of 20 frames" in capsys.readouterr().out


def test_ctrl_c_keeps_what_was_tracked(given, image_folder, tmp_path, capsys):
    given(at_frame={8: lambda: os.kill(os.getpid(), signal.SIGINT)})
    before = signal.getsignal(signal.SIGINT)
    assert main(arguments(image_folder, tmp_path / "out")) == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 9, "the frame in hand is finished first"
    assert summary(tmp_path / "out")["interrupted"] is True
    assert "interrupted after 9 frames" in capsys.readouterr().err


def test_second_ctrl_c_gives_up(given, image_folder, tmp_path, capsys):
    def twice() -> None:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)

    odometry = given(at_frame={3: twice})
    odometry.finish = lambda: pytest.fail("must not be asked to finish")
    assert main(arguments(image_folder, tmp_path / "out")) == 130
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 3, "rows written so far stay"
    written = summary(tmp_path / "out")
    assert (written["finished"], written["interrupted"]) == (False, True) and written["frames"]["tracked"] == 3
    assert "interrupted" in capsys.readouterr().err


def test_broken_image_in_the_middle_is_said_and_survived(given, image_folder, tmp_path, capsys):
    given()
    (image_folder / "0007.png").write_bytes(b"\x89PNG\r\n\x1a\n not one")
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    trajectory = read_tum(tmp_path / "out" / "trajectory.txt")
    assert len(trajectory) == 19 and not np.isclose(trajectory.timestamps, 10.7).any()
    assert "0007.png" in capsys.readouterr().err
    assert any("0007.png" in warning for warning in summary(tmp_path / "out")["warnings"])


def test_frame_of_another_size_in_the_middle_keeps_what_came_before(given, image_folder, tmp_path, capsys):
    given()
    cv2.imwrite(str(image_folder / "0012.png"), np.zeros((40, 64, 3), np.uint8))
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 12
    assert "stopped at frame 12" in capsys.readouterr().err


def test_truncated_video_yields_what_could_be_read(given, tmp_path, capsys):
    given()
    video = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    for number in range(40):
        writer.write(np.full((48, 64, 3), 5 * number, np.uint8))
    writer.release()
    whole = video.read_bytes()
    video.write_bytes(whole[: len(whole) // 2])
    (tmp_path / "calib.txt").write_text("50 50 31.5 23.5\n")
    out = tmp_path / "out"
    assert main(["run", str(video), "--calib", str(tmp_path / "calib.txt"), "--out", str(out)]) == 0
    assert 5 < len(read_tum(out / "trajectory.txt")) < 40
    assert summary(out)["warnings"]


def test_the_same_run_gives_the_same_bytes(given, image_folder, tmp_path):
    for name in ("a", "b"):
        given()
        assert main(arguments(image_folder, tmp_path / name)) == 0
    for file in ("trajectory.txt", "map.ply", "trajectory.png"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_a_failed_run_leaves_no_folder(given, image_folder, tmp_path):
    def fail() -> None:
        raise dvo.DvoError("no")

    given(at_frame={0: fail})
    assert main(arguments(image_folder, tmp_path / "out")) == 2
    assert not (tmp_path / "out").exists()


def test_help_is_quick_and_loads_nothing_heavy(repository):
    code = (
        "import sys, time; t = time.perf_counter()\n"
        "from dvo.cli import main\n"
        "assert main(['--help']) == 0\n"
        "heavy = {'torch', 'cv2', 'numpy', 'rich', 'kornia', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    fastest = 9.0
    for _ in range(3):
        started = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True, text=True)
        fastest = min(fastest, time.perf_counter() - started)
        assert done.returncode == 0, done.stderr
    assert fastest < 1.0
    assert all(word in done.stdout for word in ("demo", "run", "weights"))


def test_python_m_dvo(repository):
    done = subprocess.run([sys.executable, "-m", "dvo", "--version"], cwd=repository, capture_output=True, text=True)
    assert done.stdout.strip() == f"dvo {dvo.__version__}"


def test_package_names_are_lazy_and_complete():
    assert set(dvo.__all__) <= set(dir(dvo))
    assert dvo.open.__name__ == "open_source"
    with pytest.raises(AttributeError):
        _ = dvo.no_such_thing


@pytest.mark.long
def test_ctrl_c_at_a_terminal(image_folder, tmp_path, repository):
    """The real signal, a real process: a slow odometry, interrupted from outside."""
    script = tmp_path / "slow.py"
    script.write_text(
        "import sys, time, importlib.util\n"
        f"spec = importlib.util.spec_from_file_location('fakes', {str(repository / 'tests' / 'conftest.py')!r})\n"
        "fakes = importlib.util.module_from_spec(spec); spec.loader.exec_module(fakes)\n"
        "import dvo\n"
        "from dvo.cli import main\n"
        "def wait(): print('waiting', flush=True); time.sleep(1)\n"
        "dvo.load = lambda *a, **k: fakes.FakeOdometry(fakes.curve, at_frame={5: wait})\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, str(script), *arguments(image_folder, out)], cwd=repository, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(repository)},
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline().strip() == "waiting"
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert len(read_tum(out / "trajectory.txt")) == 6
