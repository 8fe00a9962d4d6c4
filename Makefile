# make demo   set up, then collect demos, train a teacher, distil it, evaluate both, and write a report
# make test   set up, then check style, types and tests (JOBS=4: in four processes in place of two)
# make setup  the environment .venv and a Vulkan device (FORCE=1: look at everything again; PYTHON=...: make it with that one)
# make lint   style and types alone
# make clean  remove what set-up made

PY := .venv/bin/python
JOBS ?= 2
export FORCE PYTHON

.PHONY: demo test setup lint clean

demo: setup
	$(PY) scripts/demo.py

test: setup
	$(MAKE) --no-print-directory lint
	$(PY) -m pytest -n $(JOBS)

setup:
	@scripts/setup.sh

lint: setup
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

clean:
	rm -rf .venv .vulkan .vulkan.new .mujoco_gl .mujoco_gl.new .setup-lock manicm_ms.egg-info build dist .mypy_cache \
		.ruff_cache .pytest_cache
