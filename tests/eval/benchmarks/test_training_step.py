"""Benchmark of a training step: the parts with kernels and twins, and losses that agree."""

import re

import pytest

from eval.benchmarks.training_step import main


@pytest.mark.slow
def test_parts_and_losses(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["training_step", "--repeats", "1", "--size", "64", "80"])
    main()
    *table, losses = capsys.readouterr().out.splitlines()
    rows = {line[:32].strip(): [float(x) for x in line[32:].replace("s", "").split()] for line in table[2:]}
    assert {"bundle adjustment, backward", "correlation look-up", "step"} <= set(rows)
    assert all(min(row[0], row[1], row[3]) > 0 for row in rows.values())
    found = re.findall(r"([\d.]+) / ([\d.]+) / ([\d.]+)", losses)
    assert len(found) == 2 and all(float(a) == pytest.approx(float(b), rel=1e-3) for a, b, _ in found)
    # Of an image this small the network knows little, and bfloat16 changes the loss by tenths.
    assert all(float(a) == pytest.approx(float(c), rel=0.5) for a, _, c in found)
