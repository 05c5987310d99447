"""Trackers in files: a sequence that is cut anywhere goes on as if it had not been, bit for bit."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

import dvo
from dvo.errors import DvoError
from dvo.graph.map_file import open_map_file, write_map_file
from dvo.graph.serialisation import load_graph, save_graph
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import LoadedWeights, save_weights
from dvo.nets.config import preset
from dvo.odometry.config import TrackerConfig
from dvo.odometry.protocol import Status
from dvo.synth.sequence import make_sequence
from tests.odometry.test_tracker import SMALL, frames, run, tracker

FAST = {"pixels": 160 * 120, "patches": 12, "lifetime": 5, "removal": 6, "initial_updates": 6, "final_updates": 2}


def network(operator="gated"):
    return LoadedWeights.of(tracker(operator=operator).model, "tiny")


def content(result):
    """All of a result as bytes."""
    rows = [
        segment.trajectory.poses_wc.tobytes() + segment.trajectory.timestamps.tobytes() for segment in result.segments
    ]
    return [*rows, result.map.points.tobytes(), result.map.colors.tobytes(), repr(result.breaks), repr(result.info)]


def told(estimate):
    pose = None if estimate.pose_wc is None else estimate.pose_wc.tobytes()
    covariance = None if estimate.covariance is None else estimate.covariance.tobytes()
    known = estimate.confidence, estimate.reference, covariance
    return estimate.timestamp, pose, estimate.status, known, estimate.segment, estimate.reason


def check_cuts(new, images, cuts, folder, weights=None):
    """Track everything, saving at the cuts, and go on from each of the files."""
    whole, estimates = new(), []
    for number, frame in enumerate(images):
        if number in cuts:
            whole.save(folder / f"{number}.dvo")
        estimates.append(whole.track(frame))
    result = whole.finish()
    for cut in cuts:
        found = dvo.load_map(folder / f"{cut}.dvo", weights=weights)
        assert [told(found.track(frame)) for frame in images[cut:]] == [told(e) for e in estimates[cut:]], cut
        assert content(found.finish()) == content(result), cut
    return estimates, result


@pytest.mark.parametrize(
    ("operator", "settings"),
    [
        ("gated", {}),
        ("gated", {"align": "always", "keyframe_motion": 1e9}),
        ("gated", {"align_slope": 0.03, "align_reach": 100.0}),
        ("mamba", {"align": "none", "initial_pose": "nearest", "selection": "structure", "restart": False}),
    ],
)
def test_going_on_from_a_file(operator, settings, tmp_path):
    """Before the first frame, before the initialisation, just after it, and mid-way."""
    config = replace(SMALL, **settings)
    new = lambda: tracker(config, operator=operator)  # noqa: E731
    estimates, _ = check_cuts(new, frames(18), (0, 1, 3, 5, 12), tmp_path, network(operator))
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


def test_going_on_while_lost_and_after_a_change_of_segment(interrupted, tmp_path):
    """With the shipped weights, by their name; while views wait to be joined, one of them repeated."""
    new = lambda: dvo.load("small", **FAST)  # noqa: E731
    estimates, result = check_cuts(new, interrupted, (19, 35), tmp_path)
    assert estimates[18].status is Status.LOST and estimates[34].reason == "black image"
    assert estimates[23].segment == 1 and len(result.segments) == 3


PROGRAM = """
import sys, torch
torch.set_num_threads(1)
import dvo
from tests.odometry.test_saving import content, frames
import hashlib
odometry = dvo.load_map(sys.argv[1])
for frame in frames(14)[int(sys.argv[2]):]:
    odometry.track(frame)
odometry.save(sys.argv[1])
print(hashlib.sha256(repr(content(odometry.finish())).encode()).hexdigest())
"""


def test_another_process_goes_on(tmp_path, repository):
    """The network is a file, which the map names; the process sets its threads as this one."""
    import hashlib

    save_weights(tmp_path / "tiny.safetensors", PatchVO(preset("tiny")), {})
    new = lambda: dvo.load(str(tmp_path / "tiny.safetensors"), config=SMALL)  # noqa: E731
    first = new()
    for frame in frames(14)[:9]:
        first.track(frame)
    first.save(tmp_path / "a.dvo")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "a.dvo"), "9"],
        cwd=repository, env={**os.environ, "PYTHONPATH": str(repository)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    result = run(new(), frames(14))[1]
    assert done.stdout.split()[-1] == hashlib.sha256(repr(content(result)).encode()).hexdigest()
    assert content(dvo.load_map(tmp_path / "a.dvo").finish()) == content(result)


def test_saving_changes_nothing_and_equal_states_give_equal_files(tmp_path):
    one, two = tracker(), tracker()
    for frame in frames(10):
        one.track(frame)
        one.save(tmp_path / "a.dvo")
        two.track(frame)
    two.save(tmp_path / "b.dvo")
    assert (tmp_path / "a.dvo").read_bytes() == (tmp_path / "b.dvo").read_bytes()
    assert content(one.finish()) == content(two.finish())


def test_a_finished_map_is_a_map_and_takes_no_frames(tmp_path):
    odometry = tracker()
    _, result = run(odometry, frames(12))
    odometry.save(tmp_path / "a.dvo")
    found = dvo.load_map(tmp_path / "a.dvo", weights=network())
    assert content(found.finish()) == content(result)
    with pytest.raises(DvoError, match="finished"):
        found.track(frames(13)[-1])
    graph = load_graph(tmp_path / "a.dvo")
    assert graph.points(0)[0].tobytes() == result.map.points.tobytes()
    assert graph.archive[0].image().shape == (72, 96, 3)


def saved(tmp_path, count=9, **settings):
    odometry = tracker(replace(SMALL, **settings))
    for frame in frames(count):
        odometry.track(frame)
    odometry.save(tmp_path / "a.dvo")
    return tmp_path / "a.dvo"


def rewritten(file, description, arrays):
    """Change values of the tracker and arrays of a map file."""
    with open_map_file(file) as source:
        found = source.description
        held = {name.removesuffix(".npy"): array for name, array in np.load(file).items() if name != "map.json"}
    for name, value in description.items():
        table, _, entry = name.partition(".")
        found[table][entry] = value
    held |= {name: change(held[name]) for name, change in arrays.items()}
    write_map_file(file, found, held)


WRONG = [
    ({"tracker.keyframes": 3}, {}, "keyframes"),
    ({"tracker.finished": True}, {}, "finished"),
    ({"tracker.last": None}, {}, "last"),
    ({"tracker.size": None}, {}, "size"),
    ({"tracker.size": [640, 480], "tracker.config": {}}, {}, "graph"),
    ({"tracker.size": [640, 300]}, {}, "last_image"),
    ({"tracker.new": 99.0}, {}, "new"),
    ({"tracker.intervals": [0.0]}, {}, "intervals"),
    ({"tracker.intervals": [0.1] * 99}, {}, "intervals"),
    ({"tracker.waiting": [[3]]}, {}, "waiting"),
    ({"tracker.waiting": [[300]]}, {}, "waiting"),
    ({"tracker.config": {"patches": -1}}, {}, "patches"),
    ({"graph.hidden": 96}, {}, "graph"),
    ({}, {"tracker/generator": lambda a: a[:-1]}, "generator"),
    ({}, {"tracker/origins": lambda a: a + 1000}, "origins"),
    ({}, {"window/patches": lambda a: a + 500}, "patches"),
    ({}, {"window/has_image": lambda a: a * 0, "window/images": lambda a: a[:0]}, "images"),
    ({}, {"window/matching": lambda a: np.repeat(a, 2, 2)}, "matching"),
    ({}, {"window/map_slots": lambda a: a + 1000}, "slots"),
    ({}, {"alignment/images": lambda a: a[:2]}, "images"),
]


@pytest.mark.parametrize(("description", "arrays", "match"), WRONG)
def test_a_state_that_would_fail_later_is_refused(description, arrays, match, tmp_path):
    file = saved(tmp_path)
    rewritten(file, description, arrays)
    with pytest.raises(DvoError, match=match) as caught:
        dvo.load_map(file, weights=network())
    assert caught.value.file == file and caught.value.field and caught.value.remedy


def test_other_weights_are_refused(tmp_path):
    file = saved(tmp_path)
    with pytest.raises(DvoError, match="no name.*Give the file of the weights"):
        dvo.load_map(file)
    torch.manual_seed(7)
    other = LoadedWeights.of(PatchVO(preset("tiny")), "other")
    for weights in (other, "small"):
        with pytest.raises(DvoError, match="other weights than"):
            dvo.load_map(file, weights=weights)
    rewritten(file, {"weights.name": str(tmp_path / "gone.safetensors")}, {})
    with pytest.raises(DvoError, match="weights are not found"):
        dvo.load_map(file)


def test_a_graph_alone_is_no_tracker(tmp_path):
    save_graph(tmp_path / "a.dvo", tracker().graph)
    with pytest.raises(DvoError, match="graph without a tracker.*load_graph"):
        dvo.load_map(tmp_path / "a.dvo")


def test_the_description_is_readable(tmp_path):
    import zipfile

    with zipfile.ZipFile(saved(tmp_path)) as container:
        found = json.loads(container.read("map.json"))
    assert (found["format"], found["version"]) == ("dvo-map", 2)
    assert TrackerConfig.from_dict(found["tracker"]["config"]) == SMALL
