PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: help venv sweep bench docs lint format test test-slow clean

help:  ## print this help
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/:/'

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test,lint,docs]'
	touch $@

venv: $(VENV)/.installed  ## make the virtual environment with the tested versions

sweep: venv  ## train td3, h-td3 and lstm-td3-1ha1hc on the rover: the quick preset
	$(BIN)/python -m rtd3jax.sweep --preset quick $(ARGS)

bench: venv  ## measure the speed, compared with PyTorch: 20 minutes; repeat it to continue
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]' \
		|| echo "PyTorch cannot be installed here"
	$(BIN)/python -m experiments.benchmarks.bench $(ARGS)

docs: venv  ## build the site: build/site/index.html
	$(BIN)/mkdocs build --strict --quiet

lint: venv  ## check formatting, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: venv  ## format, and fix what ruff can fix
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

test: lint  ## run lint and the whole test suite
	$(BIN)/pytest -n 2 --dist worksteal

test-slow: venv  ## run the slow tests
	$(BIN)/pytest -n 2 --dist worksteal -m slow

clean:  ## remove generated files (never runs/)
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis build *.egg-info
