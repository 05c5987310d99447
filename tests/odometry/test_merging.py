"""Merging of two maps, with the shipped weights."""

import numpy as np
import pytest

import dvo
from dvo.cli import main
from dvo.core.errors import DvoError
from dvo.odometry.merging import merge_maps
from tests.support.outcome import content
from tests.support.recorded_walk import error_of_both, map_of_room, room, street, tracked, way_back
from tests.support.tiny_tracker import frames as wall
from tests.support.tiny_tracker import network, run, tracker


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """Files of the walk, of its way back (without loops) and of another place; results of the first two; true poses."""
    folder, (frames, truth) = tmp_path_factory.mktemp("maps"), room()
    walk, back = map_of_room(folder / "walk.dvo"), tracked(way_back(frames)[:24], loops=False)
    for name, odometry in (("back", back), ("street", tracked(street(12)))):
        odometry.save(folder / f"{name}.dvo")
    return folder, [walk, back.finish()], truth


@pytest.mark.long
def test_two_maps_of_a_place_become_one(maps, tmp_path, capsys):
    folder, (walk, back), truth = maps
    out = tmp_path / "both.dvo"
    files = [str(folder / "walk.dvo"), str(folder / "back.dvo")]
    assert main(["merge", *files, "-o", str(out), "--device", "cpu"]) == 0
    assert f"map in {out}" in capsys.readouterr().out
    odometry = dvo.load_map(out)
    result, graph = odometry.finish(), odometry.graph
    assert result.info["localised"]["in_map"] and result.segments[0].in_map
    assert np.array_equal(result.trajectory.timestamps, back.trajectory.timestamps)
    assert np.array_equal(graph.log.trajectory(0).poses_wc, walk.trajectory.poses_wc)
    assert error_of_both(walk.trajectory, result.trajectory, truth) < 1.0
    assert len(graph.log.frames) == walk.frames_read + back.frames_read
    # Points of both: the joint adjustment leaves out a few others than the adjustments of the two did.
    assert len(result.map.points) == pytest.approx(len(walk.map.points) + len(back.map.points), rel=0.05)
    # A map of several recordings is extended as any other, but cannot be added to another one.
    assert len(dvo.load_map(out, new_recording=True).graph.recordings) == 2
    with pytest.raises(DvoError, match="holds 2 recordings.*Give it as the first map"):
        merge_maps(folder / "walk.dvo", out)


@pytest.mark.long
def test_maps_of_two_places_are_not_merged(maps, tmp_path, capsys):
    out = tmp_path / "both.dvo"
    assert main(["merge", str(maps[0] / "walk.dvo"), str(maps[0] / "street.dvo"), "--out", str(out)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "no place of" in line and "nothing is written" in line and not out.exists()


@pytest.mark.long
def test_maps_that_cannot_be_compared(maps, tmp_path, capsys):
    walk = maps[0] / "walk.dvo"
    odometry = dvo.load("small", device="cpu", patches=12, pixels=160 * 120)
    odometry.save(tmp_path / "patches.dvo")
    with pytest.raises(DvoError, match="has 12 patches a frame, the first map 16"):
        merge_maps(walk, tmp_path / "patches.dvo")
    odometry = dvo.load("small", device="cpu", patches=16, pixels=160 * 120)
    odometry.save(tmp_path / "empty.dvo")
    with pytest.raises(DvoError, match="working images of no size, the first map of 160x120"):
        merge_maps(walk, tmp_path / "empty.dvo")
    tiny = tracker()
    run(tiny, wall(9))
    tiny.save(tmp_path / "tiny.dvo")
    with pytest.raises(DvoError, match="other weights"):
        merge_maps(walk, tmp_path / "tiny.dvo", weights="small")
    assert main(["merge", str(walk), str(tmp_path / "none.dvo"), "-o", str(tmp_path / "x.dvo")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert content(dvo.load_map(tmp_path / "tiny.dvo", weights=network()).finish())
