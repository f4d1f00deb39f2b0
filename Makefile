# Two commands do everything on a fresh machine: `make demo` (the main job) and `make test`.
# Both rest on `make setup`, which prepares .venv once and is cheap to repeat.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

.PHONY: help setup system demo test check bench docs clean

help:  ## this list
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 12

setup: $(STAMP)  ## prepare .venv with everything the demo and the tests need

$(STAMP): pyproject.toml scripts/setup
	@PYTHON="$(PYTHON)" scripts/setup $(VENV)
	@touch $(STAMP)

demo: setup  ## run the whole pipeline on a small synthetic data set and print the AP table
	@$(BIN)/run_pipeline

test: setup  ## all tests
	@scripts/test

check: setup  ## ruff, mypy, architecture
	@scripts/check

bench: setup  ## time our code beside its peers, write benchmarks/RESULTS.md
	@$(BIN)/python -m benchmarks

docs: setup  ## the documentation as site/index.html, readable without a network
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[docs]"
	@$(BIN)/python scripts/build_docs.py

clean:  ## remove the environment and everything generated
	rm -rf $(VENV) build site *.egg-info runs .mypy_cache .ruff_cache
