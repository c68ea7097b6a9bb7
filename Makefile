# `make` lists what can be made. Everything runs in .venv, which is made first.

PYTHON ?= python3
EXTRAS ?= dev
MINUTES ?= 9
RESULTS ?= runs/results

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
NAME_ANOTHER = name one of these, as in: make $(or $(MAKECMDGOALS),.venv) PYTHON=python3.12

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help .venv demo results gpu gpu-wheels check format test test-all clean

help:  ## this list
	@sed -nE 's/^([.a-z-]+):.*## /  make \1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 18
	@echo "PYTHON=python3.12 names the Python of a new .venv; EXTRAS=dev,notebooks what goes into it."

.venv: $(STAMP)  ## the virtual environment, from the versions in constraints.txt

# A .venv that works is kept, whichever Python made it: `make clean` first to change that.
$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { \
	  echo "genidm needs Python 3.11, 3.12 or 3.13, and there is no '$(PYTHON)': $(NAME_ANOTHER)" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null || { \
	  echo "genidm needs Python 3.11, 3.12 or 3.13, and '$(PYTHON)' is $$($(PYTHON) -V 2>&1 | head -n 1): $(NAME_ANOTHER)" >&2; exit 1; }
	@echo "Installing into $(VENV); the first time this takes a few minutes."
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check \
	  --constraint constraints.txt --editable ".[$(EXTRAS)]"
	@touch $@
	@echo "Installed. For python to mean this one, here: source $(VENV)/bin/activate"

demo: $(STAMP)  ## the Ant from nothing to a table, at small scale: random sampling, then ours
	$(BIN)/python -m experiments.table1 --robot ant --methods RS LR --scale quick --run-dir runs/demo

# In a directory of its own, where a method has one run. Days on two cores; killed, it goes on.
results: $(STAMP)  ## every table, figure and number in experiments/results anew, in RESULTS (docs/runs.md)
	@set -e; \
	for robot in ant humanoid minitaur; do \
	  $(BIN)/python -m experiments.table1 --robot $$robot --seeds 3 --out $(RESULTS) \
	    --report-dir experiments/results; \
	  $(BIN)/python -m experiments.waypoints $(RESULTS)/$$robot/LR-0-* $(RESULTS)/$$robot/GE-0-* \
	    $(RESULTS)/$$robot/VGCP-0-* $(RESULTS)/$$robot/HF-0-* --goal-radius 1 --out experiments/results; \
	  $(BIN)/python -m experiments.benchmark --robot $$robot; \
	done; \
	$(BIN)/python -m experiments.humanoid_world --out $(RESULTS) --report-dir experiments/results; \
	$(BIN)/python -m experiments.latent_size --out $(RESULTS) --report-dir experiments/results; \
	$(BIN)/python -m experiments.physics; \
	$(BIN)/python -m experiments.physics --robot humanoid; \
	$(BIN)/python -m experiments.minitaur_physics; \
	$(BIN)/python -m experiments.witness

gpu: $(STAMP)  ## try, measure and use a GPU for MINUTES=9 (docs/gpu.md; EXTRAS=dev,cuda)
	$(BIN)/python -m experiments.gpu --minutes $(MINUTES)

gpu-wheels: $(STAMP)  ## what `make gpu` needs on a machine without a network, into .whl
	bash experiments/gpu_device.sh prepare

check: $(STAMP)  ## format, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy genidm experiments

format: $(STAMP)  ## mend what the linter can, and bring every file into its format
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

# Most of a test's time is compiling, which uses one core. Files stay whole: their tests share programs.
test: $(STAMP)  ## the tests, without the slow ones
	$(BIN)/python -m pytest -m "not slow" --numprocesses auto --dist loadfile

test-all: $(STAMP)  ## the slow tests too, compiled as users' programs are
	XLA_FLAGS= $(BIN)/python -m pytest --numprocesses auto --dist loadfile

clean:  ## remove .venv, caches and build outputs; runs/ stays
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache build dist genidm.egg-info
	find genidm experiments tests -name __pycache__ -prune -exec rm -rf {} +
