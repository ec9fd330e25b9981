# make demo        train a small agent, then print safety rates with and without filters
# make test        run the test suite
# make check       run its quick part, after every edit
# make oracle      run the long comparisons, with exact solutions and with stored results
# make clusters    run sweeps on a local Dask cluster
# make mutants     check that the tests fail on faulty versions of the code
# make golden      compare the output of commands and envs with stored results, when refactoring
# make lint        check style, formatting, types and the layers of imports
# make wheel-test  build the wheel, install it without extras, and use it outside the checkout
# make thesis      list the artefacts of the thesis; ARGS="all --out report" computes them
# make benchmark   measure the speed of filters, envs and commands
# make docs        build the documentation in site/
# Every target first creates the virtual environment .venv.

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
DOCS_READY := .venv/.docs-ready

.PHONY: demo test check oracle clusters mutants golden lint wheel-test thesis benchmark docs clean

demo: $(READY)
	$(BIN)/safe-envs demo

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile

check: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow"

oracle: $(READY)
	$(BIN)/python -m pytest -n 2 -m oracle

clusters: $(READY)
	$(BIN)/python -m pytest -m cluster

mutants: $(READY)
	$(BIN)/python tests/mutants/run.py

golden: $(READY)
	$(BIN)/python -m pytest -n 2 -m oracle tests/golden $(ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

wheel-test: $(READY)
	sh tests/wheel_smoke.sh $(BIN)/python

thesis: $(READY)
	$(BIN)/python -m thesis $(ARGS)

benchmark: $(READY)
	$(BIN)/python -m benchmarks $(ARGS)

docs: $(DOCS_READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,render]'
	touch $@

$(DOCS_READY): $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,render,docs]'
	touch $@

clean:
	rm -rf .venv site .docs_cache
