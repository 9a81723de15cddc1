"""Defines the commands on components and plugins: list, check and new."""

from __future__ import annotations

import contextlib
import inspect
import io
import itertools
import keyword
import re
import shlex
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from pkgutil import resolve_name
from string import Template
from typing import TYPE_CHECKING

import ipe_bench as ib
from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.machine import library_versions
from ipe_bench.cli import print_problems, renamed, say, show
from ipe_bench.cli.main import main
from ipe_bench.cli.parser import KINDS, MODELS
from ipe_bench.measurements.base import Measurement
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct, described
from ipe_bench.report.table import Table, words

if TYPE_CHECKING:
    from ipe_bench.plugins.conformance import Finding

RECORDS = {"statistic": "STATISTIC", "figure": "FIGURE", "table": "table", "section": "SECTION"}
"""Names of the elements of reports, and of each in its module."""
ALONE = {
    "function": ("{name}.py", 'measurement=function measurement.of={name}:{name} "measurement.columns.t=[0,1,2,3,4]"'),
    "ode": ("{name}.yaml", "measurement=ode measurement.file={name}.yaml"),
}
"""Models that are one file and no plugin, and how to choose them."""
SMALL = "noise=gaussian noise.deviation=0.01 trials=50 figures=none"
BENT = f"measurement=polynomial error_scale=10 {SMALL}"
PAGES = {
    "solver": f'run {BENT} "solver=[fixed_point,newton,my_solver]"',
    "filter": f'run {BENT} "baseline=[linear_lse,ekf,ukf,my_filter]"',
    "baseline": f'run {BENT} "baseline=[linear_lse,gauss_newton,my_baseline]"',
    "measurement": f'run measurement=my_measurement {SMALL} "solver=[newton,auto]" "baseline=[gauss_newton,ekf,ukf]"',
    "function": "run measurement=function measurement.of=my_function:my_function "
    f"measurement.columns.t=[0,1,2,3,4,5,6,7] error_scale=0.1 {SMALL}",
    "ode": "run measurement=ode measurement.file=my_ode.yaml error_scale=0.1 trials=50 figures=none",
    "state_model": "run state_model=my_state_model trials=50 figures=none",
    "tracker": 'run state_model=pendulum "tracker=[ekf,ukf,my_tracker]" trials=50 figures=none',
    "noise": "run measurement=polynomial noise=my_noise trials=50 figures=none",
    "prior": f"run measurement=polynomial prior=my_prior {SMALL}",
    "execution": f"run {BENT} execution=my_execution",
    **{kind: f"run {BENT} name=my_{kind}" for kind in RECORDS},
}
PAGES["figure"] = PAGES["figure"].replace("figures=none", "figures=all")
"""The kinds that have a page for coding agents, and a run of each beside its rivals."""
_GONE = {"keys": "`ipe-bench run --help` explains every key of a run"}
"""Lists of earlier versions, and what to use instead."""


def list_command(names: Sequence[str], verbose: bool) -> int:
    """Prints one line per option of each group, with its own options if `verbose`; for GROUP/NAME only that option."""
    print_problems(plugins.take_problems())
    known = [*plugins.groups(), *({"statistic", "figure"} - set(plugins.groups()))]
    for name in renamed(names) or plugins.groups():
        group, slash, option = name.partition("/")
        if group not in known:
            homes = " or ".join(f"{o.group}/{o.name}" for o in plugins.options() if o.name == name)
            remedy = f"write {homes}" if homes else unknown(group, known, "group")
            raise UserError(f"{name}: {_GONE.get(name, remedy)}")
        options, ours = {o.name: o for o in plugins.options(group)}, _ours(group)
        if slash and option not in {**options, **ours}:
            raise UserError(f"{name}: {unknown(option, [*options, *ours], 'option')}")
        if slash and option in ours:
            say(f"{name}  {ours[option]}")
            continue
        if slash:
            _describe(options[option])
            continue
        rows = [(name, text.partition(". ")[0], "built in") for name, text in ours.items()]
        rows += [(o.name, o.summary, o.source.origin) for o in options.values()]
        for origin, part in itertools.groupby(rows, lambda row: row[2]):
            names_here, texts, _ = zip(*part, strict=True)
            title = group if origin == "built in" else f"{group}, from {origin}"
            _show(title, {"option": names_here, "what it is": texts})
        print()
        for one in options.values() if verbose else [o for o in options.values() if o.fault is not None]:
            try:
                _describe(one)
            except UserError as error:
                print_problems([str(error)])
    return 0


def _ours(group: str) -> dict[str, str]:
    """Returns the statistics and figures that come with the bench, which are no options, with descriptions."""
    if group == "statistic":
        from ipe_bench.statistics.records import SCORES, STATISTICS

        return {one.name: one.definition for one in (*STATISTICS, *SCORES)}
    if group == "figure":
        from ipe_bench.report.figures import NAMES

        return NAMES
    return {}


def _show(title: str, columns: Mapping[str, Sequence[str]]) -> None:
    show([Table("list", title, "", [words(heading, list(cells)) for heading, cells in columns.items()])])


def _describe(option: plugins.Option) -> None:
    """Describes every option of a component with its value, its type, and its meaning."""
    if option.fault is not None:
        raise UserError(f"{option.group}={option.name}: {option.fault}")
    prefix = "" if option.group == "experiment" else f"{option.group}."
    if option.group in plugins.PACKAGES:
        prefix = f"{plugins.PACKAGES[option.group]}.{option.label}."
    title = f"{option.group}={option.name}  {option.summary}"
    if rows := described(option):
        columns = {
            "key": [f"{prefix}{row.name}" for row in rows],
            "value": [row.value for row in rows],
            "takes": [row.kind for row in rows],
            "meaning": [row.meaning for row in rows],
        }
        _show(title, columns)
    else:
        say(title)
    print()
    if option.group == "measurement":
        _describe_measurement(option)


def _describe_measurement(option: plugins.Option) -> None:
    """Describes the parameters of a measurement model, and the file of readings that it takes."""
    from ipe_bench.real.readings import header, labels

    try:
        if "???" in option.config.values():
            raise UserError("an option is to be given")
        model = construct(option.config, "measurement")
        assert isinstance(model, Measurement)
        columns = ",".join(header(model))
    except UserError:
        say(f"measurement={option.name}: what it has depends on its options:", option.text)
        return
    parameters = {
        "parameter": [p.name for p in model.parameters],
        "size": [f"{p.size:g}" for p in model.parameters],
        "unit": [p.unit for p in model.parameters],
    }
    _show(f"measurement={option.name}", parameters)
    first = ",".join(str(column[0]) for column in labels(model).values())
    say(f"readings={{FILE}}: {model.m} rows, header: {columns}", f"first row: {first},<reading>")
    if model.inputs:
        known = ", ".join(i.heading for i in model.inputs)
        say(f"A file's own {known} take the place of these; so it may have any number of rows.")
    say("A column sigma, if there is one, holds the standard deviation of each reading.\n")


def check_command(words: Sequence[str]) -> int:
    """Checks every option of the plugins in the given folders, and what the keys choose; exit code 1 if any fails."""
    keys = [word for word in words if "=" in word and not Path(word).is_dir()]
    folders = [word for word in words if word not in keys]
    if not words:
        raise UserError("check: name the folder of a plugin, such as plugins/my_plugin")
    for folder in folders:
        plugins.options_in(Path(folder))  # a mistake in the second is said before the first is checked
    print_problems(plugins.take_problems())
    failed = 0
    for folder in [*folders, *([" ".join(keys)] if keys else [])]:
        findings = [*ib.check(folder), *_check_experiments(folder)] if folder in folders else _check_chosen(keys)
        for one in findings:
            outcome = "FAILED" if one.complaint else "-" if one.note else "ok"
            said = f" -- {one.complaint or one.note}" if one.complaint or one.note else ""
            say(f"{outcome:7}{one.component}: {one.check}{said}")
        wrong = sum(bool(finding.complaint) for finding in findings)
        say(f"{folder}: {f'{wrong} of {len(findings)} checks failed' if wrong else 'all checks passed'}")
        failed += wrong
    return 1 if failed else 0


def _check_chosen(words: Sequence[str]) -> list[Finding]:
    from ipe_bench.cli.single import single
    from ipe_bench.cli.spec import PARTS
    from ipe_bench.plugins.conformance import check_component

    asked = single("check", words)
    parts = {key: getattr(asked.spec, key) for key in PARTS if key in asked.words.keys}
    if not set(plugins.PACKAGES).isdisjoint(asked.words.keys):
        parts |= asked.spec.estimators
    return [finding for name, part in parts.items() for finding in check_component(name, part)]


def _check_experiments(folder: str) -> Iterator[Finding]:
    """Checks that each experiment of the plugin asks for existing options."""
    from ipe_bench.cli import words as w
    from ipe_bench.cli.session import jobs_of, session
    from ipe_bench.plugins.conformance import Finding
    from ipe_bench.runs.run import validate

    for option in plugins.options_in(Path(folder)):
        if option.group == "experiment" and option.fault is None:
            complaint = ""
            try:
                with session():
                    jobs = jobs_of(w.read("run", [f"+experiment={option.name}"]), multirun=False).specs
                for job in jobs:
                    validate([job.scenario], job.estimators, job.count, job.block_size)
            except UserError as error:
                complaint = str(error)
            yield Finding(f"experiment={option.name}", "Asks for what there is", complaint)


def new_command(kind: str, name: str | None, language: str | None = None) -> int:
    """Writes plugins/NAME in the working folder, or the files of a model, of a skill or of a guard in CI."""
    if kind == "ci" and name is None:
        return _write_ci()
    if name is None:
        raise UserError("new: the following arguments are required: NAME")
    if kind in (added := plugins.kinds_to_copy()):
        return _copy_kind(kind, added[kind], name, language)
    if language is not None and kind in (*MODELS, *KINDS, "skill", "ci"):
        raise UserError(f"--language={language}: {kind} has no languages; leave it out")
    if kind == "skill":
        written = _write_skill(Path(name))
        print(f"{name} is ready: {', '.join(path.name for path in written)}")
        return 0
    (kind,) = renamed([kind])
    if kind not in (*MODELS, *KINDS):
        hint = "; `pip install plugins/process` in a checkout adds it" if kind == "process" else ""
        raise UserError(f"{kind}: {unknown(kind, (*MODELS, *KINDS, *added, 'skill', 'ci'), 'kind')}{hint}")
    group = "baseline" if kind == "filter" else kind
    _check_name(group, name)
    if kind in ALONE:
        file, choice = (text.format(name=name) for text in ALONE[kind])
        _require_absent(Path(file))
        _fill(Path(file), f"{kind}{Path(file).suffix}", {"name": name})
        noise = "noise=gaussian noise.deviation=0.01 " if kind == "function" else ""
        print(f"{file} is ready. Try:\n  ipe-bench check {choice}")
        print(f"  ipe-bench run {choice} {noise}error_scale=0.1 trials=100")
        return 0
    folder, package = Path("plugins") / name, f"ipe_bench_{name}"
    _require_absent(folder)
    class_name = "".join(part.title() for part in name.split("_"))
    words = {"kind": kind, "name": name, "package": package, "Class": class_name, "record": RECORDS.get(kind, "")}
    family = "record_" if kind in RECORDS else "experiment_" if kind == "experiment" else ""
    texts = {
        "pyproject.toml": "pyproject.toml",
        "README.md": f"{family}readme.md" if family else "README.md",
        f"{package}/__init__.py": f"{family}init.py",
        f"{package}/{name}.py": f"{kind}.py",
        f"{package}/conf/{group}/{name}.yaml": "record.yaml" if kind in RECORDS else f"{kind}.yaml",
        f"tests/test_{name}.py": f"{family}test.py",
    }
    if kind == "experiment":  # it has no class
        del texts[f"{package}/{name}.py"]
    for target, source in texts.items():
        _fill(folder / target, source, words)
    choices = {"solver": f'"solver=[{name}]" ', "baseline": f'"baseline=[{name}]" '}
    choices |= {"experiment": f"+experiment={name} ", **dict.fromkeys(RECORDS, "")}
    choices["tracker"] = f'state_model=pendulum "tracker=[{name}]" '
    choices["figure"] = "figures=all "  # the figures of main are chosen among our own
    choose = choices.get(group, f"{group}={name} ")
    print(f"{folder} is ready. Try:\n  ipe-bench check {folder}\n  ipe-bench run {choose}trials=100")
    return 0


def _copy_kind(kind: str, home: Path, name: str, language: str | None) -> int:
    """Copies the files of a plugin's kind, and those of one of its languages, into plugins/NAME."""
    languages = sorted(path.name.removeprefix(f"{kind}-") for path in home.glob(f"{kind}-*"))
    if languages and language not in languages:
        why = "is not given" if language is None else unknown(language, languages, "language")
        raise UserError(f"--language={language or ''}: {why}; choose one of {', '.join(languages)}")
    sources = (home / kind, *([home / f"{kind}-{language}"] if language else ()))
    texts = {path: path.relative_to(source) for source in sources for path in source.rglob("*") if path.is_file()}
    group = next((place.parts[2] for place in texts.values() if place.parts[1:2] == ("conf",)), kind)
    _check_name(group, name)
    folder = Path("plugins") / name
    _require_absent(folder)
    for path, place in texts.items():
        target = folder / str(place).replace("NAME", name).removesuffix(".template")
        target.parent.mkdir(parents=True, exist_ok=True)
        text = path.read_text(encoding="utf-8")
        filled = Template(text).substitute(name=name) if path.suffix == ".template" else text
        target.write_text(filled, encoding="utf-8")
    print(f"{folder} is ready. Read {folder / 'README.md'}")
    return 0


def _write_ci() -> int:
    """Writes a workflow that compares the estimators in plugins/ with those of a base, and the trials for it."""
    ours, place = {"solver": "", "baseline": ""}, Path("plugins").resolve()
    for option in (o for o in plugins.options() if o.group in ours and place in o.path.resolve().parents):
        ours[option.group] += ", " * bool(ours[option.group]) + option.name
    if not any(ours.values()):
        raise UserError(
            "new ci: plugins/ has no estimator to guard; write one, such as `ipe-bench new baseline my_fit`"
        )
    texts = {".github/workflows/estimator.yml": "ci.yml", "ci/experiment/guard.yaml": "ci.yaml"}
    for target in texts:
        _require_absent(Path(target))
    for target, source in texts.items():
        _fill(Path(target), source, {"version": ib.__version__, **ours})
    print(f"{' and '.join(texts)} are ready. Try:\n  ipe-bench run --config-dir ci +experiment=guard figures=none")
    return 0


def _require_absent(path: Path) -> None:
    if path.exists():
        raise UserError(f"{path}: is there already and is not overwritten; choose another name")


def _fill(path: Path, source: str, words: Mapping[str, str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    template = files("ipe_bench.plugins") / "templates" / f"{source}.template"
    path.write_text(Template(template.read_text(encoding="utf-8")).substitute(words), encoding="utf-8")


def _check_name(group: str, name: str) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9_]{,59}", name):
        raise UserError(
            f"{name[:80]}: give a name of at most 60 small letters, digits and underscores that starts with a letter"
        )
    if keyword.iskeyword(name):
        raise UserError(f"{name}: is a word of Python; choose another name")
    if name in ("ipe_bench", *library_versions()):
        raise UserError(f"{name}: is a package that ipe-bench imports; choose another name")
    if re.fullmatch("con|prn|aux|nul|(com|lpt)[0-9]", name):
        raise UserError(f"{name}: is no name of a folder on Windows; choose another name")
    rivals = plugins.ESTIMATOR_GROUPS if group in plugins.ESTIMATOR_GROUPS else (group,)
    for option in plugins.options():
        if option.group in rivals and option.name == name:
            origin = option.source.origin
            raise UserError(f"{name}: {option.group}={name} is there already ({origin}); choose another name")


def _write_skill(folder: Path) -> list[Path]:
    """Writes SKILL.md and a page for each kind into a new folder, by which a coding agent writes plugins."""
    _require_absent(folder)
    folder = folder.resolve()
    with tempfile.TemporaryDirectory(prefix="ipe-bench-") as place, contextlib.chdir(place):
        plugins.sources.cache_clear()  # no plugins are known there but those that are installed or made
        known = [f"- {group}: {', '.join(o.name for o in plugins.options(group))}" for group in plugins.groups()]
        texts = {f"new-{kind}": _page(kind) for kind in PAGES}
    plugins.sources.cache_clear()
    pages = [f"- a new {kind}: `new-{kind}.md`" for kind in PAGES]
    words = {"version": ib.__version__, "bent": BENT, "small": SMALL}
    _fill(folder / "SKILL.md", "skill.md", {**words, "pages": "\n".join(pages), "options": "\n".join(known)})
    for name, text in texts.items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
    return sorted(folder.iterdir())


def _page(kind: str) -> str:
    """Returns instructions for a component of a kind: its contract, the skeleton, and what `check` tests."""
    name = f"my_{kind}"
    tried = [line.strip() for line in _said(f"new {kind} {name}").splitlines() if "ipe-bench check" in line]
    check = tried[0].removeprefix("ipe-bench ")
    promises = [line.partition(": ")[2] for line in _said(check).splitlines() if line.startswith("ok")]
    lines = [f"# A new {kind}", ""]
    lines += [f"    ipe-bench {command}" for command in (f"new {kind} {name}", check, PAGES[kind])]
    for place in plugins.CONTRACTS.get(kind, ()):
        lines += ["", f"The contract of `{place}`:", "", "```text", inspect.getdoc(resolve_name(place)) or "", "```"]
    for path in (p for p in sorted(Path().rglob(f"{name}.*")) if p.suffix in (".py", ".yaml")):
        lines += ["", f"`{path}`", "", f"```{path.suffix[1:]}", path.read_text(encoding="utf-8").strip(), "```"]
    return "\n".join([*lines, "", "`check` asks of it:", "", *(f"- {promise}" for promise in promises), ""])


def _said(command: str) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = main(shlex.split(command))
    assert code == 0, f"{command}: {out.getvalue()}"
    return out.getvalue()
