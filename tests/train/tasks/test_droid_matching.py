"""Classification of true positions among all pixels: values, gradients, pixels that do not count, training."""

import math

import torch

from train.engine.build import make_program
from train.tasks.droid.matching import matching_loss
from train.tasks.droid.objective import LossConfig
from train.tasks.task import StepContext

II, JJ = torch.tensor([0, 1]), torch.tensor([1, 0])


def problem(seed=0, h=3, w=4):
    source = torch.Generator().manual_seed(seed)
    features = torch.randn(1, 2, 5, h, w, generator=source, dtype=torch.float64)
    positions = torch.rand(1, 2, h, w, 2, generator=source, dtype=torch.float64) * torch.tensor([w + 1.0, h + 1.0]) - 1
    valid = torch.rand(1, 2, h, w, generator=source) < 0.8
    return features, positions, valid


def plain(features, positions, valid):
    """The same, pixel by pixel."""
    h, w = features.shape[-2:]
    losses = []
    for edge, (i, j) in enumerate(zip(II.tolist(), JJ.tolist(), strict=True)):
        for v in range(h):
            for u in range(w):
                x, y = positions[0, edge, v, u].tolist()
                if not (valid[0, edge, v, u] and 0 <= x <= w - 1 and 0 <= y <= h - 1):
                    continue
                products = (features[0, i, :, v, u, None, None] * features[0, j]).sum(0)
                wanted = torch.zeros(h, w, dtype=features.dtype)
                for row in range(h):
                    for column in range(w):
                        wanted[row, column] = max(0.0, 1 - abs(column - x)) * max(0.0, 1 - abs(row - y))
                losses.append(-(wanted * products.flatten().log_softmax(0).view(h, w)).sum())
    return torch.stack(losses).mean()


def test_values_and_gradients_are_those_of_the_plain_form():
    features, positions, valid = problem()
    features.requires_grad_()
    fast, slow = matching_loss(features, II, JJ, positions, valid), plain(features, positions, valid)
    torch.testing.assert_close(fast.double(), slow, atol=1e-6, rtol=1e-6)
    (a,), (b,) = torch.autograd.grad(fast, features), torch.autograd.grad(slow, features)
    torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-5)


def test_features_that_tell_pixels_apart_cost_nothing():
    h, w = 3, 4
    own = 20 * torch.eye(h * w).view(1, 1, h * w, h, w).expand(1, 2, -1, -1, -1)
    x, y = torch.meshgrid(torch.arange(w), torch.arange(h), indexing="xy")
    still = torch.stack([x, y], -1).float().expand(1, 2, h, w, 2)
    every = torch.ones(1, 2, h, w, dtype=torch.bool)
    assert matching_loss(own, II, JJ, still, every) < 1e-6
    between = still.clone()
    between[..., 0] = (x + 0.5).clamp(max=w - 1.5)
    assert matching_loss(own, II, JJ, between, every) > 10
    nothing = torch.zeros(1, 2, 5, h, w)
    assert abs(float(matching_loss(nothing, II, JJ, still, every)) - math.log(h * w)) < 1e-5


def test_no_pixel_that_counts_is_no_loss():
    features, positions, valid = problem()
    features.requires_grad_()
    loss = matching_loss(features, II, JJ, positions, torch.zeros_like(valid))
    loss.backward()
    assert loss == 0 and torch.equal(features.grad, torch.zeros_like(features))


def test_it_trains_the_matching_features_alone(runs):
    torch.manual_seed(0)
    terms = {"pose": 0.0, "flow": 0.0, "target": 0.0, "residual": 0.0}
    program = make_program("droid", model="tiny", updates=1, loss=LossConfig(**terms, matching=1.0))
    found = program.task.compute_loss(StepContext(program.net, 0, {}), runs.batch(0, 1, sizes=[(64, 64)]))
    found.loss.backward()
    torch.testing.assert_close(found.loss.detach(), found.measures["loss_matching"])
    assert all(p.grad.abs().sum() > 0 for p in [program.net.fnet.conv1.weight, program.net.fnet.conv2.weight])
    assert all(p.grad is None or not p.grad.any() for p in program.net.cnet.parameters())
