"""The loss of trained weights is told before the first step, and nothing is changed by it."""

import pytest
import torch

from train.engine.baseline import LossBeforeTraining


@pytest.mark.long
def test_the_loss_is_that_of_the_first_step(tmp_path, runs, capsys):
    for name in ("plain", "told"):
        (tmp_path / name).mkdir()
    plain, losses = runs.fit(tmp_path / "plain", 2)
    program = runs.module()
    program.from_trained = True
    capsys.readouterr()
    told, same = runs.fit(tmp_path / "told", 2, program, callbacks=[LossBeforeTraining(1)])
    (line,) = [row for row in capsys.readouterr().out.splitlines() if row.startswith("before the first step: ")]
    assert float(line.split("loss ")[1].split(" ")[0]) == pytest.approx(losses[0], rel=0.01)
    assert " px of the feature map" in line and " degrees" in line and " median depths" in line
    assert losses == same
    for a, b in zip(plain.state_dict().values(), told.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_random_weights_are_not_measured(tmp_path, runs, capsys):
    runs.fit(tmp_path, 1, callbacks=[LossBeforeTraining(1)])
    assert "before the first step" not in capsys.readouterr().out
