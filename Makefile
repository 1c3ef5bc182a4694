# make setup | run | test | lab | bench | agreement | notebooks | soak | flash | pcb | lint | lock | clean
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.complete
BENCH := .venv-bench
BENCH_STAMP := $(BENCH)/.complete
INPUTS := environment.txt constraints.txt pyproject.toml

.PHONY: help setup build run test lint lab notebooks bench agreement soak flash pcb lock clean

help:
	@echo "make setup      build $(VENV) from environment.txt, install the project, compile firmware and twin"
	@echo "make run        all studies: tables, figures, build/report.html; a capture; a moving tracker followed"
	@echo "make test       linters, unit tests, every notebook"
	@echo "make lab        open the notebooks in JupyterLab"
	@echo "make notebooks  execute the notebooks again, in place, byte-reproducibly"
	@echo "make bench      speed, beside other packages; table and build/bench.json"
	@echo "make agreement  exact rays beside two other tracers, ray by ray"
	@echo "make soak       link faults, tracking for 10 min through the firmware and for 24 h: takes hours"
	@echo "make pcb        the boards' KiCad projects, written again and checked with KiCad 9"
	@echo "make flash      copy the firmware to a Nucleo that is plugged in"

# install FOLDER, ARGUMENTS: uv where it can be had (faster), pip otherwise
define install
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v < (3, 14) else \
	  f"linetrack needs Python 3.11, 3.12 or 3.13; $(PYTHON) is {v[0]}.{v[1]}. Try: make PYTHON=python3.11 ...")'
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || \
	  { echo "Python lacks venv: apt install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(1)
	@if $(1)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt uv; then \
	  echo "uv pip install $(2)"; \
	  VIRTUAL_ENV=$(1) $(1)/bin/uv pip install --quiet $(2); \
	else \
	  echo "pip install $(2)"; \
	  $(1)/bin/python -m pip install --quiet --disable-pip-version-check $(2); \
	fi
endef

setup: $(STAMP) build

# firmware and event loop: make in their folders knows what is out of date
build: $(STAMP)
	@$(MAKE) --no-print-directory -C firmware ZIG="$(abspath $(BIN))/python -m ziglang"
	@$(MAKE) --no-print-directory -C twin/core CC="$(abspath $(BIN))/python -m ziglang cc" \
	  PYTHON=$(abspath $(BIN))/python

$(STAMP): $(INPUTS)
	$(call install,$(VENV),-r environment.txt -e .)
	@touch $@

run: setup
	$(BIN)/python -m raytransfer --output build
	$(BIN)/linetrack capture --link twin -i 30000 -s 100 -n 2 -o build/output
	$(BIN)/linetrack plot build/output00001.dat build/output00002.dat --save build/output.png
	$(BIN)/linetrack live --link replay build/output --frames 2
	@echo "the chart as a picture: build/output.png"
	$(BIN)/python -m twin.experiments --output build

# matrices are small: BLAS's threads cost more than they bring; sums rounded as in the notebooks
test: export OPENBLAS_NUM_THREADS = 1
test: export OPENBLAS_CORETYPE = Haswell
test: setup lint
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

lint: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

lab: setup
	$(BIN)/jupyter lab --notebook-dir notebooks

notebooks: setup
	$(BIN)/python notebooks/execute.py

$(BENCH_STAMP): $(INPUTS) benchmarks/peers.txt
	$(call install,$(BENCH),-r environment.txt -r benchmarks/peers.txt -e .)
	@touch $@

bench: $(BENCH_STAMP) build
	$(BENCH)/bin/python -m benchmarks

agreement: $(BENCH_STAMP)
	$(BENCH)/bin/python -W ignore -m benchmarks.agreement

# link faults, then tracking: 10 virtual minutes through the firmware, 24 h of simulated spikes
# (which go on where they were interrupted)
soak: setup
	$(BIN)/python -m tests.twin.soak
	$(BIN)/python -m tests.twin.endurance --minutes 10
	$(BIN)/python -m tests.tracking.endurance --hours 24 --state build/soak

flash: setup
	@$(MAKE) --no-print-directory -C firmware flash

# needs kicad-cli 9: apt install -t bookworm-backports kicad
pcb: setup
	$(BIN)/python -m pytest tests/hardware/pcb.py

# --universal: one file for x86_64 and aarch64, Python 3.11 to 3.13
lock: setup
	grep -v '^-c' environment.txt | $(BIN)/uv pip compile --universal --python-version 3.11 --upgrade \
	  --no-header --no-annotate --no-emit-index-url --quiet - -o constraints.txt

clean:
	rm -rf $(VENV) $(BENCH) build firmware/build* twin/core/build .mypy_cache .pytest_cache .ruff_cache
