"""Full precision inside, and everything as it was outside."""

from __future__ import annotations

import pytest
import torch

from dvo.core.context import full_precision


def test_autocast_is_off_inside_and_back_on_after() -> None:
    a = torch.rand(3, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        with full_precision(a.device):
            assert (a @ a).dtype == torch.float32
        assert (a @ a).dtype == torch.bfloat16


@pytest.mark.parametrize("setting", ["highest", "high"])
def test_tf32_is_off_inside_and_restored_even_after_an_error(setting: str) -> None:
    before = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision(setting)
        with pytest.raises(RuntimeError), full_precision(torch.device("cuda")):
            assert not torch.backends.cuda.matmul.allow_tf32
            raise RuntimeError
        assert torch.get_float32_matmul_precision() == setting
    finally:
        torch.set_float32_matmul_precision(before)
