"""Output files that are replaced as a whole."""

import contextlib
import os
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dvo.core.errors import DvoError
from dvo.data.files import output
from dvo.data.files.output import replaced


def test_a_replacement_reaches_the_disk_before_it_takes_the_name(tmp_path, monkeypatch):
    calls: list[str] = []
    sync, move = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (calls.append("fsync"), sync(handle))[1])
    monkeypatch.setattr(os, "replace", lambda *paths: (calls.append("replace"), move(*paths))[1])
    with replaced(tmp_path / "a.txt") as part:
        part.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert calls == ["fsync", "replace"] and (tmp_path / "a.txt").read_text() == "new"


def test_a_replacement_that_is_interrupted_leaves_nothing_behind(tmp_path):
    with pytest.raises(KeyboardInterrupt), replaced(tmp_path / "a.txt") as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


# -- several writers -----------------------------------------------------------------------------------------------


def test_writers_of_one_file_have_parts_of_their_own_and_the_last_one_wins(tmp_path):
    file = tmp_path / "a.txt"
    with replaced(file) as first:
        with replaced(file) as second:
            assert first != second
            first.write_text("first")
            second.write_text("second")
        assert file.read_text() == "second"
    assert file.read_text() == "first" and list(tmp_path.iterdir()) == [file]


WRITER = """
import sys, threading
from pathlib import Path
from dvo.data.files.output import replaced

def write(letter):
    for _ in range(60):
        with replaced(Path(sys.argv[1])) as part:
            with part.open("w") as file:
                for _ in range(40):
                    file.write(letter * 997)

threads = [threading.Thread(target=write, args=(letter,)) for letter in sys.argv[2]]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
"""


def test_a_reader_meets_whole_files_while_two_processes_with_two_threads_write(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("-" * 997 * 40)
    running = [subprocess.Popen([sys.executable, "-c", WRITER, str(file), two]) for two in ("ab", "cd")]
    reads = 0
    while any(process.poll() is None for process in running):
        text = file.read_text()
        assert len(text) == 997 * 40 and len(set(text)) == 1
        reads += 1
    assert [process.returncode for process in running] == [0, 0] and reads > 5
    assert list(tmp_path.iterdir()) == [file], "no part is left"


def test_parts_of_dead_processes_go_with_the_next_write_and_no_others(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", "import sys, time; from dvo.data.files.output import begin_part; "
         "part = begin_part(sys.argv[1]); part.write_text('x'); print(part, flush=True); time.sleep(60)",
         str(tmp_path / "map.dvo")], stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    part = Path(process.stdout.readline().strip())
    own = tmp_path / ".part-notes.txt"
    own.write_text("of the user")
    with replaced(tmp_path / "other.txt") as file:
        file.write_text("")
    assert part.exists(), "its writer is alive"
    process.kill()
    process.wait()
    with replaced(tmp_path / "other.txt") as file:
        file.write_text("")
    assert not part.exists() and own.exists()


@pytest.mark.skipif(os.name != "posix", reason="processes cannot be asked for")
def test_folders_of_killed_processes_go_with_the_next_one(tmp_path, monkeypatch):
    """In the place of temporary files; those of other programs stay, and that of a process that lives."""
    process = subprocess.Popen(
        [sys.executable, "-c", "import time; from dvo.data.files.output import scratch_folder\n"
         "with scratch_folder('dvo-batch') as folder:\n    (folder / 'x').mkdir(); print(folder, flush=True);"
         " time.sleep(600)"],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "TMPDIR": str(tmp_path)},
    )  # fmt: skip
    left = Path(process.stdout.readline().strip())
    assert left.parent == tmp_path and left.stat().st_mode & 0o777 == 0o700
    (tmp_path / "dvo-batch-mine").mkdir()
    monkeypatch.setattr(output.tempfile, "gettempdir", lambda: str(tmp_path))
    with output.scratch_folder("dvo-batch") as folder:
        assert folder.is_dir() and left.is_dir(), "its process is alive"
    process.kill()
    process.wait()
    with output.scratch_folder("dvo-batch") as folder:
        assert folder.is_dir() and not left.exists()
    assert [child.name for child in tmp_path.iterdir()] == ["dvo-batch-mine"]


def test_a_part_of_another_machine_goes_when_it_is_old(tmp_path):
    for name, age in (("new", 60), ("old", 2 * output.ABANDONED)):
        part = tmp_path / f".part-00000000-1-00000000-0-{name}"
        part.write_text("")
        os.utime(part, (time.time() - age,) * 2)
    output.sweep_parts(tmp_path)
    assert [part.name[-3:] for part in tmp_path.iterdir()] == ["new"]


@pytest.mark.parametrize("name", ["x" * 255, "é" * 120 + ".txt", "a." + "b" * 250])
def test_a_name_may_be_as_long_as_the_system_allows(tmp_path, name):
    output.write_text(tmp_path / name, "text")
    assert (tmp_path / name).read_text() == "text"


# -- places that are no regular file -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["folder", "pipe", "socket", "link to a pipe"])
def test_only_a_regular_file_is_replaced(tmp_path, kind):
    place = tmp_path / "place"
    if kind == "folder":
        place.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server, contextlib.chdir(tmp_path):
            server.bind("place")
    else:
        os.mkfifo(tmp_path / "pipe")
        place = tmp_path / "pipe" if kind == "pipe" else place
        if kind != "pipe":
            place.symlink_to("pipe")
    before = os.lstat(place)
    with pytest.raises(OSError, match="folder" if kind == "folder" else "not a regular file"):
        output.write_text(place, "text")
    with pytest.raises(DvoError, match="--save-map"):
        output.check_place(place, "--save-map")
    assert os.lstat(place).st_mode == before.st_mode and len(list(tmp_path.iterdir())) == 1 + (kind[0] == "l")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root makes devices")
def test_a_device_is_not_replaced(tmp_path):
    device = tmp_path / "null"
    os.mknod(device, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    with pytest.raises(OSError, match="not a regular file"):
        output.write_text(device, "text")
    assert stat.S_ISCHR(device.stat().st_mode)


def test_a_link_is_followed(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there/a.txt")
    for text in ("first", "second"):
        output.write_text(tmp_path / "link", text)
        assert (tmp_path / "link").is_symlink() and (tmp_path / "there" / "a.txt").read_text() == text


# -- folders -------------------------------------------------------------------------------------------------------


def test_a_new_folder_appears_whole(tmp_path):
    with output.new_folder(tmp_path / "a" / "b") as part:
        (part / "c.txt").write_text("")
        assert not (tmp_path / "a" / "b").exists()
    assert [file.name for file in (tmp_path / "a" / "b").iterdir()] == ["c.txt"]
    with pytest.raises(DvoError, match="not an empty folder"), output.new_folder(tmp_path / "a" / "b"):
        pytest.fail("must not begin")
    with pytest.raises(ZeroDivisionError), output.new_folder(tmp_path / "other"):
        raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_link_to_an_empty_folder_is_followed(tmp_path):
    (tmp_path / "disk" / "empty").mkdir(parents=True)
    (tmp_path / "link").symlink_to("disk/empty")
    with output.new_folder(tmp_path / "link") as part:
        (part / "c.txt").write_text("")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "disk" / "empty" / "c.txt").exists()


def test_a_mounted_folder_keeps_its_place(tmp_path, monkeypatch):
    """As that of a container, which can neither be removed nor renamed."""
    (tmp_path / "out").mkdir()
    number = (tmp_path / "out").stat().st_ino
    monkeypatch.setattr(os.path, "ismount", lambda path: True)
    with output.new_folder(tmp_path / "out") as part:
        assert part.parent == tmp_path / "out"
        (part / "a").mkdir()
        (part / "a" / "c.txt").write_text("")
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["a"] and (tmp_path / "out" / "a" / "c.txt").exists()
    assert (tmp_path / "out").stat().st_ino == number
    with pytest.raises(DvoError, match="not an empty folder"), output.new_folder(tmp_path / "out"):
        pytest.fail("must not begin")


def test_of_two_writers_of_a_folder_the_second_gets_an_error(tmp_path):
    with pytest.raises(DvoError, match="not an empty folder"), output.new_folder(tmp_path / "a") as slow:
        (slow / "slow").write_text("")
        with output.new_folder(tmp_path / "a") as quick:
            (quick / "quick").write_text("")
    assert [file.name for file in (tmp_path / "a").iterdir()] == ["quick"]


def test_a_folder_has_one_writer_at_a_time(tmp_path):
    again = pytest.raises(DvoError, match="--out: another run is writing")
    with output.only_writer(tmp_path, "--out"), again, output.only_writer(tmp_path, "--out"):
        pytest.fail("must not begin")
    assert list(tmp_path.iterdir()) == []
    process = subprocess.Popen(
        [sys.executable, "-c", "import sys, time; from pathlib import Path; "
         "from dvo.data.files.output import only_writer\n"
         "with only_writer(Path(sys.argv[1]), '--out'): print(flush=True); time.sleep(60)", str(tmp_path)],
        stdout=subprocess.PIPE,
    )  # fmt: skip
    process.stdout.readline()
    with pytest.raises(DvoError), output.only_writer(tmp_path, "--out"):
        pytest.fail("must not begin")
    process.kill()
    process.wait()
    with output.only_writer(tmp_path, "--out"):
        pass
    assert list(tmp_path.iterdir()) == []
