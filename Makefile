# make demo   install into .venv, train SAUNA on InvertedPendulum-v5, show the result
# make test   install into .venv, run the tests
# make test-slow  the tests that take minutes; installs what they need besides (Ray, Brax, Playground)
# make campaign  every fault of docs/concepts/reliability.md in full (hours; continues where it stopped)
# make mutants   plants mistakes in core/ and selection/ and counts those that the tests catch
# make soak      two hours of a long run: do memory and open files stay flat?
# make cost   what checks and checkpoints take of a training
# make docs   build the documentation site into site/; a broken link is an error
# make lint   style, format and types
# make results  train what results/ holds (hours; continues where it stopped), remake tables and figures

PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
BIN := .venv/bin

.PHONY: setup demo test test-slow campaign mutants soak cost docs lint results clean

.venv/bin/python:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed (set PYTHON=...)"; exit 1; }
	$(PYTHON) -m venv .venv

.venv/.run: .venv/bin/python pyproject.toml
	$(BIN)/pip install --quiet -e .
	@touch $@

.venv/.dev: .venv/bin/python pyproject.toml
	$(BIN)/pip install --quiet -e '.[dev]'
	@touch $@ .venv/.run

.venv/.slow: .venv/bin/python pyproject.toml
	$(BIN)/pip install --quiet -e '.[dev,docs,cluster,brax,playground]'
	@touch $@ .venv/.dev .venv/.docs .venv/.run

.venv/.docs: .venv/bin/python pyproject.toml
	$(BIN)/pip install --quiet -e '.[docs]'
	@touch $@ .venv/.run

setup: .venv/.dev

demo: .venv/.run
	$(BIN)/sauna train InvertedPendulum-v5 --arm sauna --seeds 3 --steps 100000

# Half of the time of a first run is compiling: here without LLVM's optimisations.
test: .venv/.dev
	JAX_DISABLE_MOST_OPTIMIZATIONS=1 $(BIN)/python -m pytest -n 2 --dist worksteal --durations 15

test-slow: .venv/.slow
	$(BIN)/python -m pytest -m slow

campaign: .venv/.dev
	$(BIN)/python tests/faults/campaign.py

mutants: .venv/.dev
	$(BIN)/python tests/faults/mutants.py

soak: .venv/.dev
	$(BIN)/python tests/faults/soak.py

cost: .venv/.dev
	$(BIN)/python tests/faults/cost.py

docs: .venv/.docs
	$(BIN)/mkdocs build --strict

lint: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

results: .venv/.dev
	$(BIN)/python results/make.py --train

clean:
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache
