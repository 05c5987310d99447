"""Graphs in map files: what is read is what was written, and what would fail later is refused."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.map.archive import ArchiveConfig, encode_jpeg, encode_mask
from dvo.map.io.map_file import VERSION, open_map_file, write_map_file
from dvo.map.io.serialisation import graph_arrays, load_graph, save_graph
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.recordings import begin_recording
from tests.support.archived_walk import M, archived_walk


def same(a: KeyframeGraph, b: KeyframeGraph) -> None:
    """Two graphs hold the same, byte for byte."""
    (first, arrays), (second, others) = graph_arrays(a), graph_arrays(b)
    assert first == second and arrays.keys() == others.keys()
    for name, array in arrays.items():
        assert array.dtype == others[name].dtype and array.tobytes() == others[name].tobytes(), name


def walk(frames=9, dropped=(3, 4), archived=5, images=True) -> KeyframeGraph:
    """A graph in the middle of a sequence: some keyframes archived, one segment rejected, a frame lost."""
    graph, _ = archived_walk(frames, wrong=0.2, archived=False, archive=ArchiveConfig(jpeg_quality=50))
    random = np.random.default_rng(0)
    for frame in graph.window.frames:
        frame.colors = torch.from_numpy(random.integers(0, 255, (M, 3), dtype=np.uint8))
        frame.matching = torch.from_numpy(random.normal(size=(M, 8, 3, 3)).astype(np.float32))
        frame.image = random.integers(0, 255, (32, 40, 3), dtype=np.uint8) if images else None
    graph.log.add(frames * 0.1, None).lost = True
    graph.log.frames[-1].reason = "black image"
    for position in sorted(dropped, reverse=True):
        graph.drop(position)
    for _ in range(min(archived, len(graph.window))):
        graph.archive_oldest()
    graph.starts.append((frames, -1))
    return graph


@given(
    st.integers(1, 7), st.sets(st.integers(1, 6), max_size=3), st.integers(0, 7), st.booleans(), st.integers(0, 40_000)
)
@settings(max_examples=12)
def test_what_is_read_is_what_was_written(tmp_path_factory, frames, dropped, archived, images, bound):
    graph = walk(frames, [k for k in dropped if k < frames], archived, images)
    graph.archive.config = replace(graph.archive.config, max_bytes=bound)
    file = tmp_path_factory.mktemp("map") / "a.dvo"
    save_graph(file, graph)
    first = load_graph(file)
    save_graph(file, first)
    same(first, load_graph(file))
    graph.archive_window()
    if graph.archive.nbytes <= bound:
        same(graph, first)


def test_a_read_graph_releases_and_solves_as_the_one_written(tmp_path):
    graph = walk()
    before, edges = len(graph.window), len(graph.archive.edges().source)
    save_graph(tmp_path / "a.dvo", graph)
    assert len(graph.window) == before > 1 and len(graph.archive.edges().source) == edges
    found = load_graph(tmp_path / "a.dvo")
    graph.archive_window()
    same(graph, found)
    assert found.points(0)[0].tobytes() == graph.points(0)[0].tobytes() and len(found.points(0)[0])
    assert torch.equal(found.problem().targets, graph.problem().targets)
    assert np.array_equal(found.archive[0].image(), graph.archive[0].image())
    assert found.log.trajectory().poses_wc.tobytes() == graph.log.trajectory().poses_wc.tobytes()
    for one in (graph, found):  # the oldest features, edges and patches go first
        one.archive.config = replace(one.archive.config, max_bytes=4000)
        one.archive.add_part(one.archive.parts[0])
    same(graph, found)


def test_the_images_of_the_archive_are_the_jpeg_bytes(tmp_path):
    graph = walk()
    graph.archive_window()
    save_graph(tmp_path / "a.dvo", graph)
    with open_map_file(tmp_path / "a.dvo") as source:
        content = source.array("archive/jpeg", np.uint8, (None,)).tobytes()
    assert (
        content == b"".join(frame.jpeg.tobytes() for frame in graph.archive.keyframes if frame.jpeg is not None)
        and content[:2] == b"\xff\xd8"
    )
    with np.load(tmp_path / "a.dvo", allow_pickle=False) as plain:
        assert np.array_equal(plain["archive/times"], [frame.timestamp for frame in graph.archive.keyframes])


def changed(graph, **arrays):
    table, found = graph_arrays(graph)
    return {"graph": table}, found | {name.replace("__", "/"): array for name, array in arrays.items()}


WRONG = {
    "archive__poses_cw": lambda a: a * 0,
    "archive__anchors": lambda a: a + 7,
    "archive__keyframes": lambda a: a * 0,
    "archive__jpeg_bytes": lambda a: a + 1,
    "archive__inverse_depth": lambda a: a.astype(np.float64),
    "archive__intrinsics": lambda a: a * 0,
    "archive__jpeg": lambda a: a * 0,
    "edges__patch": lambda a: a + np.int16(M),
    "edges__parts": lambda a: a + 1,
    "log__removed": lambda a: a[:, ::-1].copy(),
    "log__times": lambda a: a * 0,
    "log__reasons": lambda a: a + 2,
    "segments": lambda a: a + 1,
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_content_is_refused_by_the_name_of_its_array(name, tmp_path):
    graph = walk()
    array = graph_arrays(graph)[1][name.replace("__", "/")]
    write_map_file(tmp_path / "a.dvo", *changed(graph, **{name: WRONG[name](array)}))
    with pytest.raises(DvoError) as caught:
        load_graph(tmp_path / "a.dvo")
    assert caught.value.file == tmp_path / "a.dvo" and caught.value.field and caught.value.remedy
    assert caught.value.field.split("/")[0] == name.split("__")[0]


def test_images_of_another_size_are_refused(tmp_path):
    graph = walk()
    small = encode_jpeg(np.zeros((8, 8, 3), np.uint8), 50)
    graph.archive.add(replace(graph.archive[0], jpeg=small))
    save_graph(tmp_path / "a.dvo", graph)
    with pytest.raises(DvoError, match="different sizes"):
        load_graph(tmp_path / "a.dvo")


@pytest.mark.parametrize(("shape", "jpeg"), [((8, 8), True), ((32, 40), False)])
def test_masks_without_an_image_of_their_size_are_refused(shape, jpeg, tmp_path):
    graph = walk()
    first = graph.archive[0]
    mask = encode_mask(np.ones(shape, bool))
    graph.archive.add(replace(first, mask=mask, jpeg=first.jpeg if jpeg else None))
    save_graph(tmp_path / "a.dvo", graph)
    with pytest.raises(DvoError, match="masks without an image"):
        load_graph(tmp_path / "a.dvo")


@pytest.mark.parametrize(
    ("description", "match"),
    [
        ({"version": VERSION + 1}, f"newer than {VERSION}.*Update dvo"),
        ({"version": "one"}, "version"),
        ({"format": "zip"}, "not a map of dvo"),
        ({"graph": None}, "graph: expected a table"),
        ({"graph": {"per_frame": 3}}, "incomplete"),
        ({"graph": {"per_frame": 10**18}}, "graph"),
    ],
)
def test_descriptions_that_are_refused(description, match, tmp_path):
    write_map_file(tmp_path / "a.dvo", {"graph": graph_arrays(walk())[0], **description}, {})
    with pytest.raises(DvoError, match=match):
        load_graph(tmp_path / "a.dvo")


def test_files_that_are_no_maps(tmp_path):
    file = tmp_path / "a.dvo"
    with pytest.raises(DvoError, match="no such file"):
        load_graph(file)
    save_graph(file, walk())
    whole = file.read_bytes()
    for content in (b"", b"text", whole[: len(whole) // 2], whole[:-30]):
        file.write_bytes(content)
        with pytest.raises(DvoError, match="not a map file"):
            load_graph(file)
    file.write_bytes(whole.replace(b"NUMPY", b"PUMPY", 5))
    with pytest.raises(DvoError, match="damaged"):
        load_graph(file)


def test_a_compressed_entry_is_refused_before_it_is_read(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.dvo", "w", zipfile.ZIP_DEFLATED) as container:
        container.writestr("map.json", json.dumps({"format": "dvo-map", "version": 1}))
        container.writestr("log/times.npy", bytes(10**7))
    with pytest.raises(DvoError, match="compressed"):
        load_graph(tmp_path / "a.dvo")


def test_an_existing_file_stays_if_the_new_one_cannot_be_written(tmp_path, monkeypatch):
    graph = walk()
    save_graph(tmp_path / "a.dvo", graph)
    before = (tmp_path / "a.dvo").read_bytes()

    def full(*args: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(zipfile.ZipFile, "writestr", full)
    with pytest.raises(DvoError, match="No space left"):
        save_graph(tmp_path / "a.dvo", graph)
    assert (tmp_path / "a.dvo").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_a_copy_of_a_graph_and_the_graph_change_on_their_own():
    graph, other = walk(), walk()
    copy = graph.copy()
    same(copy, graph)
    copy.log.frames[0].lost = True
    copy.window.frames[0].slopes = torch.ones(M, 2)
    copy.archive_window()
    copy.begin_segment(9)
    copy.correct(0, np.array([1.0, 2, 3, 0, 0, 0, 1]))
    copy.metric[0], copy.worlds[0] = "depth", 0
    begin_recording(copy)
    copy.archive.config = replace(copy.archive.config, max_bytes=0)
    copy.archive.add_part(copy.archive.parts[0])
    assert not len(copy.window) and not copy.archive.parts and len(graph.window) == len(other.window) > 0
    assert graph.window.slopes is None and torch.equal(graph.window.kk, other.window.kk)
    same(graph, other)
    second = graph.copy()
    graph.archive_window()
    same(second, other)
