# make demo   the main job on the emulated workstation; the report opens in any browser
# make test   the whole test suite
# Both make their own virtual environment from the lock file; Python 3.11 or newer is all they need.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
SEED   ?= 0
OUT    ?= runs/demo

# Those that are not merely the entrance to the package of their name, which mypy would take for twice the same.
SCRIPTS := bench_bus bench_guard bench_record bench_replay bench_rls bench_specimen_recursion bench_tracker bench_worlds \
  readme_figure

.PHONY: demo test test-ports test-vcan test-vm uml check format lock bench clean help

help:
	@sed -n 's/^# \{0,1\}//p;/^$$/q' Makefile

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "microdrivers needs Python 3.11 or newer; say which: make PYTHON=python3.12 …"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: $(READY)
	@rm -f $(OUT)/run.mcap $(OUT)/result.json
	$(BIN)/microdrivers calibrate optics --seed $(SEED) --out $(OUT)

# Bytecode is kept whatever the environment says: pytest rewrites every assertion, a twentieth of the time.
# Three processes for two cores: the one with the tests in real time mostly sleeps, and goes first (tests/conftest.py).
test: $(READY)
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -q -n 3 --dist loadgroup $(PYTEST_ARGS)

# What needs the machine to itself, in real time and one after the other: tools behind a serial CAN adapter and on
# Modbus, independent Modbus masters, routines on a served rig. ON=guest runs it where nothing is late because the
# computer is busy: under User Mode Linux, in a time of its own.
test-ports: $(READY) $(if $(filter guest,$(ON)),uml)
	$(if $(filter guest,$(ON)),$(BIN)/python scripts/vcan-run -b uml -t 900 -s --) \
	  $(BIN)/python -m pytest -q -m ports $(PYTEST_ARGS) tests/conformance tests/backends tests/judges tests/routines

# The CAN tests on a real SocketCAN bus: this kernel's vcan if it has one, else User Mode Linux, which it fetches once.
test-vcan: $(READY)
	$(BIN)/python scripts/vcan-run --setup auto
	$(BIN)/python scripts/vcan-run -t 300 -s -- \
	  $(BIN)/python -m pytest -q -p no:cacheprovider -m vcan $(PYTEST_ARGS) tests/vcan

uml: $(READY)
	$(BIN)/python scripts/vcan-run --setup uml

# The tests that need devices which a container lacks, in an emulated PC. The first time it fetches Debian's kernel.
# Those on CAN controllers need more of a processor than it emulates: there, time is counted in instructions.
test-vm: $(READY)
	$(BIN)/python scripts/vcan-run --setup qemu
	$(BIN)/python scripts/vcan-run -b qemu -t 1200 -- \
	  $(BIN)/python -m pytest -q -p no:cacheprovider -m vm $(PYTEST_ARGS) tests/vm/test_uart.py tests/vm/test_v4l2_camera.py
	$(BIN)/python scripts/vcan-run -b qemu -t 1200 -s -k kvaser_pci -- \
	  $(BIN)/python -m pytest -q -p no:cacheprovider -m vm $(PYTEST_ARGS) tests/vm/test_can_force.py tests/vm/test_can_fine_stage.py

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	MYPYPATH=scripts $(BIN)/mypy $(addprefix -m ,$(SCRIPTS)) -p bench_can -p bench_force -p bench_wires -p vcan_run
	$(BIN)/lint-imports --no-cache

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Needs uv (pip install uv); the lock names no index.
lock:
	uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header \
	  --no-annotate --upgrade --group dev pyproject.toml -o requirements.lock

bench: $(READY)
	$(BIN)/python scripts/bench_rls.py
	$(BIN)/python scripts/bench_bus.py
	$(BIN)/python scripts/bench_tracker.py
	$(BIN)/python scripts/bench_worlds.py
	$(BIN)/python scripts/bench_force.py
	$(BIN)/python scripts/bench_specimen_recursion.py
	$(BIN)/python scripts/bench_guard.py overshoot
	$(BIN)/python scripts/bench_wires.py
	$(BIN)/python scripts/bench_record.py
	$(BIN)/python scripts/bench_replay.py
	$(BIN)/python scripts/vcan-run --setup auto
	$(BIN)/python scripts/bench_can.py

clean:
	rm -rf $(VENV) dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
