# Everything from nothing but python3 (>= 3.11) and make:
#   make demo    replay the packaged drive through the model and over ZeroMQ into a second process
#   make test    the default tests            make check   format, lint, types
#   make slow    full-size tests, processes, the browser, C++ (half an hour, about 10 GB of memory); TESTS: some folders
# WORKERS test processes run beside each other, on a thread each; many of the tests wait rather than compute.
# TORCH_INDEX names another package index for torch, for example a CPU-only or CUDA one.

PYTHON ?= python3
VENV ?= .venv
TORCH_INDEX ?=
WORKERS ?= 3
TESTS ?=

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install -q -c constraints.txt

.PHONY: demo test slow check format clean
.DEFAULT_GOAL := demo

demo: $(VENV)/.core
	$(BIN)/gcd-node demo

test: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

slow: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow -n 2 --dist loadfile $(TESTS)

check: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

format: $(VENV)/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache dist build

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "gcd-node needs Python 3.11 or newer, this is " + sys.version.split()[0] + "; name another with PYTHON=")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.core: $(VENV)/bin/python pyproject.toml client/pyproject.toml constraints.txt
	@echo "Installing into $(VENV) (a minute or two the first time) ..."
	$(PIP) $(if $(TORCH_INDEX),--no-deps --index-url $(TORCH_INDEX)) torch==$(shell sed -n 's/^torch==//p' constraints.txt)
	$(PIP) -e client
	$(PIP) -e .
	@touch $@

$(VENV)/.dev: $(VENV)/.core
	$(PIP) -e '.[dev]'
	@touch $@
