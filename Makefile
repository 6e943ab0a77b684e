# make setup  install into .venv what development needs
# make demo   install into .venv, train PPO and SAUNA side by side, say where the picture is
# make test   install into .venv, run the tests
# make test-faults  a few tries of every fault of docs/concepts/reliability.md
# make test-newest  both with the newest versions of all packages, in .venv-newest
# make test-slow  the tests that take minutes; installs what they need besides (Ray, Brax, ONNX ...)
# make campaign  every fault of docs/concepts/reliability.md in full (hours; continues where it stopped)
# make mutants   plants mistakes in algorithm/ and counts those that the tests catch
# make soak      two hours of a long run: do memory and open files stay flat?
# make cost   what checks and checkpoints take of a training
# make docs   build the documentation site into site/; a broken link is an error
# make lint   style, format and types
# make constraints  resolve all packages anew and write constraints.txt, which all of the above install from
# make results  train what results/ holds (hours; continues where it stopped), remake tables and figures

PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
VERSIONS := -c constraints.txt
BIN := $(VENV)/bin
# pip compiles one file after the other; here all cores do, and leave out the packages' own tests.
INSTALL = $(BIN)/pip --disable-pip-version-check install --no-compile $(VERSIONS) -e
COMPILE = $(BIN)/python -m compileall -qq -j 0 -x '/tests/' $(VENV)/lib || true
USE = @echo "To use sauna in this shell: source $(VENV)/bin/activate"

.PHONY: setup setup-ci demo test test-faults test-newest test-slow campaign mutants soak cost docs lint constraints results clean

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed (set PYTHON=...)"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) .
	@$(COMPILE)
	@touch $@

$(VENV)/.dev: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) '.[dev]'
	@$(COMPILE)
	@touch $@ $(VENV)/.run

$(VENV)/.ci: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) '.[dev,cluster]'
	@$(COMPILE)
	@touch $@ $(VENV)/.dev $(VENV)/.run

$(VENV)/.slow: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) '.[dev,docs,cluster,brax,playground,onnx,minari,parquet,hub,pettingzoo,tune,envpool,wandb,trackio,mlflow]'
	@$(COMPILE)
	@touch $@ $(VENV)/.ci $(VENV)/.dev $(VENV)/.docs $(VENV)/.run

$(VENV)/.docs: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) '.[docs]'
	@$(COMPILE)
	@touch $@ $(VENV)/.run

setup: $(VENV)/.dev
	$(USE)

setup-ci: $(VENV)/.ci

demo: $(VENV)/.run
	$(BIN)/sauna train InvertedPendulum-v5 --arm ppo,sauna --threshold 0.8 --seeds 3 --steps 100000
	@echo "Look at the picture named above: PPO beside SAUNA, 3 seeds each."
	$(USE)
	@echo "Then try: sauna train CartPole-v1 --steps 100000, or: sauna compare InvertedPendulum-v5"

# Half of the time of a first run is compiling: here without LLVM's optimisations, without XLA's
# newer emitters of loops, which take twice as long, and with each program as one module of LLVM
# rather than 32, which takes a third less. Processes find our own modules compiled.
XLA := --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1
PYTEST = PYTHONDONTWRITEBYTECODE= XLA_FLAGS="$(XLA)" JAX_DISABLE_MOST_OPTIMIZATIONS=1 \
	$(BIN)/python -m pytest -n 2 --dist worksteal --durations 15

test: $(VENV)/.dev
	$(PYTEST) -m 'not slow and not campaign'

test-faults: $(VENV)/.dev
	$(PYTEST) -m 'not slow and campaign'

test-newest:
	rm -rf .venv-newest
	$(MAKE) setup-ci test test-faults VENV=.venv-newest VERSIONS= XLA=

test-slow: $(VENV)/.slow
	$(BIN)/python -m pytest -m slow

campaign: $(VENV)/.dev
	$(BIN)/python tests/faults/campaign.py

mutants: $(VENV)/.dev
	$(BIN)/python tests/faults/mutants.py

soak: $(VENV)/.dev
	$(BIN)/python tests/faults/soak.py

cost: $(VENV)/.dev
	$(BIN)/python tests/faults/cost.py

docs: $(VENV)/.docs
	$(BIN)/mkdocs build --strict

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# One file for every Python and system: uv writes both versions where they differ, with markers.
constraints:
	$(PYTHON) -m venv .venv-uv
	.venv-uv/bin/pip --disable-pip-version-check install --upgrade uv
	echo '# Made by `make constraints`: exact versions of what the package and its extras need.' > .venv-uv/new
	.venv-uv/bin/uv pip compile pyproject.toml --all-extras --universal --python-version 3.11 \
		--no-annotate --no-header --quiet >> .venv-uv/new
	mv .venv-uv/new constraints.txt

results: $(VENV)/.dev
	$(BIN)/python results/make.py --train

clean:
	rm -rf .venv .venv-newest .venv-uv .pytest_cache .mypy_cache .ruff_cache
