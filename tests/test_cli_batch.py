"""``dvo batch``: folders of ``dvo run``, a table, and what is there is not done again."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
import pytest
from hypothesis import given as examples
from hypothesis import strategies as st

import dvo
from dvo.cli import build_parser, main
from dvo.commands import batch as command
from dvo.commands.batch_names import folder_names
from dvo.commands.batch_table import COLUMNS
from dvo.commands.run_options import as_arguments, given_options
from dvo.core import cluster
from dvo.core.errors import DvoError
from dvo.core.processes import Ending
from dvo.core.threads import available_cores, share_cores, thread_rule
from dvo.data.files.output import only_writer
from tests.support.command_line import errors, names, summary, without_plots
from tests.support.fake_odometry import FakeOdometry, curve

FILES = ["frames.csv", "map.ply", "run.json", "summary.html", "trajectory.png", "trajectory.txt"]


def make_video(file: Path, frames: int = 20, size: tuple[int, int] = (64, 48)) -> Path:
    """Video of noise that drifts, with its calibration beside it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    seed = sum(str(file).encode())
    noise = np.random.default_rng(seed).integers(0, 255, (size[1], size[0] + 2 * frames, 3), dtype=np.uint8)
    noise = cv2.GaussianBlur(noise, (5, 5), 0)
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, size)
    for shift in range(0, 2 * frames, 2):
        writer.write(np.ascontiguousarray(noise[:, shift : shift + size[0]]))
    writer.release()
    file.with_suffix(".calib.txt").write_text(f"{size[0]} {size[0]} {size[0] / 2} {size[1] / 2}\n")
    return file


@pytest.fixture
def videos(tmp_path: Path) -> list[Path]:
    return [make_video(tmp_path / "videos" / f"{name}.mp4") for name in ("one", "two", "three")]


class PerThread(io.TextIOBase):
    """Stream of the main thread, and a file for any other that has one."""

    def __init__(self, stream: TextIO, files: threading.local) -> None:
        self.stream, self.files = stream, files

    def write(self, text: str) -> int:
        return getattr(self.files, "file", self.stream).write(text)


@pytest.fixture
def tracked(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Names of the videos that are tracked, in this process, by an odometry that knows the answer."""
    done: list[str] = []
    files = threading.local()

    def run_here(job: command.Job, folder: Path, log: Path) -> Ending:
        done.append(job.name)
        for name in ("stdout", "stderr"):  # which pytest sets between the fixtures and the test
            if not isinstance(getattr(sys, name), PerThread):
                monkeypatch.setattr(sys, name, PerThread(getattr(sys, name), files))
        overwrite = ["--overwrite"] if job.overwrite else []
        with open(log, "w") as files.file:
            print(command.LOG_BEGIN)
            code = main(["run", *as_arguments(job.options), "--out", str(folder), *overwrite, "--", job.source])
            del files.file
        return Ending(code, "")

    monkeypatch.setitem(vars(dvo), "load", lambda weights, **asked: FakeOdometry(curve))
    monkeypatch.setattr(command, "run_one", run_here)
    without_plots(monkeypatch)
    return done


def line(videos: list[Path], out: Path, *more: str) -> list[str]:
    jobs = () if {"--jobs", "--ray"} & set(more) else ("--jobs", "1")
    calib = ("--calib", "{stem}.calib.txt")
    return ["batch", *map(str, videos), "--out", str(out), "--device", "cpu", *calib, *jobs, *more]


def table(out: Path) -> dict[str, dict[str, str]]:
    with open(out / "batch.csv", newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


# -- results -------------------------------------------------------------------------------------------------------


def test_each_video_has_the_folder_of_dvo_run(tracked, videos, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(line(videos, out, "--end", "15f", "--export", "kitti")) == 0
    assert names(out) == ["batch.csv", "logs", "one", "three", "two"] and tracked == ["one", "two", "three"]
    assert names(out / "logs") == ["one.log", "three.log", "two.log"]
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split() == ["name", "frames", "tracked", "seconds", "verdict"]
    assert [text.split()[:3] for text in printed[1:4]] == [[n, "15", "15"] for n in ("one", "two", "three")]
    assert printed[4].startswith("3 of 3 videos tracked")
    for video in videos:
        folder, alone = out / video.stem, tmp_path / f"{video.stem}-alone"
        calib = ["--calib", f"{video.stem}.calib.txt", "--end", "15f", "--export", "kitti", "--device", "cpu"]
        assert main(["run", str(video), "--out", str(alone), *calib]) == 0
        assert names(folder) == names(alone) == sorted([*FILES, "export"])
        for name in ("trajectory.txt", "map.ply", "export/kitti/poses.txt"):
            assert (folder / name).read_bytes() == (alone / name).read_bytes()
        changing = ("seconds", "fps", "peak_memory_mb")
        one, other = ({k: v for k, v in summary(f).items() if k not in changing} for f in (folder, alone))
        assert one == other
    rows = table(out)
    assert [rows["two"][name] for name in ("source", "state", "frames", "tracked", "error")] == [
        str(videos[1]), "done", "15", "15", ""
    ]  # fmt: skip


def test_the_same_command_goes_on(tracked, videos, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    assert main(line(videos[:2], out)) == 0
    before = {name: (out / name / "run.json").read_bytes() for name in ("one", "two")}
    tracked.clear()
    monkeypatch.chdir(videos[0].parent)  # the same files, written in another way
    again = line([Path("one.mp4"), *videos[1:]], out)
    assert main(again) == 0 and tracked == ["three"]
    assert before == {name: (out / name / "run.json").read_bytes() for name in ("one", "two")}
    said = capsys.readouterr()
    assert "3 videos, 2 of them done already" in said.err
    assert [text.split()[:3] for text in said.out.splitlines()[-4:-1]] == [
        [n, "20", "20"] for n in ("one", "two", "three")
    ]
    tracked.clear()
    assert main(again) == 0 and tracked == [] and sorted(table(out)) == ["one", "three", "two"]
    for name, change in {"one": {"finished": False}, "two": {"interrupted": True}}.items():  # killed, and stopped
        file = out / name / "run.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | change))
    assert main(again) == 0 and tracked == ["one", "two"]
    assert all(summary(out / name)["finished"] and not summary(out / name)["interrupted"] for name in before)
    assert main(line(videos[2:], out)) == 0 and sorted(table(out)) == ["one", "three", "two"], "rows of others stay"


def test_results_of_dvo_run_count(tracked, videos, tmp_path):
    out, calib = tmp_path / "out", videos[0].with_suffix(".calib.txt")
    assert main(["run", str(videos[0]), "--calib", str(calib), "--device", "cpu", "--out", str(out / "one")]) == 0
    assert main(line(videos, out)) == 0 and tracked == ["two", "three"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (["--end", "12f"], "--end 12f (was not given)"),
        (["--no-loops"], "--no-loops (was not given)"),
        (["--set", "patches=5"], "--set ['patches=5'] (was not given)"),
        (["calibration"], "another file of --calib"),
        (["video"], "another source"),
    ],
)
def test_results_of_other_options_are_kept(tracked, videos, tmp_path, capsys, change, told):
    out = tmp_path / "out"
    assert main(line(videos[:1], out)) == 0
    before = (out / "one" / "run.json").read_bytes()
    if change == ["calibration"]:
        videos[0].with_suffix(".calib.txt").write_text("60 60 32 24\n")
        change = []
    elif change == ["video"]:
        make_video(videos[0], frames=18)
        change = []
    assert main(line(videos, out, *change)) == 2
    (error,) = errors(capsys.readouterr().err)[-1:]
    assert told in error and str(out / "one") in error and "--overwrite" in error
    assert tracked == ["one"] and (out / "one" / "run.json").read_bytes() == before and not (out / "two").exists()
    assert main(line(videos, out, *change, "--overwrite")) == 0 and tracked == ["one", "one", "two", "three"]
    tracked.clear()
    assert main(line(videos, out, *change, "--overwrite")) == 0 and tracked == [], "they are the same now"


def test_a_damaged_run_is_not_replaced_unasked(tracked, videos, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(line(videos[:1], out)) == 0
    file = out / "one" / "run.json"
    for damage in ({"frames": "many"}, {"inputs": {"source": 3}}, {"inputs": None}):
        file.write_text(json.dumps(json.loads(file.read_text()) | damage))
        before = file.read_bytes()
        assert main(line(videos, out)) == 2 and file.read_bytes() == before
        assert str(out / "one") in errors(capsys.readouterr().err)[-1] and tracked == ["one"]
        assert main(line(videos[:1], out, "--overwrite")) == 0 and summary(out / "one")["finished"]
        tracked.pop()


def test_a_failed_video_is_a_row(tracked, videos, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    videos[1].with_suffix(".calib.txt").unlink()
    broken, missing = tmp_path / "broken.mp4", tmp_path / "missing.mp4"
    broken.write_bytes(b"no video")
    assert main(line([broken, *videos, missing], out)) == 1
    rows = table(out)
    assert [row["state"] for row in rows.values()] == ["failed", "done", "failed", "done", "failed"]
    assert "--calib" in rows["two"]["error"] and "missing.mp4: no such file" in rows["missing"]["error"]
    printed = capsys.readouterr().out
    assert "2 of 5 videos tracked" in printed and "failed: " in printed and len(printed.splitlines()) == 7
    tracked.clear()
    videos[1].with_suffix(".calib.txt").write_text("64 64 32 24\n")
    assert main(line(videos, out)) == 0 and tracked == ["two"]


def test_a_video_without_a_pose_is_no_success(tracked, videos, tmp_path, monkeypatch):
    monkeypatch.setitem(vars(dvo), "load", lambda weights, **asked: FakeOdometry(curve, lost=tuple(range(20))))
    out = tmp_path / "out"
    assert main(line(videos[:1], out)) == 1 and table(out)["one"]["tracked"] == "0"
    assert main(line(videos[:1], out)) == 1 and tracked == ["one"], "it is done, and stays so"


# -- bad usage -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("more", "match"),
    [
        (["--save-map", "a.dvo"], "one file for all videos"),
        (["--overlay", "{stem}.mp4"], "one file for all videos"),
        (["--rerun"], "a viewer shows one run"),
        (["--groundtruth", "{clip}.txt"], "unknown placeholder {clip}"),
        (["--export", "obj"], "obj"),
        (["--system", "nothing"], "no system nothing"),
        (["--set", "seed=3"], "use the option of that name"),
        (["--jobs", "0"], "must be 1 or more"),
        (["--queue", "3"], "--queue"),
        (["--ray", "auto", "--overlay", "{name}.mp4"], "files of nodes do not come back"),
    ],
)
def test_bad_usage_ends_before_the_first_video(tracked, videos, tmp_path, capsys, more, match):
    assert main(line(videos, tmp_path / "out", *more)) == 2
    said = capsys.readouterr().err.splitlines()
    assert match.lower() in said[-1].lower() and tracked == [] and not (tmp_path / "out").exists()


@pytest.mark.parametrize("stream", ["webcam:0", "rtsp://user:word@camera/live", "-"])
def test_a_stream_is_refused(tracked, videos, tmp_path, capsys, stream):
    assert main(["batch", "--out", str(tmp_path / "out"), "--", str(videos[0]), stream]) == 2
    said = capsys.readouterr().err
    assert "a stream is no video" in said and "word" not in said


def test_a_folder_of_another_batch_or_of_files_of_the_user(tracked, videos, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    with only_writer(out, "--out"):
        assert main(line(videos, out)) == 2
    assert "another run is writing into this folder" in capsys.readouterr().err
    for name in ("batch.csv", "logs/two.log"):
        (out / "logs").mkdir(exist_ok=True)
        (out / name).write_text("mine\n")
        assert main(line(videos, out)) == 2
        assert "is not a file that dvo batch has written" in capsys.readouterr().err
        assert (out / name).read_text() == "mine\n"
        (out / name).unlink()
    assert tracked == []


def test_no_output_is_an_input_of_any_video(tracked, videos, tmp_path, capsys):
    out, room = tmp_path / "out", tmp_path / "two.dvo"
    room.write_bytes(b"a map")
    assert main(line(videos, out, "--map", str(room), "--save-map", str(tmp_path / "{name}.dvo"))) == 2
    assert "--save-map" in errors(capsys.readouterr().err)[-1] and room.read_bytes() == b"a map"
    assert main(line(videos, out)) == 0
    inside = (out / "one" / "trajectory.txt").rename(out / "one" / "trajectory-0.txt")
    before = inside.read_bytes()
    more = ("--end", "10f", "--overwrite", "--groundtruth", str(inside))
    assert main(line(videos, out, *more)) == 2
    assert "--groundtruth" in errors(capsys.readouterr().err)[-1] and inside.read_bytes() == before
    assert main(line(videos[1:2], out, *more)) == 0, "one is not tracked here"
    log = out / "logs" / "one.log"
    assert main(line(videos[:1], out, "--end", "9f", "--overwrite", "--times", str(log))) == 2
    assert "is also the log of one" in capsys.readouterr().err


# -- names ---------------------------------------------------------------------------------------------------------


def test_names_of_one_stem_and_of_folders(tmp_path):
    given = ["/v/a/x.mp4", "/v/b/x.mp4", "/v/y.mp4", "/v/Y.avi", "/v/y", "/d/P1/image_left", "/d/P2/image_left", "/"]
    assert folder_names(given, tmp_path / "out") == [
        "a-x", "b-x", "y.mp4", "Y.avi", "y", "P1-image_left", "P2-image_left", "video"
    ]  # fmt: skip
    strange = ["/v/-rf.mp4", "/v/logs.mp4", "/v/batch.csv.mp4", "/v/a b\n;c.mp4", "/v/../../x.mp4", "/v/Straße.mp4"]
    assert folder_names(strange, tmp_path / "out") == ["rf", "logs_", "batch.csv_", "a_b_c", "x", "Straße"]


PART = st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1, max_size=8)
PATHS = st.lists(st.lists(PART, min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts)), max_size=6)


@examples(paths=PATHS)
def test_names_are_unique_and_safe(paths, tmp_path_factory):
    sources = list(dict.fromkeys(map(os.path.abspath, paths)))
    out = tmp_path_factory.getbasetemp() / "no such folder"
    found = folder_names(sources, out)
    assert len({name.casefold() for name in found}) == len(sources)
    for name in found:
        assert name[0] not in ".-" and not set(name) & set("/\\ \n:*?\"<>|'$`") and len(name.encode()) <= 104
        assert name.casefold() not in ("batch.csv", "logs")


def test_a_source_keeps_its_folder(tracked, tmp_path):
    first, second = (make_video(tmp_path / folder / "x.mp4") for folder in "ab")
    out = tmp_path / "out"
    assert main(line([first], out)) == 0 and main(line([second, first], out)) == 0
    assert tracked == ["x", "b-x"]
    assert main(line([second], out)) == 0 and main(line([first, second, first], out)) == 0
    assert tracked == ["x", "b-x"] and table(out)["x"]["source"] == str(first)


def test_outputs_of_each_video(tracked, videos, tmp_path):
    assert main(line(videos, tmp_path / "out", "--overlay", str(tmp_path / "seen-{name}.mp4"))) == 0
    assert sorted(file.name for file in tmp_path.glob("seen-*")) == ["seen-one.mp4", "seen-three.mp4", "seen-two.mp4"]


# -- options, threads ----------------------------------------------------------------------------------------------

TEXT = st.text(st.characters(min_codepoint=32, max_codepoint=0x2FF), min_size=1, max_size=10)
METRES = st.floats(0.01, 1e3)
OPTIONS = st.fixed_dictionaries(
    {},
    optional={
        "calib": TEXT, "weights": TEXT.filter(lambda text: text != "small"), "seed": st.integers(1, 2**63 - 1),
        "set": st.lists(TEXT, min_size=1, max_size=3), "no_loops": st.just(True), "stride": st.integers(2, 9),
        "export": st.lists(st.sampled_from(["tum", "kitti"]), min_size=1, unique=True), "fps": st.floats(0.1, 1e4),
        "depth": st.just("") | TEXT, "end": TEXT, "max_pixels": st.integers(0, 10**7), "tsdf": st.just(True),
        "rerun": TEXT.map(lambda text: f"{text}.rrd"),
    },
)  # fmt: skip


@pytest.mark.long
@examples(options=OPTIONS)
def test_options_pass_through_a_command_line(options):
    arguments = build_parser().parse_args(["run", *as_arguments(options), "--", "-clip.mp4"])
    assert given_options(arguments) == options and arguments.source == "-clip.mp4"


def test_distances_pass_too():
    options = {"distance": [[0.0, 1.5, 2.0], [1.0, 1e-05, 3.0]]}
    assert given_options(build_parser().parse_args(["run", *as_arguments(options), "--", "clip"])) == options


@pytest.mark.parametrize("cores", [1, 2, 4, 6, 16, 64])
def test_jobs_share_the_cores(cores, monkeypatch):
    monkeypatch.setattr("dvo.core.threads.available_cores", lambda: cores)
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    jobs, threads = share_cores(None)
    assert threads == thread_rule(cores) and jobs == max(1, cores // threads)
    for jobs in (1, 2, 3, 8, 100):
        assert share_cores(jobs) == (jobs, min(4, max(1, cores // jobs)))
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert share_cores(5) == (5, 2) and share_cores(None) == (max(1, cores // 2), 2)
    assert available_cores() >= 1


# -- Ray -----------------------------------------------------------------------------------------------------------


class PretendedRay:
    """The part of Ray that is used, in this process; the last call is done first."""

    def __init__(self, cpus: float = 4.0) -> None:
        self.cpus, self.asked = cpus, []
        self.calls: list[tuple[Callable, Any]] = []
        self.cancelled: list[int] = []

    def init(self, address: str, **options) -> None:
        self.asked.append(address)

    def nodes(self) -> list[dict]:
        return [{"Alive": True, "Resources": {"CPU": self.cpus}}, {"Alive": False, "Resources": {"CPU": 64.0}}]

    def remote(self, **options):
        self.asked.append(options)

        def begin(function: Callable, item: Any) -> int:
            self.calls.append((function, item))
            return len(self.calls) - 1

        return lambda function: type("Remote", (), {"remote": staticmethod(partial(begin, function))})

    def wait(self, waiting: list, num_returns: int, timeout: float) -> tuple[list, list]:
        return waiting[-num_returns:], waiting[:-num_returns]

    def get(self, reference: int) -> bytes:
        function, item = self.calls[reference]
        if item.name == "two":
            raise RuntimeError("the node died\nat once")
        return function(item)

    def cancel(self, reference: int) -> None:
        self.cancelled.append(reference)

    def shutdown(self) -> None:
        self.asked.append("shutdown")


def test_over_ray(tracked, videos, tmp_path, monkeypatch, capsys):
    ray, out = PretendedRay(), tmp_path / "out"
    monkeypatch.setattr(cluster.importlib, "import_module", import_or(ray))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert main(line(videos, out, "--ray", "auto", "--export", "kitti")) == 1
    assert ray.asked == ["auto", {"num_cpus": 1, "max_retries": 0}, "shutdown"] and tracked == ["three", "one"]
    rows = table(out)
    assert [rows[name]["state"] for name in ("one", "two", "three")] == ["done", "failed", "done"]
    assert rows["two"]["error"] == "the node died"
    assert names(out) == ["batch.csv", "logs", "one", "three"] and names(out / "logs") == ["one.log", "three.log"]
    assert names(out / "one") == sorted([*FILES, "export"]) and names(out / "one" / "export") == ["kitti"]
    tracked.clear()
    assert main(line(videos, out, "--export", "kitti")) == 0 and tracked == ["two"], "what came over Ray is done"
    assert main(line(videos, out, "--ray", "auto", "--end", "9f", "--overwrite")) == 1
    assert names(out / "one") == FILES and table(out)["one"]["frames"] == "9", "the export of before is gone"
    capsys.readouterr()
    monkeypatch.setattr(cluster.importlib, "import_module", import_or(PretendedRay(cpus=0.5)))
    assert main(line(videos, out, "--ray", "auto", "--end", "8f", "--overwrite")) == 2
    assert "no node of the Ray cluster has 1 CPU" in capsys.readouterr().err


@pytest.mark.parametrize("address", ["127.0.0.1:{port}", "ray://127.0.0.1:{port}", "ray://[::1"])
def test_an_address_without_a_cluster_is_said_at_once(address, videos, tmp_path, monkeypatch, capsys):
    """Ray asks a port where nothing listens again and again, for more than ten minutes."""
    ray = PretendedRay()
    monkeypatch.setattr(cluster.importlib, "import_module", import_or(ray))
    with socket.socket() as bound:  # without listening, and kept from others
        bound.bind(("127.0.0.1", 0))
        address = address.format(port=bound.getsockname()[1])
        assert main(line(videos, tmp_path / "out", "--ray", address, "--system", "klt-pnp")) == 2
    error = capsys.readouterr().err
    assert f"--ray: no Ray cluster at '{address}'" in error and "ray start --head" in error and not ray.asked
    monkeypatch.setenv("RAY_ADDRESS", address)
    assert main(line(videos, tmp_path / "out", "--ray", "auto", "--system", "klt-pnp")) == 2 and not ray.asked


def import_or(ray: PretendedRay) -> Callable[[str], object]:
    """``importlib.import_module`` with a stand-in for Ray."""
    real = cluster.importlib.import_module
    return lambda name, *more: ray if name == "ray" else real(name, *more)


def test_calls_that_are_not_done_are_cancelled():
    ray = PretendedRay()
    found = cluster.run_on(ray, str, ["a", "b", "c"], threads=1, at_most=2)
    number, _ = next(found)
    found.close()
    assert number == 1 and ray.cancelled == [0]
    with pytest.raises(DvoError, match="no node of the Ray cluster has 1 CPU and 1 GPU"):
        next(cluster.run_on(ray, str, ["a"], threads=1, accelerators=1))


@pytest.mark.slow
def test_a_local_cluster(videos, tmp_path):
    pytest.importorskip("ray", reason="Ray is not installed (pip install 'dvo[ray]')")
    out = tmp_path / "out"
    assert main(line(videos[:2], out, "--ray", "local", "--system", "klt-pnp")) in (0, 1)
    assert [row["frames"] for row in table(out).values()] == ["20", "20"] and names(out / "logs")


# -- processes -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_bytes_are_the_same_whatever_the_number_of_jobs(videos, tmp_path):
    """In processes as they are, and as ``dvo run`` writes them."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    more = ["--system", "klt-pnp"]
    for jobs in (1, 3):
        arguments = [*line(videos, tmp_path / str(jobs), *more), "--jobs", str(jobs)]
        done = subprocess.run(
            [sys.executable, "-m", "dvo", *arguments], env=environment, capture_output=True, text=True
        )
        assert done.returncode in (0, 1) and "Traceback" not in done.stderr, done.stderr
        log = (tmp_path / str(jobs) / "logs" / "two.log").read_text()
        assert log.startswith("$ OMP_NUM_THREADS=1 dvo run --calib=two.calib.txt")
    for name in ("one", "two", "three"):
        first, second = (tmp_path / jobs / name for jobs in "13")
        assert names(first) == names(second)
        assert (first / "frames.csv").exists() and "klt-pnp" in (first / "run.json").read_text()
        assert (first / "trajectory.txt").read_bytes() == (second / "trajectory.txt").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_stops_what_runs_and_begins_no_more(number, tmp_path):
    long = [make_video(tmp_path / "videos" / f"{name}.mp4", 900, (320, 240)) for name in ("a", "b")]
    short = make_video(tmp_path / "videos" / "0.mp4")
    out = tmp_path / "out"
    arguments = [*line([short, *long], out, "--jobs", "1", "--system", "keyframe"), "--set", "corners=500"]
    process = subprocess.Popen(
        [sys.executable, "-m", "dvo", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: [signal.signal(one, signal.SIG_DFL) for one in (signal.SIGHUP, signal.SIGTERM)],
    )  # fmt: skip
    while not (out / "a" / "run.json").exists():
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.05)
    process.send_signal(number)
    printed, said = process.communicate(timeout=120)
    assert process.returncode == 128 + number and "Traceback" not in said
    written, rows = summary(out / "a"), table(out)
    assert written["interrupted"] is True and written["finished"] is True and not (out / "b").exists()
    assert [rows[name]["state"] for name in ("0", "a", "b")] == ["done", "interrupted", "waiting"]
    assert "the same command goes on" in said and "interrupted (" in printed
    assert tuple(rows["a"]) == COLUMNS


@pytest.mark.slow
def test_nothing_goes_on_without_the_batch(tmp_path):
    """After ``kill -9`` the run of a video ends as with SIGTERM, and the same command does it again."""
    video, out = make_video(tmp_path / "a.mp4", 900, (320, 240)), tmp_path / "out"
    arguments = line([video], out, "--system", "keyframe")
    process = subprocess.Popen([sys.executable, "-m", "dvo", *arguments], stderr=subprocess.DEVNULL)
    while not (out / "a" / "run.json").exists():
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    until = time.monotonic() + 60
    while not summary(out / "a").get("interrupted"):
        assert time.monotonic() < until
        time.sleep(0.1)
    assert summary(out / "a")["finished"] is True
