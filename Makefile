# Two commands do all the set-up: `make demo` and `make test`. `make help` lists the rest.
#
# The environment lives in .venv. Stamp files in it remember what was installed from which pyproject.toml and
# constraints.txt, so that it is made when missing and brought up to date when those files change.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := runs/demo
# Images of containers often forbid Python to keep what it compiled; every start of `esp` then takes twice as long.
export PYTHONDONTWRITEBYTECODE :=
PYTEST_ARGS ?= -n auto --maxprocesses 4 --dist worksteal --max-worker-restart 0

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow check bench docs site torture clean

help: ## list what make can do
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/.installed ## train one learner with symmetry and without it: curves and a film of both (2 minutes)
	$(BIN)/esp demo --out $(DEMO)

test: $(VENV)/.installed-test ## run the tests (12 minutes), but for those marked slow
	$(BIN)/python -m pytest -m "not slow" $(PYTEST_ARGS)

test-slow: $(VENV)/.installed-test ## run the tests marked slow (6 minutes)
	$(BIN)/python -m pytest -m slow $(PYTEST_ARGS)

check: $(VENV)/.installed-dev ## lint, format and types over every package
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(VENV)/.installed-test ## measure the speed of environments and training on this machine
	@found=0; for script in tests/benchmarks/*_speed.py; do \
	    [ -f "$$script" ] || continue; \
	    found=1; echo "== $$script"; $(BIN)/python "$$script" || exit 1; \
	done; \
	[ $$found = 1 ] || { echo "make: tests/benchmarks holds no *_speed.py" >&2; exit 1; }

docs: $(VENV)/.installed-test ## check the documentation: links lead somewhere, commands parse
	$(BIN)/python -m pytest tests/test_docs.py

site: $(VENV)/.installed-dev ## build the site of the documentation into site/, for reading without a network
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	@echo "Open site/index.html"

torture: $(VENV)/.installed-test ## kill, spoil and mistype for MINUTES (10); SEED chooses the cases, RECORD goes on
	$(BIN)/python -m tests.torture --minutes $(or $(MINUTES),10) --seed $(or $(SEED),$(shell date +%j)) $(if $(RECORD),--record "$(RECORD)")

clean: ## remove the demo run, builds and caches (runs and .venv stay)
	rm -rf $(DEMO) build dist site .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find esp_cli environments tests -name __pycache__ -type d -prune -exec rm -rf {} +

# --- the environment ---------------------------------------------------------------------------------------------

# torch comes first and alone, in the exact version that is pinned: a looser request could fetch another build.
# Python compiles what is imported, once; compiling all of it here would take half a minute.
define install
	@.ci/make-venv "$(PYTHON)" $(VENV)
	@echo "Installing $(1) into $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --no-compile "$$(grep '^torch==' constraints.txt)" \
	    && $(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e "$(1)" \
	    || { echo "make: installing failed; see pip's message above (is there a network connection and free disk?)" >&2; exit 1; }
	@.ci/install-osmesa $(BIN)/python
	@touch $@
endef

$(VENV)/.installed: pyproject.toml constraints.txt
	$(call install,.)

$(VENV)/.installed-test: pyproject.toml constraints.txt
	$(call install,.[test])
	@touch $(VENV)/.installed

$(VENV)/.installed-dev: pyproject.toml constraints.txt
	$(call install,.[dev])
	@touch $(VENV)/.installed $(VENV)/.installed-test
