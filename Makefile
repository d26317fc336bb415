# Every command first sets up .venv, and installs again only when pyproject.toml, constraints.txt or EXTRAS change.
PYTHON ?= python3
EXTRAS ?=
ARGS ?=
WORKERS ?= 2

VENV := .venv
RUN := $(VENV)/bin/python
comma := ,
empty :=
space := $(empty) $(empty)
words := $(subst $(comma),$(space),$(EXTRAS))
# A file per set of extras says that it is installed: installed-plain, installed-dev, installed-cad-dev, installed-all.
# `all` holds the tools for development already.
stamp = $(VENV)/installed-$(subst $(space),-,$(or $(strip $(if $(filter all,$(1)),$(sort $(filter all cuda bench,$(1))),$(sort $(1)))),plain))
PLAIN := $(call stamp,$(words))
DEV := $(call stamp,$(words) dev)
BENCH := $(call stamp,$(words) dev bench)

.PHONY: help setup demo test test-slow lint bench
.DEFAULT_GOAL := help

help:  ## this text
	@echo "make TARGET [EXTRAS=cad,view|all] [ARGS='...'] [PYTHON=python3.12]"
	@awk -F ':.*## *' '/^[a-z-]+:.*##/ { printf "  %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "EXTRAS: cad (STEP), view (browser), formats (PCD, LAS, E57), baselines (CGAL), cuda, dev, bench; all = all but cuda, bench"

setup: $(PLAIN)  ## install jprimfit into .venv
	@echo "Ready: $(VENV)/bin/jprimfit --help"

demo: $(PLAIN)  ## fit the bundled scan, print its primitives, write out/demo/
	@$(RUN) -m jprimfit demo $(ARGS)

test: $(DEV)  ## run the test suite, WORKERS=2 files at a time; ARGS='--cov=jprimfit' adds the coverage
	@$(RUN) -m pytest -n $(WORKERS) --dist loadfile $(ARGS)

test-slow: $(DEV)  ## run the tests that take minutes
	@$(RUN) -m pytest -m "slow and not gpu" $(ARGS) || { code=$$?; \
		if [ $$code -eq 5 ]; then echo "There are no slow tests."; else exit $$code; fi; }

lint: $(DEV)  ## check style and types
	@$(RUN) -m ruff check .
	@$(RUN) -m ruff format --check .
	@$(RUN) -m pyright

bench: $(BENCH)  ## print timings, beside other libraries' (needs a C++ compiler)
	@JAXTYPING_DISABLE=1 $(RUN) -m pytest -m benchmark -s -q -o python_files="bm_*.py test_*.py" $(ARGS)

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "jprimfit needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1 | head -n 1)." >&2; \
		echo "Name another one: make $(MAKECMDGOALS) PYTHON=/path/to/python3.12" >&2; exit 1; }
	@echo "Creating $(VENV) with $$($(PYTHON) --version) ..."
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

$(VENV)/installed-%: pyproject.toml constraints.txt | $(VENV)/bin/python
	@echo "Installing jprimfit and what it needs: $* $(if $(filter plain,$*),(200 MB to download and 0.9 GB on disk) )..."
	@$(RUN) -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt \
		--editable ".$(if $(filter plain,$*),,[$(subst -,$(comma),$*)])"
# Compiled here, on all cores and without the libraries' own tests, rather than by pip on one.
	@$(RUN) -m compileall -qq -j 0 -x '/tests?/' $(VENV)/lib || true
	@touch $(VENV)/installed-plain $(if $(findstring all,$*),$(VENV)/installed-dev) $@
	@echo "Installed."
