"""Names that earlier versions had, and results stored under them, are refused with the place where
they are now."""

from dataclasses import dataclass

import numpy as np
import pytest
from shared.synthetic_store import Pretender

import ipe_bench as ib
from ipe_bench.basics.errors import ZOO, UserError
from ipe_bench.plugins.construct import construct
from ipe_bench.runs.results import Results

PLACE = "in the plugin zoo now; work in a clone of ipe-bench, or `pip install CLONE/plugins/zoo`"


@pytest.mark.parametrize(
    "name", ["measurements.Gnss", "measurements.mgh.Mgh", "baselines.es_mda.EsMda"]
)
def test_a_config_that_names_an_old_class(name):
    cls = name.rpartition(".")[2]
    with pytest.raises(UserError) as error:
        construct({"_target_": f"ipe_bench.{name}"}, "part")
    assert str(error.value) == f"part._target_=ipe_bench.{name}: is ipe_bench_zoo.{cls} {PLACE}"


@pytest.mark.parametrize(("room", "name"), [(ib.measurements, "Mgh"), (ib.baselines, "EsMda")])
def test_an_old_class_in_python(room, name):
    with pytest.raises(AttributeError) as error:
        getattr(room, name)
    assert str(error.value) == f"{room.__name__}.{name}: is ipe_bench_zoo.{name} {PLACE}"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("run", "measurement=mgh", "noise=certified"), "measurement=mgh"),
        (("run", "baseline=[ekf,es_mda]"), "baseline=es_mda"),
        (("run", "+experiment=triad"), "experiment=triad"),
        (("estimate", "measurement=gnss", "readings=none.csv"), "measurement=gnss"),
        (("list", "measurement/bock"), "measurement/bock"),
    ],
)
def test_an_old_option_without_the_zoo(ipe_bench, words, said):
    assert ipe_bench(*words) == (2, "", f"ipe-bench: {said}: is {PLACE}\n")


@dataclass(frozen=True)
class EsMda(Pretender):
    """Stands for the class that earlier versions had."""

    __module__ = "ipe_bench.baselines.es_mda"


@pytest.mark.slow
def test_results_that_are_of_an_old_class(ipe_bench, synthetic):
    scenario, error = synthetic.scenario(), np.zeros((5, 3))
    synthetic.add(scenario, "es_mda", error, estimator=EsMda())
    synthetic.add(scenario, "other", error)
    synthetic.record(5)
    found = Results.read([synthetic.directory])
    said = (
        f"stale: ipe_bench.baselines.es_mda.EsMda is ipe_bench_zoo.EsMda {PLACE}; left out: its"
        " results (1)"
    )
    assert (found.problems, found.stale) == ([], [said])
    assert [(cell.names["estimator"], cell.done) for cell in found.cells] == [
        ("truth", 5),
        ("other", 5),
    ]
    assert set(ib.load(synthetic.directory)["estimator"]) == {"other"}
    code, out, err = ipe_bench("report", str(synthetic.directory))
    assert (code, said in err) == (0, True)
    assert "es_mda" not in out


def test_where_nothing_else_is_stored_it_is_a_problem(synthetic):
    key = synthetic.add(synthetic.scenario(), "es_mda", np.zeros((5, 3)), estimator=EsMda()).key
    for path in synthetic.store.trials.iterdir():  # the truth, which has no old class here
        if not path.name.startswith(key):
            path.unlink()
    with pytest.warns(
        UserWarning,
        match="was written by an older version of ipe-bench; run the same command again",
    ):
        assert ib.load(synthetic.directory).empty


def test_options_and_classes_are_called_alike():
    assert {name.replace("_", "") for name in ZOO} == {cls.lower() for cls in ZOO.values()}
