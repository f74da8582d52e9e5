# make demo    the core alone (no torch, no renderer) in .venv, then the poses of the bundled frames
# make test    everything in .venv-test, then lint, types and all tests
# make check   the same without the slow tests: under 3 minutes once .venv-test stands
# make docs    the documentation site in build/docs
# make lock    completes constraints.txt: keeps its pins and adds all that they need (to upgrade, edit a pin first)
# Python 3.11 to 3.13.  make PYTHON=python3.13 test   picks one;  make JOBS=8 test   runs as many tests at a time.

PYTHON ?= python3
JOBS ?= 2
SOURCES := $(shell find src -type f -not -name '*.pyc')
INSTALL = -m pip install --quiet --disable-pip-version-check
LOCKED = $(INSTALL) -c constraints.txt
# Tests run side by side, so each keeps to one thread. Tests of one file stay in one process and share what they made.
PYTEST = OMP_NUM_THREADS=1 .venv-test/bin/python -m pytest tests -n $(JOBS) --dist loadfile

.PHONY: demo test check lint docs lock clean

demo: .venv/installed
	.venv/bin/gknet demo

test: lint
	$(PYTEST) --durations=10

check: lint
	$(PYTEST) -m 'not slow'

lint: .venv-test/installed
	.venv-test/bin/ruff check .
	.venv-test/bin/ruff format --check .
	.venv-test/bin/mypy

# The site of docs/ into build/docs; a warning is an error.
docs: .venv-test/installed
	.venv-test/bin/sphinx-build -q -W --keep-going -b html docs build/docs
	@echo "build/docs/index.html"

lock: .venv-lock/made
	.venv-lock/bin/python $(LOCKED) '.[render,train,docs,dev]'
	{ echo "# Every package that the two make targets install, as tested. Made by 'make lock'."; \
	  .venv-lock/bin/python -m pip list --format=freeze --exclude gknet --exclude pip --exclude setuptools --exclude wheel | sed 's/+cpu$$//'; } > constraints.txt.new
	mv constraints.txt.new constraints.txt
	rm -rf .venv-lock

clean:
	rm -rf .venv .venv-test .venv-lock build dist demo-output .pytest_cache .ruff_cache .mypy_cache .hypothesis

# A copy is installed for the demo, so it follows every source file; the tests run on the sources themselves.
.venv/installed: .venv/made pyproject.toml constraints.txt README.md LICENSE $(SOURCES)
	.venv/bin/python $(LOCKED) .
	@touch $@

.venv-test/installed: .venv-test/made pyproject.toml constraints.txt
	.venv-test/bin/python $(LOCKED) --editable '.[render,train,docs,dev]'
	@touch $@

%/made:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || { \
		echo "gknet needs Python 3.11, 3.12 or 3.13; '$(PYTHON)' is $$($(PYTHON) --version 2>&1 || echo missing)." \
		     "Name another: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	rm -rf $*
	@$(PYTHON) -m venv $* || { rm -rf $*; \
		echo "'$(PYTHON) -m venv' failed; on Debian: apt-get install python3-venv" >&2; exit 1; }
	@touch $@
