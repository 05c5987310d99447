"""Tests of processes that are replaced now and then."""

from __future__ import annotations

import os

import pytest

from eval.execution.fresh_processes import in_fresh_processes


def tagged(number: int) -> tuple[int, int]:
    return number, os.getpid()


@pytest.mark.long
def test_all_tasks_are_done_in_order_and_processes_replaced() -> None:
    done = list(in_fresh_processes(tagged, range(5), each=2))
    assert [number for number, _ in done] == list(range(5))
    pids = [pid for _, pid in done]
    assert pids[0] == pids[1] and pids[2] == pids[3] and len(set(pids)) == 3 and os.getpid() not in pids
