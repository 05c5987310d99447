"""Search in frames, and choice of views."""

import numpy as np

from dvo.boards.board import Checkerboard
from dvo.boards.views import View, choose_views, find_views


def test_the_sharpest_of_each_few_frames_is_searched(boards):
    scene = boards.Scene(boards.RADTAN, boards.checkerboard(7, 5))
    pose = scene.poses(1)[0]
    frames = [scene.frames([pose], blur=blur, noise=0.0)[0] for blur in (2.5, 0.6, 1.5, 0.6, 2.0)]
    for index, frame in enumerate(frames):
        object.__setattr__(frame, "index", index)
    calls = []
    search = find_views(frames, Checkerboard(7, 5), 3, lambda *numbers: calls.append(numbers))
    assert [view.index for view in search.views] == [1, 3]
    assert (search.frames, search.examined, search.width, search.height) == (5, 2, boards.WIDTH, boards.HEIGHT)
    assert calls == [(3, 1), (5, 2)] and search.example_index in (1, 3)


def test_blurred_boards_are_less_sharp(boards):
    scene = boards.Scene(boards.RADTAN, boards.checkerboard(7, 5))
    frames = [scene.frames(scene.poses(1), blur=blur)[0] for blur in (0.6, 1.6)]
    sharp, blurred = find_views(frames, Checkerboard(7, 5)).views
    assert sharp.sharpness > 2 * blurred.sharpness


def view(index, x, y, side, sharpness=1.0):
    points = Checkerboard(4, 3).points
    return View(index, points[:, :2] * side + [x, y], points, sharpness)


def test_views_that_differ_are_chosen():
    crowd = [view(i, 100 + 0.1 * i, 100, 10, 2.0) for i in range(20)]
    others = [view(20, 10, 10, 10), view(21, 250, 180, 10), view(22, 20, 20, 60)]
    chosen = choose_views(crowd + others, 4, 320, 240)
    assert [v.index for v in chosen][1:] == [20, 21, 22] and chosen[0].index < 20


def test_of_views_alike_the_sharp_one_is_chosen():
    alike = [view(i, 10, 10, 10, 0.2 if i != 3 else 1.0) for i in range(6)]
    chosen = choose_views([*alike, view(9, 200, 150, 30, 1.0)], 2, 320, 240)
    assert [v.index for v in chosen] == [3, 9]


def test_all_are_kept_if_there_are_few():
    views = [view(i, i, 0, 10) for i in range(3)]
    assert choose_views(views, 3, 320, 240) == views
    assert len(choose_views(views, 2, 320, 240)) == 2


def test_no_frames():
    search = find_views([], Checkerboard(7, 5))
    assert search.examined == 0 and search.example is None and np.size(search.views) == 0
