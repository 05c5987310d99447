"""A tensor that goes NaN skips its step and is counted; a run of them, or bad weights, lead back to the last good
state; the run goes on."""

import torch

from train.engine.recovery import LastGood, weights_finite


def poison(program, steps):
    """The network's flow revision is nan in these steps."""
    real = program.net.update.forward

    def poisoned(*args):
        hidden, delta, weights = real(*args)
        return (hidden, delta * torch.nan, weights) if program.global_step in steps else (hidden, delta, weights)

    program.net.update.forward = poisoned


def finite(program):
    return all(torch.isfinite(p).all() for p in program.parameters())


def test_a_bad_step_changes_nothing_and_is_counted(tmp_path, runs):
    clean, before = runs.fit(tmp_path, 1)
    program = runs.module()
    poison(program, {1})
    _, losses = runs.fit(tmp_path, 2, program)
    assert losses[0] == before[0] and losses[1] is None
    assert int(program.skipped) == 1 and program.recovered == 0
    for a, b in zip(clean.parameters(), program.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_bad_gradient_alone_is_a_bad_step(tmp_path, runs):
    program = runs.module()
    program.net.patchify.fnet.conv1.weight.register_hook(lambda g: g * torch.nan if program.global_step == 1 else g)
    before = runs.fit(tmp_path, 1, runs.module())[0]
    runs.fit(tmp_path, 2, program)
    assert int(program.skipped) == 1
    for a, b in zip(before.net.parameters(), program.net.parameters(), strict=True):
        assert torch.equal(a, b)


def test_many_bad_steps_in_a_row_return_to_the_last_good_state(tmp_path, runs):
    program = runs.module(bad_steps=2, keep_every=1)
    poison(program, {1, 2})
    _, losses = runs.fit(tmp_path, 4, program)
    assert losses[1:3] == [None, None] and losses[3] is not None
    assert int(program.skipped) == 2 and program.recovered == 1
    assert finite(program)


def test_weights_that_go_bad_are_replaced_at_once(tmp_path, runs):
    program = runs.module(keep_every=1)
    real = program.configure_optimizers

    def spoil(*_):
        if program.global_step == 2:
            with torch.no_grad():
                next(program.net.parameters()).fill_(torch.nan)

    def configured():
        found = real()
        found["optimizer"].register_step_post_hook(spoil)
        return found

    program.configure_optimizers = configured
    _, losses = runs.fit(tmp_path, 5, program)
    assert program.recovered == 1 and int(program.skipped) == 1
    assert None not in losses and finite(program)


def test_the_last_good_state_is_a_copy_of_weights_and_optimiser():
    torch.manual_seed(0)
    net = torch.nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(net.parameters(), 0.1)
    good = LastGood()
    assert not good.restore([net], optimizer)

    def step():
        optimizer.zero_grad()
        net(torch.ones(1, 3)).square().sum().backward()
        optimizer.step()

    step()
    good.keep([net], optimizer)
    step()
    after = net.weight.detach().clone()
    with torch.no_grad():
        net.weight.fill_(torch.inf)
    assert not weights_finite([net])
    optimizer.param_groups[0]["lr"] = 0.05
    assert good.restore([net], optimizer) and weights_finite([net])
    assert optimizer.param_groups[0]["lr"] == 0.05  # the schedule goes on
    optimizer.param_groups[0]["lr"] = 0.1
    step()
    assert torch.equal(net.weight, after)
