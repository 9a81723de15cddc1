"""`check` on options that are made of others, that suit one number of readings, or that want
something given."""

import itertools
import subprocess
import sys
from pathlib import Path

import pytest

from ipe_bench.cli.main import main
from ipe_bench.plugins import discovery
from ipe_bench.workshop.conformance import check_option, left_of_skeleton

_numbers = itertools.count()

GOOD = {
    "noise/made_of_another": "defaults: [gaussian]\ndeviation: 0.3\n",
    "noise/made_of_ours": "defaults: [NOISE_made_of_another, _self_]\n",
    "noise/for_fourteen": "_target_: ipe_bench.noise.Gaussian\ndeviation:"
    " [1,1,1,1,1,1,1,1,1,1,1,1,1,2]\n",
    "prior/for_three": "defaults: [gaussian]\ndeviations: [1,2,3]\ncorrelations:"
    " [[1,0.5,0],[0.5,1,0],[0,0,1]]\n",
    "baseline/tight": (
        "# @package estimators.tight\ndefaults: [levenberg_marquardt@_here_, _self_]\ntolerance:"
        " 1e-9\n"
    ),
    "measurement/of_a_file": (
        "_target_: ipe_bench.measurements.Formula\nexpression: b1*(1-exp(-b2*t))\nstart: {b1: 250,"
        " b2: 5e-4}\n"
    ),
    "measurement/equations": (
        "defaults: [ode, _self_]\nrates: {y: -k*y}\ninitial: {y: dose}\nstart: {k: 1}\nunit: mg\n"
    ),
    "measurement/to_be_given": "defaults: [formula, _self_]\nstart: {b1: 250}\n",
}


@pytest.fixture
def checked(tmp_path):
    """The findings on one option of a plugin with a name of its own."""

    def check(files: dict[str, str], chosen: str):
        package = f"lab{next(_numbers)}"
        (tmp_path / package / "conf").mkdir(parents=True)
        (tmp_path / package / "__init__.py").touch()
        for place, text in files.items():
            path = tmp_path / package / "conf" / f"{place}.yaml"
            path.parent.mkdir(exist_ok=True)
            path.write_text(f"{text}")
        (option,) = [o for o in discovery.options_in(tmp_path) if f"{o.group}/{o.name}" == chosen]
        return list(check_option(option))

    yield check
    discovery._added.pop(tmp_path.resolve(), None)
    discovery.sources.cache_clear()


@pytest.mark.parametrize("place", GOOD)
def test_an_option_that_can_be_used_passes(checked, place):
    own = (
        {"noise/NOISE_made_of_another": GOOD["noise/made_of_another"]}
        if place == "noise/made_of_ours"
        else {}
    )
    findings = checked({place: GOOD[place], **own}, place)
    assert not [f for f in findings if f.complaint]
    if place != "measurement/to_be_given":
        assert len(findings) >= 4


def test_an_option_that_the_class_has_no_more_is_told_of_with_its_file(checked):
    text = "_target_: ipe_bench.noise.Gaussian\nkappa: 1.0\n"
    (finding,) = checked({"noise/leftover": text}, "noise/leftover")
    assert finding.check.endswith("leftover.yaml")
    assert "kappa: there is no such option" in finding.complaint


def test_what_is_to_be_given_is_named(checked):
    place = "measurement/to_be_given"
    (finding,) = checked({place: GOOD[place]}, place)
    assert finding.check == "Names what is to be given, expression, and is tried where it is"


BAD = {
    "a fault in what is made of another": (
        {"noise/bad": "defaults: [gaussian]\ndeviation: -1\n"}, "noise/bad",
        "deviation=-1: give a number above 0"
    ),
    "no such option": ({"noise/bad": "defaults: [gausian]\n"}, "noise/bad",
                       "did you mean gaussian"),
    "of another group": ({"noise/bad": "defaults: [{prior: gaussian}]\n"}, "noise/bad",
                         "no such option of noise"),
    "no list": ({"noise/bad": "defaults: gaussian\n"}, "noise/bad",
                "is no list; write defaults: [gaussian]"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_fault_is_still_found(checked, case):
    files, chosen, expected = BAD[case]
    assert expected in " ".join(f.complaint for f in checked(files, chosen))


@pytest.mark.slow
def test_the_generated_test_of_a_model_with_an_option_that_it_cannot_do_without(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "measurement", "tank"]) == 0
    home = Path("plugins/tank")
    (code,) = [p for p in home.rglob("*.py") if "@dataclass" in p.read_text()]
    text = code.read_text()
    head, mark, rest = text.partition("@dataclass(frozen=True)\n")
    name, docs = rest.split('"""', 2)[0], rest.split('"""', 2)
    code.write_text(f'{head}{mark}{name}"""{docs[1]}"""\n\n    level: float\n{docs[2]}')
    run = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(home)]
    assert (
        subprocess.run(run, capture_output=True, text=True, timeout=300, check=False).returncode
        == 1
    )
    (config,) = home.rglob("conf/measurement/*.yaml")
    config.write_text(config.read_text() + "\nlevel: 2.0\n")
    done = subprocess.run(run, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout


def test_texts_of_a_skeleton_are_found_in_its_code_and_its_config(ipe_bench):
    assert ipe_bench("new", "measurement", "tank")[0] == 0
    own = discovery.options_in(Path("plugins/tank"))
    found = {finding.component for finding in left_of_skeleton(own)}
    assert found == {"tank.py", "tank.yaml"}
    for path in Path("plugins/tank").rglob("tank.*"):
        path.write_text(
            path.read_text().replace("One line that", "What").replace("Replace", "These are")
        )
    assert not list(left_of_skeleton(own))
