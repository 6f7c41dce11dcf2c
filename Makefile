# The commands people need: make demo, make test, make up, make check, make fix.
# A machine needs only Python 3.11 or 3.12 and make; everything else is installed into .venv.

PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || echo python3)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
HOST ?= 127.0.0.1
PORT ?= 8000
CAPTURE ?=
MINUTES ?= 5
export CAPTURE HOST PORT

.DEFAULT_GOAL := help
.PHONY: help demo there-is-a-capture up test check fix chaos mutants install install-test lock clean

help: ## Show this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 16

demo: there-is-a-capture install ## Run one capture through the whole service: make demo [CAPTURE=path]
	@$(BIN)/python -m deploy.demo

there-is-a-capture: # before minutes of installing
	@test -z "$$CAPTURE" || test -f "$$CAPTURE" || { echo "There is no file $$CAPTURE. CAPTURE is a video, or a .zip of photos." >&2; exit 2; }

up: install ## Keep the service running here: make up [PORT=8000] [HOST=0.0.0.0]
	@$(BIN)/python -m deploy.local

test: install-test ## Install what the tests need and run them all
	@# A process for each core: more threads than that would only wait for each other.
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest --durations 15 --numprocesses auto --dist loadfile tests --ignore tests/integration --ignore tests/e2e
	@# Whole jobs first, in one process: what waits more than it computes is done beside them.
	@$(BIN)/python -m pytest --durations 15 --numprocesses auto --dist loadfile --no-loadscope-reorder tests/e2e tests/integration

check: install-test ## Lint, types and import rules
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@# Types on one core, import rules on another.
	@$(BIN)/mypy & types=$$!; \
	$(BIN)/python -m pytest -q tests/test_architecture.py tests/test_docs.py; rules=$$?; \
	wait $$types && exit $$rules

fix: install-test ## Format and mend what can be mended
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

chaos: install-test ## Shake the whole service for 8 minutes, judge what is left: [SEED=7]
	@$(BIN)/python -W ignore::UserWarning -m tests.chaos $(if $(SEED),--seed $(SEED))

mutants: install-test ## Plant faults, count those tests notice: 40 minutes at most, or [MINUTES=5] a group
	@$(PIP) install --quiet --editable '.[mutants]'
	@$(BIN)/python -m tests.mutants --minutes $(MINUTES)

install: $(VENV)/.installed ## Install the service into .venv

install-test: $(VENV)/.installed-test ## Install the service and its tests' needs into .venv

lock: install-test ## Write requirements*.txt anew from pyproject.toml (run in a fresh clone)
	@$(BIN)/python -m deploy.lock

$(VENV)/.installed: requirements.txt pyproject.toml deploy/system.py
	@$(PYTHON) deploy/system.py
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing nerfworks into $(VENV) (the first time takes a few minutes)"
	@$(PIP) install --quiet --requirement requirements.txt
	@$(PIP) install --quiet --no-deps --editable .
	@touch $@

$(VENV)/.installed-test: $(VENV)/.installed requirements-test.txt
	@$(PIP) install --quiet --requirement requirements-test.txt
	@touch $@

clean: ## Remove .venv and the caches; never the service's data
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
