# `make demo` and `make test` need only Python (3.11 or newer) and make; they create the virtual environment.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
GAME ?=
CONFIG ?= eqr_qrdqn
ARGS ?=
STEPS ?=
DEMO = OMP_WAIT_POLICY="$${OMP_WAIT_POLICY:-PASSIVE}" SDL_VIDEODRIVER=dummy $(BIN)/python

.PHONY: demo tutorials quick test pytest slow format lint type commit-checks doc dist clean

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $@

# The pictures of the README, in less than five minutes on two idle cores; `make demo GAME=Boxing` is a game of Atari.
demo: $(VENV)/installed
ifeq ($(GAME),)
	$(DEMO) examples/sliding_ball.py --out demo_results/ball
	$(DEMO) examples/half_cheetah.py
else
	$(DEMO) examples/demo.py --game "$(GAME)" --config "$(CONFIG)" $(ARGS) $(if $(STEPS),--steps $(STEPS))
endif

test: lint type pytest

# One thread per process: pytest runs two at once.
quick pytest slow: export OMP_NUM_THREADS = 1

# Fast unit tests: groups, losses, layers, latent model, sum tree, buffers.
quick: $(VENV)/installed
	$(BIN)/python -m pytest tests/unit

pytest: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 --dist worksteal

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

# The notebooks, with new outputs: some minutes.
tutorials: $(VENV)/installed
	$(BIN)/jupyter execute --inplace docs/tutorials/*.ipynb

# For a release: build a wheel and a source archive, and check that the wheel works in an empty environment.
dist: $(VENV)/installed
	rm -rf dist
	$(BIN)/python -m pip install --quiet --disable-pip-version-check build twine
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*
	$(PYTHON) -m venv dist/venv
	dist/venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt dist/*.whl
	cd dist && venv/bin/python -c "from sb3_eqr import EqRQRDQN; EqRQRDQN('MlpPolicy', 'CartPole-v1', learning_starts=50).learn(100)"
	@echo "Then check that CHANGELOG.md has the version, make slow passes, and docs/results are of this version, and tag it."

clean:
	rm -rf $(VENV) build dist docs/_build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
