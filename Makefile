# Every target sets itself up in .venv; `make clean` takes it away again.
.DEFAULT_GOAL := run
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: setup run test serve bench proof lint clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

run: $(STAMP)
	$(BIN)/calibench run --out calibench-data $(ARGS)

test: $(STAMP)
	$(BIN)/python -m pytest -n 2 -m "not slow" $(ARGS)

serve: $(STAMP)
	$(BIN)/calibench serve $(ARGS)

bench: $(STAMP)
	$(BIN)/python -m pytest benchmarks -m slow -s $(ARGS)

proof: $(STAMP)
	$(BIN)/python -m pytest tests -m slow -s $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
