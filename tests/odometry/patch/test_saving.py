"""Maps in files: saving leaves the tracker as it is, and a loaded map is that of the moment."""

import json
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.map.io.serialisation import load_graph, save_graph
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import LoadedWeights, save_weights
from dvo.nets.patch.config import preset
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.protocol import Status
from dvo.synth.sequence import make_sequence
from tests.support.outcome import content
from tests.support.saved_maps import FAST, check_saved_run, rewritten
from tests.support.tiny_tracker import SMALL, frames, network, run, tracker


@pytest.mark.slow
@pytest.mark.parametrize(
    ("operator", "settings"),
    [
        ("gated", {}),
        ("gated", {"keyframe_motion": 1e9}),
        ("gated", {"align_slope": 0.03, "align_reach": 100.0}),
        ("mamba", {"align": "none", "initial_pose": "nearest", "selection": "structure", "restart": False}),
    ],
)
def test_saving_changes_nothing(operator, settings, tmp_path):
    """Before the first frame, before the initialisation, just after it, and mid-way."""
    config = replace(SMALL, **settings)
    new = lambda: tracker(config, operator=operator)  # noqa: E731
    at = (5, 13) if settings else (0, 1, 3, 5, 6, 12, 13)
    estimates, _ = check_saved_run(new, frames(18), at, tmp_path, network(operator))
    assert [e.status for e in estimates[:6]].count(Status.INITIALISING) in (4, 5)


@pytest.fixture(scope="module")
def interrupted():
    """Frames of a room with a repeated image, another scene, the room again, and darkness."""
    size = {"height": 120, "width": 160, "fps": 15.0, "sensor": False}
    film = list(make_sequence(61, frames=38, family="room", kind="handheld", speed=3.0, **size))
    other = list(make_sequence(62, frames=12, family="corridor", kind="handheld", speed=3.0, **size))
    images = [frame.image for frame in film]
    images[11] = images[10]
    images[14:26] = [frame.image for frame in other]
    images[17] = images[16]
    images[34] = np.zeros_like(images[0])
    return [replace(frame, image=image) for frame, image in zip(film, images, strict=True)]


@pytest.mark.slow
def test_saving_changes_nothing_while_lost_and_after_a_change_of_segment(interrupted, tmp_path):
    """With the shipped weights, by their name; while views wait to be joined, one of them repeated."""
    new = lambda: dvo.load("small", **FAST)  # noqa: E731
    estimates, result = check_saved_run(new, interrupted, (13, 19, 24, 35), tmp_path)
    assert estimates[18].status is Status.LOST and estimates[34].reason == "black image"
    assert estimates[23].segment == 1 and len(result.segments) == 3


@pytest.mark.slow
def test_a_sequence_that_was_not_initialised_is_closed_in_the_file_as_by_finish(tmp_path):
    still = replace(SMALL, initial_parallax=1e9)
    for config, count in ((SMALL, 3), (still, 8), (still, 30)):
        odometry = tracker(config)
        for frame in frames(count):
            odometry.track(frame)
        odometry.save(tmp_path / "a.dvo")
        rows = len(odometry.window)
        result = odometry.finish()
        found = dvo.load_map(tmp_path / "a.dvo", weights=network())
        assert content(found.finish()) == content(result) and rows > 2
        assert len(result.trajectory) == len(result.map.points) == 0


def test_measurements_of_the_window_are_aligned_in_the_file(tmp_path):
    """As those that leave the window; the tracker's own are not touched."""
    odometry = tracker(replace(SMALL, align_reach=100.0))
    for frame in frames(12):
        odometry.track(frame)
    targets, count = odometry.window.targets.clone(), len(odometry.graph.archive.parts)
    odometry.save(tmp_path / "a.dvo")
    assert torch.equal(odometry.window.targets, targets) and len(odometry.graph.archive.parts) == count
    saved_edges = load_graph(tmp_path / "a.dvo").archive.edges()
    while len(odometry.window):
        odometry.graph.archive_oldest()
    edges = odometry.graph.archive.edges()
    assert np.array_equal(saved_edges.position, edges.position) and np.array_equal(saved_edges.weight, edges.weight)


def test_a_map_is_read_in_another_place(tmp_path, monkeypatch):
    """The network is a file, which the map names; the place of the process does not matter."""
    monkeypatch.chdir(tmp_path)
    save_weights(tmp_path / "tiny.safetensors", PatchVO(preset("tiny")), {})
    odometry = dvo.load("tiny.safetensors", config=SMALL)
    run(odometry, frames(9))
    odometry.save(tmp_path / "a.dvo")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert content(dvo.load_map(tmp_path / "a.dvo").finish()) == content(odometry.finish())


def test_a_map_that_was_loaded_is_saved_again_with_the_same_bytes(tmp_path):
    odometry = tracker()
    for frame in frames(9):
        odometry.track(frame)
    odometry.save(tmp_path / "a.dvo")
    for name in "bc":
        found = dvo.load_map(tmp_path / "a.dvo", weights=network(), seed=4, updates=2)
        if name == "c":
            found.finish()
        assert found.seed == 4 and found.config.updates == 2
        found.weights = odometry.weights
        found.save(tmp_path / f"{name}.dvo")
        assert (tmp_path / f"{name}.dvo").read_bytes() == (tmp_path / "a.dvo").read_bytes()


def test_a_finished_map_is_a_map_and_takes_no_frames(tmp_path):
    odometry = tracker()
    _, result = run(odometry, frames(12))
    odometry.save(tmp_path / "a.dvo")
    found = dvo.load_map(tmp_path / "a.dvo", weights=network())
    assert content(found.finish()) == content(result)
    with pytest.raises(DvoError, match="finished"):
        found.track(frames(13)[-1])
    with pytest.raises(DvoError, match=r"new_recording: .*Leave new_recording out"):
        dvo.load_map(tmp_path / "a.dvo", weights=network(), new_recording=False)
    graph = load_graph(tmp_path / "a.dvo")
    assert graph.points(0)[0].tobytes() == result.map.points.tobytes()
    assert graph.archive[0].image().shape == (72, 96, 3)


@pytest.fixture(scope="module")
def nine(tmp_path_factory):
    """Map file of a tracker on nine frames."""
    file, odometry = tmp_path_factory.mktemp("maps") / "nine.dvo", tracker()
    for frame in frames(9):
        odometry.track(frame)
    odometry.save(file)
    return file


@pytest.fixture
def saved(nine, tmp_path):
    """Copy of it that may be changed."""
    return Path(shutil.copy(nine, tmp_path / "a.dvo"))


WRONG = [
    ({"map.config": {"patches": -1}}, {}, "patches"),
    ({"map.config": {}}, {}, "graph"),
    ({"map.readout": -1.0}, {}, "readout"),
    ({"map.initialised": 3}, {}, "initialised"),
    ({"map.info": []}, {}, "info"),
    ({"graph.hidden": 96}, {}, "graph"),
    ({"loops.loops": [{}]}, {}, "loops"),
    ({"loops.loops": [{"old": 0, "new": 99, "kind": "", "inliers": 1.0, "count": 1, "joins": False}]},
     {"loops/measurements": lambda a: np.array([[0.0, 0, 0, 0, 0, 0, 1, 1]])}, "loops"),
    ({}, {"segments": lambda a: a[:1]}, "segments"),
    ({}, {"archive/matching": lambda a: np.repeat(a, 2, 2)}, "archive/matching"),
    ({}, {"archive/context": lambda a: np.repeat(a, 2, 2)}, "archive/context"),
    ({}, {"places/identifiers": lambda a: a[:0] - 1.0}, "identifiers"),
    ({}, {"places/identifiers": lambda a: np.array([99]), "places/descriptors": lambda a: np.zeros((1, 1), np.float16)},
     "identifiers"),
]  # fmt: skip


@pytest.mark.parametrize(("description", "arrays", "match"), WRONG)
def test_a_map_that_would_fail_later_is_refused(description, arrays, match, saved):
    rewritten(saved, description, arrays)
    with pytest.raises(DvoError, match=match) as caught:
        dvo.load_map(saved, weights=network())
    assert caught.value.file == saved and caught.value.field and caught.value.remedy


def test_other_weights_are_refused(saved, tmp_path):
    with pytest.raises(DvoError, match="no name.*Give the file of the weights"):
        dvo.load_map(saved)
    torch.manual_seed(7)
    other = LoadedWeights.of(PatchVO(preset("tiny")), "other")
    for weights in (other, "small"):
        with pytest.raises(DvoError, match="other weights than"):
            dvo.load_map(saved, weights=weights)
    rewritten(saved, {"weights.name": str(tmp_path / "gone.safetensors")}, {})
    with pytest.raises(DvoError, match="weights are not found"):
        dvo.load_map(saved)


def test_a_graph_alone_is_no_tracker(tmp_path):
    save_graph(tmp_path / "a.dvo", tracker().graph)
    with pytest.raises(DvoError, match="graph without a tracker.*load_graph"):
        dvo.load_map(tmp_path / "a.dvo")


def test_the_description_is_readable(nine):
    with zipfile.ZipFile(nine) as container:
        found = json.loads(container.read("map.json"))
    assert (found["format"], found["version"]) == ("dvo-map", 3)
    assert TrackerConfig.from_dict(found["map"]["config"]) == SMALL
