# Two commands do everything: `make run` and `make test`. Both set up .venv first where it is missing.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: run test slow cluster campaigns oracles plugins lowest newest mutants lint dist bench docs gallery clean

# README's figure is outputs/headline/figures/success.png.
run: .venv/ready
	$(BIN)/ipe-bench run +experiment=headline

# Bytecode is kept wherever the environment says that it should not be: without it each worker takes 10 s of CPU to
# collect the tests and not 4.4 (pytest --collect-only), and each process that a test starts compiles the package.
test slow campaigns: export PYTHONDONTWRITEBYTECODE :=

test: .venv/ready
	$(BIN)/pytest -n auto --dist worksteal --durations=30 --durations-min=1

# What takes minutes: Monte Carlo, end-to-end and browser checks.
slow: .venv/ready
	$(BIN)/pytest -n auto --dist worksteal --durations=40 --durations-min=1 -m "(slow or browser) and not campaign"

# Slurm: two nodes on this machine. On Debian, `apt-get install slurm-wlm munge` first; as root.
cluster: .venv/ready
	$(BIN)/uv pip install --quiet --python $(BIN)/python "hydra-submitit-launcher>=1.2" --editable plugins/dask
	$(BIN)/pytest -m cluster

# What takes the better part of an hour: hundreds of damaged files, wrong command lines, tables of error rates.
campaigns: .venv/ready
	$(BIN)/pytest -n auto -m campaign

# How closely numbers agree with what they are checked against: tests/oracles.json. TESTS="FILE ..."
# runs the marked tests of these files alone; those of plugins run in their environment, after `make plugins`.
oracles: .venv/ready
	RECORD_ORACLES=1 $(BIN)/pytest -m oracle $(TESTS)
	$(if $(TESTS),,outputs/plugins/.venv/bin/python -m pytest -m "oracle and plugin" --record-oracles plugins)

# The worked plugins that need a library of their own, with those libraries in an environment of their own.
plugins: .venv/ready
	$(BIN)/uv venv --quiet --allow-existing --python $(BIN)/python outputs/plugins/.venv
	$(BIN)/uv pip install --quiet --python outputs/plugins/.venv/bin/python --editable ".[test]" \
		--editable plugins/optimistix --editable plugins/stonesoup --editable plugins/gins_jax \
		--editable plugins/dask
	outputs/plugins/.venv/bin/python -m pytest -m plugin plugins

# The quick tests with the lowest versions of all libraries that pyproject.toml allows and that have a wheel for this
# Python, and with the newest and their pre-releases, beyond the bounds above, too. ONLY=hydra-core lets that library alone
# pass its bound, which says whose new version fails.
lowest newest: .venv/ready
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python outputs/$@/.venv
	sed -n 's/^    "\($(or $(ONLY),[a-z0-9-]*)>=[^",]*\).*# .*/\1/p' pyproject.toml > outputs/$@/unbounded.txt
	$(BIN)/uv pip install --quiet --python outputs/$@/.venv/bin/python --editable ".[test]" \
		$(if $(filter lowest,$@),--resolution lowest-direct --only-binary :all: \
		--no-binary ipe-bench --no-binary antlr4-python3-runtime,--upgrade --prerelease allow \
		--override outputs/$@/unbounded.txt)
	outputs/$@/.venv/bin/python -m pytest -n auto --dist worksteal -W default

# Whether the tests notice changes on purpose, as a table in outputs/mutants: those of tests/mutants/changes.py, all or
# NAMES="margin-start minima-twice" of them. SAMPLE=40 draws that many changes by Cosmic Ray instead, room by room,
# or of ROOMS="shown" alone; SEED=1 draws others.
mutants: .venv/ready
ifdef SAMPLE
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable ".[mutants]"
	$(BIN)/python tests/mutants/score.py --sample $(SAMPLE) $(if $(SEED),--seed $(SEED)) $(ROOMS)
else
	$(BIN)/python tests/mutants/notice.py $(NAMES)
endif

lint: .venv/ready
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright --pythonpath $(BIN)/python
	@$(BIN)/python tests/sizes.py

# What a release publishes, in dist.
dist: .venv/ready
	rm -rf dist
	$(BIN)/uv build --quiet
	$(BIN)/uvx --quiet twine check --strict dist/*

# What everything costs beside its rivals, as a table in outputs/bench. PEERS=1 installs other people's libraries first.
# PARTS=scale runs a million trials with their report instead, which takes minutes; SCALE=100000 that many.
bench: .venv/ready
	$(if $(PEERS),$(BIN)/uv pip install --quiet --python $(BIN)/python --editable ".[peers]")
	IPE_BENCH_THREADS=1 OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/table.py outputs/bench $(PARTS)

# The documentation, in outputs/docs/html. Its gallery is drawn from what is stored of the experiments.
docs: .venv/ready
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable ".[docs]"
	PYTHONPATH=tests $(BIN)/python tests/site/make_docs.py outputs/docs

# Draws the gallery's pages again, in outputs/docs/source/gallery, and README's table and pictures, and says what is stored
# of each experiment, in seconds.
# NAMES="headline paper" computes these anew and stores them, with their own trials: `filters`, `beyond` and `states` take
# the better part of an hour. TRIALS=100 takes a tenth of the trials, which their pages then say.
gallery: .venv/ready
	PYTHONPATH=tests $(BIN)/python tests/site/make_docs.py outputs/docs --store $(NAMES) $(if $(TRIALS),--trials $(TRIALS))

.venv/ready: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
		{ echo "ipe-bench needs Python 3.11 to 3.13: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip install --quiet --compile-bytecode --python $(BIN)/python --editable ".[test,lint]"
	@touch $@

clean:
	rm -rf .venv
