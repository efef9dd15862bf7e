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
# The stages of training in order, and what some of them take of those before.
STAGES := image_text touch texture audio image_vae unclip touch_vae touch_ldm language_model touch_llm
PICTURES := --joint $(RUNS)/image_text/model
JOINT := --joint $(RUNS)/texture/model
# Two of them begin from a stage of their own: pictures from captions alone, touch from a recipe without pictures.
STAGE_captions := image_text
STAGE_touch_pairs := touch
TAKES_image_text := --recipe image_text_lamps --init $(RUNS)/captions/model
TAKES_touch_pairs := $(PICTURES) --recipe touch_pairs
TAKES_touch := $(PICTURES) --init $(RUNS)/touch_pairs/model
TAKES_texture := --joint $(RUNS)/touch/model
TAKES_audio := $(JOINT)
TAKES_unclip := $(JOINT) --vae $(RUNS)/image_vae/model
TAKES_touch_vae := --joint $(RUNS)/touch/model
TAKES_touch_ldm := $(JOINT) --vae $(RUNS)/touch_vae/model
TAKES_language_model := $(JOINT)
TAKES_touch_llm := $(JOINT) --llama $(RUNS)/language_model/model

# Processes that keep the memory they free train and render in two thirds of the time (glibc).
weights: export MALLOC_MMAP_THRESHOLD_ := 4000000000
weights: export MALLOC_TRIM_THRESHOLD_ := 4000000000

.DEFAULT_GOAL := help
.NOTPARALLEL:  # stages share a cache
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

weights: $(STAGES:%=$(RUNS)/%/record.json)  ## train the tiny family anew (hours), going on where it stopped
	$(BIN)/python samples/assemble_family.py $(RUNS) $(FAMILY)

# A stage that left its record is done, and one that left a checkpoint goes on from there. To train one anew, remove its
# folder, and those of the stages that take what it made: a stage that goes on, and the last one, refuse others.
RECORDS := $(patsubst %,$(RUNS)/%/record.json,$(STAGES) captions touch_pairs)
$(RECORDS): $(RUNS)/%/record.json: | $(VENV)/.installed
	$(BIN)/python -m unitouch_gen.training $(or $(STAGE_$*),$*) $(TAKES_$*) --output $(RUNS)/$* --cache $(RUNS)/cache \
		$(if $(wildcard $(RUNS)/$*/checkpoints/*/progress.json),--resume)

$(foreach stage,audio unclip touch_ldm language_model,$(RUNS)/$(stage)/record.json): | $(RUNS)/texture/record.json
$(RUNS)/image_text/record.json: | $(RUNS)/captions/record.json
$(RUNS)/touch_pairs/record.json: | $(RUNS)/image_text/record.json
$(RUNS)/touch/record.json: | $(RUNS)/touch_pairs/record.json
$(RUNS)/texture/record.json: | $(RUNS)/touch/record.json
$(RUNS)/unclip/record.json: | $(RUNS)/image_vae/record.json
$(RUNS)/touch_vae/record.json: | $(RUNS)/touch/record.json
$(RUNS)/touch_ldm/record.json: | $(RUNS)/touch_vae/record.json
$(RUNS)/touch_llm/record.json: | $(RUNS)/language_model/record.json

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
