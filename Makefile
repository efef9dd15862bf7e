# `make` alone lists the targets. The first one that needs an environment builds .venv, which takes minutes.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# constraints.txt goes with every install: without it pip may take another torch, which is gigabytes.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
# More for pytest and the benchmarks: make test ARGS="tests/world -x", make bench ARGS="--only training"
ARGS ?=
# Where `make weights` keeps what it trains, and where it puts the family together.
RUNS ?= runs
FAMILY ?= $(RUNS)/family

.DEFAULT_GOAL := help
.PHONY: help venv demo test test-all soak lint docs bench weights clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

venv: $(VENV)/.installed-dev  ## build .venv: the package (editable), its tests and linters

demo: $(VENV)/.installed  ## turn the example touches into pictures (outputs/demo)
	$(BIN)/unitouch-gen touch-to-image unitouch_gen/examples -o outputs/demo --overwrite

test: $(VENV)/.installed-dev  ## run the tests, without the slow ones
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow" $(ARGS)

test-all: $(VENV)/.installed-dev  ## run all the tests
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "" $(ARGS)

soak: $(VENV)/.installed-dev  ## try threads, kills, full disks and bad inputs (make soak ARGS=SEED)
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.soak $(ARGS)

lint: $(VENV)/.installed-dev  ## check style, format, types, and that imports follow the arrows
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

docs: $(VENV)/.installed-docs  ## build the documentation (docs/_build/html)
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build/html

bench: $(VENV)/.installed  ## measure and print every figure that the README and docs/ quote
	$(BIN)/python -m tests.benchmarks $(ARGS)

weights: $(VENV)/.installed  ## train the tiny family anew (hours), going on where it stopped
	$(BIN)/python -m unitouch_gen.training family --runs $(RUNS)
	$(BIN)/python samples/assemble_family.py $(RUNS) $(FAMILY)

clean:  ## remove what was built and cached, but not .venv and trained runs
	rm -rf build dist *.egg-info docs/_build outputs/demo .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find unitouch_gen pipelines training tests samples -name __pycache__ -type d -prune -exec rm -rf {} +

# The environment in steps, each redone only when what it depends on changed. `demo` and `bench` stop at the second.

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "unitouch_gen needs Python 3.11 or newer, which '$(PYTHON)' is not. Name another: make PYTHON=python3.11" >&2; exit 1; }
	@echo "Creating $(VENV) with $$($(PYTHON) --version) ..."
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "'$(PYTHON) -m venv' failed. On Debian and Ubuntu it comes with the package python3-venv." >&2; exit 1; }

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	@echo "Installing unitouch_gen and what it runs on (the first time takes minutes) ..."
	@$(INSTALL) setuptools
	@$(INSTALL) --no-build-isolation --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@echo "Installing the tests and linters ..."
	@$(INSTALL) --no-build-isolation --editable ".[test,lint]"
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	@echo "Installing the documentation's builder ..."
	@$(INSTALL) --no-build-isolation --editable ".[docs]"
	@touch $@
