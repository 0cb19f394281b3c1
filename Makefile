# Every target sets up .venv itself: a machine with Python >= 3.11 and make is enough.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	command -v $$p >/dev/null && $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
PYTEST := $(BIN)/python -m pytest

.PHONY: demo test check bench sweep clean
.DELETE_ON_ERROR:

demo: $(VENV)/installed-demo
	$(BIN)/uwb-slam demo --out out/demo

test: $(VENV)/installed-test
	$(PYTEST) -n auto

check: $(VENV)/installed-dev
	$(BIN)/ruff format --no-cache --check .
	$(BIN)/ruff check --no-cache .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(MAKE) test

bench: $(VENV)/installed-bench
	$(PYTEST) hil_tests/bench -p no:xdist --benchmark-columns=min,median,max,rounds

# 100 seeds of lab and classroom under both presets, with the known-association bound; stopped, it
# goes on where it was.
sweep: $(VENV)/installed-sweep
	$(BIN)/uwb-slam sweep --scene lab classroom --preset paper robust --seeds 100 --bound --json out/sweep.json
	$(BIN)/uwb-slam experiment consistency --sweep out/sweep.json --out out

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "no Python >= 3.11 found; set PYTHON=/path/to/python3" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed-demo: EXTRA =
$(VENV)/installed-test: EXTRA = [test]
$(VENV)/installed-bench: EXTRA = [bench]
$(VENV)/installed-dev: EXTRA = [dev]
$(VENV)/installed-sweep: EXTRA = [gtsam]
$(VENV)/installed-%: pyproject.toml $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.$(EXTRA)'
	@touch $@

clean:
	rm -rf $(VENV) out .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
