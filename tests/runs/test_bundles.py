"""A bundle is what it was made of, the same bytes wherever it is made, and nothing at all once
anything is changed."""

import hashlib
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from shared.synthetic_store import Synthetic

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.cli.main import main
from ipe_bench.runs.bundles import MANIFEST, opened, read_bundle, write_bundle


def fill(folder: Path, factor: float = 1.0, trials: int = 30) -> Path:
    store = Synthetic(folder)
    error = 0.1 * factor * np.random.default_rng(0).standard_normal((trials, 3))
    for label in ("linear_lse", "one"):
        store.add(store.scenario(), label, error)
    store.record(trials)
    return folder


@pytest.fixture
def bundle(tmp_path):
    return write_bundle([fill(tmp_path / "theirs")], tmp_path / "theirs.zip")


def rewritten(path: Path, target: Path, change) -> Path:
    """A copy of an archive whose entries went through `change`, a function of (name, content)."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            for kept, content in change(name, old.read(name)):
                new.writestr(kept, content)
    return target


def test_what_is_read_from_a_bundle_is_what_was_stored(bundle, tmp_path):
    pd.testing.assert_frame_equal(ib.load(bundle.path), ib.load(tmp_path / "theirs"))
    table = ib.status(bundle.path)
    assert table.attrs["problems"] == []
    assert table["done"].tolist() == [30, 30, 30]


def test_the_same_results_give_the_same_bytes_anywhere(bundle, tmp_path):
    copy = tmp_path / "elsewhere" / "theirs"
    shutil.copytree(tmp_path / "theirs", copy)
    again = write_bundle([copy], tmp_path / "again.zip")
    assert again.path.read_bytes() == bundle.path.read_bytes()
    assert again.digest == bundle.digest


def test_a_report_on_ones_own_and_a_bundle(bundle, tmp_path, capsys):
    mine = Synthetic(tmp_path / "mine")
    mine.add(mine.scenario(error_scale=3.0), "one", np.full((20, 3), 0.1))
    mine.record(20)
    out = tmp_path / "out"
    words = ["report", str(mine.directory), str(bundle.path), f"output={out}", "figures=none"]
    assert main(words) == 0
    summary = pd.read_csv(out / "summary.csv")
    assert set(summary["error_scale"]) == {1.0, 3.0}
    before = (out / "report.html").stat().st_mtime_ns
    assert main(words) == 0
    assert (out / "report.html").stat().st_mtime_ns == before
    assert main(["report", str(bundle.path)]) == 2
    assert "say where the report goes with output=DIR" in capsys.readouterr().err


CHANGES = {
    "a value": lambda name, content: [(name,
        content.replace(b"PAR1", b"PAR2") if "trials" in name else content)],
    "a file less": lambda name, content: [] if "runs/" in name else [(name, content)],
    "a file more": lambda name, content: [(name, content),
        *([("theirs/trials/x.parquet", b"")] * (name == MANIFEST))],
    "a digest": lambda name, content: [(name, content.swapcase() if name == MANIFEST else content)],
    "no manifest": lambda name, content: [] if name == MANIFEST else [(name, content)],
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_bundle_that_was_changed_is_refused_in_one_line_and_leaves_nothing(
    bundle, tmp_path, change, capsys
):
    bad = rewritten(bundle.path, tmp_path / "bad.zip", change)
    mine = fill(tmp_path / "mine")
    out = tmp_path / "out"
    for words in (
        ["compare", str(mine), str(bad)],
        ["report", str(mine), str(bad), f"output={out}"],
    ):
        assert main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert str(bad) in line
    assert not out.exists()


def test_any_byte_that_is_changed_is_noticed(bundle, tmp_path):
    """Or is one of the zip's own, which says nothing of the results: then these are read as they
    were."""
    whole = bundle.path.read_bytes()
    expected = ib.load(bundle.path)
    noticed = 0
    for at in np.linspace(0, len(whole) - 1, 60).astype(int):
        bad = tmp_path / "bad.zip"
        bad.write_bytes(whole[:at] + bytes([whole[at] ^ 0x41]) + whole[at + 1 :])
        try:
            pd.testing.assert_frame_equal(ib.load(bad), expected)
        except UserError:
            noticed += 1
    assert noticed > 45


ODD = [
    "../evil.json",
    "/runs/evil.json",
    "theirs/../../runs/x.json",
    "theirs/log/x.json",
    "theirs/runs/x.py",
]
ODD += [
    f"{folder}/runs/x.json"
    for folder in ("C:", "CON", "nul.x", "-rf", " ", "~", ".git", "a:b", "a\u202eb", "base.")
]
ODD += [f"theirs/runs/{300 * 'x'}.json", f"{300 * 'x'}/runs/x.json"]


@pytest.mark.parametrize("name", ODD)
def test_a_manifest_cannot_write_elsewhere(bundle, tmp_path, name):
    def change(entry, content):
        yield (
            entry,
            content
            + f"{hashlib.sha256(b'{}').hexdigest()}  {name}\n".encode() * (entry == MANIFEST),
        )
        if entry == MANIFEST:
            yield name, b"{}"

    bad = rewritten(bundle.path, tmp_path / "bad.zip", change)
    before = set(tmp_path.rglob("*"))
    with (
        pytest.raises(UserError, match="is no name of a result"),
        opened([bad], tmp_path / "a" / "b"),
    ):
        pass
    assert set(tmp_path.rglob("*")) == before


def test_a_small_archive_that_unpacks_to_much_is_refused_before_it_is_unpacked(bundle, tmp_path):
    bomb, name = tmp_path / "bomb.zip", "theirs/runs/x.json"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        zeros = bytes(10_000_000)
        archive.writestr(MANIFEST, f"{hashlib.sha256(zeros).hexdigest()}  {name}\n")
        archive.writestr(name, zeros)
    with pytest.raises(UserError, match="would unpack to over 100 times its size"):
        read_bundle(bomb)


def test_a_file_that_is_longer_than_the_archive_states_is_refused(bundle, tmp_path):
    """Of 10 MB that are listed as one byte, one is read."""
    long, name = tmp_path / "long.zip", "theirs/runs/x.json"
    with zipfile.ZipFile(long, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(MANIFEST, f"{hashlib.sha256(bytes(1)).hexdigest()}  {name}\n")
        archive.writestr(name, bytes(10_000_000))
        archive.getinfo(name).file_size = 1
    with pytest.raises(UserError, match="is not a whole bundle"):
        read_bundle(long)


def test_a_bundle_is_a_plain_zip_that_other_programs_check(bundle, tmp_path):
    with zipfile.ZipFile(bundle.path) as archive:
        archive.extractall(tmp_path / "plain")
    for line in (tmp_path / "plain" / MANIFEST).read_text().splitlines():
        digest, name = line.split("  ")
        assert hashlib.sha256((tmp_path / "plain" / name).read_bytes()).hexdigest() == digest
    pd.testing.assert_frame_equal(ib.load(tmp_path / "plain" / "theirs"), ib.load(bundle.path))


def test_a_folder_of_any_name_is_bundled(tmp_path):
    made = write_bundle([fill(tmp_path / "größte (2)")], tmp_path / "named.zip")
    assert made.folders == ("gr_te_2",)
    pd.testing.assert_frame_equal(ib.load(made.path), ib.load(tmp_path / "größte (2)"))


def test_commands_make_and_check_bundles(tmp_path, capsys):
    folder = fill(tmp_path / "mine")
    assert main(["bundle", str(folder)]) == 0
    made = capsys.readouterr().out
    with zipfile.ZipFile(tmp_path / "mine.zip") as archive:
        digest = hashlib.sha256(archive.read(MANIFEST)).hexdigest()
    assert f"sha256:{digest}" in made
    assert main(["bundle", str(tmp_path / "mine.zip")]) == 0
    assert f"sha256:{digest}" in capsys.readouterr().out
    fill(folder, factor=2.0, trials=40)
    assert main(["bundle", str(folder)]) == 2
    assert "holds other results" in capsys.readouterr().err
    next((folder / "trials").glob("*-0-40.parquet")).unlink()
    assert main(["bundle", str(folder), f"output={tmp_path / 'part.zip'}"]) == 1
    assert "missing" in capsys.readouterr().err
    assert len(read_bundle(tmp_path / "part.zip").files) > 0
    assert main(["bundle", str(tmp_path)]) == 2
    assert main(["bundle"]) == 2
