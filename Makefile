# make demo   train a small agent, and print safety rates with and without filters
# make test   the test suite
# make check  the quick part of it, for every edit
# make oracle the long comparisons with exact answers, which the suite holds in small
# make clusters   sweeps on a Dask and on a Ray cluster that are started for it
# make mutants   wrong versions of the code, each of which the tests must notice
# make golden    what commands and envs compute, held against stored rows: for changes of names and structure only
# make lint   style, formatting and types
# make wheel-test   a wheel, installed without extras in an environment of its own, and used there
# make docs   the documentation, in site/; nothing is fetched but the packages
# Each makes its own virtual environment in .venv first.

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
DOCS_READY := .venv/.docs-ready

.PHONY: demo test check oracle clusters mutants golden lint wheel-test docs clean

demo: $(READY)
	$(BIN)/safe-envs demo

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile

check: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow and not oracle and not cluster"

oracle: $(READY)
	$(BIN)/python -m pytest -n 2 -m oracle

clusters: $(READY)
	$(BIN)/python -m pytest -m cluster

mutants: $(READY)
	$(BIN)/python tests/mutants/run.py

golden: $(READY)
	$(BIN)/python tests/golden/run.py

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

wheel-test: $(READY)
	sh tests/wheel_smoke.sh $(BIN)/python

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
	rm -rf .venv site
