# `make` lists the targets. All of them run in .venv, which is made first.

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

help:  ## print this list
	@sed -nE 's/^([.a-z-]+):.*## /  make \1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 18
	@echo "PYTHON=python3.12 chooses the Python of a new .venv; EXTRAS=dev,notebooks its extras."

.venv: $(STAMP)  ## the virtual environment, with the versions of constraints.txt

# A working .venv is kept, whatever PYTHON says: to change its Python, `make clean` first.
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

demo: $(STAMP)  ## RS and LR on the Ant at small scale, from nothing to the table
	$(BIN)/python -m experiments.table1 --robot ant --methods RS LR --scale quick --run-dir runs/demo

# RESULTS is a directory of its own, so that a method has one run in it (LR-0 and ten digits). It takes days on two cores; if
# stopped, the same command resumes. The last command needs EXTRAS=dev,benchmark.
results: $(STAMP)  ## make everything in experiments/results again, with runs in RESULTS (docs/runs.md)
	@set -e; \
	for robot in ant humanoid minitaur; do \
	  $(BIN)/python -m experiments.table1 --robot $$robot --seeds 3 --run-dir $(RESULTS) \
	    --report-dir experiments/results; \
	  $(BIN)/python -m experiments.waypoints $(RESULTS)/$$robot/LR-0-?????????? $(RESULTS)/$$robot/GE-0-?????????? \
	    $(RESULTS)/$$robot/VGCP-0-?????????? $(RESULTS)/$$robot/HF-0-?????????? --out experiments/results; \
	  $(BIN)/python -m experiments.benchmark --robot $$robot; \
	done; \
	$(BIN)/python -m experiments.humanoid_world --run-dir $(RESULTS) --report-dir experiments/results; \
	$(BIN)/python -m experiments.latent_size --run-dir $(RESULTS) --report-dir experiments/results; \
	$(BIN)/python -m experiments.physics; \
	$(BIN)/python -m experiments.physics --robot humanoid; \
	$(BIN)/python -m experiments.minitaur_physics; \
	$(BIN)/python -m experiments.witness

gpu: $(STAMP)  ## try, measure and use a GPU for MINUTES=9 minutes (docs/gpu.md; EXTRAS=dev,cuda)
	$(BIN)/python -m experiments.gpu --minutes $(MINUTES)

gpu-wheels: $(STAMP)  ## the wheels that `make gpu` needs on a machine without a network, in .whl
	bash experiments/gpu_device.sh prepare

check: $(STAMP)  ## format, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy genidm experiments

format: $(STAMP)  ## fix what the linter can fix, and format every file
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

# A test mostly compiles, on one core. One worker per file: its tests share compiled programs.
test: $(STAMP)  ## the tests, without the slow ones
	$(BIN)/python -m pytest -m "not slow" --numprocesses auto --dist loadfile

test-all: $(STAMP)  ## all tests, with the compiler settings that users have
	XLA_FLAGS= $(BIN)/python -m pytest --numprocesses auto --dist loadfile

clean:  ## remove .venv, caches and build outputs; runs/ stays
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache build dist genidm.egg-info
	find genidm experiments tests -name __pycache__ -prune -exec rm -rf {} +
