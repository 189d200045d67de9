# Every target does its own set-up; `make help` lists them.
# Choose an interpreter with `make setup PYTHON=python3.12`.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.PHONY: help setup run demo test check lint types contracts format bench campaign fuzz screens texts pictures models exchange-check cluster-check docs docs-links bundle release clean

export PYTHON
# Compiled once, not by every process again, also where the environment forbids to keep it.
unexport PYTHONDONTWRITEBYTECODE
BIN := .venv/bin
TESTS ?= tests
WORKERS ?= 2
MINUTES ?= 10
GROUP ?=
SINCE ?=
PART ?=
TO ?= de
# Where so much is free in memory, tests write there: they flush thousands of small files.
MEMORY_MB := 6000

help: ## list the targets
	@awk -F':.*## ' '/^[a-z-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: ## make .venv ready (quick when nothing changed)
	@.ci/setup.sh

run: ## open the window on the simulated bench
	@if [ "$$(uname)" = Linux ] && [ -z "$${DISPLAY:-}$${WAYLAND_DISPLAY:-}$${QT_QPA_PLATFORM:-}" ]; then \
	    echo "There is no display here, so no window can open."; \
	    echo "Without a screen the same run works as:  make demo"; \
	    exit 1; \
	fi
	@$(MAKE) --no-print-directory setup
	@$(BIN)/touchdown app $(ARGS)

demo: setup ## stack three pieces without a screen and leave a report
	@$(BIN)/touchdown demo

test: setup ## all tests and their coverage: offscreen, no hardware, no network; one by real keys (Xvfb)
	@.ci/system-packages.sh Xvfb=xvfb xdotool=xdotool
	@export QT_QPA_PLATFORM=offscreen OMP_NUM_THREADS=1 MEASURE_COVERAGE=1; \
	rm -f .coverage .coverage.*; \
	if [ -w /dev/shm ] && [ "$$(df -Pm /dev/shm | awk 'END { print $$4 }')" -ge $(MEMORY_MB) ]; then \
	    export PYTEST_DEBUG_TEMPROOT=/dev/shm; fi; \
	$(BIN)/pytest $(TESTS) -q -n $(WORKERS) --dist worksteal \
	    --junitxml=output/tests.xml || { \
	    code=$$?; [ $$code = 1 ] || exit $$code; \
	    unset MEASURE_COVERAGE; \
	    echo "test: what failed is run again, one by one:"; \
	    if $(BIN)/pytest $(TESTS) -q --last-failed --last-failed-no-failures none --maxfail 9; \
	    then echo "test: FAILED. Alone they pass: they depend on speed, or on what ran beside or before."; \
	    else echo "test: FAILED, alone as well."; fi; \
	    exit $$code; }
	@$(BIN)/coverage combine --quiet
	@echo "coverage: $$($(BIN)/coverage report --format=total) % of the product's lines"

check: lint types contracts test ## all checks of continuous integration

lint: setup ## formatting and lint
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .

types: setup ## mypy --strict
	@$(BIN)/mypy

contracts: setup ## check the import contracts
	@$(BIN)/lint-imports

format: setup ## rewrite the sources in the house style
	@$(BIN)/ruff check --fix-only --quiet .
	@$(BIN)/ruff format .

bench: setup ## measure the figures and write docs/measured.md (GROUP=name: one group, also long ones; SINCE=date: resume)
	@QT_QPA_PLATFORM=offscreen OMP_NUM_THREADS=1 $(BIN)/python -m tests.bench.run --save \
	    $(if $(SINCE),--since $(SINCE)) $(GROUP)

campaign: setup ## strike every device and process 600 times (40 min; resumes; PART=shards: kill workers)
	@QT_QPA_PLATFORM=offscreen OMP_NUM_THREADS=1 $(BIN)/python -m \
	    $(if $(PART),tests.bench.run --save $(PART),tests.bench.campaign)

fuzz: setup ## feed damaged bytes to every wire decoder (10 min each; MINUTES=1 for less)
	@OMP_NUM_THREADS=1 $(BIN)/python -m tests.fuzz.wire --minutes $(MINUTES)

screens: setup ## render every workspace and state, in all themes, into output/screens (CHECK=1: check sizes; PSEUDO=1: with longer texts)
	@QT_QPA_PLATFORM=offscreen OMP_NUM_THREADS=1 $(BIN)/python -m tests.screens $(if $(CHECK),--check) $(if $(PSEUDO),--pseudo) 2>/dev/null

texts: setup ## write or update a translation of the window, in resources/languages (TO=de)
	@mkdir -p resources/languages
	@PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python -m tests.screens --texts resources/languages/touchdown_$(TO).ts
	@$(BIN)/pyside6-lrelease resources/languages/touchdown_$(TO).ts

pictures: setup ## make the pictures of README and guides, in docs/img
	@QT_QPA_PLATFORM=offscreen OMP_NUM_THREADS=1 $(BIN)/python -m tests.pictures 2>/dev/null

models: setup ## train the shipped models from scratch (the longest target: about 50 min)
	@$(BIN)/touchdown models --pieces pot,mushroom,mug --episodes 4000 --epochs 18 --seed 2
	@$(BIN)/touchdown models --pieces barrel --episodes 8000 --epochs 22 --seed 3

docs: setup ## build the documentation site in output/docs/html and run the examples (offline)
	@.ci/docs.sh html

docs-links: setup ## check the external links of the documents (needs the network)
	@.ci/docs.sh linkcheck

exchange-check: setup ## load an export with the real readers (installs them separately: several GB)
	@.ci/exchange-check

cluster-check: setup ## run jobs on a Slurm of one node, started here (Debian packages, root)
	@.ci/cluster-check

bundle: setup ## build the application bundle for Linux, in dist (an environment of its own)
	@.ci/bundle/build

release: setup ## check, build everything of a release into dist/VERSION, tag it; pushes nothing
	@.ci/release

clean: ## remove the results of the other targets (not the data)
	@rm -rf .venv .venv-docs docs/gallery docs/generated docs/index.myst build *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
