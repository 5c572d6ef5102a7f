# `make demo` and `make test` need Python 3.11 (or 3.12: PYTHON=python3.12) and make, nothing else.

PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
EXTRAS := all,dev
# the last two need real recordings, in the folder that GREENHOUSE_GYM_REAL_DATA names
BENCHMARKS := sensing.reconstruction sensing.shapes sensing.paper_figures planning.planners speed.throughput \
	$(if $(GREENHOUSE_GYM_REAL_DATA),sensing.orbit sensing.real_data)

.PHONY: demo test test-ompl-2 test-rllib lint bench docs clean

demo: $(VENV)/.installed
	$(BIN)/greenhouse-gym demo --out demo

# a lost process of pytest-xdist ends the run: replacing it leaves 3.8.0 waiting forever
test: lint
	$(BIN)/python -m pytest -n 2 --dist loadgroup --max-worker-restart 0 -m "not slow"

# the planning tests with the other OMPL, which cannot be in the same environment
test-ompl-2:
	$(PYTHON) -m venv .venv-ompl-2
	.venv-ompl-2/bin/python -m pip install --quiet --constraint constraints.txt --editable . \
		pytest pytest-timeout pytest-xdist hypothesis matplotlib
	.venv-ompl-2/bin/python -m pip install --quiet ompl==2.0.1
	.venv-ompl-2/bin/python -m pytest tests/planning

# RLlib pins another Gymnasium than the rest
test-rllib:
	$(PYTHON) -m venv .venv-rllib
	.venv-rllib/bin/python -m pip install --quiet --constraint constraints.txt torch
	.venv-rllib/bin/python -m pip install --quiet --editable . "ray[rllib]==2.60.*" \
		pytest pytest-timeout pytest-xdist hypothesis
	.venv-rllib/bin/python -m pytest tests/learning/test_rllib.py

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.installed
	$(BIN)/python -m pytest -m slow
	for name in $(BENCHMARKS); do $(BIN)/python -m benchmarks.$$name || exit 1; done
	$(BIN)/python -m benchmarks.agents.trainings sac

# the site, in site/; strict: a warning, a dead link, or a page that loads anything from the network is an error
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) .venv-ompl-2 .venv-rllib demo runs site

# torch comes first and pinned: whatever depends on it then finds it and does not pull CUDA packages
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[$(EXTRAS)]"
	touch $@

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $@
