"""Options of the zoo's models that cannot be, each refused by its name; and the version that it
goes with."""

import tomllib
from pathlib import Path

import pytest
from ipe_bench_zoo import Accelerometer, Gnss, Triad

from ipe_bench import __version__
from ipe_bench.basics.errors import UserError

FEW = ((1.0, 0.0, 0.0),) * 9
HIGH = ((1, "gps", 2e7, 0.0, 0.0),) * 9
MISTAKES = [
    (lambda: Triad(outputs=FEW), "outputs"),
    (lambda: Accelerometer(counts=FEW), "counts"),
    (lambda: Accelerometer(scale=(0.0, 1.0, 1.0)), "scale"),
    (lambda: Gnss(satellites=HIGH[:3]), "satellites: 3 readings"),
    (
        lambda: Gnss(satellites=((2e7, 0.0),) * 9),
        r"satellites\[0\]=\[2.*, 0\.0\]: give a list of 5",
    ),
    (lambda: Gnss(position=(0.0, 0.0, 0.0)), "position:"),
]


@pytest.mark.parametrize(("make", "said"), MISTAKES, ids=[said for _, said in MISTAKES])
def test_mistakes_are_named(make, said):
    with pytest.raises(UserError, match=f"^{said}"):
        make()


def test_it_goes_with_this_version_of_the_package():
    project = tomllib.loads(
        (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    )["project"]
    assert (project["version"], project["dependencies"]) == (
        __version__,
        [f"ipe-bench=={__version__}"],
    )
