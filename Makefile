# From a bare Debian or Ubuntu machine with Python 3.11-3.13 to a result: `make demo`, `make test`.
# `make demo PYTHON=python3.12` chooses the interpreter; `make test PYTEST_ARGS="-k surface"` hands options to pytest.
.PHONY: demo test lint format setup

# ROS and the like point these at another Python's packages.
unexport PYTHONPATH PYTHONHOME

demo: setup
	.venv/bin/unifusion reconstruct synthetic --out results/demo

test: setup
	.venv/bin/python -m pytest $(PYTEST_ARGS)

lint: setup
	.venv/bin/ruff check
	.venv/bin/ruff format --check

format: setup
	.venv/bin/ruff check --fix
	.venv/bin/ruff format

setup:
	@bash scripts/setup.sh
