"""Benchmark of kernels: a line for each, whose results agree; what is not there is refused."""

import pytest

from eval.benchmarks.kernels import main


def test_a_line_of_a_kernel_and_its_twin(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["kernels", "--only", "level 4", "--repeats", "1"])
    main()
    _, line = capsys.readouterr().out.splitlines()
    assert line.startswith("correlation, level 4") and 0 <= float(line.split()[-1]) < 1e-3


@pytest.mark.parametrize(
    ("precision", "names", "most"),
    [("bfloat16", ["encoder", "correlation", "update"], 0.2), ("int8", ["correlation", "update"], 1.0)],
)
def test_prints_both_precisions_of_the_network(precision, names, most, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["kernels", "--only", precision, "--repeats", "1"])
    main()
    lines = capsys.readouterr().out.splitlines()[1:]
    assert [line.split(",")[0] for line in lines] == names
    assert all(0 < float(line.split()[-1]) < most for line in lines)


@pytest.mark.parametrize("arguments", [["--only", "none"], ["--repeats", "0"]])
def test_no_run(capsys, monkeypatch, arguments):
    monkeypatch.setattr("sys.argv", ["kernels", *arguments])
    with pytest.raises(SystemExit):
        main()
    assert "correlation, level 1" in capsys.readouterr().err
