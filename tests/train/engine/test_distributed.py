"""Two processes over gloo see the gradients of one process with twice the batch."""

import os
import runpy
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from dvo.synth.clip import make_clip

WORKER = Path(__file__).with_name("distributed_step.py")
ROOT = WORKER.parents[3]


def start(path, batch, processes, rank, port, clips):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    if processes > 1:
        environment |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(processes),
                        "RANK": str(rank), "LOCAL_RANK": str(rank), "NODE_RANK": "0"}  # fmt: skip
    command = [sys.executable, str(WORKER), str(path), str(batch), str(processes), str(clips)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, cwd=ROOT, env=environment, **pipes)


@pytest.mark.slow
def test_two_processes_equal_one_with_twice_the_batch(tmp_path, runs):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    clips = tmp_path / "clips.pt"
    sizes = runs.clip["sizes"]
    options = {"frames": 4, "flow_range": (2.0, 19.0)}
    rendered = [make_clip(5, i, height=sizes[i // 2][0], width=sizes[i // 2][1], **options) for i in range(4)]
    torch.save(rendered, clips)
    started = [start(tmp_path / "two.pt", 1, 2, rank, port, clips) for rank in (0, 1)]
    try:
        step = runpy.run_path(str(WORKER))
        threads = torch.get_num_threads()
        step["main"](str(tmp_path / "one.pt"), 2, 1, str(clips))
        torch.set_num_threads(threads)
        for process in started:
            output, _ = process.communicate(timeout=400)
            assert process.returncode == 0, output
    finally:
        for process in started:
            process.kill()
    two, one = (torch.load(tmp_path / name, weights_only=False) for name in ("two.pt", "one.pt"))
    assert two["seen"] == one["seen"] == 4
    assert max(g.abs().max() for g in one["grads"].values()) > 1e-3
    total = torch.stack([g.norm() for g in one["grads"].values()]).norm()
    for name, gradient in one["grads"].items():  # a bias before a normalisation has a gradient of rounding alone
        off = (two["grads"][name] - gradient).norm()
        assert off < 1e-4 * gradient.norm() + 1e-6 * total, (name, off)
    assert one["balance"] != (1.0, 1.0)
    for a, b in zip(one["balance"], two["balance"], strict=True):
        assert abs(a - b) < 1e-3 * a
    torch.testing.assert_close(one["within"], two["within"], rtol=1e-4, atol=1e-6)
