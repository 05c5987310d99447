"""Head that scores patch positions: a convolution at chosen positions, without a gradient to the features."""

import torch
from torch.nn import functional as F

from dvo.nets.score import ScoreHead


def test_it_is_the_convolution_of_the_whole_map():
    torch.manual_seed(0)
    head, maps = ScoreHead(8, 5), torch.randn(2, 3, 8, 12, 17)
    points = torch.stack([torch.randint(1, 16, (2, 3, 40)), torch.randint(1, 11, (2, 3, 40))], -1)
    points[0, 0, :4] = torch.tensor([[1, 1], [15, 10], [1, 10], [15, 1]])
    dense = F.conv2d(maps.flatten(0, 1), head.conv1.weight, head.conv1.bias, padding=1).relu()
    dense = F.conv2d(dense, head.conv2.weight, head.conv2.bias).unflatten(0, (2, 3))[:, :, 0]
    b, n = torch.arange(2)[:, None, None], torch.arange(3)[:, None]
    torch.testing.assert_close(head(maps, points), dense[b, n, points[..., 1], points[..., 0]])


def test_the_features_receive_no_gradient():
    torch.manual_seed(0)
    maps = torch.randn(1, 1, 4, 6, 6, requires_grad=True)
    head = ScoreHead(4, 3)
    head(maps * 2, torch.tensor([[[[2, 3]]]])).sum().backward()
    assert maps.grad is None and all(p.grad is not None for p in head.parameters())
