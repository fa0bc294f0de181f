# make demo | test | check | bench | campaign: each does its own set-up, into ./.venv
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# numpy's and OpenCV's own threads only get in each other's way here
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1

.PHONY: demo test check bench campaign setup clean prerequisites

demo: $(READY)
	$(BIN)/robotd demo --out out/demo

test: $(READY)
	$(BIN)/python -m pytest

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	rm -rf build/types && mkdir -p build/types
	cp -rs "$(CURDIR)/robotd" build/types/robotd && ln -s "$(CURDIR)/drivers" build/types/robotd/drivers
	$(BIN)/mypy build/types/robotd
	$(BIN)/robotd check -c etc/robotd.toml

bench: $(READY)
	$(BIN)/python -m tests.bench

campaign: $(READY)
	HYPOTHESIS_PROFILE=campaign $(BIN)/python -m pytest tests/campaign tests

setup: $(READY)

# the stamp is written last: a half-made .venv is made again
$(READY): pyproject.toml setup.py $(wildcard cython/*.pyx) | prerequisites
	rm -f $(READY)
	test -x $(BIN)/python || { rm -rf $(VENV); $(PYTHON) -m venv $(VENV); }
	if command -v uv >/dev/null 2>&1; then \
	    VIRTUAL_ENV="$(CURDIR)/$(VENV)" uv pip install -q -e '.[dev]'; \
	else \
	    $(BIN)/python -m pip install -q --disable-pip-version-check -e '.[dev]'; \
	fi
	if pkg-config --exists libsystemd 2>/dev/null; then \
	    $(BIN)/python -m pip install -q --disable-pip-version-check 'systemd-python>=235'; \
	else \
	    echo "note: libsystemd-dev and pkg-config are not installed, so systemd-python is left out (robotd has a fallback)"; \
	fi
	touch $(READY)

prerequisites:
	@test -e $(READY) || sh .ci/prerequisites $(PYTHON)

clean:
	rm -rf $(VENV) build out *.egg-info robotd/*/_*.so
