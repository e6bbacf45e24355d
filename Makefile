# Needs Python >= 3.11 and make, nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# on a terminal, pip and Sphinx show their progress
QUIET := $(if $(MAKE_TERMOUT),,-q)
PIP := $(BIN)/python -m pip --disable-pip-version-check $(QUIET)
RUNS ?= runs
# of `make learn-TASK`: cpu or cuda (else the device that docs/reference/zoo/zoo.yaml names), and the seed
DEVICE ?=
SEED ?= 1
# of `make bench`: which tables; all, if empty
TABLES ?=
# of `make smoke`
SMOKE := tests/test_layers.py tests/config tests/registry tests/managers tests/mdp tests/envs
# Tests run beside each other: threads of theirs that wait must not keep a core busy.
export OMP_WAIT_POLICY ?= PASSIVE

.PHONY: docs demo test test-all test-faults test-faults-long smoke check bench zoo-pages setup clean

# The installation is repeated when what is installed changes.
$(VENV)/.demo: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install -c constraints.txt torch
	$(PIP) install -c constraints.txt -e '.[video,tensorboard]'
	touch $@

# What `make docs` needs, where the developer's installation is not there.
$(VENV)/.docs: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install -c constraints.txt torch
	$(PIP) install -c constraints.txt -e '.[docs]'
	touch $@

$(VENV)/.dev: $(VENV)/.demo
	$(PIP) install -c constraints.txt -e '.[dev]'
	$(PIP) install -c constraints.txt --no-deps rsl-rl-lib rl_games
	$(PIP) install --no-deps -e plugins/rlcli-rsl-rl -e plugins/rlcli-rl-games
	$(PIP) install --no-deps -e plugins/rlcli-isaaclab -e plugins/rlcli-oige
	touch $@

setup: $(VENV)/.dev

demo: $(VENV)/.demo
	$(BIN)/rlcli train cartpole --runs-dir $(RUNS) --name demo
	$(BIN)/rlcli eval cartpole --runs-dir $(RUNS) --episodes 500
	$(BIN)/rlcli play cartpole --runs-dir $(RUNS) --video $(RUNS)/cartpole.mp4
	@echo
	@echo "policy and logs: $$(ls -d $(RUNS)/cartpole/*-demo* | tail -n 1)"
	@echo "video:           $(RUNS)/cartpole.mp4"

test: $(VENV)/.dev
	$(BIN)/python -m pytest -m 'not slow' -n 2

# What one runs while editing: under 90 seconds on two cores. Left out: the GPU engine, whose kernels take minutes to
# compile once, and tests that start several processes each.
smoke: $(VENV)/.dev
	$(BIN)/python -m pytest -m 'not slow and not warp and not processes' -n 2 $(SMOKE)

test-all: $(VENV)/.dev
	RLCLI_TEST_SIZE=full $(BIN)/python -m pytest -n 2 --cov --cov-report=json:.coverage.json
	$(BIN)/python tests/coverage_gate.py .coverage.json

# Kills, faults of the machine, signals, divergence, hostile files, exact resume: all cases, and what a night is for.
# Every day draws new cases; RLCLI_TEST_SEED=YYYYMMDD repeats those of a day.
test-faults test-faults-long: export RLCLI_TEST_SEED ?= $(shell date +%Y%m%d)

test-faults: $(VENV)/.dev
	RLCLI_TEST_SIZE=full $(BIN)/python -m pytest -n 2 --timeout 1200 tests/faults

test-faults-long: $(VENV)/.dev
	RLCLI_TEST_SIZE=long $(BIN)/python -m pytest -n 2 --timeout 7200 tests/faults

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Trains a built-in task with its default agent, evaluates it, and compares with its bar in docs/reference/zoo/zoo.yaml.
learn-%: $(VENV)/.demo
	$(BIN)/python benchmarks/zoo.py learn $* --device "$(DEVICE)" --seed $(SEED) --runs-dir $(RUNS)

# The generated parts of docs/zoo.
zoo-pages: $(VENV)/.demo
	$(BIN)/python benchmarks/zoo.py pages

docs: $(if $(wildcard $(VENV)/.dev),,$(VENV)/.docs)
	$(BIN)/python -m sphinx $(QUIET) -W --keep-going -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

# Every table of the CPU in docs/explanation/benchmarks.md, and the figures of the README: about half an hour on an idle machine.
# The libraries that it compares with are installed below .bench. TABLES=envpool: one of them.
bench: $(VENV)/.dev
	$(BIN)/python benchmarks/bench.py $(TABLES)

clean:
	rm -rf $(VENV) .bench .coverage* .pytest_cache .ruff_cache
