# `make run` serves, `make test` tests: both create what they need (a virtual environment in .venv, from uv.lock).
# Needed on the machine: Python 3.11 or newer, and the network for the packages of the lock file.

PYTHON ?= python3
VENV ?= .venv
UV_VERSION := 0.13.8
BIN := $(VENV)/bin
ARGS ?=

# uv installs the lock file in seconds; where it is absent it is put into the virtual environment first. The machine's
# own certificates are trusted, as pip and curl do.
UV := $(shell uv --version >/dev/null 2>&1 && echo uv || echo $(BIN)/uv)
SYNC := UV_SYSTEM_CERTS=true UV_PROJECT_ENVIRONMENT=$(VENV) $(UV) sync --frozen --extra server --inexact --quiet --no-python-downloads

# What a robot runs, and signing for its tests: on Python 3.10 as well (Ubuntu 22.04, ROS 2 Humble). `compression` is Python 3.14's; others take the backport.
ROBOT := app/__init__.py app/bearer.py app/clock.py app/dangerous_variables.py app/errors.py app/event_types.py app/backends/__init__.py app/backends/documents.py \
  app/backends/locks.py \
  app/events/__init__.py app/events/credentials.py \
  app/events/messages.py app/model/__init__.py app/model/frame.py app/model/names.py app/signing.py app/agent app/cli

# Sources of the web page. Installing builds it (app/web/build.py) with Node 20.19 or newer, which pip brings if there is none.
PAGE := $(shell find app/web -path app/web/node_modules -prune -o -path app/web/dist -prune -o -type f -not -name openapi.json -not -name schema.d.ts -print)

.PHONY: run test lint docs bundle bench bench-web chaos soak fuzz figures release install install-dev clean

run: install
	@$(BIN)/fleetmap serve --demo $(ARGS)

test: install-dev
	@$(BIN)/python -m pytest -n auto --dist worksteal $(ARGS)

lint: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy --python-version 3.10 --follow-imports silent $(ROBOT)
	$(BIN)/vermin --target=3.10- --violations --no-tips --exclude compression --exclude compression.zstd $(ROBOT)
	$(BIN)/lint-imports
	$(BIN)/python -c 'import json; from app.main import create_app; from app.config import Settings; print(json.dumps(create_app(Settings()).openapi()))' > app/web/openapi.json
	cd app/web && npm run --silent types >/dev/null && npm run --silent check
	UV_SYSTEM_CERTS=true UV_PROJECT_ENVIRONMENT=$(VENV) $(UV) lock --check --no-python-downloads

# The documentation, into build/docs: warnings are errors, links and anchors are checked.
docs: install-dev
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --config-file .mkdocs.yml $(ARGS)
	@echo "build/docs/index.html"

bench: install-dev
	@$(BIN)/python -m tests.bench $(ARGS)

# The web page in Chromium against its bounds; ARGS=--large adds a grid of 27 000 × 24 000 cells.
bench-web: install-dev
	@$(BIN)/python -m tests.bench.web $(ARGS)

# Kills of the server, the router and the database at random moments: 50 of each; `make test` does 4.
chaos: install-dev
	@FLEETMAP_CHAOS=$${FLEETMAP_CHAOS:-50} $(BIN)/python -m pytest -s tests/chaos $(ARGS)

# An hour of load with faults at random, against bounds: ARGS="--minutes 5 --seed 7 --sqlite".
soak: install-dev
	@$(BIN)/python -m tests.soak $(ARGS)

# Mutations of every sample through the read boundary, for some minutes: ARGS="--minutes 30 --seed 7 --format kml".
# First the property tests with 2000 examples each instead of 60, and more odd values of properties.
fuzz: install-dev
	@$(BIN)/python -m pytest -q -n auto -m hypothesis --hypothesis-profile fuzz
	@FLEETMAP_WORDS=50 $(BIN)/python -m pytest -q -n auto tests/hostile/test_property_types.py
	@FLEETMAP_FENCES=40 $(BIN)/python -m pytest -q -n auto tests/generate/test_fields.py -k random_fences
	@$(BIN)/python -m tests.hostile.fuzz $(ARGS)

# The two tables of docs/security.md: hostile input and faults.
figures: install-dev
	@$(BIN)/python -m tests.figures hostile $(ARGS)
	@$(BIN)/python -m tests.figures faults $(ARGS)

# Wheel, sdist, bill of materials, checksums and their signature (RELEASE_KEY), from the last commit, into build/release.
release: install-dev
	@.ci/release

# For machines without internet, into build/: wheels of uv.lock, container images if there is an engine, checksums, install.sh.
# ARGS="--processor aarch64 --python 3.12": for another machine; --robot: only the agent.
bundle: install
	@$(BIN)/python docker/make_bundle.py $(ARGS)

install: $(VENV)/.installed

install-dev: $(VENV)/.installed-dev

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed: make PYTHON=/path/to/it" if sys.version_info < (3, 11) else 0)'
	@echo "creating $(VENV) ..."
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "this Python has no venv module (Debian: apt install python3-venv)"; exit 1; }
	@test "$(UV)" = uv || $(BIN)/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)

$(VENV)/.installed: pyproject.toml uv.lock $(PAGE) | $(BIN)/python
	@echo "installing the packages of uv.lock, and building the web page ..."
	@$(SYNC) --no-dev --reinstall-package fleet-map-server
	@touch $@

$(VENV)/.installed-dev: pyproject.toml uv.lock $(PAGE) | $(BIN)/python
	@echo "installing the packages of uv.lock, and building the web page ..."
	@$(SYNC) --reinstall-package fleet-map-server
	@touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
