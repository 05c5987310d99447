"""Poses as numpy arrays: exponential maps, quaternions, composition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvo.geometry.poses import (
    compose_rodrigues,
    invert_rodrigues,
    matrix_to_quaternion,
    quaternion_to_matrix,
    se3_exp,
    so3_exp,
)

vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array)


@given(vectors, vectors)
def test_rotations_round_trip(phi: np.ndarray, tau: np.ndarray) -> None:
    r = so3_exp(phi)
    assert np.allclose(r @ r.T, np.eye(3), atol=1e-12) and np.linalg.det(r) == pytest.approx(1)
    q = matrix_to_quaternion(r)
    assert np.allclose(quaternion_to_matrix(q), r, atol=1e-12)
    pose = np.concatenate([tau, q])
    assert np.allclose(compose_rodrigues(pose, invert_rodrigues(pose)), [0, 0, 0, 0, 0, 0, 1], atol=1e-9)
    half, whole = (se3_exp(np.concatenate([tau, phi]) * s) for s in (0.5, 1.0))
    assert np.allclose(half[0] @ half[0], whole[0], atol=1e-9)  # one-parameter subgroup
    assert np.allclose(half[0] @ half[1] + half[1], whole[1], atol=1e-9)
