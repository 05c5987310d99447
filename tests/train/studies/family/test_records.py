"""Tables of measurements."""

import threading
from dataclasses import replace

import pytest

from dvo.core.errors import DvoError
from train.studies.family.records import Records, Table


def test_rows_are_appended_and_the_last_of_equal_ones_counts(tmp_path):
    file = tmp_path / "folder" / "t.csv"
    table, other = (Table(file, ("member", "seed"), ("value",)) for _ in range(2))
    assert table.rows() == []
    table.append(member="a", seed=0, value=1 / 3)
    other.append(member="a", seed=1, value=float("nan"))
    table.append(member="b, c", seed=0, value=float("inf"))
    other.append(member="a", seed=0, value=12)
    assert file.read_text().splitlines()[:2] == ["member,seed,value", "a,0,0.333333"]
    assert [tuple(row.values()) for row in table.rows()] == [("a", "0", "12"), ("a", "1", "nan"), ("b, c", "0", "inf")]
    with pytest.raises(KeyError):
        table.append(member="a", seed=0)


def test_rows_that_were_cut_off_do_not_count(tmp_path):
    table = Table(tmp_path / "t.csv", ("a",), ("b", "c"))
    table.append(a=1, b=2, c=3)
    for part in ("", "2", "2,3", "2,3,4"):  # the process was killed; the next one appends
        with table.file.open("a") as file:
            file.write(part)
        assert [row["a"] for row in table.rows()][:1] == ["1"] and not any(row["a"] == "2" for row in table.rows())
        table.append(a=f"after {part}", b=4, c=5)
    assert [row["a"] for row in table.rows()] == ["1", "after ", "after 2", "after 2,3", "after 2,3,4"]
    assert {(row["b"], row["c"]) for row in table.rows()} == {("2", "3"), ("4", "5")}
    table.file.write_text("a,b\n1,2\n")
    with pytest.raises(DvoError, match=r"t.csv: has no column 'c'"):
        table.rows()


def test_a_table_that_was_begun_without_its_names_gets_them(tmp_path):
    table = Table(tmp_path / "t.csv", ("a",), ("b",))
    table.file.touch()
    assert table.rows() == []
    table.append(a=1, b=2)
    assert table.rows() == [{"a": "1", "b": "2"}] and table.file.read_text() == "a,b\n1,2\n"


def test_rows_of_several_writers_are_all_there(tmp_path):
    def write(number):
        for k in range(20):
            Table(tmp_path / "t.csv", ("a", "b"), ("c",)).append(a=number, b=k, c="x" * 500)

    writers = [threading.Thread(target=write, args=(number,)) for number in range(6)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    head, *rows = (tmp_path / "t.csv").read_text().splitlines()
    assert head == "a,b,c" and sorted(rows) == sorted(f"{a},{b},{'x' * 500}" for a in range(6) for b in range(20))


def test_measurements_with_other_settings_are_refused(family):
    config = family()
    records = Records(config)
    row = {"frames": 8, "posed": 8, "segments": 1, "ate_percent": 1.0, "rotation_ratio": 1.0, "fps": 1.0}
    row |= {"memory_mb": 1.0, "member": "deepvo", "seed": 0, "digest": config.digest("deepvo")}
    names = list(config.held_out.sequences())
    records.sequences.append(**row, sequence=names[0])
    records.check()
    assert records.measured("deepvo", 0) == {names[0]} and records.measured("deepvo", 1) == set()
    records.sequences.append(**row, sequence=names[1])
    assert not records.complete("deepvo", 0)  # the row of the run is missing
    run = dict.fromkeys(records.runs.columns, 1) | {"member": "deepvo", "seed": 0, "digest": row["digest"]}
    records.runs.append(**run)
    assert records.complete("deepvo", 0) and not records.complete("null", 0)
    changed = Records(replace(config, clips=2))
    with pytest.raises(DvoError, match=r"runs.csv: holds measurements of deepvo with other settings"):
        changed.check()
