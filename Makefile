# VaneLoop: `make` lists what can be done. Everything runs in a private environment, .venv, made on first use.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
# Targets share one environment, and what takes long uses the cores itself.
.NOTPARALLEL:
.PHONY: help demo test test-all test-short test-pythons test-can mutants bench bench-all pictures docs release lint clean compiled

# `make test PYTHON=python3.13`: another Python, in an environment of its own. Without it, the first that fits.
PYTHON :=
VENV := .venv$(addprefix -,$(notdir $(PYTHON)))
PY := $(VENV)/bin/python
SAY := printf '[vaneloop] %s\n'
# Tests of real time, of fleets and of pages wait for much of their time: three workers keep two cores busy.
JOBS ?= 3
# Threads of BLAS would wait for each other.
ONE_THREAD := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1
# Many tests start Python: what it compiles of a module is kept, wherever this is switched off.
unexport PYTHONDONTWRITEBYTECODE
PYTEST = $(PY) -m pytest -n $(JOBS) --dist worksteal
TESTS ?=
LONG_TESTS := -m '(slow or hypothesis) and not socketcan' --hypothesis-profile thorough \
  --junitxml out/test-all.xml --durations=15
# What may differ from one Python to the next: how functions are compiled and kept, processes, the command line, packages.
SHORT := imports controller plant frames bus node logs record kept identification laws own_laws exit_codes
# Why tests were skipped: pytest writes it there, and the last lines of `make test-all` say it.
NOT_TESTED := out/not_tested.txt

# An environment serves only the checkout that it was made in: a copied, moved or broken one is made anew.
HOME_OF_VENV := $(VENV)/.made-in
# What is installed in it: the core alone, or an extra of pyproject.toml beside it. A target adds what it runs.
READY_CORE := $(VENV)/.ready-core
READY := $(VENV)/.ready-test
READY_ALL := $(VENV)/.ready-test-all
READY_DOCS := $(VENV)/.ready-docs
READY_BENCH := $(VENV)/.ready-bench
READY_RELEASE := $(VENV)/.ready-release
ifneq ($(shell cat $(HOME_OF_VENV) 2>/dev/null && $(PY) -c '' 2>/dev/null && echo works),$(CURDIR) works)
  $(shell rm -f $(HOME_OF_VENV) $(VENV)/.ready-*)
endif

help:  ## list the targets
	@printf 'VaneLoop\n\n'
	@sed -nE 's/^([a-z-]+):[^#]*## (.*)/  make \1\t\2/p' $(firstword $(MAKEFILE_LIST)) | expand -t 20

demo: compiled  ## replay a recorded engine run and the long engine test; writes demo/*.html
	@$(PY) -m vaneloop.cli.demo

test: $(READY)  ## lint, types, and every capability once: some six minutes; TESTS='tests/test_xcp.py' only those files
	@$(need_chromium)
	@mkdir -p out
	@$(call tested,pytest,$(PYTEST) $(TESTS) -m 'not slow and not socketcan' --junitxml out/test.xml --durations=15)

test-all: $(READY_ALL)  ## all that `make test` leaves: long tests, more examples of each property, a real vcan0
	@$(need_chromium)
	@mkdir -p out
	@rm -f $(NOT_TESTED)
	@$(call ahead,$(if $(TESTS),,test-all))
	@$(SAY) 'pytest: the long tests'
	@$(ONE_THREAD) VANELOOP_NOT_TESTED=$(NOT_TESTED) $(PY) -m tests.vcan.run --beside $(PYTEST) $(TESTS) $(LONG_TESTS)

test-short: $(READY)  ## imports and the quick tests of controller, plant, bus, logs and search; PYTHON=python3.13 names a Python
	@$(ONE_THREAD) $(PY) -m pytest -q -n 2 --dist worksteal --durations=5 -m 'not slow and not socketcan' $(SHORT:%=tests/test_%.py)

test-pythons: $(READY)  ## the same on every other Python that the package promises and this machine has
	@$(PY) -m tests.pythons

test-can: $(READY_ALL)  ## only the tests on a real vcan0: this kernel's, that of user-mode Linux, or under QEMU (VANELOOP_CAN=host, uml, qemu)
	@$(PY) -m tests.vcan.run

mutants: $(READY_ALL) compiled  ## would the tests notice? changes the code in small ways, a sample; MUTANTS='--all' takes every one
	@$(PY) -m tests.mutants $(MUTANTS)

bench: $(READY_BENCH)  ## measure speed against C, python-control and pathsim: some five minutes
	@$(need_gcc)
	@$(PY) -m benchmarks

bench-all: $(READY_BENCH)  ## the same, and real time, the workbench, fleets, long logs, learning
	@$(need_gcc)
	@$(PY) -m benchmarks --all

pictures: $(READY_ALL)  ## take every picture of the README and of docs anew (docs/pictures)
	@$(need_chromium)
	@$(PY) -m benchmarks.pictures

docs: $(READY_DOCS)  ## the documentation site, in out/site/index.html; every link and anchor is checked
	@NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict
	@$(SAY) 'open out/site/index.html'

release: $(READY_RELEASE)  ## wheel and source archive, in dist/; both are tried in an empty environment
	@$(PY) -m tests.release

lint: $(READY)  ## ruff, mypy, and what the packages allow that are brought in
	@$(ruff)
	@$(SAY) 'licences, pins and advisories of the packages'
	@$(PY) -m tests.audit
	@$(SAY) 'mypy'
	@$(PY) -m mypy

compiled: $(READY_CORE)
	@$(call ahead)

clean:  ## remove what the other targets made, the environment too
	@rm -rf .venv .venv-* build dist demo out *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis vaneloop/base/ahead
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(HOME_OF_VENV):
	@$(make_venv)
	@echo '$(CURDIR)' >$@

$(READY_CORE): pyproject.toml constraints.txt | $(HOME_OF_VENV)
	@$(call install,core)
	@touch $@

# The core comes first; what is there already stays. What pip leaves of two processors compiles meanwhile.
$(VENV)/.ready-%: pyproject.toml constraints.txt | $(READY_CORE)
	@{ $(call ahead,$*); } >/dev/null 2>&1 & ahead=$$!; code=0; \
	{ $(call install,$*); } || code=$$?; \
	wait $$ahead || true; \
	exit $$code
	@touch $@

# The editable install makes edits count at once. Python compiles a module when it is first imported; pip would compile
# all of them, for 20 s. A slow or failing package index is asked again.
define install
($(SAY) 'installing the pinned packages for $(1) (a minute or two on first use; full log: $(VENV)/pip.log)'; \
export PIP_CONSTRAINT=constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_RETRIES=8 PIP_DEFAULT_TIMEOUT=$${PIP_DEFAULT_TIMEOUT:-60}; \
for try in 1 2 3; do \
  if $(PY) -m pip install --no-compile -e '.$(if $(filter-out core,$(1)),[$(1)])' 2>&1 | tee $(VENV)/pip.log \
    | { grep --line-buffered -E '^ +Downloading .*MB|^Installing|^ *(ERROR|error:)|[Rr]etrying' || true; } | cut -c1-110; \
  then exit 0; fi; \
  if [ $$try != 3 ]; then $(SAY) 'not installed; trying again'; sleep $$((try * 5)); fi; \
done; \
$(SAY) 'the packages could not be installed; the lines above and $(VENV)/pip.log say why'; exit 1)
endef

# The first Python from 3.11 on that can make an environment; Debian and Ubuntu keep that part in a package of its own.
define make_venv
can() { "$$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' 2>/dev/null; }; \
whole() { "$$1" -c 'import ensurepip, venv' 2>/dev/null; }; \
candidates="$(or $(PYTHON),python3.13 python3.12 python3.11 python3.14)"; \
if [ -z "$(PYTHON)" ] && python3 -c 'import sys; sys.exit(sys.version_info >= (3, 14))' 2>/dev/null; then candidates="python3 $$candidates"; fi; \
found=; bare=; \
for p in $$candidates; do \
  if can $$p; then if whole $$p; then found=$$p; break; fi; bare=$${bare:-$$p}; fi; \
done; \
if [ -z "$$found" ] && [ -n "$$bare" ]; then \
  v=$$("$$bare" -c 'import sys; print("%d.%d" % sys.version_info[:2])'); \
  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
    $(SAY) "installing python$$v-venv with apt-get"; \
    export DEBIAN_FRONTEND=noninteractive; \
    apt-get update -qq >/dev/null || true; \
    apt-get install -y -qq "python$$v-venv" >/dev/null || apt-get install -y -qq python3-venv >/dev/null || true; \
  fi; \
  if whole "$$bare"; then found=$$bare; \
  else $(SAY) "$$bare lacks its venv module: install the package python$$v-venv (Debian, Ubuntu) and try again"; exit 1; fi; \
fi; \
if [ -z "$$found" ]; then $(SAY) 'no Python 3.11 or newer found (looked for $(or $(PYTHON),python3$(comma) python3.11 to python3.14)): install one and try again'; exit 1; fi; \
$(SAY) "making $(VENV) with $$("$$found" --version)"; \
rm -rf $(VENV); "$$found" -m venv $(VENV)
endef

# What the first commands run; of all tests, or of the environment for them, also what several of these run.
ahead = $(PY) -m vaneloop.cli.ahead$(if $(filter test test-all,$(1)), && $(PY) -m tests.ahead)

comma := ,
define ruff
$(SAY) 'ruff'; \
$(PY) -m ruff check --output-format concise .; \
$(PY) -m ruff format --check --quiet --diff .
endef

# mypy takes one core for a minute: it runs beside what is compiled ahead and the first tests. What it found is said
# when they have ended, and fails as they do. Words of (2) are pytest's.
define tested
$(ruff); \
$(SAY) 'mypy, beside the others'; \
$(PY) -m mypy >out/mypy.txt 2>&1 & types=$$!; code=0; \
{ $(call ahead,$(if $(TESTS),,test)) && $(SAY) '$(1)' && $(ONE_THREAD) $(2); } || code=$$?; \
wait $$types || { code=1; $(SAY) 'mypy:'; cat out/mypy.txt; }; \
exit $$code
endef

define need_gcc
if ! command -v gcc >/dev/null; then \
  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
    $(SAY) 'installing gcc with apt-get, for the comparison with C'; \
    export DEBIAN_FRONTEND=noninteractive; \
    apt-get update -qq >/dev/null || true; \
    apt-get install -y -qq gcc libc6-dev >/dev/null; \
  else $(SAY) 'the comparison with C needs gcc: install it and try again'; exit 1; fi; \
fi
endef

define need_chromium
if ! command -v chromium chromium-browser google-chrome >/dev/null; then \
  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
    $(SAY) 'installing chromium with apt-get, for the tests of the workbench'; \
    export DEBIAN_FRONTEND=noninteractive; \
    { apt-get update -qq && apt-get install -y -qq chromium; } >/dev/null || $(SAY) 'chromium could not be installed: THE TESTS OF THE WORKBENCH ARE SKIPPED'; \
  else $(SAY) 'no chromium, and not root to install it: THE TESTS OF THE WORKBENCH ARE SKIPPED'; fi; \
fi
endef
