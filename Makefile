# make demo          set everything up and run the main job; BAG=path takes your own bag, results are in out/
# make check         lint, types and the fast tests
# make test          lint, types and the tests but for the costly ones
# make test-thorough the costly tests, which make test leaves out
# make test-minimum  the fast tests with the oldest dependencies that setup.py allows
# make api           the API reference, built from the docstrings, in out/api/
# make clean         remove the environments and the results

PYTHON ?= python3
VENV ?= .venv
BAG ?=
OUT ?= out
# constraints.txt takes the versions that the tests last passed with; empty takes the newest.
CONSTRAINTS ?=
FAST = not slow and not dds and not gpu and not thorough

# PyTorch with CUDA where there is an NVIDIA GPU, the ten times smaller CPU build where there is none.
TORCH ?= torch==2.13.0
TORCH_INDEX ?= $(shell command -v nvidia-smi >/dev/null 2>&1 || echo --extra-index-url https://download.pytorch.org/whl/cpu)
PIP_INSTALL = python -m pip install --quiet $(if $(CONSTRAINTS),-c $(CONSTRAINTS))
# Where the surroundings forbid to write bytecode, each of some hundred processes of the tests would compile the package anew.
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo lint types fast check most-tests test test-thorough test-minimum api setup links clean

demo: setup
	$(VENV)/bin/endo-sim demo --out $(OUT) $(if $(BAG),--bag $(BAG))

lint: setup
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check

# With room for young objects the type checker spends a tenth less on looking for those that nobody uses any more.
types: setup
	NODE_OPTIONS=--max-semi-space-size=128 $(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

fast: setup
	$(VENV)/bin/python -m pytest -n 2 --dist worksteal -q -m "$(FAST)"

check: lint
	@$(MAKE) --no-print-directory -j2 --output-sync types fast

# The type checker has one thread: it works beside the tests.
test: lint
	@$(MAKE) --no-print-directory -j2 types most-tests

# Three workers on two cores: while a test waits for the processes of a graph, another one works.
most-tests: setup
	$(VENV)/bin/python -m pytest -n 3 --dist worksteal -m "not thorough"

test-thorough: setup
	$(VENV)/bin/python -m pytest -n 3 --dist worksteal -m thorough

test-minimum:
	$(MAKE) setup VENV=.venv-minimum CONSTRAINTS=constraints-minimum.txt
	.venv-minimum/bin/python -m pytest -n 2 --dist worksteal -q -m "$(FAST)"

api: setup
	$(VENV)/bin/pdoc --no-show-source --docformat google --output-directory $(OUT)/api endo_sim_ros '!endo_sim_ros.learning.ppo'  # which needs stable-baselines3

setup: links

$(VENV)/.installed: setup.py setup.cfg package.xml $(CONSTRAINTS)
	@echo "setting up $(VENV), about a minute ..."
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --upgrade pip
	$(VENV)/bin/$(PIP_INSTALL) --retries 0 $(TORCH_INDEX) '$(TORCH)'
	$(VENV)/bin/$(PIP_INSTALL) -e '.[test]'
	touch $@

# pip leaves out the data files of an editable package: `ros2 run` and `ros2 launch` find the package by them, and by AMENT_PREFIX_PATH.
SHARE = $(VENV)/share/endo_sim_ros
links: $(VENV)/.installed
	@mkdir -p $(VENV)/lib/endo_sim_ros $(SHARE)/launch $(SHARE)/config/sros2 $(VENV)/share/ament_index/resource_index/packages
	@ln -sf $(CURDIR)/scripts/*_node $(VENV)/lib/endo_sim_ros
	@ln -sf $(CURDIR)/resource/endo_sim_ros $(VENV)/share/ament_index/resource_index/packages
	@ln -sf $(CURDIR)/package.xml $(CURDIR)/msg_conventions.md $(SHARE)
	@ln -sf $(CURDIR)/launch/*.py $(SHARE)/launch
	@ln -sf $(CURDIR)/config/*.* $(SHARE)/config
	@ln -sf $(CURDIR)/config/sros2/*.xml $(SHARE)/config/sros2

clean:
	rm -rf .venv .venv-minimum $(OUT)
