# From a bare Debian or Ubuntu machine with Python 3.11-3.13 to a result: `make demo`, `make test`.
# `make demo PYTHON=python3.12` chooses the interpreter; `make test PYTEST_ARGS="-k surface"` hands options to pytest.
.PHONY: demo test setup

# ROS and the like point these at another Python's packages.
unexport PYTHONPATH PYTHONHOME

demo: setup
	.venv/bin/unifusion reconstruct synthetic --out results/demo

test: setup
	.venv/bin/python -m pytest $(PYTEST_ARGS)

setup:
	@bash scripts/setup.sh
