# `make help` lists the targets. Set-up happens by itself; it needs Python 3.11 or newer and git.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
UV := $(BIN)/python -m uv
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder
UV_VERSION := $(shell sed -n 's/^uv==\([0-9.]*\).*/\1/p' constraints.txt)

.PHONY: help setup quickstart gallery smoke test test-all test-quick test-foreign test-lerobot durations lint format docs bench release constraints clean
help:
	@echo "make quickstart   train, report and film the small billiards example (four to eight minutes)"
	@echo "make gallery      the films of docs/gallery.md"
	@echo "make test         run the tests (8 to 20 minutes on 2 cores, by their speed)"
	@echo "make test-all     these, and what checks the same at length"
	@echo "make test-quick   those in files that take little of that (under 3 minutes)"
	@echo "make test-foreign those of PyTorch, Stable-Baselines3, onnxruntime and Meta-World, which it installs"
	@echo "make test-lerobot the chain with LeRobot, in an environment of its own (PYTHON312=python3.12; some minutes)"
	@echo "make durations    make test, and tests/durations.txt: the seconds of each file"
	@echo "make smoke        one tiny sweep of every form of feedback and of every adaptation on both tasks (minutes on 2 cores)"
	@echo "make lint         ruff and pyright"
	@echo "make format       what ruff can put right by itself"
	@echo "make docs         the pages of docs/ as a site, in site/ (under half a minute)"
	@echo "make bench        the benchmarks of this machine (some minutes)"
	@echo "make release      build sdist and wheel, and try the wheel in an empty environment: PYTHONS='3.11 3.12 3.13'"
	@echo "make setup        only the set-up of all of these, in $(VENV)"
	@echo "make constraints  resolve the pinned versions anew"
	@echo "make clean        remove $(VENV) and the caches"
	@echo "Another Python:   make PYTHON=python3.12 ..."

$(BIN)/uv: constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "cuelearner needs Python 3.11 or newer: make PYTHON=python3.11")'
	test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check "uv==$(UV_VERSION)"
	@touch $@

$(VENV)/.installed: $(BIN)/uv pyproject.toml constraints.txt
	$(UV) pip install --python $(BIN)/python --constraints constraints.txt --editable '.[label]'
	@touch $@

$(VENV)/.tested: $(VENV)/.installed
	$(UV) pip install --python $(BIN)/python --constraints constraints.txt --group dev
	@touch $@

$(VENV)/.foreign: $(VENV)/.tested
	$(UV) pip install --python $(BIN)/python "pip>=25.1" # the first that knows groups
	$(BIN)/python -m pip install --disable-pip-version-check --constraint constraints.txt --group foreign
	$(BIN)/python -m pip install --disable-pip-version-check --no-deps metaworld==3.1.1 # it asks for an older MuJoCo
	@touch $@

setup: $(VENV)/.tested

quickstart: $(VENV)/.installed
	$(BIN)/cuelearner sweep billiards --preset quickstart --out runs/quickstart
	$(BIN)/cuelearner report runs/quickstart --out runs/quickstart/report --overwrite
	$(BIN)/cuelearner render runs/quickstart --guidance relative --out runs/quickstart/pictures --overwrite
	@grep '^|' runs/quickstart/report/report.md

gallery: $(VENV)/.tested
	$(BIN)/python experiments/gallery.py

smoke: $(VENV)/.installed
	$(BIN)/python experiments/billiards_bootstrapping.py --scale smoke --pieces easy/frame --resume
	$(BIN)/python experiments/navigation_bootstrapping.py --scale smoke --pieces clutter/frame --resume
	$(BIN)/python experiments/adaptation.py --scale smoke --resume --pieces billiards/bases billiards/tilted_table \
		navigation/bases navigation/turned_lidar navigation/corridor_left

test: $(VENV)/.tested
	$(PYTEST) -m "not long"

test-all: $(VENV)/.tested
	$(PYTEST)

test-quick: $(VENV)/.tested
	$(PYTEST) -m "not slow and not long"

test-foreign: $(VENV)/.foreign
	$(PYTEST) tests/foreign tests/examples/test_notebook.py

PYTHON312 ?= python3.12
LEROBOT := .venv-lerobot
$(LEROBOT)/.installed: $(BIN)/uv plugins/lerobot_processor_cuelearner/pyproject.toml
	$(PYTHON312) -m venv $(LEROBOT)
	$(UV) pip install --python $(LEROBOT)/bin/python "lerobot[training,evaluation,pusht]==0.6.1" \
		--editable "plugins/lerobot_processor_cuelearner[kinematics]"
	@touch $@

test-lerobot: $(VENV)/.tested $(LEROBOT)/.installed
	LEROBOT_PYTHON=$(abspath $(LEROBOT)/bin/python) $(PYTEST) tests/lerobot_chain

durations: $(VENV)/.tested
	$(PYTEST) -m "not long" --durations-to tests/durations.txt

lint: $(VENV)/.tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: $(VENV)/.tested
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(VENV)/.documented: $(VENV)/.tested
	$(UV) pip install --python $(BIN)/python --constraints constraints.txt --group docs
	@touch $@

docs: $(VENV)/.documented
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

bench: $(VENV)/.tested
	$(BIN)/python benchmarks/billiards_speed.py
	$(BIN)/python benchmarks/scaling.py --out scaling.json

PYTHONS ?= 3.11 3.12 3.13
release: $(BIN)/uv
	$(BIN)/python release/check.py --pythons $(PYTHONS)

constraints: $(BIN)/uv
	$(UV) pip compile --quiet --upgrade --universal --python-version 3.11 --all-extras --group dev --group docs --no-annotate --no-header \
		--no-emit-index-url --no-emit-find-links pyproject.toml --output-file constraints.txt

clean:
	rm -rf $(VENV) $(LEROBOT) .jax_cache .pytest_cache .ruff_cache
