# Three commands matter: `make setup`, `make demo` and `make test`. They need python3.11+, and set up what they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TORCH ?= auto

.PHONY: setup demo test suite lint types bench docs soak clean
.DELETE_ON_ERROR:

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "brushloop needs python3.11 or newer; set PYTHON=..."; exit 2; }
	$(PYTHON) -m venv $(VENV)

# What brushloop needs; TORCH=cuda or TORCH=cpu overrides the choice of torch's build.
$(STAMP): requirements/run.lock requirements/install.py pyproject.toml | $(VENV)/bin/python
	$(BIN)/python requirements/install.py run --torch $(TORCH)
	@touch $@

# What tests and checks need as well.
$(STAMP)-dev: requirements/run.lock requirements/dev.lock requirements/install.py pyproject.toml | $(VENV)/bin/python
	$(BIN)/python requirements/install.py dev --torch $(TORCH)
	@touch $(STAMP) $@

setup: $(STAMP)  ## make .venv with all that the commands need, and run none of them
	@echo "brushloop is installed in $(VENV). Next, in each new terminal: . $(BIN)/activate; then brushloop --help lists the commands."

# Bytecode is kept, whatever the shell says: without it each of the demo's processes compiles some 600 modules again.
demo: $(STAMP)  ## press, calibrate, press again and validate on the loopback rig; `brushloop demo --full` does more
	PYTHONDONTWRITEBYTECODE= $(BIN)/brushloop demo

test: $(STAMP)-dev  ## lint, layers, types, and the tests; types are checked beside the tests
	@$(MAKE) --no-print-directory --jobs 2 lint types suite

# The workers and the processes that tests start keep bytecode as well.
suite: $(STAMP)-dev
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 6 --dist loadgroup --no-loadscope-reorder

lint: $(STAMP)-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(STAMP)-dev
	$(BIN)/pyright

bench: $(STAMP)-dev  ## speed and memory beside named peers, some 25 minutes, kept in docs/results.md
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m bench --table

docs: $(STAMP)-dev  ## the documentation as a site, in build/site/index.html; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build

soak: $(STAMP)-dev  ## long kill and load loops, and property tests on new examples
	$(BIN)/python -m pytest -m soak --timeout 3600
	$(BIN)/python -m pytest --hypothesis-profile search

clean:
	rm -rf $(VENV) build demo-run .pytest_cache .ruff_cache .hypothesis .import_linter_cache
