# make studio   set up what is missing, then serve the studio and print where
# make test     set up, then the checks and all tests
# make verify   the long checks, up to an hour
# make clean    remove what set-up made; never your data
#
# Everything is installed in .venv/. Debian packages are installed where this user may; elsewhere the line to
# run is printed, and what needs them is left out. A second run finds its stamps and starts at once.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.ONESHELL:

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
INSTALLED := .venv/.installed
WITH_TESTS := .venv/.with-tests
RENDERS := .venv/.renders
DEBIAN := libgomp1 libegl1 libgl1 libgl1-mesa-dri
PACKAGE := $(wildcard web_assets/package.json web_assets/package-lock.json)
LIBRARIES := $(if $(PACKAGE),web_assets/node_modules/.installed)

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: studio test check verify clean chromium

studio: $(INSTALLED) $(RENDERS) $(LIBRARIES)
	exec $(BIN)/studio serve

test: $(WITH_TESTS) $(RENDERS) $(LIBRARIES) chromium check
	$(BIN)/pytest -q -m "not verify" -n 2 --dist loadfile --ignore tests/browser
	$(BIN)/pytest -q -m "not verify" tests/browser  # each needs the cores for itself

verify: $(WITH_TESTS) $(RENDERS)
	$(BIN)/pytest -m verify

check: $(WITH_TESTS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf .venv web_assets/node_modules *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +

$(INSTALLED): pyproject.toml Makefile
	@refuse() { echo "Comp-ACT Studio needs Python 3.11 to 3.13; $$1."; exit 1; }
	[ -n "$(PYTHON)" ] || refuse "there is no python3 here"
	$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' \
	    || refuse "$(PYTHON) is $$($(PYTHON) --version)"
	$(PYTHON) -c 'import ensurepip, venv' 2> /dev/null || .ci/install "virtual environment" $(DEBIAN) \
	    "$$($(PYTHON) -c 'import sys; print("python3.%d-venv" % sys.version_info[1])')"
	[ -e $(BIN)/pip ] || $(PYTHON) -m venv --clear .venv
	echo "Installing Comp-ACT Studio in .venv; the first time takes some minutes."
	$(BIN)/pip install --quiet --editable .
	$(BIN)/python -c 'import pinocchio' 2> /dev/null || .ci/install "library of Pinocchio" $(DEBIAN)
	touch $@

$(WITH_TESTS): $(INSTALLED)
	@echo "Installing what the tests need."
	$(BIN)/pip install --quiet --editable '.[test]'
	touch $@

# The stamps of these appear only where it works; elsewhere every run tries again.

$(RENDERS): $(INSTALLED)
	@renders() { $(BIN)/python -c 'import sys; from studio.doctor import render_backend as b; sys.exit(not b())'; }
	if renders || { .ci/install "offscreen rendering" $(DEBIAN) && renders; }; then touch $@; fi

web_assets/node_modules/.installed: $(PACKAGE)
	@command -v npm > /dev/null || .ci/install "web page" nodejs npm || exit 0
	npm ci --prefix web_assets --ignore-scripts --no-audit --no-fund
	mkdir -p $(@D) && touch $@

chromium:
	@command -v chromium chromium-browser google-chrome > /dev/null || .ci/install "browser for tests" chromium || true
