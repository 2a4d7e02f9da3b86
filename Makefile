# make run             explore the Ant maze        make run ARGS="--seed=1 --preset=smoke"
# make test            run the tests               make test ARGS="-k checkpoint"
# make check           lint, format and types
# make lock            pin the dependencies again  make lock ARGS=--upgrade
#
# All but `lock` first create .venv from requirements.lock if it is not there yet. PYTHON names the interpreter to do it
# with: make run PYTHON=python3.12

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

# A named interpreter is used or refused; otherwise the first that fits is taken.
ifeq ($(origin PYTHON),undefined)
PYTHONS := python3 python3.13 python3.12 python3.11
else
PYTHONS := $(PYTHON)
endif

.PHONY: help run test check lock
.DELETE_ON_ERROR:

help:
	@sed -n '/^#/!q; s/^# \{0,1\}//p' Makefile

run: $(INSTALLED)
	@$(BIN)/python -m experiments.run --env=ant_maze $(ARGS)

test: $(INSTALLED)
	@$(BIN)/python -m pytest $(ARGS)

# Use the node that comes with pyright from PyPI, and do not ask PyPI for a newer pyright.
check: $(INSTALLED)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@PYRIGHT_PYTHON_IGNORE_WARNINGS=1 PYRIGHT_PYTHON_GLOBAL_NODE=off $(BIN)/pyright

# Every platform, every Python from 3.11 on and the extras that tests need, in one file; playground, peers and wandb are
# large, and not among them. The versions already there are kept where they can be.
lock:
	@test -x $(BIN)/uv || $(MAKE) $(INSTALLED)
	@$(BIN)/uv pip compile pyproject.toml --extra experiments --extra render --extra robotics \
	  --group dev --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --no-annotate --quiet --output-file requirements.lock $(ARGS)

$(INSTALLED): requirements.lock pyproject.toml
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(MAKE) --no-print-directory venv
	@echo "installing the packages of requirements.lock into $(VENV): a few minutes the first time"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

.PHONY: venv
venv:
	@for python in $(PYTHONS); do \
	  if $$python -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then \
	    rm -rf $(VENV); \
	    $$python -m venv $(VENV) && exit 0; \
	    rm -rf $(VENV); \
	    echo "$$python cannot create $(VENV); on Debian and Ubuntu: apt install python3-venv" >&2; \
	    exit 1; \
	  fi; \
	done; \
	echo "jaxplore needs Python 3.11, 3.12 or 3.13 and found none of them as: $(PYTHONS)" >&2; \
	for python in $(PYTHONS); do $$python --version >/dev/null 2>&1 && echo "  $$python is $$($$python --version 2>&1)" >&2; done; \
	echo "Install one and name it: make run PYTHON=/path/to/python3.12" >&2; \
	exit 1
