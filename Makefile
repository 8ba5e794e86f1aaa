# make train: set up and train.  make test: set up and test.  Both need Python >= 3.11 and nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --constraint constraints.txt

.PHONY: train evaluate test lint benchmark figures notebooks

train: $(VENV)/.core
	$(BIN)/python train.py $(ARGS)

evaluate: $(VENV)/.core
	$(BIN)/python eval_mc.py $(ARGS)

test: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --dist loadfile $(ARGS)

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

benchmark: $(VENV)/.core
	$(BIN)/python benchmarks/speed.py $(ARGS)

# The pictures in README.md.
figures: $(VENV)/.dev
	$(BIN)/python fly.py --agent phase1 --out docs/figures/phase1
	$(BIN)/python fly.py --agent phase2 --out docs/figures/phase2 --gif

notebooks: $(VENV)/.dev
	$(BIN)/python notebooks/build.py $(ARGS)

$(VENV)/.core: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("koz_jax needs Python 3.11 or later: set PYTHON" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	touch $@

$(VENV)/.dev: $(VENV)/.core
	$(PIP) --editable ".[dev]"
	touch $@
