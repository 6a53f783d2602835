# make demo    set everything up and run the main job; BAG=path takes your own bag, results are in out/
# make test    set everything up and run the tests
# make clean   remove the environment and the results

PYTHON ?= python3
VENV ?= .venv
BAG ?=
OUT ?= out

# PyTorch with CUDA where there is an NVIDIA GPU, the ten times smaller CPU build where there is none.
TORCH ?= torch==2.13.0
TORCH_INDEX ?= $(shell command -v nvidia-smi >/dev/null 2>&1 || echo --extra-index-url https://download.pytorch.org/whl/cpu)

.PHONY: demo test setup clean

demo: setup
	$(VENV)/bin/endo-sim demo --out $(OUT) $(if $(BAG),--bag $(BAG))

test: setup
	$(VENV)/bin/ruff check
	$(VENV)/bin/python -m pytest -n 2 --dist worksteal test

setup: $(VENV)/.installed

$(VENV)/.installed: setup.py setup.cfg package.xml
	@echo "setting up $(VENV), about a minute ..."
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --upgrade pip
	$(VENV)/bin/python -m pip install --quiet --retries 0 $(TORCH_INDEX) '$(TORCH)'
	$(VENV)/bin/python -m pip install --quiet -e '.[test]'
	touch $@

clean:
	rm -rf $(VENV) $(OUT)
