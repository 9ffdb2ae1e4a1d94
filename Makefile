# Needs Python 3.11 or newer with venv and pip; everything else is installed into .venv once.

VENV := .venv
BIN := $(VENV)/bin
# Newer than pyproject.toml and constraints.txt when the environment is up to date.
STAMP := $(VENV)/.jaxmarine-installed

# The first of these that is new enough; `make PYTHON=...` takes another.
PYTHON := $(shell for python in python3.11 python3; do \
	"$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& { echo "$$python"; break; }; done)

# Compiled programs are kept between runs, small and quick ones too: those of the tests here, where `make clean`
# finds them; those of the demo where the command line keeps its own.
test: export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/.cache/jax
# Threads of the linear algebra that share a small matrix mostly wait for each other, and for those of the other
# process: what is solved with dense matrices takes many times as long with them.
test: export OMP_NUM_THREADS ?= 1
test: export OPENBLAS_NUM_THREADS ?= 1
# Tests compile more than they run: with these a cold run takes half as long to compile. Where every core has tests
# of its own, programs cut into parts that are compiled side by side only take longer.
test: export XLA_FLAGS ?= --xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 \
	--xla_llvm_disable_expensive_passes=true --xla_cpu_parallel_codegen_split_count=1
# Programs of tests, which nobody reads, are not told of which line each of their operations is.
test: export JAX_TRACEBACK_IN_LOCATIONS_LIMIT ?= 0
export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS ?= 0
export JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES ?= -1

# What Python compiles is kept, whatever the machine says: else each process compiles all packages again (3 s).
export PYTHONDONTWRITEBYTECODE :=
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup demo test docs clean

help:
	@echo "make demo    diagnose an example log and write demo-report/"
	@echo "make test    style, types and tests"
	@echo "make docs    the documentation as a site: site/index.html"
	@echo "make setup   only install into $(VENV)"
	@echo "make clean   remove $(VENV), caches, demo-report/ and site/"

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "jaxmarine needs Python 3.11 or newer, but \
	this machine has $$(python3 --version 2>/dev/null || echo no Python 3)." >&2; exit 1; }
	@echo "Installing jaxmarine and its dependencies into $(VENV), once."
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	@# The pip that comes with Python looks for each wheel's platform among all, and takes twice as long.
	@$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --upgrade pip
	@# Modules are compiled when they are first imported: most of the packages' never are.
	@$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[test]'
	@touch $@

demo: $(STAMP)
	$(BIN)/jaxmarine demo --out demo-report

test: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyrefly check
	$(BIN)/pytest -n 2 --no-loadscope-reorder

# The variable silences an advertisement that counts as no warning.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

clean:
	rm -rf $(VENV) .cache .hypothesis .pytest_cache .ruff_cache demo-report site
	find jaxmarine experiments tests -name __pycache__ -type d -prune -exec rm -rf {} +
