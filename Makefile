PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: help venv sweep bench docs lint format test test-slow clean

help:  ## these lines
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/:/'

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test,lint,docs]'
	touch $@

venv: $(VENV)/.installed  ## the environment, at the tested versions

sweep: venv  ## train td3, h-td3 and lstm-td3-1ha1hc on the slipping rover: the quick preset
	$(BIN)/python -m rtd3jax.sweep --preset quick $(ARGS)

bench: venv  ## how fast it is here, beside PyTorch: 20 minutes; the same command goes on
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]' \
		|| echo "PyTorch cannot be installed here"
	$(BIN)/python -m experiments.benchmarks.bench $(ARGS)

docs: venv  ## the documentation's site: build/site/index.html
	$(BIN)/mkdocs build --strict --quiet

lint: venv  ## formatting, lint, types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: venv  ## mend what ruff can mend
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

test: lint  ## lint and the whole test suite
	$(BIN)/pytest -n 2 --dist worksteal

test-slow: venv  ## the tests that are too slow for every change
	$(BIN)/pytest -n 2 --dist worksteal -m slow

clean:  ## remove what can be made again (never runs/)
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis build *.egg-info
