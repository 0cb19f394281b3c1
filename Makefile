# Every target sets up .venv itself: a machine with Python >= 3.11 and make is enough.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	command -v $$p >/dev/null && $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
PYTEST := $(BIN)/python -m pytest

.PHONY: demo test test-quick test-rare test-all test-explore test-install check bench sweep stress scenes failures harm pictures docs clean
.DELETE_ON_ERROR:

demo: $(VENV)/installed-view
	$(BIN)/uwb-slam demo --out out/demo

# One process more than cores: many tests wait for a pty.
ON_ALL_CORES := -n $$($(BIN)/python -c 'import os; print((os.cpu_count() or 1) + 1)')

# The tests of a file stay in one process, so that what they share is made once. The order is kept, which
# has files with long tests first and short ones last.
test: $(VENV)/installed-test
	$(PYTEST) $(ON_ALL_CORES) --dist loadfile --no-loadscope-reorder

# What the default suite shows of one case only, because it takes long and seldom breaks, and all
# examples of each property, of which the default suite has a third: after a change of documents, of
# sweeps, benchmarks or the plugin, and before a push.
test-rare: $(VENV)/installed-test
	HYPOTHESIS_PROFILE=rare $(PYTEST) $(ON_ALL_CORES) --dist worksteal -m '(rare or hypothesis) and not thorough'

# About a minute: the bytes of the protocol, the driver and the mathematics of SLAM.
test-quick: $(VENV)/installed-test
	$(PYTEST) -n auto --dist worksteal hil_tests/golden hil_tests/unit/xethru_protocol \
		hil_tests/unit/slam --ignore hil_tests/unit/slam/app

# And the cases and examples that would take the default suite over five minutes of two cores.
test-all: $(VENV)/installed-test
	HYPOTHESIS_PROFILE=thorough $(PYTEST) -n auto -m ''

# New random examples of every property, 2000 where its test has no number of its own. By hand, never
# in CI. `make test-explore SEED=7` repeats those of a seed, `TESTS=hil_tests/property/slam` limits them.
test-explore: SEED := $(shell od -An -N4 -tu4 /dev/urandom | tr -d ' ')
test-explore: TESTS := hil_tests/property hil_tests/unit
test-explore: $(VENV)/installed-test
	@echo 'seed $(SEED): make test-explore SEED=$(SEED) repeats these examples'
	HYPOTHESIS_PROFILE=explore $(PYTEST) -n auto --timeout 3600 -m hypothesis --hypothesis-seed=$(SEED) $(TESTS)

check: $(VENV)/installed-dev
	$(BIN)/ruff format --no-cache --check .
	$(BIN)/ruff check --no-cache .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(MAKE) docs
	$(MAKE) test

# The wheel with each extra in an empty environment, for every Python from 3.11 to 3.13 on the path: about
# six minutes and 2 GB a Python. `make test-install INSTALL="--python 3.11 --extra hil slam"`.
test-install: $(VENV)/bin/python
	$(BIN)/python -m hil_tests.system.installation $(INSTALL)

# The documents as a site in out/site; a warning fails, but not with --quiet, which also hides it from
# --strict. The variable silences an advertisement.
docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: $(VENV)/installed-bench
	$(PYTEST) hil_tests/bench -p no:xdist --benchmark-columns=min,median,max,rounds

# 100 seeds of lab and classroom under both presets, with the known-association bound; stopped, it
# goes on where it was.
sweep: $(VENV)/installed-sweep
	$(BIN)/uwb-slam sweep --scene lab classroom --preset paper robust --seeds 100 --bound --json out/sweep.json
	$(BIN)/python docs/studies/sweep_result.py consistency out/sweep.json

SCENES := lab classroom lab_six lab_three symmetric smoke calibration two_rooms walls corridor store hall
FAMILIES := pillars office dense loop sparse people rig
DECEIVING := rack doors legs columns yard twins
MODEL_ERRORS := pulse_wide pulse wander_3 wander_10 rod_rod bursts slip mounts stamps offsets_20 mismatch
STRESSES := outliers dropped skew walk silent all dead carried $(MODEL_ERRORS)

# What each hardship costs preset robust, on two laps and five seeds: 200 runs. `make stress
# STRESSES="wander_10 slip"` runs some rows only. Stopped, it goes on where it was; the picture
# is in out/studies.
stress: $(VENV)/installed-slam
	$(BIN)/uwb-slam sweep --scene lab classroom --laps 2 --seeds 5 --json out/stress.json \
		--stress $(STRESSES)
	$(BIN)/python docs/studies/sweep_result.py stress out/stress.json

# Preset robust in every scene that has wheels and something to map, five seeds each, and in ten
# rooms of every random family: 130 runs, in two sweeps that go on likewise.
scenes: $(VENV)/installed-slam
	$(BIN)/uwb-slam sweep --seeds 5 --json out/scenes.json --scene $(SCENES)
	$(BIN)/python docs/studies/sweep_result.py scenes out/scenes.json
	$(BIN)/uwb-slam sweep --seeds 1 --json out/rooms.json --scene $(FAMILIES:=:0-9)
	$(BIN)/python docs/studies/sweep_result.py scenes out/rooms.json --out out/studies/rooms

# Every scene and three rooms of every family under every hardship, a run each: 660 runs, whose last
# line counts those that are worse than their wheels, lost, or carried and not found.
failures: $(VENV)/installed-slam
	$(BIN)/uwb-slam sweep --laps 2 --seeds 1 --json out/failures.json \
		--scene $(SCENES) $(FAMILIES:=:0-2) --stress $(STRESSES)

# Whether SLAM is worse than the wheels, or sure and wrong: three rooms of each usual family and ten
# of each that deceives, from number FIRST_SEED on, as they are, under two stresses and carried: 324
# runs. Rooms below 40 are for development. The last lines count.
FIRST_SEED := 0
upto = $(shell expr $(FIRST_SEED) + $(1))
harm: $(VENV)/installed-slam
	$(BIN)/uwb-slam sweep --seeds 1 --json out/harm-$(FIRST_SEED).json \
		--scene $(DECEIVING:=:$(FIRST_SEED)-$(call upto,9)) $(FAMILIES:=:$(FIRST_SEED)-$(call upto,2)) \
		--stress slip_large noise_stated_low carried

# The pictures of fixtures/pictures. Needs Mesa's lavapipe (Debian: mesa-vulkan-drivers) for the
# screenshot of Rerun and Chromium for that of the report. RECORDING names the real recording that
# docs/studies/recording.py compares with.
pictures: $(VENV)/installed-test
	$(BIN)/uwb-slam demo --out out/pictures/demo
	$(BIN)/uwb-slam demo --scene classroom --out out/pictures/classroom
	cp out/pictures/classroom/map.png fixtures/pictures/classroom_map.png
	$(BIN)/uwb-slam demo --scene office:20 --out out/pictures/office
	cp out/pictures/office/image.png fixtures/pictures/office_image.png
	$(BIN)/uwb-slam view out/pictures/demo --screenshot fixtures/pictures/lab_rerun.png --at 330
	$(BIN)/uwb-slam report out/pictures/demo
	$(BIN)/python -m hil_tests.browser out/pictures/demo/report.html fixtures/pictures/lab_report.png
	$(BIN)/python docs/studies/figure7.py --out out/pictures
	$(BIN)/python docs/studies/smoke.py --out out/pictures
	$(BIN)/python docs/studies/outlier_filter.py --out out/pictures
	$(BIN)/python docs/studies/limits.py --out out/pictures
	$(if $(RECORDING),$(BIN)/python docs/studies/recording.py --recording '$(RECORDING)' --out out/pictures)
	cp out/pictures/*.png fixtures/pictures
	$(BIN)/python -m hil_tests.golden.update_manifest

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "no Python >= 3.11 found; set PYTHON=/path/to/python3" >&2; exit 1; }
	"$(PYTHON)" -m venv $(VENV)

$(VENV)/installed-view: EXTRA = [view]
$(VENV)/installed-slam: EXTRA = [slam]
$(VENV)/installed-test: EXTRA = [test]
$(VENV)/installed-bench: EXTRA = [bench]
$(VENV)/installed-dev: EXTRA = [dev]
$(VENV)/installed-docs: EXTRA = [docs]
$(VENV)/installed-sweep: EXTRA = [gtsam]
$(VENV)/installed-%: pyproject.toml $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.$(EXTRA)'
	@touch $@

clean:
	rm -rf $(VENV) out .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
