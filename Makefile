# make demo | test | test-all | lint | types | bench | trials | pages | bundle | lock | notices | clean. The first call makes .venv.

PYTHON ?= python3
VENV   ?= .venv
EXTRAS ?= gpu,onnx,ground,logs,dev
# For instance PIP_FLAGS='--extra-index-url https://download.pytorch.org/whl/cpu' where there
# is no NVIDIA GPU: it saves some gigabytes of download.
PIP_FLAGS ?=
ARGS ?=

BIN := $(VENV)/bin
CORE := $(VENV)/core
STAMP := $(VENV)/installed
PEERS := $(VENV)/peers/installed
WEB := service/ground/web
PAGE := $(addprefix $(WEB)/,package-lock.json index.html vite.config.ts) $(wildcard $(WEB)/src/*)

.PHONY: demo test test-all lint types check bench trials pages format bundle lock notices clean

# Needs the core and the portal alone, without torch and Open3D.
demo: $(CORE)
	@$(BIN)/skyrelief demo --out demo-output $(ARGS)

# The tests start hundreds of Python processes; each would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

# A worker a core and MORE, as tests of services wait half of their time, but none without a GiB of
# memory; JOBS=0: one after the other, in one process. `make test` is the quick tier; tests named by
# ARGS run whatever their tier.
MORE = 1
test: MORE = 2
JOBS ?= $(shell $(PYTHON) -c 'import os; \
  gib = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") >> 30; \
  print(max(1, min($(MORE) + (os.cpu_count() or 1), gib)))')
PYTEST = $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder
test: $(STAMP) $(PEERS)
	$(PYTEST) $(if $(ARGS),$(ARGS),-m "not slow")

# Everything: browsers, trials, documents' commands, hard flights, benchmarks, peers.
test-all: $(STAMP) $(PEERS)
	$(PYTEST) $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(STAMP)
	$(BIN)/mypy

check: lint types test-all

bench: $(STAMP)
	PYTHONPATH=tests/support $(BIN)/python tests/bench/bench_run.py $(ARGS)

# Over an hour: fifty kills, the fuzzers, and in parallel an hour of flights and a scan of an hour
# (MINUTES=6 is shorter), which are their load. As root with systemd-container and debootstrap it
# also installs into a bare Debian and boots that. Writes docs/reports/runs.
MINUTES ?= 60
SOAK := tests/trials/test_trial_soak.py
trials: $(STAMP)
	$(BIN)/python -m pip install --no-compile --disable-pip-version-check -qq -c constraints.txt -e '.[$(EXTRAS),trials]'
	@export SKYRELIEF_TRIALS=whole SKYRELIEF_SOAK_MINUTES=$(MINUTES); \
	  export SKYRELIEF_TRIALS_TABLE=docs/reports/runs/trials.json SKYRELIEF_BOOT_LOG=docs/reports/runs/boot.json; \
	  $(BIN)/python -m pytest -m trial $(SOAK) -k flights $(ARGS) & flights=$$!; \
	  $(BIN)/python -m pytest -m trial $(SOAK) -k scan $(ARGS) & scan=$$!; \
	  $(BIN)/python -m pytest -m trial tests/trials --ignore=$(SOAK) $(ARGS); rest=$$?; \
	  wait $$flights; flights=$$?; wait $$scan; scan=$$?; $(BIN)/python docs/report.py; cat docs/reports/trials.md; \
	  for rc in $$rest $$flights $$scan; do case $$rc in 0|5) ;; *) exit $$rc;; esac; done  # 5: none

# What commands write in docs: reports, configuration and pictures.
pages: $(CORE)
	for script in report configuration architecture concepts growth; do $(BIN)/python docs/$$script.py || exit; done

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Everything that deploy/install.sh needs on a machine without a network.
bundle: $(STAMP)
	PYTHON=$(abspath $(BIN))/python deploy/bundle.sh $(ARGS)

# deploy/locked: pins and hashes of what is installed, renewed after a change of constraints.txt.
lock: $(STAMP)
	@test -x $(VENV)/lock/bin/uv || { $(BIN)/python -m venv $(VENV)/lock && \
	  $(VENV)/lock/bin/python -m pip install --disable-pip-version-check -qq uv==0.13.9; }
	$(BIN)/python deploy/lock.py $(abspath $(VENV))/lock/bin/uv

# What a bundle holds, again: requirements.txt, sbom.cdx.json and THIRD_PARTY_NOTICES.
BUNDLE ?= dist/bundle
notices:
	$(PYTHON) deploy/inventory.py $(BUNDLE)

clean:
	rm -rf demo-output build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis

# Installed again only when what is installed changes, which includes the portal's page. Python
# compiles a module when it is first imported: to compile all of them takes longer than to download them.
$(CORE): pyproject.toml constraints.txt hatch_build.py $(PAGE)
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "skyrelief needs Python 3.10 to 3.13; say which with: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 2; }
	@echo "installing skyrelief and some 40 packages into $(VENV): once, a minute or two"
	@{ test -x $(BIN)/python || $(PYTHON) -m venv $(VENV); } && \
	  $(BIN)/python -m pip install --no-compile --disable-pip-version-check -qq -c constraints.txt -e '.[portal]' & \
	  s=0; while kill -0 $$! 2>/dev/null; do sleep 1; s=$$((s + 1)); \
	  n=$$(ls -d $(VENV)/lib/python*/site-packages/*.dist-info 2>/dev/null | wc -l); \
	  if test -t 1; then printf '\r[%-40.40s] %s packages, %s s' "$$(printf '%*s' $$n '' | tr ' ' '=')" $$n $$s; \
	  elif test $$((s % 2)) = 0; then echo "  $$n packages, $$s s"; fi; \
	  done; test ! -t 1 || echo; wait $$!
	@touch $(CORE)

$(STAMP): $(CORE)
	$(BIN)/python -m pip install --no-compile --disable-pip-version-check -qq -c constraints.txt $(PIP_FLAGS) -e '.[$(EXTRAS)]'
	@$(BIN)/skyrelief warm-up  # else each of the tests' processes compiles the same kernels
	@PYTEST_ADDOPTS= $(BIN)/python -m pytest -qq --collect-only -m "not slow" >/dev/null || true  # and the same modules
	@touch $(STAMP)

# MAVProxy, a ground station for the tests, in an environment of its own without its graphical
# parts, which clash with ours. Without a network its tests are skipped by name.
$(PEERS): constraints.txt | $(STAMP)
	@test -x $(VENV)/peers/bin/python || $(BIN)/python -m venv $(VENV)/peers
	@PIP="$(VENV)/peers/bin/python -m pip --disable-pip-version-check --retries 1 --timeout 15"; \
	  { $$PIP install -qq -c constraints.txt pymavlink pyserial && \
	    $$PIP install -qq --no-deps MAVProxy==1.8.75 && touch $@; } || \
	  echo "could not install MAVProxy; its tests are skipped" >&2
