"""Files appear under their names whole or not at all, and nothing else is left of a write that
fails."""

import os

import pytest

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import fault_of, write_atomically, write_text


@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), KeyboardInterrupt(), ValueError("odd")]
)
def test_a_write_that_fails_leaves_what_was_there(tmp_path, error):
    path = tmp_path / "folder" / "a.txt"
    write_text(path, "whole")

    def fails(temporary):
        temporary.write_text("half")
        raise error

    with pytest.raises(StorageError if isinstance(error, OSError) else type(error)):
        write_atomically(path, fails)
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]
    write_text(path, "other")
    assert path.read_text() == "other"
    assert list(path.parent.iterdir()) == [path]


def test_a_text_with_bytes_that_are_no_utf8_and_a_terminal_s_commands_is_written(tmp_path):
    write_text(tmp_path / "page.html", "of bad\udcff, \x1b[31mred, é\tand \n")
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == (
        "of bad\\udcff, \\x1b[31mred, é\tand \n"
    )


def test_what_is_no_file_says_what_it_is(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "file").touch()
    said = {name: fault_of(tmp_path / name) for name in ("file", "pipe", "loop", ".", "none")}
    assert said == {
        "file": "",
        "pipe": "is no regular file; name a file",
        "loop": "is no regular file; name a file",
        ".": "is a folder; name a file",
        "none": "there is no such file",
    }
