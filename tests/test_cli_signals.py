"""Files of a run when it is killed, terminated or interrupted."""

from __future__ import annotations

import errno
import io
import json
import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import dvo
from dvo.cli import main
from dvo.commands import run as command
from dvo.core.errors import DvoError
from dvo.data.trajectory import read_tum
from tests.support.command_line import arguments, errors, names, summary
from tests.support.fake_odometry import FakeOdometry, curve

# A program that is `dvo` with an odometry that knows the answer, several times over in processes of their own: imports
# take longer than all runs. Each logs a line when the odometry is asked for a frame, at which moment the frame before
# has been recorded, and gets a signal when the log has the given number of lines.
PROGRAM = """
import importlib.util, json, os, sys, time
images, out, signals = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
spec = importlib.util.spec_from_file_location("fakes", sys.argv[4])
fakes = importlib.util.module_from_spec(spec); spec.loader.exec_module(fakes)
import dvo, dvo.commands.run
from dvo.cli import main
from dvo.commands import run as command

class Logged(fakes.FakeOdometry):
    def track(self, frame):
        log.write(f"{frame.index}\\n")
        log.flush()
        time.sleep(0.01)
        return super().track(frame)

dvo.load = lambda *args, **kwargs: Logged(fakes.curve, new_segment=(7,))
codes = []
for run, (lines, signal) in enumerate(signals):
    log = open(f"{out}{run}.log", "w")
    child = os.fork()
    if child == 0:
        os._exit(main(["run", images, "--out", f"{out}{run}", "--device", "cpu", *sys.argv[5:]]))
    while len(open(f"{out}{run}.log").readlines()) < lines:
        time.sleep(0.001)
    os.kill(child, signal)
    codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(json.dumps(codes))
"""


@pytest.mark.long
def test_kill_loses_no_tracked_frame(image_folder, tmp_path, repository):
    """Rows that had been recorded when the process was killed are there; no frame is missing, so no second is. SIGTERM,
    the last of the signals, ends with all results."""
    (tmp_path / "program.py").write_text(PROGRAM)
    draw = random.Random(0)
    signals = [(draw.randrange(2, 18), signal.SIGKILL) for _ in range(5)] + [(3, signal.SIGTERM)]
    out, fakes = str(tmp_path / "out"), str(repository / "tests" / "conftest.py")
    command = [sys.executable, "program.py", str(image_folder), out, json.dumps(signals), fakes,
               "--calib", str(image_folder.parent / "calib.txt")]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": str(repository)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == 5 * [-signal.SIGKILL] + [143]
    for run, (lines, number) in enumerate(signals):
        folder = tmp_path / f"out{run}"
        last = int((tmp_path / f"out{run}.log").read_text().split()[-1])
        assert last >= lines - 1
        several = (folder / "trajectory-0.txt").exists()
        parts = [folder / f"trajectory-{k}.txt" for k in range(2)] if several else [folder / "trajectory.txt"]
        stamps = np.concatenate([read_tum(part).timestamps for part in parts if part.exists()])
        rows = np.round(stamps * 10 - 100).astype(int).tolist()
        assert rows == list(range(len(rows))) and len(rows) >= last, "frames before the last one asked for"
        assert summary(folder)["finished"] is (number == signal.SIGTERM)


@pytest.mark.slow
def test_kill_at_ten_moments_of_a_real_clip(data_root, tmp_path, repository):
    """The real command with the shipped weights, killed at random times; no more than a second of work is missing."""
    script = tmp_path / "timed.py"
    script.write_text(
        "import sys, time, dvo\n"
        "from dvo.cli import main\n"
        "from dvo.odometry.patch.tracker import PatchOdometry\n"
        "track, log = PatchOdometry.track, open(sys.argv[1], 'w')\n"
        "def timed(self, frame):\n"
        "    estimate = track(self, frame)\n"
        "    row = estimate.pose_wc is not None and estimate.status.value != 'lost'\n"
        "    log.write(f'{time.monotonic()} {int(row)}\\n'); log.flush()\n"
        "    return estimate\n"
        "PatchOdometry.track = timed\n"
        "sys.exit(main(sys.argv[2:]))\n"
    )
    clip, draw = data_root / "tum_fr1_rpy_60", random.Random(1)
    for number in range(10):
        out, log = tmp_path / f"out{number}", tmp_path / f"log{number}"
        process = subprocess.Popen(
            [sys.executable, str(script), str(log), "run", str(clip), "--out", str(out), "--device", "cpu"],
            cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(repository)}, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        while not log.exists() or not log.read_text():
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(draw.uniform(0.0, 2.0))
        process.kill()
        assert process.wait() == -signal.SIGKILL, "the clip must be longer than the wait"
        tracked = np.array([[float(part) for part in line.split()] for line in log.read_text().splitlines()])
        recorded = tracked[:-1]  # the last one may have been logged but not yet recorded
        old = recorded[(recorded[:, 0] <= tracked[-1, 0] - 1.0) & (recorded[:, 1] == 1)]
        lines = (out / "trajectory.txt").read_text().splitlines()
        assert len(lines) - 1 >= len(old) and summary(out)["finished"] is False
        assert len(lines) - 1 >= recorded[:, 1].sum(), "every row is written at once"


@pytest.fixture(autouse=True)
def default_signals():
    """Signals as a shell leaves them; under ``nohup`` one of them is ignored."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGHUP, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


ENDING = pytest.mark.parametrize(
    ("number", "code", "said"), [(signal.SIGTERM, 143, "terminated"), (signal.SIGHUP, 129, "hung up")]
)


@ENDING
def test_a_signal_finishes_and_has_its_exit_code(number, code, said, given, image_folder, tmp_path, capsys):
    given(at_frame={8: lambda: os.kill(os.getpid(), number)})
    assert main(arguments(image_folder, tmp_path / "out")) == code
    assert signal.getsignal(number) is signal.SIG_DFL
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 9
    written = summary(tmp_path / "out")
    assert written["interrupted"] is True and written["finished"] is True
    expected = ["frames.csv", "map.ply", "run.json", "summary.html", "trajectory.png", "trajectory.txt"]
    assert names(tmp_path / "out") == expected
    assert "interrupted after 9 frames" in capsys.readouterr().err


@ENDING
def test_a_second_signal_aborts(number, code, said, given, image_folder, tmp_path, capsys):
    def twice() -> None:
        for _ in range(2):
            os.kill(os.getpid(), number)

    given(at_frame={5: twice})
    assert main(arguments(image_folder, tmp_path / "out")) == code
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 5
    assert summary(tmp_path / "out")["interrupted"] is True and summary(tmp_path / "out")["finished"] is False
    assert errors(capsys.readouterr().err)[-1] == f"dvo: {said}"


@ENDING
def test_a_signal_before_tracking_leaves_no_folder(number, code, said, monkeypatch, image_folder, tmp_path, capsys):
    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: os.kill(os.getpid(), number))
    assert main(arguments(image_folder, tmp_path / "out")) == code
    assert not (tmp_path / "out").exists()
    assert errors(capsys.readouterr().err) == [f"dvo: {said}"]


class Hasty(FakeOdometry):
    """Whose final optimisation takes long."""

    def current(self):
        return super().finish()

    def finish(self):
        raise AssertionError("there is no time for it")


def test_sigterm_writes_what_there_is(monkeypatch, image_folder, tmp_path, capsys):
    """Within two seconds, if plots take longer; a container is killed in ten."""
    term = {8: lambda: os.kill(os.getpid(), signal.SIGTERM)}
    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: Hasty(curve, at_frame=term))
    monkeypatch.setattr("dvo.commands.console.GRACE", 0.2)
    monkeypatch.setattr("dvo.commands.run.draw", lambda *args, **options: time.sleep(60))
    assert main(arguments(image_folder, tmp_path / "out")) == 143
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 9
    written = summary(tmp_path / "out")
    assert written["interrupted"] is True and written["finished"] is True
    assert any("no time for the final optimisation" in text for text in written["warnings"])
    assert names(tmp_path / "out") == ["frames.csv", "map.ply", "run.json", "trajectory.txt"]
    assert "summary.html" not in capsys.readouterr().out
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL


def test_sigterm_ends_a_frame_that_takes_long(given, image_folder, tmp_path, monkeypatch, capsys):
    def stuck():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)

    given(at_frame={8: stuck})
    monkeypatch.setattr("dvo.commands.console.GRACE", 0.2)
    assert main(arguments(image_folder, tmp_path / "out")) == 143
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 8 and not summary(tmp_path / "out")["finished"]


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_a_signal_that_is_ignored_stays_ignored(number, given, image_folder, tmp_path):
    """As under ``nohup``."""
    given(at_frame={k: lambda: os.kill(os.getpid(), number) for k in (3, 4)})
    before = signal.signal(number, signal.SIG_IGN)
    try:
        assert main(arguments(image_folder, tmp_path / "out")) == 0
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 20


@pytest.mark.parametrize(("first", "second", "code"), [("SIGHUP", "SIGINT", 130), ("SIGINT", "SIGHUP", 129)])
def test_two_different_signals(first, second, code, given, image_folder, tmp_path):
    def both() -> None:
        for name in (first, second):
            os.kill(os.getpid(), getattr(signal, name))

    given(at_frame={5: both})
    assert main(arguments(image_folder, tmp_path / "out")) == code


def test_a_closed_terminal(given, image_folder, tmp_path, monkeypatch):
    """What is printed after the terminal is gone fails with an input/output error, which is none of the run."""

    class Gone(io.StringIO):
        def write(self, text: str = "") -> int:
            raise OSError(errno.EIO, "Input/output error")

        flush = write  # type: ignore[assignment]

    given(at_frame={8: lambda: os.kill(os.getpid(), signal.SIGHUP)})
    monkeypatch.setattr(sys, "stdout", Gone())
    monkeypatch.setattr(sys, "stderr", Gone())
    assert main(arguments(image_folder, tmp_path / "out")) == 129
    assert summary(tmp_path / "out")["finished"] is True


def test_second_ctrl_c_while_the_results_are_written(given, image_folder, tmp_path, monkeypatch):
    """Each file is then the old or the new one, and run.json says so."""

    def interrupted(*args: object, **options: object) -> None:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)

    given()
    monkeypatch.setattr("dvo.commands.run.draw", interrupted)
    assert main(arguments(image_folder, tmp_path / "out")) == 130
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 20
    written = summary(tmp_path / "out")
    assert (written["interrupted"], written["finished"], written["frames"]["tracked"]) == (True, False, 20)
    assert names(tmp_path / "out") == ["map.ply", "run.json", "trajectory.txt"]


def test_a_signal_while_exports_are_written_lets_them_end(given, image_folder, tmp_path, monkeypatch):
    """Tracking is over then, and the results are there; the second signal would end the program."""
    export = command.export_run

    def signalled(*args):
        os.kill(os.getpid(), signal.SIGTERM)
        return export(*args)

    given()
    monkeypatch.setattr(command, "export_run", signalled)
    assert main(arguments(image_folder, tmp_path / "out", "--export", "tum")) == 0
    assert summary(tmp_path / "out")["finished"] and (tmp_path / "out/export/tum/trajectory.txt").is_file()


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [(signal.SIGTERM, 143, "terminated"), (signal.SIGHUP, 129, "hung up"), (signal.SIGINT, 130, "interrupted")],
)
@pytest.mark.parametrize("error", [DvoError("not a safetensors file"), ValueError("shape"), OSError("cannot read")])
def test_a_signal_that_a_library_turns_into_another_error(
    number, code, said, error, image_folder, tmp_path, monkeypatch, capsys, request
):
    """As in a reader of weights, whose own code calls Python."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a shell's background
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))

    def load(*args, **options):
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
            time.sleep(1)
        raise error

    monkeypatch.setitem(vars(dvo), "load", load)
    assert main(arguments(image_folder, tmp_path / "out")) == code
    assert errors(capsys.readouterr().err)[-1] == f"dvo: {said}" and not (tmp_path / "out").exists()
