"""The device of the tests with the marker ``gpu``."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from dvo.core.arguments import checked_device
from eval.benchmarks.device.stand_in import DEVICE, stand_in


@pytest.fixture
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """That of ``--device``, else an accelerator, else a stand-in, which shows if tensors of two devices are mixed."""
    chosen = request.config.getoption("--device")
    if chosen:
        yield checked_device(chosen, "--device")
    elif torch.accelerator.is_available():
        yield torch.device(torch.accelerator.current_accelerator().type)
    else:
        with stand_in():
            yield DEVICE
