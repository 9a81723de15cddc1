"""The JSON schema accepts every config that we ship, and refuses what a run would refuse."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.options import checked, option_types
from ipe_bench.cli.spec import keys_of_a_run
from ipe_bench.plugins import discovery
from ipe_bench.plugins.construct import find_class
from ipe_bench.plugins.schema import name_of, schema_of

ROOT = Path(__file__).parents[2]
SHIPPED = sorted([*(ROOT / "conf").rglob("*.yaml"), *(ROOT / "plugins").rglob("conf/**/*.yaml")])
OURS = [o for o in discovery.options() if o.source.name == "ipe-bench" and o.group in discovery.COMPONENT_GROUPS]
EXPERIMENT = "defaults: [{override /measurement: gins}, {override /solver: [newton]}]\n"


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    ours = [option for option in discovery.options() if option.source.name == "ipe-bench"]
    found, problems = schema_of(ours, keys_of_a_run())
    assert not problems
    Draft202012Validator.check_schema(found)
    return found


@pytest.fixture(scope="module")
def validator(schema) -> Draft202012Validator:
    return Draft202012Validator(schema)


def read(text: str) -> Any:
    return yaml.load(text, discovery._Loader)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: "/".join(path.parts[-2:]))
def test_what_we_ship_fits(path, validator):
    assert [error.message for error in validator.iter_errors(read(path.read_text(encoding="utf-8")))] == []


@pytest.mark.parametrize(
    "text",
    [
        "_target_: ipe_bench.solvers.Newtn",
        "_target_: ipe_bench.solvers.Newton\ntolerence: 1.0",
        "_target_: ipe_bench.solvers.Newton\ntolerance: 0",
        "_target_: ipe_bench.solvers.newton.Newton\ntolerance: small",
        "_target_: ipe_bench.solvers.Newton\nstart: here",
        "defaults: [{override /measurement: gin}]",
        "defaults: [{override /mesurement: gins}]",
        "defaults: [{override /solver: [newtn]}]",
        EXPERIMENT + "trials: 0",
        EXPERIMENT + "trails: 5",
        EXPERIMENT + "estimators: {newton: {tolerence: 1}}",
        EXPERIMENT + "estimators: {newton: 5}",
        EXPERIMENT + "measurement: {rounds: 5}",
        EXPERIMENT + "measurement: {interval_min: 0}",
        EXPERIMENT + "hydra: fast",
        "[]",
    ],
)
def test_what_a_run_would_refuse_does_not_fit(text, validator):
    assert not validator.is_valid(read(text))


@pytest.mark.parametrize(
    "text",
    [
        "_target_: ipe_bench.solvers.Newton\ntolerance: ${tolerance}",
        "_target_: my_plugin.Solver\nanything: 5",
        "_target_: ipe_bench.measurements.Ode\nrates: ???",
        EXPERIMENT + "name: ${default_name}\nmeasurement: {interval_min: 1.5}\nestimators: {my_label: {depth: 2}}",
        "defaults: [{override /measurement@truth_measurement: gins_tilted}, {override hydra/launcher: joblib}, _self_]",
    ],
)
def test_what_a_run_would_take_fits(text, validator):
    assert validator.is_valid(read(text))


# To JSON 1.0 is a whole number, to us it is none.
VALUES = (0, 1, -1, 2, 0.5, -0.5, 12.5, True, "a", "linear_lse", None, [], [1], [1, 2], [[1, 2]], ["a"], {}, {"a": 1})


@pytest.mark.parametrize("option", OURS, ids=lambda o: f"{o.group}/{o.name}")
def test_schema_and_class_agree_of_every_option(option, schema):
    """But for rules that JSON schemas cannot say; such an option is accepted here and refused by the class."""
    properties = schema["$defs"][name_of(option)]["properties"]
    types = option_types(find_class(option.target, option.group))
    assert set(properties) == {"_target_", *types}
    for name, hint in types.items():
        fits = Draft202012Validator(properties[name]).is_valid
        for value in VALUES:
            try:
                checked(value, hint, name)
                accepted = True
            except UserError:
                accepted = False
            if "Predicate" not in str(hint) or accepted:
                assert fits(value) == accepted, (name, value)


def test_every_option_of_ours_has_a_meaning(schema):
    parts = [schema["$defs"][name_of(option)]["properties"] for option in OURS]
    silent = [key for part in parts for key, value in part.items() if value["description"].startswith("Give ")]
    assert silent == []


def test_the_command_prints_it_and_names_what_is_left_out(ipe_bench, tmp_path):
    for name in ("hum", "hiss"):
        assert ipe_bench("new", "noise", name)[0] == 0
    (module,) = tmp_path.rglob("hiss.py")
    module.write_text("import a_library_that_is_not_there\n")
    code, out, error = ipe_bench("schema")
    definitions = json.loads(out)["$defs"]
    assert code == 0
    assert "noise.hum" in definitions
    assert "noise.hiss" not in definitions
    (line,) = error.splitlines()
    assert line.startswith("ipe-bench: noise/hiss: has no schema: ")
    assert "a_library_that_is_not_there" in line
