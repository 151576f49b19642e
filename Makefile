# Each target makes .venv where there is none, installs what it needs with the pins of constraints.txt, and runs.
# Stamp files in .venv remember what is installed; a change of pyproject.toml or constraints.txt installs again.

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= $(shell for python in python3.11 python3.12 python3.13 python3.14 python3 python; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && command -v $$python && break; done)
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
# More arguments for the command that a target runs: make test ARGS="tests/robots -x"
ARGS ?=

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: demo test test-all test-processors mutants test-browser check docs format bench release-check clean help

demo: $(VENV)/.demo  ## simulate, learn and score; prints the table and writes a report
	$(BIN)/forcegp demo $(ARGS)

# Files stay together, so that what a module shares is computed once.
test: $(VENV)/.test  ## run the fast tests; every subject is in one, but the browser (make test-browser)
	$(BIN)/python -m pytest -n 2 --dist loadfile --ignore=tests/report/test_browser.py $(ARGS)

test-all: $(VENV)/.test  ## run all tests, the slow ones too, and check annotated shapes at run time
	FORCEGP_CHECK_SHAPES=1 $(BIN)/python -m pytest -n 2 --dist loadfile -m "" $(ARGS)

test-processors: $(VENV)/.test  ## run the tests as other processors and a busy machine do; goes on where it ended
	$(BIN)/python tests/processors.py $(ARGS)

mutants: $(VENV)/.test  ## put faults into the source, one at a time, and see whether the tests notice
	$(BIN)/python -m tests.mutants $(ARGS)

test-browser: $(VENV)/.browser  ## look at reports in a headless Chromium, which must be installed
	$(BIN)/python -m pytest -q -rs tests/report/test_browser.py tests/report/test_page.py $(ARGS)

check: $(VENV)/.check  ## lint, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/pyright -p pyright-public.json

# One thread: notebooks are small, and the cores belong to the tests.
docs: $(VENV)/.docs  ## build the documentation into build/docs; a warning is an error
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs $(ARGS)

format: $(VENV)/.check  ## mend what ruff can mend by itself
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.test  ## measure; benchmarks/README.md says what
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m benchmarks $(ARGS)

# The sdist is tested by the first Python that is here; the wheel makes the demo's report with each.
release-check:  ## build what is published, check it, and try it in empty environments of every Python that is here
	rm -rf dist build/release
	$(PYTHON) -m venv build/release/tools
	build/release/tools/bin/pip install --quiet build twine
	build/release/tools/bin/python -m build --outdir dist
	build/release/tools/bin/twine check --strict dist/*
	for python in python3.11 python3.12 python3.13 python3.14; do \
		$$python -c pass 2> /dev/null || { echo "$$python is not here, and was not tried."; continue; }; \
		$$python -m venv build/release/$$python || exit 1; \
		build/release/$$python/bin/pip install --quiet --retries 0 --extra-index-url $(TORCH_INDEX) --constraint constraints.txt "$$(ls dist/*.whl)[sim]" || exit 1; \
		(cd build/release/$$python && bin/forcegp demo) || exit 1; \
	done
	tar -xzf dist/*.tar.gz -C build/release
	$(MAKE) -C build/release/forcegp-* test

clean:  ## remove .venv, caches and builds; keeps what runs and demos wrote
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .hypothesis .processors
	find src tests benchmarks examples -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## */\t/' | expand -t 18

# A larger installation contains the smaller ones, so it stamps them too.
$(VENV)/.demo: EXTRAS := sim,view
$(VENV)/.demo: STAMPS := $(VENV)/.demo
$(VENV)/.test: EXTRAS := sim,test,logs
$(VENV)/.test: STAMPS := $(VENV)/.demo $(VENV)/.test
$(VENV)/.check: EXTRAS := sim,test,logs,dev
$(VENV)/.check: STAMPS := $(VENV)/.demo $(VENV)/.test $(VENV)/.check
$(VENV)/.browser: EXTRAS := sim,test,logs,browser
$(VENV)/.browser: STAMPS := $(VENV)/.demo $(VENV)/.test $(VENV)/.browser
$(VENV)/.docs: EXTRAS := sim,test,logs,docs
$(VENV)/.docs: STAMPS := $(VENV)/.demo $(VENV)/.test $(VENV)/.docs

# torch first and alone, because only torch may come from TORCH_INDEX; where that index is out of reach, pip goes on without it.
# Python compiles what is imported; to compile all that is installed takes half a minute.
$(VENV)/.demo $(VENV)/.test $(VENV)/.check $(VENV)/.browser $(VENV)/.docs: $(VENV)/pyvenv.cfg pyproject.toml constraints.txt
	@echo "Installing forcegp[$(EXTRAS)] in $(VENV): one to two minutes the first time."
	$(BIN)/python -m pip install --quiet --quiet --no-compile --retries 0 --no-deps --extra-index-url $(TORCH_INDEX) --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --quiet --no-compile --constraint constraints.txt --editable '.[$(EXTRAS)]'
	@touch $(STAMPS)

$(VENV)/pyvenv.cfg:
	@test -n "$(PYTHON)" || { echo "forcegp needs Python 3.11 or newer and found none; say: make PYTHON=/path/to/python3.11"; exit 2; }
	$(PYTHON) -m venv $(VENV)
