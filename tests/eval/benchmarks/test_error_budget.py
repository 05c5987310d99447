"""What alignment and final adjustment take from the error."""

import pytest

from dvo.synth.sequence import make_sequence
from eval.benchmarks.error_budget import CASES, measure


@pytest.mark.slow
def test_aligned_and_adjusted_measurements_leave_less_error():
    sequence = make_sequence(
        77, frames=36, height=192, width=256, fps=15.0, family="street", kind="handheld", apart=True
    )
    network, adjusted, aligned = (measure(sequence, case, "small", 0) for case in CASES)
    assert network.matched == adjusted.matched == aligned.matched == 36
    assert aligned.rpe_rot_deg < 0.75 * min(network.rpe_rot_deg, adjusted.rpe_rot_deg)
