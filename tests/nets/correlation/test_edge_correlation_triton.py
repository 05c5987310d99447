"""The kernel of an accelerator against its twin, run by Triton's interpreter, and compiled for devices."""

from __future__ import annotations

import sys

import torch

from dvo.core import kernels
from tests.support.triton_programs import run

PROGRAM = """
import torch
from dvo.core.device_triton import check
from dvo.nets.correlation import edge_correlation
from dvo.nets.correlation.edge_correlation import EdgeCorrelation, correlate_edges
from dvo.nets.correlation.edge_correlation_triton import correlate

check(torch.device("cpu"))
for seed, (channels, radius, side, edges) in enumerate([(40, 3, 3, 3), (8, 1, 1, 9), (24, 2, 2, 5), (8, 3, 3, 0)]):
    g = torch.Generator().manual_seed(seed)
    level = EdgeCorrelation(1, radius, "cpu")
    for slot in range(3):
        level.keep_map(slot, torch.randn(channels, 9, 13, generator=g))
    features = torch.randn(4, side * side, channels, generator=g)
    kk, frames = torch.randint(4, (edges,), generator=g), torch.randint(3, (edges,), generator=g)
    at = torch.rand(edges, side * side, 2, generator=g) * torch.tensor([30.0, 24.0]) - 8
    if edges:
        bad = [[torch.nan, 3.0], [3.0, torch.nan], [1e9, 2.0], [2.0, -1e9], [torch.inf, -torch.inf], [4.0, 5.0]]
        at.view(-1, 2)[:6] = torch.tensor(bad)[: at.numel() // 2]
    given = level.maps, features, at, kk, frames, radius
    found, again, expected = correlate(*given), correlate(*given), correlate_edges(*given)
    assert torch.equal(found.nan_to_num(7), again.nan_to_num(7))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5, equal_nan=True)
    edge_correlation.use_kernels, edge_correlation.use_device_kernels = (lambda *_: False), (lambda *_: True)
    coords = at.unflatten(1, (side, side))
    assert torch.equal(level.lookup(coords, features, kk, frames).nan_to_num(7), found.flatten(1).nan_to_num(7))
    print("equal", int(expected.isfinite().sum()))
"""
COMPILED = """
from dvo.core.device_triton import _try
compiled(_try, {"x": "*fp32", "out": "*fp32"}, {})
from dvo.nets.correlation.edge_correlation_triton import correlate_pixel
types = {"maps": "*fp32", "features": "*fp32", "at": "*fp32", "kk": "*i64", "frames": "*i64", "out": "*fp32",
         "pixels": "i32", "height": "i32", "width": "i32"}
compiled(correlate_pixel, types, {"channels": 64, "taps": 8, "side": 8, "block": 32}, {"num_warps": 2})
"""


def test_values_are_those_of_the_twin(tmp_path):
    lines = run(PROGRAM, interpret=True, kept=tmp_path).splitlines()
    assert len(lines) == 4 and all(line.startswith("equal") for line in lines)
    assert int(lines[0].split()[1]) > 1000 and lines[-1] == "equal 0"


def test_compiles(tmp_path):
    assert run(COMPILED, interpret=False, kept=tmp_path).count("compiled for 90") == 2


def test_the_cpu_has_kernels_of_its_own():
    assert not kernels.use_device_kernels(torch.zeros(3))
    assert "triton" not in sys.modules


def test_a_device_on_which_nothing_runs_is_told_once(monkeypatch, capsys):
    kernels._works_on.cache_clear()
    monkeypatch.setitem(sys.modules, "triton", None)
    monkeypatch.delitem(sys.modules, "dvo.core.device_triton", raising=False)
    assert not kernels._works_on(torch.device("cpu")) and not kernels._works_on(torch.device("cpu"))
    kernels._works_on.cache_clear()
    assert capsys.readouterr().err.count("no kernels on cpu") == 1
