# `make demo`, `make test` (every change) and `make acceptance` (releases) create .venv on first use.
# `make demo` installs requirements.lock: the run time. All other targets add requirements-dev.lock.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
# The observers are memory-bound; more BLAS threads only fight with each other.
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1
# The demo compiles the modules that it imports. All modules of the run time take 12 s and 130 MB more.
# A lock file names every package. Resolving it again would let a release of a later day break the installation.
INSTALL := $(BIN)/python -m pip install --no-deps --no-compile --quiet --disable-pip-version-check
COMPILE := uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-header \
  --no-emit-index-url --no-emit-find-links

.PHONY: demo test acceptance check lint types imports bench sbom lock clean

demo: $(VENV)/.installed-demo
	$(BIN)/gridsec demo

test: $(VENV)/.installed
	$(MAKE) --jobs --output-sync check
	$(BIN)/python -m pytest -n auto -m "not acceptance"

# All tests. Coverage is traced here only: tracing takes a quarter of the time on Python 3.11.
acceptance: $(VENV)/.installed
	$(MAKE) --jobs --output-sync check
	$(BIN)/python -m coverage erase
	$(BIN)/python -m pytest -n auto --cov --cov-report=
	$(BIN)/python -m coverage report --fail-under=95

check: lint types imports

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed
	$(BIN)/mypy

imports: $(VENV)/.installed
	$(BIN)/lint-imports

bench: $(VENV)/.installed
	$(BIN)/python -m benchmarks

$(VENV)/.installed-demo: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "gridsec needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --require-hashes -r requirements.lock
	$(INSTALL) --no-build-isolation --editable .
	touch $@

# Bill of materials of the run time, CycloneDX 1.6.
sbom: $(VENV)/.installed-demo
	mkdir -p dist
	$(BIN)/python deploy/sbom.py requirements.lock > dist/gridsec.cdx.json

# pytest treats warnings as errors, also those of a foreign module's syntax on its first import: all are compiled here.
$(VENV)/.installed: $(VENV)/.installed-demo requirements-dev.lock
	$(INSTALL) --require-hashes -r requirements-dev.lock
	-$(BIN)/python -W ignore -m compileall -qq -j 0 $(VENV)/lib
	touch $@

# Needs uv; writes no address into the files. The run time has the versions of the whole.
lock:
	$(COMPILE) --extra dev pyproject.toml --output-file requirements-dev.lock
	$(COMPILE) --extra editable --constraint requirements-dev.lock pyproject.toml --output-file requirements.lock

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .coverage* dist build
