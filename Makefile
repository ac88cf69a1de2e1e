# Every target makes the environment that it needs in .venv; nothing touches the system's Python.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
define COMPILE
@echo "Compiling the simulator, once on this machine: about half a minute"
$(BIN)/python -c "from tactile_rt.sim_backend.source import compile_simulator as c; c()"
endef
# The exact releases that the tests run with.
PINS := requirements/constraints.txt
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint $(PINS)
# One process more than cores, as tests often wait; each takes the next file, so that what a file's
# tests share is made once. `pytest` alone runs all but the slow ones in one process.
PYTEST := $(BIN)/python -m pytest
WORKERS := $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1)
PARALLEL := -n $(WORKERS) --maxprocesses 9 --max-worker-restart 0 --dist loadfile --no-loadscope-reorder
QUICK := -m "not slow and not hardware and not lengthy"

# What `make quick` looks at: a package under tactile_rt, as P=drivers.
P ?= stream

.PHONY: demo test quick lint check wheel docs roads check-export bench fuzz captures format clean

demo: $(VENV)/.sim
	$(BIN)/tactile-rt demo --sweeps 12

test: $(VENV)/.dev
	$(PYTEST) $(PARALLEL) $(QUICK)

quick: $(VENV)/.dev
	@test -e tactile_rt/$(P) -o -e tactile_rt/$(P).py || { echo "no package tactile_rt/$(P)"; exit 2; }
	$(BIN)/ruff format --check tactile_rt tests
	$(BIN)/ruff check tactile_rt tests
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(PYTEST) $(PARALLEL) $(QUICK) $(wildcard tests/$(P) tests/test_$(P).py)

docs: $(VENV)/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# What needs no test to be run.
lint: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check: lint
	$(PYTEST) $(PARALLEL) -m "not hardware and not alone"
	$(PYTEST) -m alone
	$(MAKE) wheel

wheel: $(VENV)/.dev
	$(BIN)/python -m bench.checks.wheel

roads: $(VENV)/.dev
	$(BIN)/python -m bench.roads base page extras lerobot

check-export: $(VENV)/.dev
	$(BIN)/python -m bench.checks.export

bench: $(VENV)/.dev
	$(BIN)/tactile-rt bench

fuzz: $(VENV)/.dev
	$(BIN)/python -m bench.drivers.fuzzing
	$(BIN)/python -m bench.drivers.variants

captures: $(VENV)/.dev
	$(BIN)/python -m bench.drivers.captures

format: $(VENV)/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) dist site

$(VENV)/.sim: pyproject.toml $(PINS)
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --editable '.[sim]'
	$(COMPILE)
	touch $@

$(VENV)/.dev: pyproject.toml $(PINS)
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --editable '.[sim,gym,train,view,dbc,import,publish,ros2,lerobot,test,docs,dev]'
	$(COMPILE)
	touch $@ $(VENV)/.sim
