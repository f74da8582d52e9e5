# make demo   the core alone (no torch, no renderer) in .venv, then poses of the bundled frames
# make test   everything in .venv-test, then lint, types and tests
# Both need Python >= 3.11 and install the releases of constraints.txt.  PYTHON=python3.12 make test picks another one.

PYTHON ?= python3
SOURCES := $(shell find src -type f -not -name '*.pyc')
INSTALL = -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: demo test lint docs clean

demo: .venv/installed
	.venv/bin/gknet demo

test: lint
	.venv-test/bin/python -m pytest tests --durations=10

lint: .venv-test/installed
	.venv-test/bin/ruff check .
	.venv-test/bin/ruff format --check .
	.venv-test/bin/mypy

# The site of docs/ into build/docs; a warning is an error.
docs: .venv-test/installed
	.venv-test/bin/sphinx-build -q -W --keep-going -b html docs build/docs
	@echo "build/docs/index.html"

clean:
	rm -rf .venv .venv-test build dist demo-output .pytest_cache .ruff_cache .mypy_cache .hypothesis

# A copy is installed for the demo, so it follows every source file; the tests run on the sources themselves.
.venv/installed: .venv/made pyproject.toml constraints.txt README.md LICENSE $(SOURCES)
	.venv/bin/python $(INSTALL) .
	@touch $@

.venv-test/installed: .venv-test/made pyproject.toml constraints.txt
	.venv-test/bin/python $(INSTALL) --editable '.[render,train,docs,dev]'
	@touch $@

%/made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "gknet needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>&1 || echo missing)." \
		     "Name another: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	rm -rf $*
	@$(PYTHON) -m venv $* || { rm -rf $*; \
		echo "'$(PYTHON) -m venv' failed; on Debian: apt-get install python3-venv" >&2; exit 1; }
	@touch $@
