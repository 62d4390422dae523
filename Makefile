# Everything starts here, from a clean clone: 'make demo' and 'make test' set up what they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DRIVES ?= builtin
OUT ?= build/demo
TRIPS ?= ../shared/data/bmw_i3_summer
SEED ?= 2900
PYTHONS ?=
PIP_QUIET := --quiet --disable-pip-version-check --no-deps
# processes share the cores: threads of BLAS in each would only wait for those of the others
export OMP_NUM_THREADS = 1
unexport PYTHONDONTWRITEBYTECODE # where it is set, each of some thousand processes compiles anew what it imports

.DEFAULT_GOAL := help
.PHONY: help setup demo test suite vcan-fleet bus-gateway bus-node check-long coverage bench bench-quick experiments soak fuzz release-check mutants lint types docs \
	notebook dist package sbom licences schema constraints clean

help:                    ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*##/\t/' | expand -t 14

setup: $(VENV)/.compiled ## the virtual environment, pinned by constraints.txt

$(VENV)/.installed: constraints.txt pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed; make PYTHON=python3.12 ..." if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	awk '/^[a-z]/ { wanted = /^uv==/ } wanted' constraints.txt > $(VENV)/uv.txt # uv is four times as fast as pip
	$(BIN)/pip install $(PIP_QUIET) --require-hashes -r $(VENV)/uv.txt
	VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --quiet --compile-bytecode --no-deps --require-hashes -r constraints.txt \
		|| $(BIN)/pip install $(PIP_QUIET) --require-hashes -r constraints.txt # its own settings, such as a mirror
	$(BIN)/pip install $(PIP_QUIET) --no-build-isolation --editable .
	@touch $@

$(VENV)/.compiled: $(VENV)/.installed
	$(BIN)/python examples/twelve_vehicles.py >/dev/null # compiles the estimator, once
	@touch $@

demo: setup              ## a fleet, its calibration, and the Kirchhoff sum before and after (DRIVES=folder: real drives)
	$(BIN)/python tools/demo.py --drives $(DRIVES) --out $(OUT)

# tests write many files and sync each, which costs nothing in memory: where there are 4 GB of it
IN_MEMORY := $(shell [ "$$(df --output=avail /dev/shm | tail -n 1)" -gt 4000000 ] 2>/dev/null && echo TMPDIR=/dev/shm)
TEST := $(IN_MEMORY) $(BIN)/python -m pytest --numprocesses auto --dist worksteal
VCAN := HV_CALIBRATED_FLEET=build/vcan_fleet tools/with_vcan

test: setup              ## all tests but the long ones; those of SocketCAN on a kernel that has it
	$(MAKE) --no-print-directory --jobs=3 suite bus-gateway bus-node

suite: setup             # the tests that need no bus
	$(TEST) -m "not long" --durations 20

vcan-fleet: setup
	@mkdir -p build
	$(BIN)/python -m tests.vcan.calibrated_fleet build/vcan_fleet >build/vcan_fleet.log 2>&1 || { cat build/vcan_fleet.log; false; }

GATEWAY := tests/vcan/test_kernel_gateway.py
bus-gateway bus-node: vcan-fleet # each on a kernel of its own, most of the time waiting, beside the others
	PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 $(VCAN) --or-skip $(BIN)/python -m pytest -m "not long" \
		$(if $(filter bus-gateway,$@),$(GATEWAY),tests/vcan --ignore $(GATEWAY)) >build/$@.log 2>&1 \
		|| { cat build/$@.log; false; }
	@tail -n 1 build/$@.log

check-long: setup        ## the long tests: whole fleets, soak, power cuts, fuzz of many seeds (half an hour)
	$(TEST) -m long --durations 20

coverage: setup          ## all tests but the long ones, and which lines they reach: all of ecu_node, 95 % of calibrator
	rm -rf build/coverage
	$(TEST) -m "not long" --cov --cov-report=
	$(BIN)/python -m tests.vcan.calibrated_fleet build/vcan_fleet
	$(VCAN) $(BIN)/python -m pytest --cov=ecu_node --cov-append --cov-report= tests/vcan
	$(BIN)/coverage report --include='ecu_node/*' --fail-under=100
	$(BIN)/coverage report --include='calibrator/*' --fail-under=95

bench: setup             ## how long each step takes, beside its peers; also build/bench.json (long)
	PYTHONPATH=tools $(BIN)/python -m bench

bench-quick: setup       ## the same at small sizes, within five minutes
	PYTHONPATH=tools $(BIN)/python -m bench --quick

experiments: setup       ## docs/results anew, the repetitions of each from SEED on; TRIPS=folder of the recorded BMW i3 trips (half an hour)
	$(BIN)/python tools/import_bmw_i3.py $(TRIPS) --layout dbc/hv_powertrain.toml --out build/i3
	$(BIN)/calibrator experiment all --seed $(SEED) --drives build/i3 --layout dbc/hv_powertrain.toml --out build/results
	cp -r build/results build/results.md docs/ # only now: once a result has changed, git calls the commit dirty

soak: setup              ## the node at the full load of a CAN FD bus, 10^7 frames; its watch on 24 h of real drives (hours)
	PYTHONPATH=tools $(BIN)/python -m bench node --out build/soak.json
	HV_WATCH_HOURS=24 $(BIN)/python -m pytest -n 2 tests/real/test_watch_on_real_drives.py

fuzz: setup              ## 10^7 random frames through node and C core, 10^6 changed bundles (hours)
	HV_BUNDLES=1000000 HV_FRAMES=10000000 $(TEST) tests/update/test_changed_bundles.py \
		tests/ecu_node/test_random_vehicles.py tests/calibrator/export/test_c_core.py
	PYTHONPATH=tools $(BIN)/python -m bench.c_core fuzz --seconds 3600

release-check: coverage check-long bench experiments package ## the bars of a release on one commit, met or not (two hours)
	PYTHONPATH=tools $(BIN)/python -m bench.bars

mutants: setup           ## change the code in small ways and see that tests notice (an hour; goes on where it stopped)
	unshare --map-current-user --pid --fork --kill-child --mount-proc $(BIN)/mutmut run --max-children 2
	$(BIN)/mutmut results

lint: $(VENV)/.installed  ## ruff, formatting included
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed ## mypy --strict
	$(BIN)/mypy

LOADED := <(script|link|img|iframe|source|video|object|embed)[^>]*(src|srcset|href|data)=.?(https?:)?//[^ >]*|(url\(|@import )[^a-z/]?(https?:)?//[^ )]*
docs: setup              ## the documentation, in build/docs; its examples are run
	rm -rf build/docs docs/reference/api docs/gallery
	PYTHONPATH=tools $(BIN)/sphinx-build --quiet --fail-on-warning --keep-going --fresh-env --conf-dir docs \
		--doctree-dir build/doctrees . build/docs
	! grep -rnoE --include='*.html' --include='*.css' '$(LOADED)' build/docs # from another server

notebook: setup          ## run the notebook of the examples, and keep its outputs in it
	$(BIN)/jupyter execute --inplace --timeout 1800 examples/fleet_to_node.ipynb

dist: setup              ## wheel and source distribution, in dist/, checked
	rm -rf dist
	$(BIN)/python -m build --no-isolation
	$(BIN)/python -m twine check --strict dist/*

sbom: dist               ## and a bill of materials of what they bring (CycloneDX JSON)
	rm -rf build/sbom
	$(PYTHON) -m venv build/sbom
	grep -oE '^[^ ]+==[^\\]*' constraints.txt > build/sbom/pins.txt # without hashes: the wheel itself has none
	build/sbom/bin/pip install --quiet --constraint build/sbom/pins.txt \
		"$$(ls $$PWD/dist/*.whl)[calibrator,cluster,demo,mf4]"
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible --of JSON -o dist/sbom.cdx.json \
		build/sbom/bin/python

package: sbom            ## and all of it, with every extra, in clean environments (long; PYTHONS='other interpreters')
	HV_PYTHONS="$(PYTHONS)" $(BIN)/python -m pytest tests/package

licences: setup          ## what is installed, with its licence; fails on those that do not go with Apache-2.0
	$(BIN)/python tools/licences.py

schema: setup            ## write the JSON Schema of the parameter file anew
	$(BIN)/ecu-node schema > ecu_node/parameters.schema.json

constraints:             ## pin the newest versions of all dependencies, with hashes (needs uv)
	uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --no-annotate \
		--all-extras --upgrade pyproject.toml --output-file constraints.txt

clean:                   ## what the other targets made
	rm -rf $(VENV) build dist docs/reference/api docs/gallery
