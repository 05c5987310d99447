"""Choice of threads: the rule, what the user has set, and torch imported before dvo (each in a process of its own)."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import dvo
from dvo.core import context, threads
from dvo.core.errors import DvoError
from dvo.core.threads import available_cores, process_environment, processor_quota, thread_rule
from dvo.synth.clip import make_clip
from eval.benchmarks import threads as benchmark
from eval.benchmarks.threads import Speed

ROOT = Path(__file__).resolve().parents[2]
OWN = ("OMP_", "MKL_", "GOMP_", "KMP_", "OPENBLAS_")


def said(code: str, **variables: str) -> list[str]:
    """Output of a program without settings of threads in its environment, but for those given."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith(OWN)}
    done = subprocess.run(
        [sys.executable, "-W", "always", "-c", code], env={**clean, "PYTHONPATH": str(ROOT), **variables},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return (done.stdout + "".join(line for line in done.stderr.splitlines(True) if "UserWarning" in line)).splitlines()


def test_rule_depends_on_the_cores_alone():
    assert [thread_rule(cores) for cores in (1, 2, 3, 4, 6, 8, 16, 128)] == [1, 2, 3, 4, 4, 4, 4, 4]


def test_cores_are_those_of_the_affinity():
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("no affinity on this system")
    before = os.sched_getaffinity(0)
    assert 1 <= available_cores() <= len(before)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert available_cores() == 1
    finally:
        os.sched_setaffinity(0, before)


@pytest.mark.parametrize(
    ("membership", "files", "expected"),
    [
        ("0::/a/b\n", {"a/b/cpu.max": "300000 100000"}, 3.0),
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000", "a/cpu.max": "150000 100000"}, 1.5),
        ("0::/a/b\n", {"cpu.max": "50000 100000"}, 0.5),
        ("0::/a\n", {"a/cpu.max": "max 100000"}, float("inf")),
        ("0::/\n", {}, float("inf")),
        ("", {}, float("inf")),
        ("3:cpuset:/x\n2:cpu,cpuacct:/x\n",
         {"cpu,cpuacct/x/cpu.cfs_quota_us": "200000", "cpu,cpuacct/x/cpu.cfs_period_us": "100000"}, 2.0),
        ("2:cpu:/host/x\n", {"cpu/cpu.cfs_quota_us": "400000", "cpu/cpu.cfs_period_us": "100000"}, 4.0),
        ("2:cpu:/x\n", {"cpu/x/cpu.cfs_quota_us": "-1", "cpu/x/cpu.cfs_period_us": "100000"}, float("inf")),
    ],
)  # fmt: skip
def test_quota_of_the_control_group(tmp_path, monkeypatch, membership, files, expected):
    (tmp_path / "self").write_text(membership)
    for name, text in files.items():
        (tmp_path / "groups" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / name).write_text(text + "\n")
    assert processor_quota(tmp_path / "self", tmp_path / "groups") == expected
    monkeypatch.setattr(threads, "MEMBERSHIP", tmp_path / "self")
    monkeypatch.setattr(threads, "CGROUPS", tmp_path / "groups")
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda process: set(range(6)), raising=False)
    assert available_cores() == max(1, int(min(6, expected)))


LOAD = "import os, dvo; dvo.load(); import torch; from dvo.core.threads import current_threads as now; "


@pytest.mark.parametrize(("cores", "count", "busy", "expected"), [
    (2, 2, True, 1), (2, 2, False, 2), (8, 4, True, 4), (4, 4, True, 3), (1, 1, True, 1), (2, 1, True, 1),
])  # fmt: skip
def test_a_core_is_left_to_a_busy_thread(monkeypatch, cores, count, busy, expected):
    monkeypatch.setattr(context, "available_cores", lambda: cores)
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with pytest.raises(ValueError), context.core_left(busy):
            assert torch.get_num_threads() == expected
            raise ValueError
        assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
def test_dvo_chooses_where_nothing_is_set():
    code = LOAD + (
        "t = now(); print(t.count, t.chosen_by, t.wait_policy, t.waits_by, torch.get_num_threads());"
        "torch.set_num_threads(3); dvo.load(); print(torch.get_num_threads())"
    )
    counts = {min(thread_rule(available_cores()), count) for count in threads.default_counts()}
    first, later = said(code)
    assert first in {f"{count} dvo passive dvo {count}" for count in counts} and later == "3"


@pytest.mark.slow
def test_what_the_user_has_set_is_kept():
    code = "import dvo.core.threads as threads; threads.thread_rule = lambda cores: 2; " + LOAD
    code += "t = now(); print(t.count, t.chosen_by, t.wait_policy, t.waits_by, 'OMP_WAIT_POLICY' in os.environ)"
    assert said(code, OMP_NUM_THREADS="1", GOMP_SPINCOUNT="100") == [
        "1 OMP_NUM_THREADS GOMP_SPINCOUNT=100 GOMP_SPINCOUNT False"
    ]


@pytest.mark.slow
def test_torch_imported_first():
    """The number can still be set; spinning is told once, and only if several threads are left."""
    start = (
        "import torch, dvo, dvo.core.threads as t; torch.set_num_threads(4); "
        "t.thread_rule = lambda cores: {}; t.default_counts = lambda: {}; "
    )
    show = "dvo.load(); dvo.load(); now = t.current_threads(); print(now.count, now.chosen_by, now.wait_policy)"
    default = "{torch.get_num_threads()}"
    several = said(start.format(3, default) + show)
    assert several[0] == "3 dvo spinning (default)" and len(several) == 2
    assert "3 threads spin" in several[1] and "OMP_WAIT_POLICY=PASSIVE" in several[1]
    assert said(start.format(1, default) + show) == ["1 dvo spinning (default)"]
    assert said(start.format(3, "{77}") + "torch.set_num_threads(5); " + show, OMP_WAIT_POLICY="PASSIVE") == [
        "5 program passive"
    ]


@pytest.mark.long
@pytest.mark.parametrize("module", ["dvo", "dvo.cli", "dvo.geometry.se3", "train", "eval", "tests.conftest"])
def test_programs_wait_passively(module):
    """The choice is made before torch is imported, also if the environment sets the number of threads."""
    code = f"import os, {module}; print(os.environ.get('OMP_WAIT_POLICY'))"
    assert said(code, OMP_NUM_THREADS="2") == ["PASSIVE"]


@pytest.mark.long
def test_openmp_reads_the_choice():
    """As OpenMP itself tells when it is loaded."""
    done = subprocess.run(
        [sys.executable, "-c", "import dvo, torch"], capture_output=True, text=True, timeout=300,
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "2", "OMP_DISPLAY_ENV": "verbose"},
    )  # fmt: skip
    told = re.findall(r"(OMP_WAIT_POLICY|GOMP_SPINCOUNT) *= *'(\w+)'", done.stderr)
    assert ("OMP_WAIT_POLICY", "PASSIVE") in told, done.stderr
    assert all(int(turns) <= 1000 for name, turns in told if name == "GOMP_SPINCOUNT")


def test_environment_of_a_process():
    found = process_environment(3, {"PATH": "p", "OMP_NUM_THREADS": "8"})
    assert found == {
        "PATH": "p", "OMP_NUM_THREADS": "3", "MKL_NUM_THREADS": "3", "OPENBLAS_NUM_THREADS": "3",
        "OMP_WAIT_POLICY": "PASSIVE",
        "GOMP_SPINCOUNT": "1000",
    }  # fmt: skip
    assert process_environment(1, {"OMP_WAIT_POLICY": "ACTIVE"})["OMP_WAIT_POLICY"] == "ACTIVE"
    assert "OMP_WAIT_POLICY" not in process_environment(1, {"GOMP_SPINCOUNT": "0"})


def test_table_of_the_benchmark():
    rates = {"before": (20.0, 0.5), "dvo": (22.0, 14.0), "one thread": (20.0, 16.0)}
    results = {
        (name, state): [Speed(rate * factor, 2, "passive") for factor in (0.5, 1.0, 4.0)]
        for name, both in rates.items()
        for state, rate in zip(benchmark.STATES, both, strict=True)
    }
    row = benchmark.table(results).splitlines()[2].split()
    assert row == ["dvo", "2", "passive", "22.00", "1.10", "1.10", "14.00", "28.00", "0.88"]


def test_environments_of_the_benchmark():
    base = {"PATH": "p", "OMP_NUM_THREADS": "7", "GOMP_SPINCOUNT": "9"}
    found = {case.name: benchmark.environment_of(case, base) for case in benchmark.cases(8)}
    assert {name for name in found["dvo"] if name.startswith(OWN)} == set() and found["dvo"]["PATH"] == "p"
    assert found["before"] == found["dvo"]
    assert found["one per core, passive"]["OMP_NUM_THREADS"] == "8"


def test_busy_processes_end():
    with benchmark.busy_processes(2) as running:
        assert [process.poll() for process in running] == [None, None]
    assert all(process.poll() is not None for process in running)


def test_benchmark_refuses_bad_input(capsys):
    assert benchmark.main(["--states", "asleep"]) == 2
    assert benchmark.main(["--frames", "5", "--warmup", "5"]) == 2
    assert "choose from idle, busy" in capsys.readouterr().err.lower()


FORK = """
import os, sys
import numpy as np
import dvo, torch
from dvo.synth.clip import ClipSpec, make_clip
from tests.support.forked import in_fork
torch.set_num_threads(1)  # for the tensors
camera = dvo.Camera(200.0, 200.0, 159.5, 119.5, 320, 240)
images = np.random.default_rng(0).integers(0, 255, (4, 240, 320, 3), dtype=np.uint8)
frames = [dvo.Frame(i, 0.1 * i, image, camera) for i, image in enumerate(images)]
edges = 200_000
poses = torch.tensor([0, 0, 0, 0, 0, 0, 1.0]).repeat(1, 2, 1)
patches = torch.ones(1, 50, 3, 1, 1)
index = torch.zeros(edges, dtype=torch.long), torch.ones(edges, dtype=torch.long), torch.arange(edges) % 50
measured = torch.ones(1, edges, 2), torch.ones(1, edges, 2)
intrinsics = torch.tensor([100.0, 100, 50, 50]).repeat(1, 2, 1)
torch.set_num_threads(2)
def adjust(): return dvo.bundle_adjust(poses, patches, intrinsics, *measured, *index).poses_cw.shape
def load(): return type(dvo.load("small")).__name__
def model(): return type(dvo.load_model("small")).__name__
def render(): return make_clip(0, 0, ClipSpec(frames=2)) is None
def run(): return dvo.run(dvo.load("small"), frames).frames_fed
def one_thread():
    torch.set_num_threads(1)
    return run()
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize("before", ["adjust", "load", "render"])
def test_a_fork_after_work_of_several_threads_is_one_error(before):
    """At every entry to computation; without it, each hangs in its first parallel loop."""
    code = FORK + f"{before}()\nwork = [adjust, load, model, render, run]\n"
    if before == "load":  # and of an odometry of the parent
        code += "odometry = dvo.load('small')\nodometry.track(frames[0])\n"
        code += "work += [lambda: odometry.track(frames[1]), odometry.current, odometry.finish]\n"
    code += "for each in work: print(in_fork(each))\n"
    code += "print(in_fork(one_thread), load())"
    *lines, last = said(code, OMP_NUM_THREADS="2")
    assert len(lines) == (8 if before == "load" else 5) and len(set(lines)) == 1, lines
    assert lines[0].startswith("DvoError: fork: this process was forked after threads of torch had computed")
    assert '"spawn"' in lines[0] and '"forkserver"' in lines[0]
    assert last == "4 PatchOdometry", "one thread waits for no others, and the parent goes on"


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_fork_before_work_of_several_threads_computes():
    """Also after work of one thread."""
    code = FORK + "print(in_fork(run)); torch.set_num_threads(1); load(); torch.set_num_threads(2); print(in_fork(run))"
    assert said(code, OMP_NUM_THREADS="2") == ["4", "4"]


def test_work_of_several_threads_is_noted_at_its_entries(monkeypatch):
    """As :data:`FORK` does in processes of their own; a fork is only told here."""
    forks = {"work": False, "after work": False}
    monkeypatch.setattr(context, "_forks", forks)
    torch.set_num_threads(1)
    dvo.load_model("small")
    context._after_fork()
    assert not any(forks.values()), "one thread"
    try:
        torch.set_num_threads(2)
        context.use_threads()
        assert forks["work"] and not forks["after work"]
        context._after_fork()
        for work in (lambda: dvo.load("small"), lambda: dvo.load_model("small"), lambda: make_clip(0, 0)):
            with pytest.raises(DvoError, match="fork: .*forked after threads of torch.*spawn"):
                work()
    finally:
        torch.set_num_threads(1)
    dvo.load_model("small")
