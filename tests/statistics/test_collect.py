"""Whatever lies in a directory is used or named, and nothing is touched."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.runs import parts
from ipe_bench.runs.execution import Failure
from ipe_bench.runs.provenance import digest
from ipe_bench.runs.run import compute
from ipe_bench.statistics import analyse
from ipe_bench.statistics.collect import collect


@pytest.fixture
def filled(synthetic):
    rng = np.random.default_rng(0)
    scenario = synthetic.scenario()
    for label in ("one", "two"):
        synthetic.add(scenario, label, 0.1 * rng.normal(size=(60, 3)), block=20)
    synthetic.record(60)
    return synthetic


def pieces(store, label="one"):
    cell = next(c for c in store.cells.values() if c.label == label)
    return sorted(store.store.trials.glob(f"{cell.key}-*.parquet"))


def test_a_complete_directory_has_no_problems(filled):
    collection = collect([filled.directory])
    assert collection.problems == []
    assert (collection.complete, collection.expected) == (3, 3)


def test_missing_trials_are_counted_per_cell(filled):
    pieces(filled)[1].unlink()
    collection = collect([filled.directory])
    assert (collection.complete, collection.expected) == (2, 3)
    (line,) = collection.problems
    assert line.startswith("missing: one on repeated, gaussian, error scale 1")
    assert "40 of 60 expected trials" in line


@pytest.mark.parametrize("keep", [0, 10, 500, -9])
def test_a_truncated_file_is_named_skipped_and_left_alone(filled, keep):
    path = pieces(filled)[0]
    content = path.read_bytes()[:keep]
    path.write_bytes(content)
    analysis = analyse([filled.directory])
    assert any(str(path) in line and "damaged" in line for line in analysis.collection.problems)
    assert path.read_bytes() == content
    rows = analysis.summary[analysis.summary["parameter"] == "all"].set_index("estimator")
    assert rows.loc["one", "trials"] == 40
    assert rows.loc["two", "trials"] == 60


def test_foreign_files_under_our_names_are_named_and_skipped(filled):
    trials = filled.store.trials
    pq.write_table(pa.table({"x": [1.0]}), trials / "weather.parquet")
    pq.write_table(pa.table({"x": [1.0]}), trials / "0123456789abcdef-0-1.parquet")
    parts.write(
        trials / "0123456789abcdef-1-2.parquet", pa.table({"trial": [1]}), {"key": "another"}
    )
    shutil.copy(pieces(filled)[0], trials / "fedcba9876543210-0-20.parquet")
    (filled.store.runs / "note.json").write_text("[1, 2]")
    analysis = analyse([filled.directory])
    assert len(analysis.collection.problems) == 4
    assert (analysis.summary["trials"] == 60).all()
    assert (trials / "weather.parquet").exists()


def test_a_file_with_fewer_rows_than_its_name_says_is_damaged(filled):
    path = pieces(filled)[0]
    footer, table = parts.StoredPart.parse(path).read()
    parts.write(path, table.slice(0, 5), footer)
    assert any(
        "does not count from 0 to 20" in line for line in collect([filled.directory]).problems
    )


@pytest.mark.parametrize("file", ["kinds", "base"])
def test_stale_results_are_named_and_never_mixed_in(filled, file):
    # The same identity under the key of another source, as older code would have stored it, with
    # noise in this file.
    for path in pieces(filled):
        footer, table = parts.StoredPart.parse(path).read()
        identity = json.loads(
            json.dumps(footer["identity"]).replace(".noise.kinds.", f".noise.{file}.")
        )
        assert (identity == footer["identity"]) is (file == "kinds")
        older = {"key": digest("of older code"), "source": "old"}
        footer = {**footer, **older, "identity": identity, "identity_key": digest(identity)}
        table = table.set_column(table.column_names.index("error_a"), "error_a", [np.full(20, 1e9)])
        parts.write(path.with_name(path.name.replace(path.name[:16], footer["key"])), table, footer)
    analysis = analyse([filled.directory])
    assert not analysis.collection.problems
    (line,) = analysis.collection.stale
    assert line.startswith("stale: one on repeated")
    assert "60 trials" in line
    assert analysis.summary["rmse_solved"].max() < 1e3


def test_failed_blocks_are_told_from_missing_ones(filled):
    first, second, _ = pieces(filled)
    first.unlink()
    second.unlink()
    cell = next(c for c in filled.cells.values() if c.label == "one")
    start, stop = map(int, first.stem.split("-")[1:])
    filled.store.write_failure(cell, start, stop, Failure("error", "MemoryError: too large", ""))
    failed, missing = collect([filled.directory]).problems
    assert failed.startswith("failed: one on")
    assert "20 of 60 expected trials: error: MemoryError: too large" in failed
    assert missing.startswith("missing: one on")
    assert "20 of 60 expected trials are there" in missing


def test_a_directory_that_is_not_there_is_the_users_mistake(tmp_path):
    with pytest.raises(UserError, match="no such directory"):
        collect([tmp_path / "nowhere"])


def test_the_truth_being_absent_is_a_problem_and_not_a_crash(filled):
    for path in pieces(filled, "truth"):
        path.unlink()
    analysis = analyse([filled.directory])
    assert any("the truth" in line for line in analysis.collection.problems)
    assert analysis.summary["crlb"].isna().all()
    assert analysis.summary["rmse_solved"].notna().all()


def test_columns_stand_in_one_order_whichever_other_estimators_there_are(tmp_path):
    scenario = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    few = {"linear": ib.baselines.LinearLSE(), "newton": ib.solvers.Newton()}
    more = few | {"another": ib.baselines.LinearLSE()}
    for folder, estimators in (("few", few), ("more", more)):
        assert not compute([scenario], estimators, 4, tmp_path / folder)
    assert ib.load(tmp_path / "few").columns.tolist() == ib.load(tmp_path / "more").columns.tolist()


@pytest.mark.parametrize(
    ("growths", "shown"),
    [
        ([3.22332032510465, 2.0, 4.70110018], ["2", "3.223", "4.701"]),
        ([3.22332032510465, 3.223321], ["3.22332", "3.223321"]),
        ([3.0, np.nextafter(3.0, 4.0)], ["3", "3.0000000000000004"]),
    ],
)
def test_a_label_says_no_more_of_an_option_than_tells_it_from_others(tmp_path, growths, shown):
    scenario = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    for growth in growths:
        compute([scenario], {"progressive": ib.solvers.Progressive(growth=growth)}, 1, tmp_path)
    groups = collect([tmp_path]).groups
    assert sorted(group.estimator for group in groups) == [
        f"progressive (growth={one})" for one in shown
    ]
    # What is computed with stands in a column of its own, whole.
    assert {group.options["estimator.growth"] for group in groups} == set(growths)
