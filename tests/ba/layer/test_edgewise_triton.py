"""Kernels of an accelerator against their twin in double precision, run by Triton's interpreter, and compiled."""

import pytest

from tests.support.triton_programs import run

STEPS = """
import math
from dataclasses import replace
import torch
from dvo.ba.kernels import Kernel
from dvo.ba.layer import layer
from dvo.ba.layer.layer import BADamping, BAOptions, bundle_adjust
from dvo.geometry import se3
from tests.support.window_problem import window_problem

CASES = [
    BAOptions(bounds=(80, 60), kernel=Kernel("cauchy", 0.3), iterations=1, check=False),
    BAOptions(fixed=0, kernel=Kernel("huber", 0.3), max_residual=20.0, damping=BADamping(1.0, 0.3, 0.2), check=False),
    BAOptions(fixed=2, iterations=1, max_residual=math.inf, depth_range=(0.4, 0.9), check=False),
]
used = []
for seed, options in enumerate(CASES):
    poses, patches, intrinsics, targets, weights, ii, jj, kk = window_problem(seed, 3, 2)
    chosen = torch.randperm(len(ii), generator=torch.Generator().manual_seed(seed))[torch.arange(20) % len(ii)]
    targets, weights, ii, jj, kk = targets[:, chosen], weights[:, chosen], ii[chosen], jj[chosen], kk[chosen]
    targets[0, 2, 0], targets[0, 3, 1], weights[0, 4, 0] = math.nan, 1e9, math.inf
    if seed == 1:  # a frame that looks away, and a batch
        poses[:, 2] = se3.retract(poses[:, 2], torch.tensor([0, 0, 0, 0, math.pi - 0.3, 0]))
        poses, patches, intrinsics, targets, weights = (
            torch.cat((x, x)) for x in (poses, patches, intrinsics, targets, weights)
        )
        targets[1] += 0.3
    given = poses, patches, intrinsics, targets, weights, ii, jj, kk
    exact = se3.normalise(poses.double()), *(x.double() for x in given[1:5]), ii, jj, kk
    expected = bundle_adjust(*exact, options)
    layer.use_kernels, layer.use_device_kernels = (lambda *_: False), (lambda *_: used.append(1) or True)
    found = bundle_adjust(*given, options)
    again = bundle_adjust(*given, options) if seed == 0 else found
    layer.use_device_kernels = lambda *_: False
    assert torch.equal(found.poses_cw, again.poses_cw) and torch.equal(found.patches, again.patches)
    for name in ("poses_cw", "patches"):
        x, y = getattr(found, name), getattr(expected, name)
        assert x.dtype == torch.float32
        torch.testing.assert_close(x.double(), y, atol=2e-5, rtol=2e-5)
    print("moved", float((expected.poses_cw - exact[0]).abs().max()) > 1e-4, len(used))

options = CASES[0]
wrong = ii.clone()
wrong[5], weights[:, 5] = 77, 0.0
layer.use_device_kernels = lambda *_: True
same = bundle_adjust(poses, patches, intrinsics, targets, weights, ii, jj, kk, options)
other = bundle_adjust(poses, patches, intrinsics, targets, weights, wrong, jj, kk, options)
assert torch.equal(same.poses_cw, other.poses_cw)
print("out of range")
"""
SOLUTIONS = """
import math
import numpy as np
import torch
from dvo.ba.layer.edgewise_kernels import solve_reduced
from dvo.ba.layer.edgewise_triton import solve

for kind, size in (("plain", 12), ("indefinite", 6), ("hopeless", 6), ("nan", 6), ("infinite", 6), ("long", 6)):
    random = np.random.default_rng(size)
    root = random.normal(size=(size, size + 4))
    system, rest = root @ root.T, random.normal(size=size)
    if kind == "indefinite":
        system -= np.eye(size) * (np.linalg.eigvalsh(system)[0] + 1e-3)
    if kind == "hopeless":
        system = -system
    if kind in ("nan", "infinite"):
        system[2, 2] = math.nan if kind == "nan" else math.inf
    if kind == "long":
        rest *= 1e12
    expected, nothing = np.empty(size), np.empty(0)
    limits = 0.1, 0.2, np.full(size, 1e8)
    solve_reduced(system.copy(), np.empty((0, size)), nothing, rest, nothing, *limits, expected, nothing)
    found = torch.empty(1, size + 1, dtype=torch.float64)
    solve[(1,)](torch.tensor(system)[None], torch.tensor(rest)[None], found, size, 0.1, 0.2, 16)
    np.testing.assert_allclose(found[0, :size].numpy(), expected, rtol=1e-5, atol=1e-9)
    assert (found[0, size] == 0) == (kind == "long")
    print(kind, bool(np.abs(expected).max() > 0))
"""
COMPILED = """
import dvo.ba.layer.edgewise_triton as kernels
names = {
    "*fp32": "poses depths centres intrinsics targets weights", "*i64": "ii jj kk order starts",
    "*fp64": "table h_lp h_ll g_l system rest steps", "i32": "frames patches edges fixed size",
    "fp32": "least_z longest middle_x middle_y reach_x reach_y scale damping absolute relative low high",
}
types = {name: kind for kind, line in names.items() for name in line.split()}
sizes = {
    "sum_pairs": {"robust": 2, "block": 32}, "sum_patches": {"robust": 2, "block": 16, "wide": 16},
    "eliminate": {"block": 32}, "solve": {"wide": 64}, "move_depths": {"block": 64}, "move_poses": {"wide": 16},
}
for name, constants in sizes.items():
    compiled(getattr(kernels, name), types, constants)
"""


@pytest.mark.slow
def test_steps_are_those_of_the_twin(tmp_path):
    lines = run(STEPS, interpret=True, kept=tmp_path).splitlines()
    assert lines == ["moved True 2", "moved True 3", "moved True 4", "out of range"]


def test_solutions_are_those_of_the_kernel_of_the_cpu(tmp_path):
    lines = run(SOLUTIONS, interpret=True, kept=tmp_path).splitlines()
    solved = ["plain", "indefinite"]
    assert lines == [f"{kind} {kind in solved}" for kind in (*solved, "hopeless", "nan", "infinite", "long")]


@pytest.mark.slow
def test_compile(tmp_path):
    assert run(COMPILED, interpret=False, kept=tmp_path).count("compiled for 90") == 6
