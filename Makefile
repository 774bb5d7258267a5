# From a bare Debian or Ubuntu machine with Python 3.11-3.13 to a result: `make demo`, `make test`.
# `make demo PYTHON=python3.12` chooses the interpreter; `make test PYTEST_ARGS="-k surface"` hands options to pytest.
# WORKERS processes share the tests, a file at a time, so that fixtures of a file are made once; each takes 1 to 2 GB.
.PHONY: demo test fuzz debug soak viewers validator lint types format setup

WORKERS ?= 2

# ROS and the like point these at another Python's packages.
unexport PYTHONPATH PYTHONHOME

demo:
	@bash scripts/setup.sh demo
	.venv/bin/unifusion reconstruct synthetic --out results/demo
	@echo
	@echo "To look at it in the browser: .venv/bin/unifusion view results/demo"

test: setup
	.venv/bin/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

# Every reader of files gets 20,000 mutated ones, recordings and lists of poses 2,000; FUZZ="-k png" chooses.
fuzz: setup
	UNIFUSION_FUZZ=20000 .venv/bin/python -m pytest -n $(WORKERS) tests/fuzz/test_fuzz.py $(FUZZ)
	UNIFUSION_FUZZ=2000 .venv/bin/python -m pytest -n $(WORKERS) tests/fuzz/test_readers.py tests/fuzz/test_phones.py $(FUZZ)

# Kernels of maps, tracking and pictures with checks of every index and sum: half a minute.
debug: setup
	UNIFUSION_DEBUG_KERNELS=1 .venv/bin/python -m pytest tests/maps/test_debug_mode.py

# Ten thousand frames of one scene: memory must not grow.
soak: setup
	.venv/bin/python benchmarks/soak.py

# Chromium, a screen in memory and Vulkan in software, for the tests of pages and windows; without them these skip.
viewers:
	@bash scripts/viewers.sh

# Khronos's validator, for the tests of GLB files; without npm or a network they skip.
validator: setup
	@npm install --silent --no-save --prefix .venv gltf-validator@2.0.0-dev.3.10 || \
		echo "validator: npm cannot install gltf-validator; the tests that ask it are skipped" >&2

lint: setup
	.venv/bin/ruff check
	.venv/bin/ruff format --check

types: setup
	.venv/bin/basedpyright --pythonpath .venv/bin/python --level error

format: setup
	.venv/bin/ruff check --fix
	.venv/bin/ruff format

setup:
	@bash scripts/setup.sh
