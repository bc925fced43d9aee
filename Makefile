# `make demo` and `make test` need Python (3.10 or newer) and make, and nothing before them.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
GAME ?= Pong
CONFIG ?= eqr_qrdqn
ARGS ?=
STEPS ?=

.PHONY: demo quick test pytest slow format lint type commit-checks doc clean

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $@

demo: $(VENV)/installed
	OMP_WAIT_POLICY="$${OMP_WAIT_POLICY:-PASSIVE}" $(BIN)/python examples/demo.py --game "$(GAME)" --config "$(CONFIG)" $(ARGS) $(if $(STEPS),--steps $(STEPS))

test: lint type pytest

# The inner loop: groups, losses, layers, latent model, sum tree, buffers.
quick: $(VENV)/installed
	$(BIN)/python -m pytest tests/unit

pytest: $(VENV)/installed
	$(BIN)/python -m pytest -n 2

slow: $(VENV)/installed
	$(BIN)/python -m pytest -m slow

format: $(VENV)/installed
	$(BIN)/ruff check --select I --fix .
	$(BIN)/ruff format .

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

type: $(VENV)/installed
	$(BIN)/mypy

commit-checks: format lint type

doc: $(VENV)/installed
	$(BIN)/python -m sphinx -b html -W --keep-going docs docs/_build/html

clean:
	rm -rf $(VENV) build dist docs/_build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
