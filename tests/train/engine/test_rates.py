import pytest
import torch

from train.engine.rates import constant_rate, one_cycle_rate


@pytest.mark.parametrize("steps, rise", [(200, 0.01), (1000, 0.01), (50, 0.3)])
def test_one_cycle_equals_that_of_torch(steps, rise):
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], 2.0)
    theirs = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, 2.0, steps, pct_start=rise, anneal_strategy="linear", cycle_momentum=False
    )
    factor = one_cycle_rate(steps, rise)
    for step in range(steps):
        assert 2.0 * factor(step) == pytest.approx(theirs.get_last_lr()[0], rel=1e-6)
        optimizer.step()
        if step < steps - 1:
            theirs.step()
    assert factor(10 * steps) == factor(steps - 1) > 0  # a run that goes on is not killed by its schedule


def test_constant_rate_warms_up_and_decays():
    rate = constant_rate(warmup=10, decay_from=20, decay_steps=10)
    assert [rate(0), rate(9), rate(20), rate(25), rate(30), rate(99)] == [0.1, 1.0, 1.0, 0.5, 0.0, 0.0]
