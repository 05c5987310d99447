"""Bundle adjustment as a layer: learn which measurements to trust, from the pose error alone.

    python examples/bundle_adjustment_in_training.py [--steps 60]

A scene is seen from five cameras; a third of the measurements is wrong by several pixels, and a feature of each
measurement tells which, though not linearly. A small network maps the feature to a weight, `dvo.bundle_adjust` solves
for the poses with these weights, and the gradient of the pose error flows back through the solver.
"""

import argparse

import torch
from torch import nn

import dvo
from dvo.geometry.projection import reproject

FRAMES, PATCHES = 5, 16


def problem(generator: torch.Generator):
    """Poses, patches, intrinsics, targets, edges and the feature of each measurement."""
    poses = dvo.se3.exp(0.1 * torch.randn(1, FRAMES, 6, generator=generator))
    poses[:, 0] = dvo.se3.identity()
    xy = 8 + 48 * torch.rand(1, FRAMES * PATCHES, 2, 1, 1, generator=generator)
    depth = 0.5 + torch.rand(1, FRAMES * PATCHES, 1, 1, 1, generator=generator)
    patches = torch.cat([xy, depth], 2)
    intrinsics = torch.tensor([60.0, 60.0, 32.0, 32.0]).expand(1, FRAMES, 4)
    kk = torch.arange(FRAMES * PATCHES).repeat_interleave(FRAMES)
    jj = torch.arange(FRAMES).repeat(FRAMES * PATCHES)
    edges = [index[kk // PATCHES != jj] for index in (kk // PATCHES, jj, kk)]
    targets = reproject(poses, patches, intrinsics, *edges).coords[:, :, 0, 0]
    wrong = torch.rand(1, len(edges[0]), 1, generator=generator) < 1 / 3
    feature = torch.where(wrong, 1.0, -1.0) * torch.sign(torch.randn(wrong.shape, generator=generator)) + wrong
    targets = targets + wrong * 6 * torch.randn(targets.shape, generator=generator)
    return poses, patches, intrinsics, targets, edges, feature


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=60)
    steps = parser.parse_args().steps
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    trust = nn.Sequential(nn.Linear(1, 16), nn.ReLU(), nn.Linear(16, 2), nn.Sigmoid())
    optimizer = torch.optim.Adam(trust.parameters(), 2e-2)
    history = []
    for step in range(steps):
        poses, patches, intrinsics, targets, (ii, jj, kk), feature = problem(generator)
        start = dvo.se3.identity(1, FRAMES)
        options = dvo.BAOptions(fixed=1, iterations=6, damping=dvo.BADamping(relative=1e-2))
        found = dvo.bundle_adjust(start, patches, intrinsics, targets, trust(feature), ii, jj, kk, options)
        error = dvo.se3.log(dvo.se3.relative(poses, found.poses_cw)).norm(dim=-1).mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        history.append(error.item())
        if step % 10 == 0:
            print(f"step {step}: pose error {error.item():.4f}")
    third = max(1, steps // 3)
    print(f"pose error, first third {sum(history[:third]) / third:.4f}, last third {sum(history[-third:]) / third:.4f}")


if __name__ == "__main__":
    main()
