"""Training runs of studies."""

from types import SimpleNamespace

import pytest

from dvo.core.errors import DvoError
from train.studies import training
from train.studies.training import StepClock, task_program


def test_the_clock_counts_steps_alone_and_goes_on_from_a_state(monkeypatch):
    now = iter([10.0, 11.5, 20.0, 20.25])
    monkeypatch.setattr(training, "time", SimpleNamespace(process_time=lambda: next(now)))
    clock = StepClock()
    for _ in range(2):
        clock.on_train_batch_start()
        clock.on_train_batch_end(None, None)
    assert clock.train_seconds == 1.75
    other = StepClock()
    other.load_state_dict(clock.state_dict())
    assert other.train_seconds == 1.75


def test_common_settings_are_for_tasks_that_have_them():
    program = task_program("deepvo", {"model": "tiny", "updates": 3}, learning_rate=1e-3, both_ways=True)
    assert program.task.both_ways and program.settings.learning_rate == 1e-3
    with pytest.raises(DvoError, match="updates"):
        task_program("deepvo", {"model": "tiny"}, updates=3)
