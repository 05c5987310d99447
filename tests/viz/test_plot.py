"""The plan view."""

from __future__ import annotations

import warnings

import cv2
import numpy as np
import pytest

from dvo.data.trajectory import Trajectory
from dvo.viz.plot import COLOURS, Panel, Track, literal, plan_axes, plot_panels, plot_trajectory, with_gaps


def line(count: int, step: tuple[float, float, float]) -> Trajectory:
    positions = np.arange(count)[:, None] * np.array(step)
    rotation = np.tile([0, 0, 0, 1.0], (count, 1))
    return Trajectory(0.1 * np.arange(count), np.hstack([positions, rotation]))


@pytest.mark.parametrize(
    ("step", "axes"), [((1, 0.1, 2), (0, 2)), ((0, 3, 2), (1, 2)), ((2, 1, 0), (0, 1)), ((0, 0, 0), (0, 1))]
)
def test_plan_is_the_plane_of_the_longest_axes(step, axes):
    assert plan_axes(line(10, step).positions) == axes


def test_no_line_is_drawn_across_a_gap():
    whole = line(20, (1, 0, 0))
    kept = np.r_[0:8, 15:20]
    gappy = Trajectory(whole.timestamps[kept], whole.poses_wc[kept])
    rows = with_gaps(gappy)
    assert len(rows) == 14 and np.isnan(rows[8]).all() and np.isfinite(np.delete(rows, 8, axis=0)).all()
    assert np.isfinite(with_gaps(whole)).all()


@pytest.mark.long
@pytest.mark.parametrize("count", [0, 1, 2, 50])
@pytest.mark.parametrize("with_reference", [False, True])
def test_a_picture_comes_out_whatever_the_length(tmp_path, count, with_reference):
    reference = line(50, (1, 0, 0.2)) if with_reference else None
    estimate, points = line(count, (1, 0, 0.2)), np.zeros((3, 3))
    plot_trajectory(tmp_path / "p.png", estimate, reference=reference, points=points, title="t")
    picture = cv2.imread(str(tmp_path / "p.png"))
    assert picture is not None and picture.shape[0] > 500


def test_the_estimate_is_drawn_where_it_is(tmp_path):
    """Both tracks show: the picture with an estimate off the reference has pixels of both colours, well apart."""
    reference = line(50, (1, 0, 0.3))
    shifted = Trajectory(reference.timestamps, reference.poses_wc + np.array([0, 0, 6, 0, 0, 0, 0]))
    plot_trajectory(tmp_path / "p.png", shifted, reference=reference)
    picture = cv2.imread(str(tmp_path / "p.png"))[:, :, ::-1].astype(int)
    near_accent = np.abs(picture - [0xE4, 0x57, 0x2E]).max(axis=2) < 30
    near_truth = np.abs(picture - [0x4A, 0x6F, 0xA5]).max(axis=2) < 60
    assert near_accent.sum() > 500 and near_truth.sum() > 500
    assert np.flatnonzero(near_truth.any(axis=1)).mean() > np.flatnonzero(near_accent.any(axis=1)).mean() + 30


@pytest.mark.parametrize("reach", [0.0, 0.2, 3.0])
def test_the_nearer_half_of_the_map_is_in_the_picture(tmp_path, monkeypatch, reach):
    """Also of a camera that stands; far points do not make the path small."""
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    near = np.random.default_rng(0).uniform(-2, 2, (200, 3)) + [0, 0, 4.0]
    points = np.concatenate([near, near[:150] + [0, 0, 500.0], np.full((3, 3), np.nan)])
    plot_trajectory(tmp_path / "p.png", line(50, (reach / 50, 0, 0.3 * reach / 50)), points=points)
    plot, insets = drawn[0].axes[0], drawn[0].axes[0].child_axes
    assert bool(insets) == (0.02 < reach < 0.5), "a path that is small beside its map is drawn once more"
    axes = plan_axes(line(50, (reach / 50, 0, 0.3 * reach / 50)).positions)
    limits = np.array([plot.get_xlim(), plot.get_ylim()])
    inside = ((points[:, axes] > limits[:, 0]) & (points[:, axes] < limits[:, 1])).all(axis=1)
    assert inside.sum() >= 176 and np.ptp(limits, axis=1).max() < 12
    assert "map points" in [text.get_text() for text in drawn[0].legends[0].get_texts()]


def test_loops_are_marked_where_they_were_found(tmp_path):
    """The picture with a loop differs from that without one only around the pose, and in the legend."""
    track = Track(line(50, (1, 0, 0.3)), "dvo", 0)
    pictures = []
    for name, loops in (("without.png", None), ("with.png", track.trajectory.positions[25:26])):
        plot_panels(tmp_path / name, [Panel((track,), loops=loops)])
        pictures.append(cv2.imread(str(tmp_path / name)).astype(int))
    assert pictures[0].shape == pictures[1].shape
    above_legend = int(0.85 * pictures[0].shape[0])
    changed = np.abs(pictures[1] - pictures[0]).max(axis=2) > 60
    path = np.argwhere(colour_of(pictures[0][:above_legend], 0))
    place = path[0] + (path[-1] - path[0]) * 24 / 49  # rows are sorted: the path ends at the top
    marked = np.argwhere(changed[:above_legend])
    assert len(marked) > 20 and np.abs(marked - place).max() < 20
    assert changed[above_legend:].any(), "the legend"


def test_the_same_input_gives_the_same_bytes(tmp_path):
    for name in ("a.png", "b.png"):
        plot_trajectory(tmp_path / name, line(30, (1, 0, 2)), points=np.random.default_rng(0).normal(size=(50, 3)))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def colour_of(picture: np.ndarray, number: int) -> np.ndarray:
    """Mask of the pixels of a colour in a picture as OpenCV reads it."""
    wanted = [int(COLOURS[number][k : k + 2], 16) for k in (5, 3, 1)]
    return np.abs(picture.astype(int) - wanted).max(axis=2) < 30


@pytest.mark.long
@pytest.mark.parametrize("count", [2, 3, 5])  # the sixth colour resembles blurred text
def test_every_panel_fills_its_part_of_the_picture(tmp_path, count):
    """Worlds of very different size and place: each line is long, because its panel has limits of its own."""
    lines = [line(40, (10.0**k, 0, 0.5 * 10.0**k)) for k in range(count)]
    plot_panels(tmp_path / "p.png", [Panel((Track(one, f"segment {k}", k),)) for k, one in enumerate(lines)])
    picture = cv2.imread(str(tmp_path / "p.png"))
    columns = 2 if count <= 4 else 3
    for number in range(count):
        pixels = np.argwhere(colour_of(picture, number)[200 if number < columns else 560 :])
        assert np.ptp(pixels[:, 1]) > 60, "across its panel"
        centre = pixels[:, 1].mean() / picture.shape[1] * columns
        assert number % columns < centre < number % columns + 1, "in its column"


@pytest.mark.long
def test_segments_in_one_world_share_a_panel(tmp_path):
    """Two halves of a track: in one panel each covers its half."""
    whole = line(60, (1, 0, 0.3))
    halves = [Trajectory(whole.timestamps[part], whole.poses_wc[part]) for part in (slice(0, 30), slice(30, 60))]
    tracks = tuple(Track(half, f"segment {k}", k) for k, half in enumerate(halves))
    plot_panels(tmp_path / "p.png", [Panel(tracks, None, whole)], title="t", subtitle="s")
    picture = cv2.imread(str(tmp_path / "p.png"))
    picture = picture[: 6 * len(picture) // 8]  # without the legend
    left, right = (np.argwhere(colour_of(picture, k))[:, 1] for k in range(2))
    assert left.max() < right.min() + 20 and min(np.ptp(left), np.ptp(right)) > 200


@pytest.mark.long
@pytest.mark.parametrize("name", ["$x^{_$", "$x", "a\x1b[31m\x7f", "\udcff.tum", "_run.tum", "a\nb", "50 %"])
def test_names_are_shown_as_they_are(tmp_path, name):
    """No name of a file is mathematics, a warning about a letter that steers a terminal, or none in the legend."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracks = tuple(Track(line(9, (1, k, 0)), f"{name}{k}", k) for k in range(2))
        for count in (1, 2):
            plot_panels(tmp_path / "p.png", [Panel(tracks)] * count, title=name, subtitle=name)
    assert not literal(name).startswith("_") and (tmp_path / "p.png").stat().st_size > 10000
