# Every target sets up what it needs in .venv; only Python (>= 3.11) and make have to be there.
ENOUGH := import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c '$(ENOUGH)' 2>/dev/null && { echo $$p; break; }; done)
BIN := .venv/bin
WORKERS ?= 2

# The matrices are small: more threads only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1
export XLA_FLAGS ?= --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1

.PHONY: demo test test-slow lint types bench fuzz kills audit docs pictures format clean

demo: .venv/installed ## the main job on the embedded recording
	$(BIN)/figaroh-jax demo --out runs/demo

test: .venv/developed ## the tests, without the slow ones
	$(BIN)/python -m pytest -m "not slow" -n $(WORKERS) --dist loadfile $(ARGS)

test-slow: .venv/developed ## the slow tests: many hidden effects, many clean recordings
	JAX_DISABLE_MOST_OPTIMIZATIONS=0 $(BIN)/python -m pytest -m slow -n $(WORKERS) --dist loadfile $(ARGS)

lint: .venv/developed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/developed
	$(BIN)/pyright $(ARGS)

bench: .venv/developed ## CPU seconds of import and diagnose; the regressor against Pinocchio and figaroh
	$(BIN)/python benchmarks/diagnose.py
	$(BIN)/python benchmarks/regressor.py

fuzz: .venv/developed ## a minute of malformed input; nightly: ARGS="--count 20000 --minutes 600"
	$(BIN)/python benchmarks/fuzz.py --minutes 1 --workers $(WORKERS) $(ARGS)

kills: .venv/developed ## commands killed at random moments, and every call that writes refused once
	$(BIN)/python benchmarks/kills.py $(ARGS)

audit: .venv/developed ## known vulnerabilities of what is installed
	$(BIN)/pip-audit --local --skip-editable --strict $(ARGS)

docs: .venv/documented ## the site in site/, with every warning an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

pictures: .venv/developed ## the docs' screenshots, from the demo
	$(BIN)/figaroh-jax demo --out runs/demo --quiet
	$(BIN)/python benchmarks/pages.py runs/demo --docs docs/images
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[view]'
	$(BIN)/python benchmarks/pages.py runs/demo --view docs/images/view.png

format: .venv/developed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv .cache .pytest_cache .ruff_cache .hypothesis runs site build dist

.venv/bin/python:
	@test -n "$(PYTHON)" || { echo "make: needs Python >= 3.11 with venv (on Debian: apt-get install python3-venv);" \
		"name it with make PYTHON=/path/to/python3" >&2; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade "pip>=25.1"

.venv/documented: pyproject.toml | .venv/developed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --group docs
	@touch $@

# A stamp is newer than pyproject.toml once what it names is installed, so a second run installs nothing.
.venv/installed: pyproject.toml | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

.venv/developed: pyproject.toml | .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable . --group dev
	@touch $@
