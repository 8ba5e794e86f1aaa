# make train: set up and train.  make test: set up and test.  Both need Python >= 3.11 and nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt

# What is imported is compiled once and kept; to compile all of jax takes seconds, at every start.
unexport PYTHONDONTWRITEBYTECODE

# One worker for each core; in the order that tests/conftest.py gives the files.
WORKERS := -n auto --dist loadfile --no-loadscope-reorder

.PHONY: train evaluate test test-fast test-pythons lint docs benchmark figures notebooks

train: $(VENV)/.core
	$(BIN)/koz train $(ARGS)

evaluate: $(VENV)/.core
	$(BIN)/koz evaluate $(ARGS)

test: $(VENV)/.dev
	$(BIN)/python -m pytest $(WORKERS) $(ARGS)

test-fast: $(VENV)/.dev
	$(BIN)/python -m pytest $(WORKERS) -m "not slow and not gpu" $(ARGS)

# A short selection on every Python that is found, and once with the lowest versions of pyproject.toml.
test-pythons:
	$(PYTHON) tools/test_pythons.py $(ARGS)

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

# Into build/site; a warning is an error.
docs: $(VENV)/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict $(ARGS)

benchmark: $(VENV)/.core
	$(BIN)/python benchmarks/speed.py $(ARGS)

# The pictures in README.md and on the site.
figures: $(VENV)/.dev
	$(BIN)/koz fly --agent phase1 --out docs/figures/phase1
	$(BIN)/koz fly --agent phase2 --out docs/figures/phase2 --gif

notebooks: $(VENV)/.dev
	$(BIN)/python notebooks/build.py $(ARGS)

define install
	$(PYTHON) -c 'import sys; sys.exit("koz_jax needs Python 3.11 or later: set PYTHON" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(PIP) --editable "$(1)"
	touch $(VENV)/.core
endef

$(VENV)/.core: pyproject.toml constraints.txt
	$(call install,.)

$(VENV)/.dev: pyproject.toml constraints.txt
	$(call install,.[dev])
	touch $@
