"""The keys of `ipe-bench run` in one table, which help, refusals and names of folders read."""

from typing import NamedTuple

from ipe_bench.report.formats import MEANING


class Key(NamedTuple):
    """A key of the config, or a word that stands for several."""

    kind: str
    """Subject of the key: parameters that stand still, moving states, estimators, trials, a run of
    many, files, ..."""
    written: str
    """The word as help writes it: N stands for a whole number, [A,B] for a list of names."""
    meaning: str
    """Its line in `ipe-bench run --help`; empty if the line of another key names it."""

    @property
    def name(self) -> str:
        """First part of the key."""
        return self.written.lstrip("+").partition("=")[0].partition(".")[0]


_ROWS = (
    (
        "still",
        "measurement=NAME",
        "the measurement model; `ipe-bench list measurement` shows which there are",
    ),
    ("still", "noise=NAME", "the errors of the readings"),
    ("still", "prior=NAME", "the distribution of the true parameters about the start"),
    ("estimators", "solver=[A,B]", "iterative solvers of the estimating equation"),
    ("estimators", "baseline=[A,B]", "other estimators, on the same trials"),
    ("moving", "state_model=NAME", "a model of moving states, instead of a measurement model"),
    (
        "moving",
        "tracker=[A,B]",
        "filters and smoothers of such states; trackers.NAME.KEY=X sets an option of one",
    ),
    ("moving", "trackers.NAME.KEY=X", ""),
    (
        "run",
        "execution=NAME",
        "where blocks of trials are computed: in this process, or in several at once",
    ),
    (
        "",
        "GROUP.KEY=VALUE",
        "option of one of these; `ipe-bench list GROUP/NAME` shows its type and default",
    ),
    (
        "estimators",
        "estimators.NAME.KEY=X",
        "option of a chosen solver or baseline, set by its label",
    ),
    (
        "still",
        "truth_measurement=NAME",
        "model that simulates the readings, if estimators assume another model",
    ),
    (
        "scale",
        "error_scale=X",
        "standard deviation of the true parameters in multiples of their sizes, or of states in"
        " multiples of the prior of a state model (1)",
    ),
    ("trials", "seed=N", "number that all random draws follow from (0)"),
    ("trials", "trials=N", "number of trials (1000); with precision= the largest number"),
    (
        "run",
        "precision=X",
        "add trials until the shares of success are known to within X, as in 0.01",
    ),
    ("run", "time_limit=SECONDS", "stop after this many seconds"),
    (
        "run",
        "objective=NAME.COLUMN",
        "statistic that a sweeper minimises, as in newton.capped_error",
    ),
    (
        "still",
        "parameters.NAME.KEY=X",
        "knowledge of a parameter: fixed, nominal, deviation, lower, upper, positive",
    ),
    ("folder", "output=DIR", "folder of the results; the same command in the same folder resumes"),
    (
        "folder",
        "name=NAME",
        "name of the folder under outputs/ (default_name, made of the other keys)",
    ),
    ("folder", "default_name=NAME", ""),
    ("figures", "figures=main", "figures to draw: main, all or none"),
    ("run", "formats=pdf,md,tex", MEANING),
    ("run", "block_size=N", "trials that are computed at once; results do not depend on it"),
    (
        "run",
        "write_readings=FILE",
        "write the simulated readings of trial write_readings_trial=N to a file, and estimate"
        " nothing",
    ),
    ("run", "write_readings_trial=N", ""),
    (
        "files",
        "readings=FILE",
        "readings of `ipe-bench estimate`, with ignore_columns=, find= and gate=",
    ),
    ("files", "ignore_columns=[A]", ""),
    ("files", "find=[A,B]", ""),
    ("files", "gate=P", ""),
    (
        "",
        "+experiment=NAME",
        "an experiment, which sets some of these keys; `ipe-bench list experiment` names them",
    ),
)
ROWS = tuple(Key(*row) for row in _ROWS)
WHOLE = tuple(key.name for key in ROWS if key.written.endswith("=N"))
"""Keys that take a whole number."""


def of(*kinds: str) -> tuple[str, ...]:
    """Selects the keys of these kinds."""
    return tuple(key.name for key in ROWS if key.kind in kinds)


OF_FILES = of("files")
OF_STATES = of("moving")
OF_CONSTANTS = (*of("still", "estimators"), "write_readings")
SETTING_NOTHING = ("hydra", *of("trials", "run", "figures", "files", "folder"))
"""Keys that change no setting, or add trials to it: no part of a folder's name."""
