"""What is simulated like a user's readings has the noise that was stated for those present."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.cli.estimate import standard_words
from ipe_bench.cli.own_data import like_these
from ipe_bench.cli.single import single
from ipe_bench.cli.spec import Spec
from ipe_bench.measurements.base import UsualNoise

LINE = (
    "measurement=formula",
    "measurement.expression=a*t+b",
    "measurement.start={a: 1, b: 1}",
    "measurement.reading=y",
)
ROWS = ("t,y", "0,1.1", "1,2.9", "2,", "3,7.2", "4,8.9")


@dataclass(frozen=True)
class Rounded(ib.measurements.Formula):
    """A formula whose readings are rounded."""

    usual_noise = UsualNoise(step=0.5)


def like(*words: str, rounded: bool = False) -> tuple[Spec, list[str]]:
    asked = single("design", [*LINE, *words])
    spec = asked.spec
    if rounded:
        spec = replace(spec, measurement=Rounded("a*t+b", {"a": 1, "b": 1}, reading="y"))
    return like_these(spec, ["own.csv"], asked.words.keys, at_estimate=True)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.csv").write_text("\n".join(ROWS))


def test_deviations_that_are_stated_for_each_reading_are_those_of_the_present() -> None:
    spec, lines = like("noise=gaussian", "noise.deviation=[0.1,0.2,0.3,0.4,0.5]")
    assert spec.scenario.problem.R.deviations.tolist() == [0.1, 0.2, 0.4, 0.5]
    assert not any(line.startswith("Noise") for line in lines)


def test_readings_that_their_model_rounds_are_rounded() -> None:
    spec, lines = like(rounded=True)
    assert spec.noise == ib.noise.Quantization(0.5)
    assert lines[0] == "Noise: quantization, standard deviation 0.144, as stated."


def test_correlated_errors_of_readings_that_are_missing_are_not_simulated() -> None:
    typed = ("noise=colored", "noise.deviation=0.3", "noise.correlation=0.5")
    with pytest.raises(UserError, match="noise=colored: is correlated, and readings are missing"):
        like(*typed)
    Path("own.csv").write_text("\n".join(row for row in ROWS if not row.endswith(",")))
    assert like(*typed)[0].noise == ib.noise.Colored(deviation=0.3, correlation=0.5)


@pytest.mark.parametrize("word", ["find=[c]", "++find=[c]", "+gate=0.999"])
def test_filters_are_the_standard_of_what_only_filters_answer(word: str) -> None:
    assert "tracker=[ekf,ukf]" in standard_words([word])
