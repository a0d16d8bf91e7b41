# Everything needs only Python 3.11 or newer (and make): the first call sets up .venv by itself.
#
#   make demo       trains a policy across the gap on a shipped network; table, page, film
#   make test       builds the wheel, installs it into .venv and tests it
#   make test-slow  the tests that take long and are left out there
#   make test-all   both, small versions of the paper's tables, digests of behaviour, 3,000 damaged inputs, and each documented command (over two hours)
#   make check      format, lint, types, architecture, words, tests
#   make compat     the learners of other libraries: what runs where (LATEST=1: their newest releases)
#   make bench      the figures of docs/, measured on this machine
#   make scenarios  builds the shipped scenarios again from their sources
#   make docs       builds the documentation site; broken links and names fail
#   make notebooks  runs the notebooks of docs/ and keeps what they show
#   make package    builds the wheel and the source archive, and installs them with every extra (ten minutes)
#   make words      how docstrings open, how long lines and paragraphs of pages are
#
# PYTHON=... picks the interpreter, TESTS=... the tests, ARGS=... adds options to the command run.

SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
TESTS ?= tests

# The first interpreter that is new enough; `make PYTHON=/path/to/python` overrules.
CANDIDATES := python3 python3.13 python3.12 python3.11 python3.14 python
PYTHON ?= $(shell for p in $(CANDIDATES); do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo "$$p" && break; done)
ENVIRONMENT = "$(PYTHON)" .ci/environment.py

# One more than processors: a fifth of the tests' time is spent waiting for processes.
JOBS ?= $(shell "$(PYTHON)" -c 'import os; print((os.cpu_count() or 1) + 1)')

# Nothing outside .venv is imported: not the source tree, not the user's own packages.
unexport PYTHONPATH PYTHONHOME SUMO_HOME VIRTUAL_ENV
export PYTHONSAFEPATH := 1
export PYTHONNOUSERSITE := 1

.PHONY: help demo test test-slow test-all check static format lint types architecture words docs package notebooks bench scenarios oldest compat python environment environment-dev environment-notebooks
.DEFAULT_GOAL := help

help:
	@sed -n '1,/^$$/s/^# \{0,1\}//p' Makefile

demo: environment
	rm -rf runs/demo
	OMP_NUM_THREADS=1 $(BIN)/ugat-marl train single-v1 --real V4 --out runs/demo --duration-s 1200 \
		--iterations 1 --street.simulations 40 --street.rule-budget 3 --street.rival none --street.judged 4 \
		--tuning-seeds 1 $(ARGS)
	OMP_NUM_THREADS=1 $(BIN)/ugat-marl report runs/demo
	OMP_NUM_THREADS=1 $(BIN)/ugat-marl rollout single-v1 --domain V4 --policy runs/demo/policies/direct-transfer.pt \
		--beside runs/demo/policies/fitted-street.pt --video runs/demo/before-after.gif \
		--film.from-s 1000 --film.length-s 60 --film.size 400

test: environment-dev
	UGAT_MARL_TEST_INSTALLED=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(JOBS) --dist worksteal $(TESTS) $(ARGS)

test-slow: environment-dev
	UGAT_MARL_TEST_INSTALLED=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -m slow -n $(JOBS) --dist worksteal $(TESTS) $(ARGS)

test-all: test test-slow
	UGAT_MARL_TEST_INSTALLED=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -m nightly $(TESTS)/nightly $(ARGS)

check: static
	@$(MAKE) --no-print-directory test

static: format lint types architecture words

format: environment-dev
	$(BIN)/python -m ruff format --check .

lint: environment-dev
	$(BIN)/python -m ruff check .

types: environment-dev
	$(BIN)/python -m basedpyright --pythonpath $(BIN)/python

architecture: environment-dev
	$(BIN)/python -m pytest -q tests/architecture_test.py

bench: environment-dev
	PYTHONPATH=. PYTHONSAFEPATH= $(BIN)/python -m studies.bench all $(ARGS)

scenarios: environment
	PYTHONSAFEPATH= $(BIN)/python scenarios/build.py $(ARGS)

words: python
	@"$(PYTHON)" .ci/words.py

docs: python
	@"$(PYTHON)" .ci/site.py

notebooks: environment-notebooks
	OMP_NUM_THREADS=1 $(BIN)/python .ci/notebooks.py

package: environment-dev
	OMP_NUM_THREADS=1 $(BIN)/python .ci/package.py $(ARGS)

# The lower ends of the version ranges, in an environment of their own.
oldest: environment-dev
	"$(PYTHON)" -m venv $(VENV)-oldest
	$(VENV)-oldest/bin/python -m pip install -q -c constraints-oldest.txt --force-reinstall --no-deps $(VENV)/wheel/*.whl
	$(VENV)-oldest/bin/python -m pip install -q -c constraints-oldest.txt ugat-marl hypothesis pytest pytest-timeout pytest-xdist osmium sumo-rl==1.4.5
	UGAT_MARL_TEST_INSTALLED=1 OMP_NUM_THREADS=1 $(VENV)-oldest/bin/python -m pytest -q -n $(JOBS) --dist worksteal $(TESTS) $(ARGS)

# Every learner of every library, in .venv-compat; LATEST=1 tries each library's newest release in one of its own.
compat: environment-dev
	OMP_NUM_THREADS=1 "$(PYTHON)" .ci/compat.py $(VENV)/wheel/*.whl $(if $(LATEST),--latest) $(ARGS)

environment: python
	@$(ENVIRONMENT)

environment-dev: python
	@$(ENVIRONMENT) dev osm resco

environment-notebooks: python
	@$(ENVIRONMENT) dev osm resco notebooks

python:
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	echo "ugat_marl needs Python 3.11 or newer and found none in PATH (PYTHON='$(PYTHON)')." >&2; \
	echo "Install one, or name it: make PYTHON=/path/to/python3.12 $(or $(MAKECMDGOALS),test)" >&2; exit 1; }
