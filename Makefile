# Every target sets itself up in .venv; `make clean` takes it away again.
.DEFAULT_GOAL := run
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# Compiled code is kept, whatever the shell says: the tests start hundreds of commands.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: aravis chromium ci-extra coverage docs peers third-party names soak kills halts faults setup run test serve bench proof proof-live proof-unlisted twin real slow lint clean

setup: $(STAMP)

# Modules are compiled when they are first imported (--no-compile): most never are.
$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[dev]'
	rm -rf calibench.egg-info  # pytest would rewrite the assertions of every module that it lists
	$(BIN)/python scripts/compile_loops.py
	touch $@

# A day in virtual time on a bench whose instruments fail at 1 % of their answers. ARGS as pytest's. Its logging keeps every failed run in memory: off.
SOAK_CAPTURES ?= 20000
soak: $(STAMP)
	SOAK_CAPTURES=$(SOAK_CAPTURES) $(BIN)/python -m pytest tests/soak/test_soak.py -m slow -s -p no:logging $(ARGS)

# kill -9 of service, worker and bench at random moments, KILLS of them; about ten seconds each.
KILLS ?= 20
kills: $(STAMP)
	KILLS=$(KILLS) $(BIN)/python -m pytest tests/soak/test_kills.py -m slow -s $(ARGS)

# Halts of a session at random moments, packing included, HALTS of them; about five seconds each. HALTS_SEED=N draws others.
HALTS ?= 20
halts: $(STAMP)
	HALTS=$(HALTS) $(BIN)/python -m pytest tests/soak/test_halts.py -m slow -s $(ARGS)

# Random faults over every driver that has a mock, FAULTS of them; about three seconds each. FAULTS_SEED=N draws others,
# FAULTS_ONLY=DRIVER:SEED repeats one that failed, FAULTS_ONLY=DRIVER takes one driver.
FAULTS ?= 100
faults: $(STAMP)
	FAULTS=$(FAULTS) $(BIN)/python -m pytest tests/soak/test_faults.py -m slow $(ARGS)

# The library for GigE cameras of any maker, from the distribution; tests that need it skip without it.
aravis:
	scripts/install-aravis

# Simulators of INDI's and Alpaca's cameras, Argyll's spotread, and the packages that only `make ci-extra` needs: makers' libraries with
# emulated cameras, the driver of the browser, a database server; COLMAP and mrcal, which read exports. Tests that need them skip without them.
peers: $(STAMP)
	scripts/install-peers $(BIN)/python

# Simulators of third parties, for `python -m evaluation third-party`; tests that need them skip without them.
third-party: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[third-party]'
	rm -rf calibench.egg-info  # as above

# The documentation as a site, with search and the reference of the Python interface: build/site/index.html. A link that leads nowhere fails.
docs: $(STAMP)
	$(BIN)/python -c 'import sphinx, myst_parser, furo' 2>/dev/null || \
		$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[docs]'
	rm -rf calibench.egg-info  # as above
	$(BIN)/sphinx-build --quiet --fail-on-warning --jobs 2 -c docs . build/site $(ARGS)

# The browser in which the tests drive the operator's page, from the distribution.
chromium:
	scripts/install-chromium

run: $(STAMP)
	$(BIN)/calibench run --out calibench-data $(ARGS)

test: $(STAMP)
	$(BIN)/python -m pytest -n 3 --dist worksteal -m "not slow and not extra" $(ARGS)

# Branch coverage of the everyday suite, in build/coverage/html; the tests take about twice as long. ARGS as pytest's.
coverage: $(STAMP)
	rm -rf build/coverage
	$(BIN)/coverage run -m pytest -n 3 --dist worksteal -m "not slow and not extra" $(ARGS)
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage html --quiet
	$(BIN)/coverage report | tail -1

# What CI runs beside `make test`: a browser, other programs, a database server, the wheel, whole sessions of the mock bench, whole diagnoses.
ci-extra: $(STAMP)
	$(BIN)/python -m pytest -n 3 --dist worksteal -m "extra and not slow" $(ARGS)

serve: $(STAMP)
	$(BIN)/calibench serve $(ARGS)

bench: $(STAMP)
	$(BIN)/python -m pytest benchmarks -m slow -s $(ARGS)

# A blind proof of the diagnosis: goes on where it stopped; a new one needs another PROOF, for a scored seed is spent.
CASES ?= 200
PROOF ?= calibench-data/proof
proof: $(STAMP)
	mkdir -p $(dir $(PROOF))
	test -s $(PROOF).seed || $(BIN)/python -c "import random; print($(if $(SEED),$(SEED),random.SystemRandom().randrange(10**6, 2**32)))" > $(PROOF).seed
	test -f $(PROOF).score.json || $(BIN)/python -m evaluation make --proof --out $(PROOF) --cases $(CASES) --seed "$$(cat $(PROOF).seed)"
	$(BIN)/python -m evaluation score $(PROOF) --truths $(PROOF).truths.json --json $(PROOF).score.json --page docs/proof.md

# A blind proof of discovery, of laws that no list has: goes on where it stopped; a new one needs another UNLISTED.
UNLISTED_CASES ?= 200
UNLISTED ?= calibench-data/proof-unlisted
proof-unlisted: $(STAMP)
	mkdir -p $(dir $(UNLISTED))
	test -s $(UNLISTED).seed || $(BIN)/python -c "import random; print($(if $(SEED),$(SEED),random.SystemRandom().randrange(10**6, 2**32)))" > $(UNLISTED).seed
	test -f $(UNLISTED).score.json || $(BIN)/python -m evaluation make --unlisted --proof --out $(UNLISTED) --cases $(UNLISTED_CASES) --seed "$$(cat $(UNLISTED).seed)"
	$(BIN)/python -m evaluation score $(UNLISTED) --truths $(UNLISTED).truths.json --json $(UNLISTED).score.json --page docs/proof-unlisted.md

# The live proof: benches that conceal each effect, a session over the wire of each, and the diagnosis. Goes on where it stopped;
# ARGS="--only CASE" runs one.
LIVE ?= calibench-data/proof-live
proof-live: $(STAMP)
	$(BIN)/python -m evaluation live --out $(LIVE) --page docs/proof.md $(ARGS)

# False names: quick sessions of the default bench, healthy cameras, strong effects and blurs of the independent simulator. Goes on
# where it stopped; ARGS="--only bench --most 5" runs a part.
NAMES ?= calibench-data/names
names: $(STAMP)
	$(BIN)/python -m evaluation names --out $(NAMES) $(ARGS)

# Real recordings through import, fit and diagnose, beside what is known of them by other means: docs/real-recordings.md, compared with
# its last state. Goes on where it stopped; ARGS="--only SET" runs one, ARGS="--more DIR" takes the sets of another folder.
REAL ?= ../shared/data
real: $(STAMP)
	$(BIN)/python -m benchmarks.real --data $(REAL) --out calibench-data/real $(ARGS)

# The proof of the twin: concealed cameras carried to configurations that they weren't fitted in. Goes on where it stopped; ARGS="--only
# CASE" runs one, another SEED draws cameras that nobody has seen. Then the highest levels of real photon-transfer sets from the lowest.
TWIN ?= calibench-data/proof-twin
twin: $(STAMP)
	$(BIN)/python -m evaluation twin --out $(TWIN) $(if $(SEED),--seed $(SEED)) --page docs/proof-twin.md $(ARGS)
	test ! -d $(REAL) || $(BIN)/python -m benchmarks.real.extrapolation --data $(REAL) --page docs/proof-twin.md

# The tests that the everyday suite leaves out: recovery and coverage over many draws.
slow: $(STAMP)
	$(BIN)/python -m pytest tests -m slow -s $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	scripts/check-pages $(BIN)/python

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
