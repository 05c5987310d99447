"""A small evaluation, and the film that classical odometries are tried on."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Many
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.metrics import transform
from dvo.odometry.protocol import Break, Estimate, Odometry, Result, Segment, SparseMap, Status
from eval.execution.plan import Plan, read_manifest
from eval.execution.predict import Job, Prediction, predict, predict_here
from eval.execution.runner import predict_all
from eval.scoring.score import Row, score_all
from eval.suites.suite import Sequence, Suite
from eval.systems.registry import add_system, find_system, remove_system
from eval.systems.system import System
from tests.support.flat_film import dark, film, path, rendered

# --- an evaluation on the twenty images of ``image_folder`` -----------------------------------------------------------


@pytest.fixture
def sequence() -> Sequence:
    """The twenty images."""
    return Sequence("clip", "clip/images", calib="../calib.txt", times="../times.txt", groundtruth="../truth.txt")


@pytest.fixture
def suite(sequence: Sequence) -> Suite:
    """A suite of them."""
    return Suite("tiny", "made for a test", (sequence,))


@pytest.fixture
def suite_file(tmp_path: Path) -> Path:
    """The suite as a file."""
    path = tmp_path / "tiny.yaml"
    path.write_text(
        "name: tiny\nlabel: made for a test\nsequences:\n"
        "  - {name: clip, path: clip/images, calib: ../calib.txt, times: ../times.txt, groundtruth: ../truth.txt}\n"
    )
    return path


@pytest.fixture
def job(tmp_path: Path, image_folder: Path, sequence: Sequence) -> Job:
    """The null system on them."""
    (tmp_path / "run").mkdir()
    return Job("null", sequence, str(tmp_path), str(tmp_path / "run"), threads=1)


@pytest.fixture
def systems(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """``systems(name=odometry, ...)`` puts odometries into the registry; a string is a reason to be missing."""
    module = ModuleType("systems_of_a_test")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    module.version = lambda: "9.9"  # type: ignore[attr-defined]
    names = []

    def register(**entries: Odometry | str) -> None:
        for name, thing in entries.items():
            setattr(module, name, lambda thing=thing: thing)
            setattr(module, f"missing_{name}", lambda thing=thing: thing if isinstance(thing, str) else None)
            place = module.__name__
            add_system(System(name, f"{place}:{name}", about="for a test", version_from=f"{place}:version",
                              missing_from=f"{place}:missing_{name}"))  # fmt: skip
            names.append(name)

    yield register
    for name in names:
        remove_system(name)


class Pieces:
    """Knows the answer, in segments ``[start, stop)`` of frames, each in a world and a scale of its own."""

    name = "pieces"

    def __init__(
        self,
        motion: Callable[[float], np.ndarray],
        bounds: Many[tuple[int, int]],
        joined: dict[int, int],
        breaks: tuple[Break, ...],
    ) -> None:
        self.motion, self.bounds, self.joined, self.breaks = motion, bounds, joined, breaks
        self.times: list[float] = []

    def track(self, frame: Frame) -> Estimate:
        if frame.index == 0:
            self.times = []
        self.times.append(frame.timestamp)
        inside = [n for n, (start, stop) in enumerate(self.bounds) if start <= frame.index < stop]
        if not inside:
            return Estimate(frame.timestamp, None, Status.LOST)
        return Estimate(frame.timestamp, self._pose(frame.timestamp, inside[0]), Status.TRACKING, 1.0, inside[0])

    def finish(self) -> Result:
        segments = []
        for number, (start, stop) in enumerate(self.bounds):
            times = np.array(self.times[start:stop])
            track = Trajectory(times, np.array([self._pose(time, number) for time in times]))
            segments.append(Segment(track, times[0], times[-1], self.joined.get(number)))
        longest = max(segments, key=len).trajectory
        lost = len(self.times) - sum(map(len, segments))
        return Result(longest, SparseMap(), len(self.times), lost, {}, tuple(segments), self.breaks)

    def _pose(self, seconds: float, number: int) -> np.ndarray:
        world = self.joined.get(number, number)
        one = Trajectory(np.zeros(1), self.motion(seconds)[None])
        turn = Rotation.from_rotvec([0, 0.7 * world, 0.1]).as_matrix()
        return transform(one, 1.0 + world, turn, np.full(3, 2.0 * world)).poses_wc[0]


@pytest.fixture
def pieces(fake_odometry) -> Callable[..., Pieces]:
    """``pieces((start, stop), ..., joined={segment: world}, breaks=())``, see :class:`Pieces`."""
    motion = fake_odometry().motion
    return lambda *bounds, joined=None, breaks=(): Pieces(motion, bounds, joined or {}, breaks)


@pytest.fixture
def boom() -> Callable[[], None]:
    """Raises."""

    def stop() -> None:
        raise RuntimeError("boom | with a bar\nand two lines")

    return stop


def here(job: Job) -> Prediction:
    """Run a job in this process, which is quicker and knows the systems of the test."""
    if find_system(job.system).missing():
        return predict(job)
    return predict_here(job)


@pytest.fixture
def plan(tmp_path: Path, suite: Suite) -> Plan:
    """Five systems, two seeds."""
    names = ("good", "lossy", "bad", "absent", "null")
    (tmp_path / "out").mkdir()
    return Plan((suite,), names, (0, 1), tmp_path, tmp_path / "out", threads=1)


@pytest.fixture
def rows(plan: Plan, image_folder: Path, fake_odometry, systems, boom) -> list[Row]:
    """The plan, carried out."""

    class Fresh:
        """A fake that can be used for one run after the other."""

        name = "fresh"

        def __init__(self, **options) -> None:
            self.options = options
            self.inner = fake_odometry(**options)

        def track(self, frame):
            return self.inner.track(frame)

        def finish(self):
            done, self.inner = self.inner.finish(), fake_odometry(**self.options)
            return done

    systems(
        good=Fresh(lost=(3, 4)),
        lossy=Fresh(lost=tuple(range(12))),
        bad=fake_odometry(at_frame={5: boom}),
        absent="needs a thing",
    )
    said: list[str] = []
    predict_all(plan, said.append, here)
    assert len(said) == 10
    return score_all(plan.out, read_manifest(plan.out))


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports have empty figures: drawing them takes most of the time."""
    for name in ("plot_axis", "plot_sequence", "plot_speed"):
        monkeypatch.setattr(f"eval.reporting.report.{name}", lambda *_: "<svg></svg>")


__all__ = ["dark", "film", "path", "rendered"]
