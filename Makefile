# SPDX-License-Identifier: Apache-2.0
# make demo | demo-live | test | test-all | lint | bench | docs | studies | study-table1 | bags | clean
# Everything happens in $(VENV); PYTHON= chooses the interpreter that makes it (3.11 or later).

# On a sourced ROS 2 the environment is another one, which sees ROS and the NumPy it was built for.
VENV := .venv$(addprefix -,$(ROS_DISTRO))
PY := $(VENV)/bin/python
PIP := $(PY) -m pip install --quiet --disable-pip-version-check --prefer-binary
# Two processes with one BLAS thread each are faster on two cores than the reverse. What several
# tests of a file share is made once; bytecode is kept, for tests start the command many times.
PYTEST := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= \
  $(PY) -m pytest -n 2 --dist loadfile
PYTHON ?=
# Of the recordings of `make bench`: 300000 are files of 0.6 GB, and take three times as long.
BENCH_MESSAGES ?= 100000
PACKAGING := setup.py setup.cfg pyproject.toml $(wildcard ctsid_core/likelihood/kernel.c)

.PHONY: demo demo-live test test-all lint bench docs studies study-table1 bags clean
.DEFAULT_GOAL := demo

demo: $(VENV)/.installed
	@echo 'Identifying models along the example bag and comparing them with the truth ...'
	$(VENV)/bin/ctsid replay bags/quadrotor_roll --params config/quadrotor_roll.yaml \
	  --truth bags/quadrotor_roll_truth.json --out results/demo --force

demo-live: $(VENV)/.installed$(if $(ROS_DISTRO),,-ros)
	$(PY) -m ctsid_ros.examples.live_demo --params config/live_demo.yaml

test: $(VENV)/.installed-test $(VENV)/.tried-ros
	$(PYTEST) -m 'not slow'

test-all: $(VENV)/.installed-test $(VENV)/.tried-ros
	$(PYTEST)

lint: $(VENV)/.installed-dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

# Pages from declarations first; a link inside that leads nowhere, or any other warning, is an error.
docs: $(VENV)/.installed-docs
	@rm -rf build/docs
	$(PY) docs/generated.py
	$(PY) -m sphinx --builder html --fail-on-warning --keep-going --quiet --fresh-env \
	  --doctree-dir build/doctrees docs build/docs
	@echo 'The documentation is in build/docs/index.html.'

# Ten minutes on two cores; goes on where it was if it is interrupted.
studies: $(VENV)/.installed
	$(VENV)/bin/ctsid study all
	$(PY) -m ctsid_ros.studies.page docs/papers.md results/studies

study-table1: $(VENV)/.installed
	$(PY) -m ctsid_ros.studies.table1

bench: $(VENV)/.installed-bench $(VENV)/.tried-ros
	$(PY) benchmarks/floor.py
	$(PY) benchmarks/peers.py
	$(PY) benchmarks/bursty.py
	$(PY) benchmarks/methods.py
	$(PY) benchmarks/recordings.py --messages $(BENCH_MESSAGES)
	$(PY) benchmarks/node.py

bags: $(VENV)/.installed
	$(PY) bags/make_quadrotor_roll.py

clean:
	rm -rf .venv $(VENV) .venv-ci-* results build install log *.egg-info .mypy_cache .ruff_cache .pytest_cache
	rm -f ctsid_core/likelihood/_kernel.*
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(PY):
	python=$${PYTHON:-$$(.ci/find-python 3.12 3.11 3.13 3.14)} && \
	  "$$python" -m venv $(if $(ROS_DISTRO),--system-site-packages) $(VENV)

$(VENV)/.installed: $(PACKAGING) | $(PY)
	@echo 'Installing ctsid and what it needs into $(VENV) ...'
	$(PIP) --editable .
	@touch $@

# A sourced ROS 2 brings rclpy; else it comes from PyPI, which has it for Python 3.11 and 3.12 on
# Linux. Where there is none, the tests of the node are skipped and say so.
$(VENV)/.tried-ros: | $(VENV)/.installed
	@$(if $(ROS_DISTRO),true,$(MAKE) --no-print-directory $(VENV)/.installed-ros) || \
	  echo 'rclpy cannot be installed here: the tests of the node will be skipped.'
	@touch $@

# One rule for every set of extras of setup.py: .installed-test installs ctsid[test].
$(VENV)/.installed-%: $(PACKAGING) | $(PY)
	@echo 'Installing ctsid[$*] into $(VENV) ...'
	$(PIP) --editable '.[$*]'
	@touch $@ $(VENV)/.installed
