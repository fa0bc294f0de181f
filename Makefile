# make demo | test | check | bench | fuzz | campaign: each does its own set-up, into ./.venv
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DEV := $(VENV)/.dev
PIP = $(if $(shell command -v uv),VIRTUAL_ENV="$(CURDIR)/$(VENV)" uv pip install -q,$(BIN)/python -m pip install -q --disable-pip-version-check)
# numpy's and OpenCV's own threads only get in each other's way here
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1

.PHONY: demo test check bench fuzz campaign setup clean prerequisites

demo: $(READY)
	$(BIN)/robotd demo --out out/demo

test: $(DEV)
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal

check: $(DEV)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	rm -rf build/types && mkdir -p build/types
	cp -rs "$(CURDIR)/robotd" build/types/robotd && ln -s "$(CURDIR)/drivers" build/types/robotd/drivers
	$(BIN)/mypy build/types/robotd
	$(BIN)/robotd check -c etc/robotd.toml
	$(BIN)/python -m tests.units

bench: $(READY)
	$(BIN)/python -m tests.bench

# half a minute of coverage-guided fuzzing; ten minutes of it are in the campaign
fuzz: $(DEV)
	$(BIN)/python -m tests.fuzz.fuzz_oi --seconds 30

campaign: $(DEV)
	HYPOTHESIS_PROFILE=campaign $(BIN)/python -m pytest tests tests/campaign/*.py
	$(BIN)/python -m tests.fuzz.fuzz_oi --seconds 600

setup: $(DEV)

# the stamps are written last: what was left half made is made again
$(READY): pyproject.toml setup.py $(wildcard cython/*.pyx cython/*.pxi) | prerequisites
	rm -f $(READY) $(DEV)
	test -x $(BIN)/pip || { rm -rf $(VENV); $(PYTHON) -m venv $(VENV); }
	$(PIP) 'setuptools>=69' 'cython>=3.0.10' 'numpy>=2.0'
	$(PIP) --no-build-isolation -e '.[solver]'
	touch $(READY)

$(DEV): $(READY)
	$(PIP) --no-build-isolation -e '.[dev]'
	if pkg-config --exists libsystemd 2>/dev/null; then \
	    $(PIP) 'systemd-python>=235'; \
	else \
	    echo "note: without pkg-config and libsystemd-dev, systemd-python is left out (robotd has a fallback)"; \
	fi
	$(PIP) --only-binary :all: 'atheris>=3.0' || echo "note: no wheel of atheris for this platform; make fuzz does nothing"
	touch $(DEV)

prerequisites:
	@test -e $(READY) || sh .ci/prerequisites $(PYTHON)

clean:
	rm -rf $(VENV) build out *.egg-info robotd/*/_*.so
