# Everything is set up once, in .venv: Python 3.11, make and a way to PyPI are all it takes.
#   make demo     identify, diagnose and tune on the packaged sample; reports go to demo_out/
#   make test     style, types, tests
#   make test-all the slow tests too; twenty minutes and more
#   make lint     style and types alone
#   make bench    speed, beside other ways of doing the same
#   make clean    remove what the others made

PYTHON ?= $(shell command -v python3.11 || echo python3)
BIN := .venv/bin

.PHONY: demo test test-all lint bench clean

demo: .venv/ready
	@$(BIN)/pmdc demo --out demo_out

# a file's tests stay in one process, where they share what JAX has compiled; in the order of their names, for by the
# number of tests the few long ones would come last, and alone
TESTS := $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

test: lint
	@$(TESTS)

test-all: lint
	@$(TESTS) -m ''

lint: .venv/ready
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/basedpyright --pythonpath $(BIN)/python

bench: .venv/ready-for-bench
	@$(BIN)/python -m benchmarks

clean:
	rm -rf .venv demo_out experiments/out build *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +

.venv/ready: pyproject.toml constraints.txt
	@echo "Setting up .venv; this happens once and takes a minute or two"
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[test]'
	@touch $@

.venv/ready-for-bench: .venv/ready
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[bench]'
	@touch $@
