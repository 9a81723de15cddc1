"""Options are checked by their types, alike from Python and from a config; and conf says what the
classes say."""

from __future__ import annotations

import copy
import dataclasses
import operator
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import yaml
from annotated_types import Ge, Gt, Interval, Le, Len, Lt, MinLen
from omegaconf import OmegaConf

from ipe_bench.baselines import EKF, LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.options import Count, Finite, NonNegative, Positive, Share, Whole, checked
from ipe_bench.measurements import Gins, Nist, Ranging
from ipe_bench.noise import Gaussian
from ipe_bench.plugins import discovery
from ipe_bench.plugins.construct import construct
from ipe_bench.priors import GaussianPrior
from ipe_bench.runs.execution import Processes
from ipe_bench.solvers import Newton, Relinearized, SteepestDescent
from ipe_bench.states import Formulas

inf, nan = np.inf, np.nan


@pytest.mark.parametrize(
    ("text", "wrong"), [("a: 1\nb: 2\na: 3", "a is there twice"), ("a: &x 1\nb: *x", "an alias")]
)
def test_yaml_that_would_lose_or_hide_a_value_is_refused(text, wrong):
    assert discovery.read_yaml("a: 1e-6\nb: [2, x]") == {"a": 1e-6, "b": [2, "x"]}
    with pytest.raises(yaml.YAMLError, match=wrong):
        discovery.read_yaml(text)


@pytest.mark.parametrize(
    ("hint", "good", "bad", "remedy"),
    [
        (
            Positive,
            [1e-300, 2, np.float32(0.5)],
            [0, -1, inf, nan, True, "1", None],
            "a number above 0",
        ),
        (NonNegative, [0, 1e300], [-1e-9, inf, nan, False], "a number from 0 up"),
        (Finite, [-1e300], [inf, -inf, nan], "a finite number"),
        (Annotated[float, Gt(2)], [inf, 3], [2, nan], "a number above 2"),
        (Share, [0, 1, 0.5], [-0.1, 1.1, nan], "a number from 0 to 1"),
        (Count, [1, np.int64(7)], [0, 1.0, True, "3"], "a whole number above 0"),
        (Whole, [0], [-1, 0.0], "a whole number from 0 up"),
        (Annotated[float, Gt(0), Lt(1)], [0.5], [0, 1, nan], "a number between 0 and 1"),
        (Annotated[float, Gt(0), Le(1)], [1], [0, 1.01], "a number above 0 and up to 1"),
        (Annotated[float, Ge(0), Lt(1)], [0, 0.99], [1, -1], "a number from 0 to below 1"),
        (Positive | None, [None, 3], [0, "null"], "a number above 0 or null"),
        (bool, [True], [1, "true"], "true or false"),
        (str, ["a"], [1, None], "a text"),
        (
            Annotated[tuple[int, ...], MinLen(2)],
            [[1, 2], (1, 2, 3)],
            [(), (1,)],
            "a list of at least 2",
        ),
        (tuple[float, float], [(1, 2), np.ones(2)], [(1,), 3, "ab"], "a list of 2 numbers"),
        (Mapping[str, Any], [{}], [[], 1], "keys and values"),
        (Any, [object], [], ""),
    ],
)
def test_a_type_accepts_what_it_means_and_says_what_it_wants(hint, good, bad, remedy):
    for value in good:
        checked(value, hint, "key")
    for value in bad:
        with pytest.raises(UserError, match=rf"^key=.*: give {remedy}$"):
            checked(value, hint, "key")


@pytest.mark.parametrize(("text", "unit"), [("5mm", "mm"), ("99.9 %", "%"), ("-.5°", "")])
def test_a_number_with_its_unit_is_told_to_come_without(text, unit):
    said = f"^key={text}: leave {unit} out, and give a" if unit else "°: give a number"
    with pytest.raises(UserError, match=said):
        checked(text, Positive, "key")


def test_a_choice_is_one_of_its_own_type():
    assert checked(2, Literal[1, 2], "start") == 2
    for value in (3, "1", True, 1.0):
        with pytest.raises(UserError, match=r"^start=.*: choose one of 1, 2$"):
            checked(value, Literal[1, 2], "start")


@pytest.mark.parametrize(
    ("value", "hint", "kept"),
    [
        (np.True_, bool, True),
        (np.int64(2), Literal[1, 2], 2),
        (np.array(2.0), float, 2.0),
        (np.str_("a"), str, "a"),
    ],
)
def test_a_single_value_of_numpy_is_as_good_as_one_of_python(value, hint, kept):
    found = checked(value, hint, "key")
    assert found == kept
    assert type(found) is type(kept)


def test_an_array_that_is_one_number_is_no_list():
    with pytest.raises(UserError, match=r"^key=1.0: give a list$"):
        checked(np.array(1.0), tuple[float, ...], "key")


def test_an_entry_of_a_list_is_named_by_its_place():
    with pytest.raises(UserError, match=r"^beacons\[1\]\[2\]=up: give a number$"):
        Ranging(beacons=((0.0, 0.0, 1.0), (0.0, 0.0, "up")))  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"^deviations\[0\]=-1.0: give a number from 0 up$"):
        GaussianPrior((-1.0,))


def test_values_are_kept_as_their_type_has_them():
    model = Ranging(position=[1, 2, 3], beacons=np.ones((5, 3)), rounds=np.int64(2))  # type: ignore[arg-type]
    assert model.position == (1.0, 2.0, 3.0)
    assert {type(v) for v in model.position} == {float}
    assert type(model.rounds) is int
    assert type(Newton(tolerance=1).tolerance) is float
    assert hash(model) == hash(
        Ranging(position=(1.0, 2.0, 3.0), beacons=((1.0, 1.0, 1.0),) * 5, rounds=2)
    )


# fmt: off
WRONG = [
    (Newton, "tolerance", -1.0), (Newton, "start", "home"), (Relinearized, "budget", 0.0),
    (Gaussian, "deviation", True), (LevenbergMarquardt, "damping", inf),
    (EKF, "prior_inflation", nan),
    (Gins, "readings_per_case", 0), (Nist, "dataset", "Iris"), (Processes, "workers", 0),
    (SteepestDescent, "max_iterations", "many"),
]
# fmt: on


@pytest.mark.parametrize(
    ("cls", "key", "value"), WRONG, ids=lambda v: getattr(v, "__name__", str(v))
)
def test_python_and_config_say_the_same_of_a_mistake(cls, key, value):
    with pytest.raises(UserError) as from_python:
        cls(**{key: value})
    with pytest.raises(UserError) as from_config:
        construct({"_target_": f"{cls.__module__}.{cls.__qualname__}", key: value}, "part")
    assert str(from_config.value) == f"part.{from_python.value}"
    assert str(from_python.value).startswith(f"{key}={value}: ")


@dataclass(frozen=True)
class Own:
    """A plugin's class that knows nothing of `Component`, with a `__post_init__` of its own."""

    size: Positive = 1.0
    count: int = 1

    def __post_init__(self) -> None:
        if self.count > 9:
            raise ValueError(f"count={self.count}:\nat most 9")


@dataclass(frozen=True)
class Deaf(Newton):
    """A plugin's class whose `__post_init__` does not call ours."""

    gain: Share = 0.5

    def __post_init__(self) -> None:
        pass


@dataclass(frozen=True)
class Unreadable:
    option: Missing = 1  # type: ignore[name-defined]  # noqa: F821


def test_what_a_plugins_class_does_not_check_is_checked_where_it_is_constructed():
    discovery.packages.add(__name__)
    made = construct({"_target_": f"{__name__}.Own", "size": 2}, "part")
    assert type(made.size) is float
    for options, said in (
        ({"_target_": "Own", "size": 0.0}, r"^part\.size=0\.0: give a number above 0$"),
        (
            {"_target_": "Own", "sise": 1.0},
            r"^part\.sise: there is no such option; did you mean size\?",
        ),
        ({"_target_": "Own", "count": 10}, r"^part: count=10: at most 9$"),
        ({"_target_": "Deaf", "gain": 2.0}, r"^part\.gain=2\.0: give a number from 0 to 1$"),
        ({"_target_": "Deaf", "tolerance": 0.0}, r"^part\.tolerance=0\.0: give a number above 0$"),
        (
            {"_target_": "Unreadable"},
            r"Unreadable: the type of an option cannot be read \(NameError",
        ),
        ({"_target_": "np"}, "is not a component"),
        ({"_target_": "Deef"}, r"Deef: test_options has no Deef; did you mean Deaf\?$"),
    ):
        with pytest.raises(UserError, match=said):
            construct({**options, "_target_": f"{__name__}.{options['_target_']}"}, "part")


PRESETS = {
    # Ways of one class that stand in tables beside its default.
    ("baseline", "dogbox"): {"method"},
    ("baseline", "geodesic_lm"): {"geodesic"},
    ("baseline", "minpack"): {"method"},
    ("baseline", "ukf_wide"): {"alpha"},
    # Each is one way in which the truth may be richer; the class itself is GINS as it is.
    ("measurement", "gins_misaligned"): {"accelerometer_misalignment", "platform_misalignment"},
    ("measurement", "gins_nonlinear"): {"accelerometer_quadratic"},
    ("measurement", "gins_random_walk"): {"gyro_random_walk"},
    ("measurement", "gins_platform_misaligned"): {"platform_misalignment"},
    # The filters and smoothers are rules and numbers of iterations.
    **{("tracker", name): {"rule"} for name in ("ukf", "ckf", "ghkf")},
    ("tracker", "ipe_newton"): {"method"},
    ("tracker", "iterated_ekf"): {"iterations"},
    ("tracker", "iplf"): {"rule", "iterations"},
    ("tracker", "ukf_rts"): {"filter"},
    ("tracker", "ieks"): {"first"},
    ("tracker", "ipls"): {"first", "rule"},
}


PARTS_OF_A_REPORT = ("statistic", "figure", "table", "section")


def test_an_import_that_fails_is_named_by_its_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "my_library.py").write_text("import math\nimport nunpy\n")
    discovery.packages.add("my_library")
    said = (
        r"my_library\.py, line 2: ModuleNotFoundError: No module named 'nunpy';"
        r" install what the plugin needs$"
    )
    with pytest.raises(UserError, match=said):
        construct({"_target_": "my_library.Model"}, "part")


DESCRIBED = (
    "_target_: ipe_bench.measurements.Ode",
    "_target_: ipe_bench.states.Formulas",
    "states.RecordedFormulas",
)
"""Of models that are nothing but their config."""


@pytest.mark.parametrize(
    "option",
    [
        o
        for o in discovery.options()
        if o.group not in ("experiment", *PARTS_OF_A_REPORT)
        and not any(text in o.path.read_text(encoding="utf-8") for text in ("???", *DESCRIBED))
    ],
    ids=lambda o: f"{o.group}={o.name}",
)
def test_conf_says_what_the_class_says(option):
    config: Any = OmegaConf.to_container(OmegaConf.load(option.path))
    try:
        component = construct(config, option.group)
    except UserError as error:
        if "No module named" in str(error):
            pytest.skip(str(error))
        raise
    fields = {f.name: f for f in dataclasses.fields(component) if f.init}
    assert set(config) - {"_target_"} <= set(fields)
    assert option.group in ("measurement", "execution") or set(fields) <= set(config), (
        "an option that nobody sees"
    )
    if any(f.default is f.default_factory for f in fields.values()):
        return  # a model that a file describes: the class alone is none
    differs = {
        name for name in fields if getattr(component, name) != getattr(type(component)(), name)
    }
    assert differs == PRESETS.get((option.group, option.name), set())


def test_a_component_keeps_dictionaries_of_its_own_that_nobody_edits():
    """A model whose constant was edited tracked by its old value, which machine code had."""
    shared = {"rate": 0.5}
    options = {"next": {"x": "rate*x"}, "readings": {"z": "x"}, "deviation": {"z": 1.0}}
    first = Formulas(**options, spread={"x": 1.0}, constants=shared)
    shared["rate"] = 0.9
    assert first.constants == {"rate": 0.5}
    for edit in (
        lambda entries: entries.update(rate=0.9),
        lambda entries: operator.setitem(entries, "rate", 0.9),
        lambda entries: operator.delitem(entries, "rate"),
    ):
        with pytest.raises(UserError, match="make another component"):
            edit(first.constants)
    for same in (pickle.loads(pickle.dumps(first)), copy.deepcopy(first), replace(first)):
        assert same == first
    assert replace(first, constants=shared).constants == {"rate": 0.9}


@pytest.mark.parametrize(
    ("value", "hint", "said"),
    [
        (5.0, Annotated[float, Interval(gt=0, lt=1)], "a number between 0 and 1"),
        ((), Annotated[tuple[float, ...], Len(1)], "a list of at least 1"),
        (2, Annotated[float, Lt(1), Gt(0)], "a number below 1 and above 0"),
        (-7, Annotated[int, Ge(0), Le(5), Lt(4)], "a whole number from 0 up and up to 5 and below"),
        ("abc", Sequence[float], "a list"),
        (b"abc", Sequence, "a list"),
        (10**400, float, "a number"),
        (10**400, Positive, "a number above 0"),
    ],
    ids=["Interval", "Len", "upper first", "three", "text", "bytes", "giant", "positive giant"],
)
def test_a_constraint_made_of_others_a_text_and_a_giant_are_refused(
    value: Any, hint: Any, said: str
) -> None:
    with pytest.raises(UserError, match=f"give {said}"):
        checked(value, hint, "key")


def test_what_meets_a_constraint_made_of_others_is_taken() -> None:
    assert checked(1, Annotated[float, Interval(ge=0, le=1)], "key") == 1.0
    assert checked([1, 2], Sequence[int], "key") == (1, 2)
