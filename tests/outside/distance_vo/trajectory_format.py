"""Trajectory format: positions alone."""

import numpy as np


def write_positions(trajectory, folder):
    np.savetxt(folder / "positions.csv", trajectory.positions, delimiter=",")
