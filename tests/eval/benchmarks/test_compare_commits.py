"""Comparison with an earlier commit: the checkout, the order of runs, one true measurement."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from dvo.core.errors import DvoError
from eval.benchmarks import compare_commits
from eval.benchmarks.compare_commits import (
    Settings,
    alternate_steps,
    main,
    median_ratio,
    paired,
    same_trajectories,
    seconds,
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

    def measure(tree: Path) -> float:
        order.append(tree)
        return next(times)

    pairs = paired(measure, base, current, 3)
    assert order == [base, current] * 3 and pairs == [(2.0, 1.0), (2.0, 4.0), (2.0, 3.0)]
    assert median_ratio(pairs) == 1.5


def test_one_measurement_of_bundle_adjustment():
    assert 1e-4 < seconds("ba", ROOT, Settings(Path())) < 10


def test_training_steps_of_two_trees_take_turns(tmp_path, monkeypatch):
    """Each process takes as many steps as asked for; the two first of each do not count."""
    script = tmp_path / "steps.py"
    script.write_text(
        "import sys, pathlib\nprint('READY', flush=True)\n"
        "for number, _ in enumerate(sys.stdin):\n"
        "    with open('../turns', 'a') as file: file.write(pathlib.Path.cwd().name)\n"
        "    print('SECONDS', 99 if number < 2 else 1 + ('b' == pathlib.Path.cwd().name), flush=True)\n"
    )
    monkeypatch.setattr(compare_commits, "SCRIPT", str(script))
    for name in "ab":
        (tmp_path / name).mkdir()
    assert alternate_steps(tmp_path / "a", tmp_path / "b", 3) == (1.0, 2.0)
    assert (tmp_path / "turns").read_text() == "ababababab"
    script.write_text("print('no')")
    with pytest.raises(DvoError, match="training failed"):
        alternate_steps(tmp_path / "a", tmp_path / "b", 1)


def test_failures_are_told(tmp_path, capsys):
    with pytest.raises(DvoError, match="failed"):
        seconds("tracking", ROOT, Settings(tmp_path, "no such clip"))
    assert main(["--base", "HEAD", "--what", "beauty"]) == 2 and "beauty" in capsys.readouterr().err
    assert main(["--base", "HEAD", "--what", "ba", "--pairs", "0"]) == 2 and "--pairs" in capsys.readouterr().err
