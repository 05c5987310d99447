"""The benchmark of an accelerator runs on the CPU too; the stand-in for one does as one does."""

from __future__ import annotations

import json
import time

import pytest
import torch

from dvo.synth.sequence import make_sequence
from eval.benchmarks.device import __main__ as command
from eval.benchmarks.device.rows import Row, append_row, read_rows, table
from eval.benchmarks.device.sections import SECTIONS, Setting, _cases
from eval.benchmarks.device.stand_in import DEVICE, stand_in
from eval.benchmarks.device.waits import waits_of_stand_in


def test_rows_of_a_section_that_was_stopped(tmp_path):
    file = tmp_path / "rows"
    rows = [Row("videos", "1 at once", 12.345678, "frames/s", 100.4), Row("videos", "a | b", note="x\ny", failed=True)]
    for row in rows:
        append_row(file, row)
    file.write_text(file.read_text() + '{"section": "vid')
    assert read_rows(file) == rows and read_rows(tmp_path / "none") == []
    assert table(rows).splitlines()[2:] == [
        "| videos | 1 at once | 12.35 | frames/s | 100 |  |", "| videos | a \\| b | failed |  |  | x y |",
    ]  # fmt: skip


def test_a_case_that_fails_is_a_row_and_the_others_go_on():
    given = Setting(torch.device("cpu"), 60.0, True, time.perf_counter())

    def broken(_):
        raise RuntimeError("out of\nmemory")

    rows = list(_cases("x", given, [("first", broken), ("second", lambda _: Row("x", "second", 1.0))]))
    assert rows == [Row("x", "first", note="RuntimeError: out of memory", failed=True), Row("x", "second", 1.0)]
    late = Setting(torch.device("cpu"), 0.0, True, time.perf_counter())
    assert [row.failed for row in _cases("x", late, [("first", broken)])] == [False]


def test_a_section_that_fails_is_a_row(tmp_path, monkeypatch):
    def broken(_):
        yield Row("waits", "one", 1.0)
        raise ValueError("no")

    monkeypatch.setitem(SECTIONS, "waits", (1.0, broken))
    command.measure_section("waits", torch.device("cpu"), 5.0, True, tmp_path / "rows")
    assert [row.case for row in read_rows(tmp_path / "rows")] == ["one", "the rest"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--device", "cuda:77"], "--device: 'cuda:77' cannot be used"),
        (["--device", "cpu", "--only", "waits,none"], "--only: no section 'none'"),
        (["--device", "cpu", "--out", "/none/there.json"], "its folder does not exist"),
    ],
)
def test_what_cannot_be_run_is_one_line(capsys, arguments, message):
    assert command.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_shares_and_stops(tmp_path, monkeypatch):
    times = []

    def section(name, device, seconds, quick):
        times.append(seconds)
        return [Row(name, "only", failed=name == "waits")]

    monkeypatch.setattr(command, "run_section", section)
    out = tmp_path / "out.json"
    assert command.main(["--device", "cpu", "--minutes", "2", "--out", str(out)]) == 1
    assert [row["section"] for row in json.loads(out.read_text())["rows"]] == list(SECTIONS)
    # Nothing was used: the last section could have all of it.
    assert times[0] == pytest.approx(120 * SECTIONS["tests"][0], abs=1) and times[-1] == pytest.approx(120, abs=2)


@pytest.mark.slow
def test_all_sections_on_the_cpu(tmp_path):
    out = tmp_path / "out.json"
    assert command.main(["--device", "cpu", "--quick", "--minutes", "20", "--out", str(out)]) == 0
    rows = [Row(**row) for row in json.loads(out.read_text())["rows"]]
    assert {row.section for row in rows if row.value is not None} == set(SECTIONS)


@pytest.mark.slow
def test_few_waits_of_a_frame():
    frames = list(make_sequence(1, frames=18, height=96, width=128))
    value, places = waits_of_stand_in(frames)
    assert 0 < value < 60 and ".py:" in places


def test_the_stand_in_computes_and_refuses_a_mix():
    x = torch.arange(6.0).view(2, 3)
    with stand_in():
        there = x.to(DEVICE)
        assert there.device == DEVICE and torch.equal((there @ there.mT).cpu(), x @ x.mT)
        there[0] = 1.0
        there += torch.ones(3, device=DEVICE)
        assert there.tolist() == [[2.0, 2.0, 2.0], [4.0, 5.0, 6.0]] and x[0, 2] == 2
        with pytest.raises(RuntimeError, match="same device"):
            there + x
        with pytest.raises((TypeError, RuntimeError)):
            there.numpy()
        assert (there + torch.tensor(1.0)).device == DEVICE  # one number may come from the CPU


@pytest.mark.parametrize(
    ("ask", "count"),
    [
        (lambda x: x.sum().item(), 1), (lambda x: bool((x > 0).all()), 1), (lambda x: x[x > 0], 1),
        (lambda x: x.nonzero(), 1), (lambda x: x.cpu(), 1), (lambda x: torch.tensor([1.0], device=x.device), 1),
        (lambda x: torch.unique(x), 1), (lambda x: x[torch.tensor([0, 0])], 1),
        (lambda x: x.repeat_interleave(torch.ones(2, dtype=torch.long, device=x.device)), 1),
        (lambda x: x * 2 + 1, 0), (lambda x: x.new_zeros(3), 0), (lambda x: x[x.argsort()], 0),
        (lambda x: torch.where(x > 0, x, 0.0), 0), (lambda x: x.repeat_interleave(3), 0),
    ],
)  # fmt: skip
def test_waits_are_counted(ask, count):
    with stand_in() as waits:
        x = torch.zeros(2, device=DEVICE)
        waits.places.clear()
        ask(x)
        assert waits.places.total() == count
