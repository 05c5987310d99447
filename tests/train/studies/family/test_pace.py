"""Learning rate and end of a phase by the share of its budget."""

from types import SimpleNamespace

import pytest

from train.studies import training
from train.studies.family.pace import Budget, Pace


class Steps:
    """Trainer whose steps take a second of the processor, and which a pace may stop."""

    def __init__(self, pace, monkeypatch, start=0):
        self.global_step, self.should_stop, self.now = start, False, 100.0
        self.optimizers = [SimpleNamespace(param_groups=[{"lr": 0.0}])]
        self.pace, self.rates = pace, []
        monkeypatch.setattr(training, "time", SimpleNamespace(process_time=lambda: self.now))

    def run(self, limit=100):
        self.pace.on_train_start(self, None)
        while not self.should_stop and self.global_step < limit:
            self.pace.on_train_batch_start(self, None, None, 0)
            self.rates.append(self.optimizers[0].param_groups[0]["lr"])
            self.now += 1.0
            self.global_step += 1
            self.pace.on_train_batch_end(self, None, None, None, 0)
            self.now += 7.0  # rendering and measurements
        return self.rates


def test_the_rate_follows_the_time_and_the_end_comes_with_it(monkeypatch):
    seen = []
    pace = Pace(Budget(10.0), 0.5, 0.2, lambda program, share, steps, seconds: seen.append((share, steps, seconds)))
    rates = Steps(pace, monkeypatch).run()
    assert len(rates) == 10 and pace.share == 1
    assert rates[0] == pytest.approx(0.5 / 25) and rates[2] == pytest.approx(0.5, rel=1e-3)
    assert rates[6] == pytest.approx(0.25, rel=1e-3) and rates[9] == pytest.approx(0.0625, rel=1e-3)
    assert pace.rate_at(1.0) < 1e-5
    assert seen[0] == (0, 0, 0) and seen[-1] == (1, 10, 10)


def test_a_budget_of_steps_does_not_look_at_the_time(monkeypatch):
    pace = Pace(Budget(1e-3, 4), 1.0, 0.5)
    assert len(Steps(pace, monkeypatch).run()) == 4 and pace.train_seconds == 4


def test_the_time_goes_on_from_a_state(monkeypatch):
    whole = Steps(Pace(Budget(10.0), 1.0, 0.2), monkeypatch).run()
    first = Pace(Budget(10.0), 1.0, 0.2)
    begun = Steps(first, monkeypatch).run(limit=6)
    second = Pace(Budget(10.0), 1.0, 0.2)
    second.load_state_dict(first.state_dict())
    assert begun + Steps(second, monkeypatch, start=6).run() == whole
    done = Pace(Budget(10.0), 1.0, 0.2)
    done.load_state_dict(second.state_dict())
    assert Steps(done, monkeypatch, start=10).run() == []
