"""Exports by name: folders, segments, and what cannot be exported."""

import numpy as np
import pytest
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory, read_tum
from dvo.export.formats import (
    MAP_FORMATS,
    check_formats,
    describe_rows,
    export_graph,
    export_map,
    export_run,
    export_trajectory,
)
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.odometry.protocol import Result, Segment, SparseMap
from tests.support.archived_walk import archived_walk
from tests.support.command_line import names
from tests.support.reconstructions import walk


class Tracker:
    """Odometry with a keyframe graph, as far as an export is concerned."""

    name = "walker"

    def __init__(self, graph: KeyframeGraph) -> None:
        self.graph = graph


def poses(count, start=0.0):
    return Trajectory(start + 0.1 * np.arange(count), np.tile([1.0, 2, 3, 0, 0, 0, 1], (count, 1)))


@pytest.mark.parametrize(
    ("name", "files"),
    [("colmap", ["images", "sparse", "times.txt"]), ("colmap-text", ["images", "sparse", "times.txt"]),
     ("nerfstudio", ["images", "sparse_pc.ply", "times.txt", "transforms.json"])],
)  # fmt: skip
def test_maps(name, files, tmp_path):
    found = dvo.export_map(Tracker(walk(6)), tmp_path / "out", name)
    assert names(tmp_path / "out") == files and names(tmp_path) == ["out"]
    again = export_graph(walk(6), 0, name, tmp_path / "deep" / "er")
    assert str(again) == str(found) and len(found.jpegs) == 6
    for file in (tmp_path / "out").rglob("*"):
        if file.is_file():
            assert file.read_bytes() == (tmp_path / "deep" / "er" / file.relative_to(tmp_path / "out")).read_bytes()


def test_an_empty_folder_is_filled_and_any_other_refused(tmp_path, monkeypatch):
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    dvo.export_trajectory(poses(3), ".", "tum")
    assert names(tmp_path / "empty") == ["trajectory.txt"]
    with pytest.raises(DvoError, match="is not an empty folder. Give a new folder"):
        dvo.export_trajectory(poses(3), tmp_path / "empty", "kitti")
    (tmp_path / "file").write_text("")
    with pytest.raises(DvoError, match="is not an empty folder"):
        export_map(walk(4), tmp_path / "file")
    with pytest.raises(DvoError, match="cannot be written"):
        export_trajectory(poses(3), tmp_path / "file" / "out", "kitti")
    assert names(tmp_path) == ["empty", "file"]


def test_an_export_that_fails_leaves_nothing(tmp_path, monkeypatch):
    def fail(reconstruction, folder):
        (folder / "half").write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("dvo.export.colmap.write_colmap", fail)
    with pytest.raises(DvoError, match="No space left"):
        export_map(walk(4), tmp_path / "out")
    assert names(tmp_path) == []


def test_a_map_needs_a_graph_that_is_finished(tmp_path, fake_odometry):
    with pytest.raises(DvoError, match=r"fake keeps no keyframe graph.*trajectory format: tum, kitti, euroc"):
        dvo.export_map(fake_odometry(), tmp_path / "out")
    graph, _ = archived_walk(8, archived=False)
    with pytest.raises(DvoError, match=r"not finished. Call finish\(\)"):
        dvo.export_map(Tracker(graph), tmp_path / "out")
    with pytest.raises(DvoError, match="no map format 'ply'. Use one of colmap, colmap-text, nerfstudio"):
        export_map(walk(4), tmp_path / "out", "ply")
    with pytest.raises(DvoError, match="segment 2: no archived keyframes"):
        export_map(walk(4), tmp_path / "out", segment=2)
    with pytest.raises(DvoError, match="no trajectory format 'colmap'"):
        export_trajectory(poses(3), tmp_path / "out", "colmap")
    with pytest.raises(DvoError, match="no poses"):
        export_trajectory(poses(0), tmp_path / "out")
    assert names(tmp_path) == []


def test_names_are_checked_before_a_run(fake_odometry):
    check_formats(["colmap", "nerfstudio", "kitti"])
    check_formats(["tum", "kitti", "euroc"], fake_odometry())
    check_formats(["colmap"], Tracker(walk(4)))
    check_formats(["colmap"], PatchOdometry(dvo.load_model("small"), dvo.TrackerConfig(), device=torch.device("cpu")))
    with pytest.raises(DvoError, match="no keyframe graph"):
        check_formats(["kitti", "colmap"], fake_odometry())
    with pytest.raises(DvoError, match="no export format 'obj'. Use one or more of colmap"):
        check_formats(["obj"])


def result(*parts, lost=0):
    segments = tuple(Segment(part, part.timestamps[0], part.timestamps[-1]) for part in parts)
    longest = max(parts, key=len)
    return Result(longest, SparseMap(), sum(map(len, parts)) + lost, lost, segments=segments)


def test_exports_of_a_run_lie_beside_each_other_and_replace_nothing(tmp_path):
    odometry = Tracker(walk(6))
    out = tmp_path / "export"
    export_run(odometry, result(poses(6)), ["colmap", "tum"], out)
    said = export_run(odometry, result(poses(6), lost=2), ["nerfstudio", "kitti"], out)
    assert names(out) == ["colmap", "kitti", "nerfstudio", "tum"]
    assert said[0].startswith("nerfstudio: 6 images, ") and "reprojection error 0.0" in said[0]
    assert said[1] == "kitti: 6 poses; 2 of 8 frames have no pose in it and no row; times.txt has the time of each row"
    with pytest.raises(DvoError, match="not an empty folder"):
        export_run(odometry, result(poses(6)), ["tum"], out)


def test_every_segment_of_a_run_has_a_trajectory(tmp_path):
    parts = poses(4), poses(7, 10.0)
    said = export_run(Tracker(walk(4)), result(*parts), ["euroc", "tum"], tmp_path)
    assert names(tmp_path / "tum") == ["segment-0", "segment-1", "trajectory.txt"]
    for path, part in (("", parts[1]), ("segment-0", parts[0]), ("segment-1", parts[1])):
        found = read_tum(tmp_path / "tum" / path / "trajectory.txt")
        np.testing.assert_allclose(found.timestamps, part.timestamps)
    assert said == ["euroc: 7 poses", "tum: 7 poses"]


def test_rows_of_a_format_with_times_need_no_note():
    assert describe_rows("euroc", 5, 9) == "5 poses"
    assert describe_rows("kitti", 5, 5) == describe_rows("kitti", 5, None)


def test_another_package_can_add_a_format(tmp_path):
    MAP_FORMATS.register("count", "tests.export.test_formats:write_count")
    try:
        export_map(walk(5), tmp_path / "out", "count")
    finally:
        MAP_FORMATS.unregister("count")
    assert (tmp_path / "out" / "count.txt").read_text() == "5"


def write_count(reconstruction, folder):
    (folder / "count.txt").write_text(str(len(reconstruction.jpegs)))
