"""Comparison with an earlier commit: the checkout, the order of runs, one true measurement."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from dvo.core.errors import DvoError
from eval.benchmarks import compare_commits
from eval.benchmarks.compare_commits import (
    Cost,
    Settings,
    alternate_steps,
    costs,
    main,
    median_ratios,
    paired,
    same_trajectories,
    worktree,
)
from eval.suites.suite import ROOT


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """Two commits of a tree in which ``python -m dvo run`` writes what is in a file."""
    place = tmp_path / "repository"
    (place / "dvo").mkdir(parents=True)
    (place / "dvo/__init__.py").touch()
    (place / "dvo/__main__.py").write_text(
        "import sys\nfrom pathlib import Path\nout = Path(sys.argv[sys.argv.index('--out') + 1])\nout.mkdir()\n"
        "(out / 'trajectory.txt').write_text(Path('track').read_text() + Path(sys.argv[2]).name[0])\n"
    )

    def git(*arguments: str) -> None:
        name = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", "-C", str(place), *name, *arguments], check=True, capture_output=True)

    git("init", "-b", "main")
    for text in ("one", "two"):
        (place / "track").write_text(text)
        git("add", ".")
        git("commit", "-m", text)
    return place


def test_a_commit_is_checked_out_and_removed(repository):
    with worktree("HEAD~1", repository) as base:
        assert (base / "track").read_text() == "one" and (repository / "track").read_text() == "two"
    assert not base.exists()
    listed = subprocess.run(["git", "-C", str(repository), "worktree", "list"], capture_output=True, text=True)
    assert len(listed.stdout.splitlines()) == 1
    with pytest.raises(DvoError, match="no_such"), worktree("no_such", repository):
        pass


def test_trajectories_are_compared_byte_by_byte(repository, tmp_path):
    settings = Settings(tmp_path, clips=("a", "b"))
    assert same_trajectories(repository, repository, settings) == {"a": True, "b": True}
    with worktree("HEAD~1", repository) as base:
        assert same_trajectories(base, repository, settings) == {"a": False, "b": False}


def test_trees_take_turns_and_the_median_decides():
    base, current = Path("base"), Path("current")
    order: list[Path] = []
    times = iter([2.0, 1.0, 2.0, 4.0, 2.0, 3.0])

    def measure(tree: Path) -> dict[str, Cost]:
        order.append(tree)
        now = next(times)
        return {"track": Cost(now, 2 * now if tree == current else now), "finish": Cost(1.0, now)}

    pairs = paired(measure, base, current, 3)
    assert order == [base, current] * 3 and [one["track"] for one, _ in pairs] == [Cost(2.0, 2.0)] * 3
    assert median_ratios(pairs) == {"track": Cost(1.5, 3.0), "finish": Cost(1.0, 1.5)}


@pytest.mark.long
def test_one_measurement_of_bundle_adjustment():
    (found,) = costs("ba", ROOT, Settings(Path())).items()
    assert found[0] == "ba" and 1e-4 < found[1].processor < 10 and found[1].wall > 1e-4


def test_track_and_finish_are_told_apart_and_have_the_threads_that_are_asked_for(tmp_path, monkeypatch):
    (tmp_path / "steps.py").write_text(
        "import os, sys\nprint('SECONDS track', float(sys.argv[sys.argv.index('--threads') + 1]), 1.5)\n"
        "print('SECONDS finish', float(os.environ['OMP_NUM_THREADS']), 4.0)"
    )
    monkeypatch.setattr(compare_commits, "SCRIPT", str(tmp_path / "steps.py"))
    found = costs("tracking", tmp_path, Settings(tmp_path, threads=3))
    assert found == {"track": Cost(3.0, 1.5), "finish": Cost(3.0, 4.0)}


def test_training_steps_of_two_trees_take_turns(tmp_path, monkeypatch):
    """Each process takes as many steps as asked for; the two first of each do not count."""
    script = tmp_path / "steps.py"
    script.write_text(
        "import sys, pathlib\nprint('READY', flush=True)\n"
        "for number, _ in enumerate(sys.stdin):\n"
        "    with open('../turns', 'a') as file: file.write(pathlib.Path.cwd().name)\n"
        "    print('SECONDS training', 99 if number < 2 else 1 + ('b' == pathlib.Path.cwd().name), 7, flush=True)\n"
    )
    monkeypatch.setattr(compare_commits, "SCRIPT", str(script))
    for name in "ab":
        (tmp_path / name).mkdir()
    one, two = alternate_steps(tmp_path / "a", tmp_path / "b", 3)
    assert (one, two) == ({"training": Cost(1.0, 7.0)}, {"training": Cost(2.0, 7.0)})
    assert (tmp_path / "turns").read_text() == "ababababab"
    script.write_text("print('no')")
    with pytest.raises(DvoError, match="training failed"):
        alternate_steps(tmp_path / "a", tmp_path / "b", 1)


@pytest.mark.long
def test_failures_are_told(tmp_path, capsys):
    with pytest.raises(DvoError, match="failed"):
        costs("tracking", ROOT, Settings(tmp_path, "no such clip"))
    assert main(["--base", "HEAD", "--what", "beauty"]) == 2 and "beauty" in capsys.readouterr().err
    assert main(["--base", "HEAD", "--what", "ba", "--pairs", "0"]) == 2 and "--pairs" in capsys.readouterr().err
