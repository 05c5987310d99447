"""True measurements in place of the network's: what is left is the tracker's own error."""

import pytest
import torch

from dvo.synth.sequence import make_sequence
from eval.benchmarks.error_budget import measure


@pytest.mark.slow
def test_true_measurements_leave_next_to_no_error():
    sequence = make_sequence(
        77, frames=36, height=192, width=256, fps=15.0, family="street", kind="handheld", apart=True
    )
    depth = torch.stack([torch.as_tensor(sequence.rendering(i).depth[0]) for i in range(len(sequence))])
    cases = ("network, adjusted", "true positions, adjusted")
    network, true = (measure(sequence, depth, case, "small", 0) for case in cases)
    assert true.matched == network.matched == 36
    assert true.rpe_rot_deg < 0.2 * network.rpe_rot_deg and true.ate_percent < 0.5 * network.ate_percent
