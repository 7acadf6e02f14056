# make setup | demo | test | test-all | test-portable | mutants | lint | types | docs | figures
# TORCH_INDEX: on a machine without a GPU, give pip the address of torch's CPU builds here to avoid the CUDA packages.
PYTHON ?= python3
TORCH_INDEX ?=
# Waiting threads must not occupy a core: see cli.main.
export OMP_WAIT_POLICY ?= PASSIVE
# Without .pyc files, pytest compiles every test anew in each worker: 10 s of `make test`.
export PYTHONDONTWRITEBYTECODE :=
VENV := .venv
BIN := $(VENV)/bin
INDEX := $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX),)

.PHONY: setup demo test test-all test-portable mutants lint types docs figures clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml $(wildcard sphereorient/*/*.c)
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed, this is " + sys.version.split()[0])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q $(INDEX) torch==2.13.0
	$(BIN)/python -m pip install -q $(INDEX) -e '.[dev]'
	touch $@

demo: setup
	$(BIN)/python scripts/demo.py

# worksteal: neighbouring tests stay in one worker, so that what a file prepares for its tests is made once.
test: setup
	$(BIN)/python -m pytest -q -m "not slow" -n 2 --dist worksteal --durations=10 --durations-min=5

test-all: setup
	$(BIN)/python -m pytest -q -n 2 --dist worksteal

# tests/portable/sitecustomize.py hides the posix modules from every process.
test-portable: setup
	PYTHONPATH=tests/portable $(BIN)/python -m pytest -q -m "not slow" -n 2 --dist worksteal

mutants: setup
	$(BIN)/python scripts/mutants.py

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

# The site, out/site/index.html: every tutorial runs, every link is followed, any warning fails.
docs: setup
	$(BIN)/python -m pip install -q $(INDEX) -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# The tables and figures of the docs that are older than the code that they measure: hours for all.
figures: setup
	$(BIN)/python scripts/figures.py

clean:
	rm -rf out .cache .pytest_cache .mypy_cache .ruff_cache
