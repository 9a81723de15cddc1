"""Files appear under their names whole or not at all, and nothing else is left of a write that
fails."""

import pytest

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import write_atomically, write_text


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
