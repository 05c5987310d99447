"""Maps that trackers save, what holds of them, and files with changed content."""

from __future__ import annotations

import numpy as np

import dvo
from dvo.map.io.map_file import open_map_file, write_map_file
from tests.support.outcome import content, told

FAST = {"pixels": 160 * 120, "patches": 12, "lifetime": 5, "removal": 6, "initial_updates": 6, "final_updates": 2}


def check_saved_run(new, images, cuts, folder, weights=None):
    """Track everything twice, once with maps saved at the cuts, each with the rows of the moment; and finish."""
    runs = []
    for saves in (True, False):
        odometry, estimates = new(), []
        for number, frame in enumerate(images):
            if saves and number in cuts:
                odometry.save(folder / f"{number}.dvo")
                expected = odometry.current() if odometry.state.initialised else None
                check_map(dvo.load_map(folder / f"{number}.dvo", weights=weights), number, expected)
            estimates.append(odometry.track(frame))
        runs.append(([told(estimate) for estimate in estimates], content(odometry.finish()), estimates))
    assert runs[0][:2] == runs[1][:2]
    return runs[0][2], odometry.finish()


def check_map(found, count, expected):
    """A loaded map: nothing is in a window, and its result is that of the moment, with the points of the window too."""
    result = found.current()
    assert not len(found.window) and result.frames_read == count
    if expected is None:
        return
    if not result.metric:  # a scale by depth images is told, too
        assert result.info.keys() == expected.info.keys()
    assert [len(segment) for segment in result.segments] == [len(segment) for segment in expected.segments]
    for mine, other in zip(result.segments, expected.segments, strict=True):
        assert np.array_equal(mine.trajectory.timestamps, other.trajectory.timestamps)
        np.testing.assert_allclose(mine.trajectory.poses_wc, other.trajectory.poses_wc, atol=1e-5)
    assert len(result.map.points) >= len(expected.map.points)  # of the longest world, which may be closed


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
