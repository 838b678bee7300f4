# make run    the project's experiments, from a bare machine to results/report.html
# make test   ruff, mypy and pytest in the same environment
# make bench  every benchmark, with its figures as JSON under build/benchmarks
# make lock   renew requirements.lock from pyproject.toml
# make clean  take away the environment and whatever was made in it

SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
LOCKER := .venv-lock
UV := uv==0.13.9
OUT ?= results

# The first interpreter that starts, is new enough and can make an environment; or name one: make run PYTHON=/path/to/python
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do \
	"$$p" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo "$$p"; break; }; done)

.PHONY: run test bench lock clean
.DELETE_ON_ERROR:

run: $(VENV)/.ready
	$(BIN)/fingerjax run experiments.yaml --out $(OUT)

test: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2 --dist loadfile --max-worker-restart 0

bench: $(VENV)/.ready
	$(BIN)/python -m benchmarks --out build/benchmarks

$(VENV)/.locked: requirements.lock
ifeq ($(PYTHON),)
	@echo "fingerjax needs Python 3.11 or newer with its venv module; python3 here is: $$(python3 --version 2>&1 || true)." >&2
	@echo "Install one (Debian, Ubuntu: apt install python3 python3-venv), or name one: make PYTHON=/path/to/python3.11 ..." >&2
	@exit 1
endif
	@echo "[1/3] a fresh environment in $(VENV), with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv --clear $(VENV)
	@echo "[2/3] $$(grep -c == requirements.lock) pinned packages, about 700 MB to download the first time; takes one to three minutes"
	@$(BIN)/python -m pip install --disable-pip-version-check --no-input --require-hashes -r requirements.lock
	@touch $@

$(VENV)/.ready: $(VENV)/.locked pyproject.toml
	@echo "[3/3] fingerjax itself, editable"
	@$(BIN)/python -m pip install --disable-pip-version-check --no-input --quiet --no-deps --no-build-isolation --editable .
	@touch $@

# Resolved for the oldest Python we run on, whose versions newer ones can use too; hashes of every published file.
lock:
	@test -x $(LOCKER)/bin/uv || { $(PYTHON) -m venv $(LOCKER) && $(LOCKER)/bin/python -m pip install --quiet $(UV); }
	$(LOCKER)/bin/uv pip compile pyproject.toml requirements.in --extra test --extra direct --output-file requirements.lock \
		--upgrade --python-version 3.11 --python-platform x86_64-unknown-linux-gnu --generate-hashes \
		--no-header --no-annotate --no-emit-index-url --quiet
	@! grep -nE '://|--(extra-)?index-url|--find-links|--trusted-host' requirements.lock

clean:
	rm -rf $(VENV) $(LOCKER) build dist results .pytest_cache .ruff_cache .mypy_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
