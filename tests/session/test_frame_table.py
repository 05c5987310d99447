"""The table of the frames: what it says of each, and its file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.recordings import begin_recording
from dvo.map.window import Keyframe
from dvo.odometry.protocol import Estimate, Status
from dvo.session import session
from dvo.session.frame_table import FrameRow, FrameTable, keyframe_times, near, read_frames, write_frames

CAMERA = Camera(50, 50, 31.5, 23.5, 64, 48)


def tracked(odometry, count=10, **options):
    table = FrameTable()
    images = (Frame(k, 100 + 0.1 * k, np.zeros((48, 64, 3), np.uint8), CAMERA) for k in range(count))
    return table, session.run(odometry, images, on_frame=table.update, **options)


def test_rows_tell_status_segment_and_time(fake_odometry):
    table, run = tracked(fake_odometry(lost=(3, 4), new_segment=(5,)))
    truth = np.arange(30.0).reshape(10, 3)
    truth[7] = np.nan
    rows = table.rows(run, [100.0, 100.6], truth)
    assert [row.status for row in rows] == ["tracking"] * 3 + ["lost"] * 2 + ["tracking"] * 5
    assert [row.segment for row in rows] == [0, 0, 0, None, None, 1, 1, 1, 1, 1]
    assert [row.reason for row in rows if row.reason] == ["black image"] * 2
    assert [k for k, row in enumerate(rows) if row.keyframe] == [0, 6]
    assert [row.seconds for row in rows] == list(run.frame_seconds)
    assert rows[6].true_position == (18, 19, 20) and rows[7].true_position is None
    assert table.rows(run, None)[0].keyframe is None


def test_skipped_frames_have_no_time_and_the_last_one_is_tracked(fake_odometry):
    table, run = tracked(fake_odometry(), count=9, stride=5)
    rows = table.rows(run, None)
    assert [row.status for row in rows] == ["tracking", *["skipped"] * 4, "tracking", *["skipped"] * 2, "tracking"]
    assert [row.seconds for row in rows if row.seconds is not None] == list(run.frame_seconds)
    assert all(row.segment == 0 for row in rows), "skipped frames have poses"


def test_the_file_gives_the_rows_back(tmp_path, fake_odometry):
    table, run = tracked(fake_odometry(lost=(3,), reason='a "reason", with commas'))
    rows = table.rows(run, [100.0], np.full((10, 3), 0.25))
    write_frames(tmp_path / "frames.csv", rows)
    back = read_frames(tmp_path / "frames.csv")
    assert back[3].reason == 'a "reason", with commas' and back[3].segment is None
    for row, same in zip(rows, back, strict=True):
        assert (row.status, row.segment, row.keyframe, row.true_position) == (
            same.status, same.segment, same.keyframe, same.true_position,
        )  # fmt: skip
        assert same.timestamp == pytest.approx(row.timestamp, abs=1e-9)
        assert same.seconds == pytest.approx(row.seconds, abs=1e-4)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "header"),
        ("time,status\n", "header"),
        ("{header}\n1.0,tracking\n", "line 2"),
        ("{header}\n1.0,asleep,,,,,,,,,,\n", "unknown status 'asleep'"),
        ("{header}\n1.0,tracking,one,,,,,,,,,\n", "line 2"),
        ("{header}\nnan,tracking,,,,,,,,,,\n", "timestamp is not finite"),
        ("{header}\n,tracking,,,,,,,,,,\n", "no timestamp"),
    ],
)
def test_a_table_that_is_none(tmp_path, text, problem):
    file = tmp_path / "frames.csv"
    write_frames(file, [])
    file.write_text(text.replace("{header}", file.read_text().strip()))
    with pytest.raises(DvoError, match=problem) as caught:
        read_frames(file)
    assert caught.value.file == file


def test_sigmas_are_kept_and_tables_without_them_are_read(tmp_path, fake_odometry):
    _, run = tracked(fake_odometry(), count=2)
    table, pose = FrameTable(), np.array([0.0, 0, 0, 0, 0, 0, 1])
    covariance = np.diag([1e-8, 4e-8, 4e-8, 0, 0, 1e-6])
    estimates = Estimate(100.0, None, Status.LOST), Estimate(100.1, pose, Status.TRACKING, covariance=covariance)
    for k, estimate in enumerate(estimates):
        table.update(Frame(k, estimate.timestamp, np.zeros((48, 64, 3), np.uint8), CAMERA), estimate)
    file = tmp_path / "frames.csv"
    write_frames(file, table.rows(run, None))
    lost, found = read_frames(file)
    assert lost.position_sigma is None and lost.rotation_sigma is None
    assert found.position_sigma == 3e-4 and found.rotation_sigma == pytest.approx(np.rad2deg(1e-3), rel=1e-3)
    lines = file.read_text().splitlines()
    assert lines[0].endswith(",position_sigma,rotation_sigma")
    file.write_text("\n".join(line.rsplit(",", 2)[0] for line in lines))
    assert read_frames(file) == [lost, replace(found, position_sigma=None, rotation_sigma=None)]


def test_no_table(tmp_path):
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    for name in ("none.csv", "bytes.csv"):
        with pytest.raises(DvoError, match=name):
            read_frames(tmp_path / name)


def test_near_finds_times_up_to_rounding():
    assert near(np.array([1.0, 2.0, 3.0]), np.array([2.0000004, 9.0])).tolist() == [False, True, False]
    assert near(np.array([1.0]), np.zeros(0)).tolist() == [False]


def test_keyframes_of_a_graph_and_of_an_odometry_without_one(fake_odometry):
    odometry = fake_odometry()
    _, run = tracked(odometry, count=3)
    assert keyframe_times(odometry, run.result) is None
    odometry.graph = KeyframeGraph(2, 3, 4, torch.device("cpu"))
    patches = torch.ones(2, 3, 3, 3)
    for number in range(4):
        nothing = torch.zeros(2, 1, 1, 1), torch.zeros(2, 4), torch.zeros(2, 3, dtype=torch.uint8), torch.ones(4)
        keyframe = Keyframe(number, 0.5 * number, number, *nothing)
        odometry.graph.window.append(keyframe, torch.tensor([0.0, 0, 0, 0, 0, 0, 1]), patches)
    odometry.graph.drop(1)
    odometry.graph.archive_oldest()
    assert keyframe_times(odometry, run.result) == [0.0, 1.0, 1.5], "without the dropped one"


def test_keyframes_of_a_map_are_not_those_of_the_recording(fake_odometry):
    odometry = fake_odometry()
    _, run = tracked(odometry, count=3)
    odometry.graph = graph = KeyframeGraph(2, 3, 4, torch.device("cpu"))
    for number, time in enumerate((0.0, 0.5, 0.25, 1.0)):  # two of a map, on a clock of its own
        if number == 2:
            graph.begin_segment(2)
            begin_recording(graph)
        nothing = torch.zeros(2, 1, 1, 1), torch.zeros(2, 4), torch.zeros(2, 3, dtype=torch.uint8), torch.ones(4)
        pose = torch.tensor([0.0, 0, 0, 0, 0, 0, 1])
        graph.window.append(Keyframe(number, time, number, *nothing), pose, torch.ones(2, 3, 3, 3))
        if number < 3:
            graph.archive_oldest()
    assert keyframe_times(odometry, run.result) == [0.25, 1.0]


def test_a_row_has_a_whole_true_position_or_none():
    row = FrameRow(0.0, "lost").at(np.array([1.0, 2, 3]))
    assert row.true_position == (1, 2, 3) and row.at(np.array([1.0, np.nan, 3])).true_position is None
