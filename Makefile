# Bare `make` lists the targets. Everything is installed into .venv from PyPI, by hash.
PYTHON ?= python3
BIN := .venv/bin
TRACKER := .venv/.tracker
SETUP := .venv/.installed
NATIVE := src/tumortrack/native
KERNELS := $(NATIVE)/kernels.elf
CLIENTS := .clients/.installed
TOOLS := .tools/.installed
PIP := pip install --quiet --disable-pip-version-check --no-compile --no-deps
# Whatever the environment says: without kept bytecode every start compiles what it imports anew.
unexport PYTHONDONTWRITEBYTECODE

# uv fetches and unpacks side by side, in a fraction of pip's time. It reads the certificates that the system trusts, but not pip's
# settings (a mirror): where it fails, pip does the work.
define INSTALL
	VIRTUAL_ENV=$(or $(2),.venv) $(BIN)/uv pip install --quiet --system-certs --no-deps --require-hashes -r $(1) 2>$(or $(2),.venv)/uv.log || { \
	echo "uv could not install $(1) ($(or $(2),.venv)/uv.log says why); pip does, which takes longer"; \
	$(or $(2),.venv)/bin/$(PIP) --require-hashes -r $(1); }
endef

# ziglang (440 MB) is there for the build alone, and only where nothing else compiles C.
COMPILER = $(BIN)/python tools/build_backend.py --compiler >/dev/null 2>&1 || { echo "no C compiler here: ziglang, from PyPI"; $(call INSTALL,requirements/compiler.txt); }
NO_COMPILER = $(BIN)/pip uninstall --quiet --yes ziglang 2>/dev/null

.DEFAULT_GOAL := help
.PHONY: help setup debian clients demo demo-scenes test quick pythons pytest test-hard check attack replay fingerprint figures pages bench soak wheel lock licences audit stress pull bounds accuracy following evidence cut paper ultrasound noise rehearsal population site pictures clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

setup: $(SETUP)  ## install everything into .venv: tracker, devices, the paper's method with PyTorch, resection, benchmarks, experiment, what tests and the site need

$(TRACKER): pyproject.toml requirements/core.txt requirements/uv.txt requirements/compiler.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15) and "tumortrack needs Python 3.11 to 3.14, and this is " + sys.version.split()[0] + "; give make PYTHON=python3.12, or another of these")'
	@$(PYTHON) -c 'import ensurepip, venv' || { echo "$(PYTHON) cannot make environments; on Debian and Ubuntu: apt-get install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv --clear .venv
	@$(BIN)/$(PIP) --require-hashes -r requirements/uv.txt
	@$(call INSTALL,requirements/core.txt)
	@$(COMPILER)
	$(BIN)/$(PIP) --no-build-isolation -e .
	@$(NO_COMPILER)
	@$(BIN)/python -m compileall -q -j 0 -x '/tests?/' .venv/lib src  # where nothing may be written every start would
	$(BIN)/python -I -m pip check  # -I: what PYTHONPATH names, as ROS sets it, is none of ours
	@touch $@

$(KERNELS): $(wildcard $(NATIVE)/*.h $(NATIVE)/*/*.[ch]) tools/build_backend.py | $(TRACKER)
	@$(COMPILER)
	$(BIN)/python tools/build_backend.py
	@$(NO_COMPILER)

# PyTorch's CPU build is taken where pip knows of it, else PyPI's, which on x86-64 needs CUDA's packages.
$(SETUP): $(TRACKER) $(KERNELS) devices/pyproject.toml occupancy/pyproject.toml resection/pyproject.toml benchmarks/pyproject.toml experiment/pyproject.toml requirements/rest.txt requirements/cuda.txt requirements/torch-cpu.txt
	@$(BIN)/$(PIP) --require-hashes -r requirements/torch-cpu.txt 2>/dev/null || echo "PyTorch: PyPI's build"
	@$(call INSTALL,requirements/rest.txt)
	@if $(BIN)/python -c 'from importlib.metadata import requires; print(requires("torch"))' | grep -q nvidia; then \
	echo "PyTorch's CUDA packages: some 3 GB"; $(call INSTALL,requirements/cuda.txt); fi
	$(BIN)/$(PIP) --no-build-isolation -e devices -e occupancy -e resection -e experiment -e benchmarks
	$(BIN)/python -I -m pip check
	@touch $@

$(TOOLS): requirements/tools.txt
	$(PYTHON) -m venv .tools
	.tools/bin/$(PIP) --require-hashes -r requirements/tools.txt
	touch $@

demo: $(TRACKER) $(KERNELS)  ## install the tracker (without PyTorch), then CT -> tumors located in ten scenes of other physics (ARGS="--scenes 2": the first two)
	$(BIN)/tumortrack demo $(ARGS)

check: setup  ## lint, types, import order, licences, figures in the pages
	$(BIN)/ruff check src devices occupancy resection benchmarks experiment tests examples tools notebooks conftest.py
	$(BIN)/ruff check --select F821 benchmarks/scripts tools tests/support  # mypy does not see these
	$(BIN)/ruff format --check src devices occupancy resection benchmarks experiment tests examples tools notebooks conftest.py
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/dependencies.py licences
	$(BIN)/python tools/figures.py --check

debian:  ## install what tests need from Debian (Chromium, libusb, a compiler)
	tools/debian.sh

clients: $(TRACKER)  ## install other makers' programs that tests talk to (ROS 2's rclpy and Fast DDS, ur_rtde, 3D Slicer's core, usd-core, newton: 1.6 GB); they have wheels of Python 3.11 on x86-64
	@if $(BIN)/python -c 'import platform, sys; sys.exit(sys.version_info[:2] != (3, 11) or platform.machine() != "x86_64")'; \
	then $(MAKE) --no-print-directory $(CLIENTS); else echo "make clients: not Python 3.11 on x86-64; tests that need them skip"; fi

# An environment of its own, as a ROS is one; its programs run with that of `make setup` behind it.
$(CLIENTS): requirements/clients.txt requirements/ur.txt
	$(BIN)/python -m venv --clear .clients
	@$(call INSTALL,requirements/clients.txt,.clients)
	@$(call INSTALL,requirements/ur.txt,.clients)
	@touch $@

site: setup  ## the documentation's site, strictly: build/site/index.html (`.venv/bin/mkdocs serve`: while you write)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

test: check site pytest  ## check, then the tests of all distributions (those of Chromium after `make debian`, of others' programs after `make clients`)

quick: setup  ## the quickest tests of the tracker (a minute)
	OMP_NUM_THREADS=1 $(BIN)/pytest -q -n 2 -m 'not slow' tests/core

pythons:  ## a fresh clone with every Python here: install, short demo, doctor, quick tests (ARGS=/usr/bin/python3)
	tools/pythons.sh $(ARGS)

pytest: setup  ## all tests, without the checks (ARGS=tests: the tracker's)
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 4 --dist loadfile --no-loadscope-reorder $(ARGS)

attack: setup  ## hostile and damaged files for every reader, commands killed, short of something, two at once (an hour; ARGS="--attack 3 -k plans")
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 tests/hostile --attack 10 $(ARGS)

replay: setup  ## has any of 500 answers changed since runs/replay.json, by how many mm? Without that file: record them
	$(BIN)/python tools/replay.py compare

fingerprint: setup  ## the method's version, by 30 answers: recorded again where it has changed (a minute)
	$(BIN)/python tools/replay.py fingerprint

figures: setup  ## measure all that the pages claim with today's method, then `make pages` (an hour; ARGS="STEP ...", ARGS="--data DATA": also your KiTS19)
	$(BIN)/python benchmarks/scripts/figures.py $(ARGS)

pages: setup  ## write the measured figures of the pages from docs/data; fails on tables of another method
	$(BIN)/python tools/figures.py

test-hard: setup  ## tests on narrow vector units beside two busy processes (ARGS=tests/...)
	@$(BIN)/python -c 'while True: pass' & one=$$!; $(BIN)/python -c 'while True: pass' & two=$$!; \
	trap "kill $$one $$two" EXIT; ONEDNN_MAX_CPU_ISA=AVX2 ATEN_CPU_CAPABILITY=avx2 \
	OMP_NUM_THREADS=1 $(BIN)/pytest $(ARGS)

bench: setup  ## speed of every part; fills docs/results.md and docs/data/speed*.csv (5 minutes; ARGS=--quick)
	$(BIN)/tumortrack bench --document docs/results.md $(ARGS)

soak: setup  ## an hour of tracking with faults of eleven kinds (ARGS="MODEL CASE --minutes 5"; after make demo)
	$(BIN)/python benchmarks/scripts/soak.py $(ARGS)

stress: setup  ## scenes of wider physics, noise and views, and whether plans cut tumors out of them (ARGS="CASE OUT --plans MODEL")
	$(BIN)/python benchmarks/scripts/stress.py $(ARGS)

demo-scenes: setup  ## the ten scenes that the package brings (ARGS=OUT: what takes long is kept there)
	$(BIN)/python benchmarks/scripts/demo.py $(ARGS)

pull: setup  ## an organ under the pull of a plan's holder, for the virtual source (ARGS="PLAN virtual:CASE?... OUT")
	$(BIN)/python benchmarks/scripts/pull.py $(ARGS)

bounds: setup  ## learns how far off organs and tumors may be, from random organs (ARGS="OUT --write src/tumortrack/assessment/bounds.json"; an hour)
	$(BIN)/python benchmarks/scripts/bounds.py $(ARGS)

accuracy: setup  ## how far off tumors are by state and organ, on random kidneys (ARGS="OUT --kidneys 12")
	$(BIN)/python benchmarks/scripts/accuracy.py $(ARGS)

following: setup  ## how well moving random kidneys are followed: jumps, two cameras (ARGS="OUT --kidneys 4")
	$(BIN)/python benchmarks/scripts/following.py $(ARGS)

evidence: setup  ## what touches, outlines, landmarks and held tumors bring, on random kidneys (ARGS="OUT --kidneys 4"; 10 minutes)
	$(BIN)/python benchmarks/scripts/evidence.py $(ARGS)

cut: setup  ## how well a tumor is followed while it is cut out of random kidneys (ARGS="OUT --organs 14"; hours)
	$(BIN)/python benchmarks/scripts/cut.py $(ARGS)

paper: setup  ## the paper's table and its study of deformations, on the twin (ARGS="CASE OUT --limited MODEL --full MODEL")
	$(BIN)/python benchmarks/scripts/paper.py $(ARGS)

population: setup  ## KiTS19's kidneys with tumors: a fleet over them, and its tables (ARGS="DATA OUT --count 12")
	$(BIN)/python benchmarks/scripts/population.py $(ARGS)

ultrasound: setup  ## how well lag and scales of a tracked probe are found, on random kidneys (ARGS="OUT --kidneys 2"; 5 s an answer)
	$(BIN)/python benchmarks/scripts/ultrasound.py $(ARGS)

noise: setup  ## good answers and tumors' errors against noise, cameras and distances, on random kidneys (ARGS="OUT --kidneys 4"; half a second an answer)
	$(BIN)/python benchmarks/scripts/noise.py $(ARGS)

rehearsal: setup  ## the experiment on a bench that does not exist, by all its commands (ARGS="CASE MODEL OUT", after make demo)
	$(BIN)/python benchmarks/scripts/rehearsal.py $(ARGS)

pictures: demo debian  ## the pictures in docs/images that the demo shows (docs/maintaining.md has the others; 10 minutes)
	$(BIN)/python benchmarks/scripts/picture.py runs/demo/case docs/images/demo.png
	$(BIN)/tumortrack locate runs/demo/case runs/demo/dataset/1-rest/cloud.ply --out runs/pictures/run --depth-error 0 --overwrite
	$(BIN)/tumortrack plan runs/pictures/run runs/pictures/plan --accept-budget --overwrite
	cp runs/pictures/plan/plan.png docs/images/plan.png
	rm -f docs/images/resection.gif  # a film replaces none
	$(BIN)/tumortrack resect runs/pictures/plan --film docs/images/resection.gif
	TUMORTRACK_PICTURES=docs/images TUMORTRACK_DEMO=runs/demo TUMORTRACK_PLAN=runs/pictures/plan $(BIN)/pytest -n0 devices/tests/test_viewer_page.py

wheel: setup $(TOOLS)  ## build the wheels of tracker, devices, the paper's method, resection, experiment and benchmarks into dist/, with their dependencies (SBOM)
	rm -rf dist build/lib devices/build occupancy/build resection/build benchmarks/build experiment/build  # modules that are gone would be packed from there
	CC=".tools/bin/python -m ziglang cc" $(BIN)/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist --config-settings portable=1 .
	$(BIN)/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist ./devices ./occupancy ./resection ./experiment ./benchmarks
	rm -f $(NATIVE)/*.elf && $(MAKE) --no-print-directory $(KERNELS)  # for this machine again
	.tools/bin/twine check --strict dist/*.whl
	.tools/bin/auditwheel show dist/tumortrack-*.whl
	$(BIN)/python tools/dependencies.py sbom dist/tumortrack-*.whl dist/tumortrack_devices-*.whl dist/tumortrack_occupancy-*.whl dist/tumortrack_resection-*.whl dist/tumortrack_experiment-*.whl dist/tumortrack_benchmarks-*.whl

lock: setup $(TOOLS)  ## pin the dependencies by hash (ARGS=--upgrade: newest; ARGS="--upgrade-package NAME")
	PATH="$(CURDIR)/.tools/bin:$$PATH" $(BIN)/python tools/dependencies.py lock $(ARGS)
	PATH="$(CURDIR)/.tools/bin:$$PATH" $(BIN)/python tools/dependencies.py wheels

licences: setup  ## list the dependencies' licences in docs/data/dependencies.csv; fails on one not allowed
	$(BIN)/python tools/dependencies.py table
	$(BIN)/python tools/dependencies.py licences

audit: $(TOOLS)  ## known vulnerabilities of all that is pinned; fails also if PyPI does not answer
	@.tools/bin/pip-audit --strict --progress-spinner off --disable-pip --require-hashes \
	$(foreach name,core rest cuda ur tools,-r requirements/$(name).txt) || { echo \
	"audit: not passed: there are vulnerabilities (listed above), or PyPI could not be asked" >&2; exit 1; }

clean:  ## remove .venv and caches (runs/ stays)
	rm -rf .venv .clients .tools .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
