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
    assert all(min(row[:2]) > 0 for row in rows.values())
    pairs = re.findall(r"([\d.]+) / ([\d.]+)", losses)
    assert len(pairs) == 2 and all(float(a) == pytest.approx(float(b), rel=1e-3) for a, b in pairs)
