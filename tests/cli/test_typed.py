"""An option of a wrong type, or one that nothing chosen has, is refused before the first job begins."""

from pathlib import Path

import pytest

COMMON = ("measurement=polynomial", "noise=gaussian", "execution=serial", "output=out", "trials=5")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["noise.deviation=0.1,abc"], "noise.deviation=abc: give a number above 0 or a list"),
        (["noise.deviation=0.1,0"], "noise.deviation=0: give a number above 0 or a list"),
        (["seed=1,first"], "seed=first: give a whole number from 0 up"),
        (["error_scale=1,-1"], "error_scale=-1.0: give a number above 0"),
        (["measurement.strength=0.1,[1]"], "measurement.strength=[1]: give a finite number"),
        (["measurement=ranging,polynomial", "measurement.rounds=5"], "measurement.rounds: there is no such option"),
        (["estimators.fixed_point.start=nominal,here"], "estimators.fixed_point.start=here: choose one of"),
        (["+baseline@estimators.a=ekf,ukf", "estimators.a.engine=x,y"], "estimators.a.engine=x: choose one of"),
        (["execution.threads=1,2"], "execution.threads: there is no such option"),
        (["+prior.width=1,2"], "prior.width: there is no such option"),
    ],
)
def test_no_job_of_a_sweep_begins_where_one_would_be_refused(words, complaint, ipe_bench):
    code, _, err = ipe_bench("run", "-m", *COMMON, *words)
    assert code == 2
    (line,) = err.splitlines()
    assert line.startswith(f"ipe-bench: {complaint}")
    assert not list(Path().rglob("*.parquet"))


@pytest.mark.parametrize("command", ["estimate", "design", "posterior"])
def test_every_command_that_composes_refuses_it(command, ipe_bench):
    code, _, err = ipe_bench(command, "measurement=ranging", "measurement.rounds=many")
    assert code == 2
    assert "measurement.rounds=many: give a whole number above 0" in err


@pytest.mark.parametrize(
    "words",
    [
        ["noise.deviation=${error_scale}"],
        ["noise.deviation='${error_scale}'"],
        [
            "noise=gaussian",
            "noise.deviation=1",
            "noise._target_=ipe_bench.noise.StudentT",
            "+noise.degrees_of_freedom=5",
        ],
        ["+experiment=triad", "measurement.field=5"],
        ["solver=[newton]", "+solver@estimators.b=broyden", "estimators.b.tolerance=1e-3"],
        ["measurement=nist/misra1a", "measurement.start=2"],
        ["estimators.fixed_point.budget=null"],
    ],
)
def test_what_is_right_is_taken(words, ipe_bench):
    code, _, err = ipe_bench("run", *words, "--cfg", "job")
    assert (code, err) == (0, "")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["model=pendulum", "baseline=[ekf]"], "baseline: is of a measurement, and model= chooses states that move"),
        (["model=pendulum", "error_scale=3"], "error_scale: is of a measurement, and model= chooses states that move"),
        (["measurement=polynomial", "tracker=[ekf]"], "tracker: goes with model=NAME"),
        (["model=pendulum", "tracker=[newton]"], "tracker=newton: newton is no tracker but a solver"),
        (["model=pendulum", "trackers.ukf.iterations=0"], "trackers.ukf.iterations=0: give a whole number above 0"),
        (["model=pendulum", "trackers.bootstrap.particles=5"], "trackers.bootstrap.particles: is set, but bootstrap"),
        (
            ["model=pendulum", "tracker=[grid]"],
            "trackers.grid: is exact for one state, and pendulum has 2; leave it out",
        ),
        (["model=growth", "model.next.state=x"], "model.next.state: there is no such name"),
        (["+experiment=polynomial", "model=growth"], "+experiment=polynomial: sets measurement, which is of a measur"),
        (["+experiment=headline", "model=growth"], "+experiment=headline: sets noise, which is of a measurement"),
        (["model=pendulum_book", "trials=2"], "trials=2: certified readings are one trial"),
    ],
)
def test_what_does_not_go_with_a_state_model_is_refused(words, complaint, ipe_bench):
    code, _, err = ipe_bench("run", *words, "output=out")
    assert code == 2
    assert err.splitlines()[-1].startswith(f"ipe-bench: {complaint}")
    assert not list(Path().rglob("*.parquet"))
