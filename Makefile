# make quickstart | test | lint | bench | constraints. Set-up happens by itself; it needs Python 3.11 or newer and git.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
UV := $(BIN)/python -m uv
UV_VERSION := $(shell sed -n 's/^uv==\([0-9.]*\).*/\1/p' constraints.txt)

.PHONY: help quickstart test lint format bench constraints clean
help:
	@echo "make quickstart   train, report and film the small billiards example (two to three minutes)"
	@echo "make test         run the tests"
	@echo "make lint         ruff and pyright"
	@echo "make bench        the benchmarks of this machine (some minutes)"
	@echo "make constraints  resolve the pinned versions anew"

$(BIN)/uv: constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "cuelearner needs Python 3.11 or newer: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet "uv==$(UV_VERSION)"
	@touch $@

$(VENV)/.installed: $(BIN)/uv pyproject.toml constraints.txt
	$(UV) pip install --quiet --python $(BIN)/python --constraints constraints.txt --editable .
	@touch $@

$(VENV)/.tested: $(VENV)/.installed
	$(UV) pip install --quiet --python $(BIN)/python --constraints constraints.txt --group dev
	@touch $@

quickstart: $(VENV)/.installed
	$(BIN)/python experiments/quickstart.py

test: $(VENV)/.tested
	$(BIN)/python -m pytest

lint: $(VENV)/.tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: $(VENV)/.tested
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.tested
	$(BIN)/python benchmarks/billiards_speed.py
	$(BIN)/python benchmarks/training_speed.py
	$(BIN)/python benchmarks/guidance_overhead.py

constraints: $(BIN)/uv
	$(UV) pip compile --quiet --universal --python-version 3.11 --all-extras --group dev --no-annotate --no-header \
		--no-emit-index-url --no-emit-find-links pyproject.toml --output-file constraints.txt

clean:
	rm -rf $(VENV) .jax_cache .pytest_cache .ruff_cache
