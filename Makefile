# `make run` and `make test` do everything from a bare clone: Python >= 3.11, make and a C++ compiler are all they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# The benchmarks compare with other libraries, which nothing else needs: an environment of their own.
BENCH_VENV := .venv-bench
BENCH_STAMP := $(BENCH_VENV)/.installed
RIVALS := stable-baselines3==2.9.2 sbx-rl==0.28.0 jax==0.10.2

.PHONY: run test lint types bench clean

run: $(STAMP)
	$(BIN)/python -m recipes.half_cheetah --preset quick

# One thread: threads that wait for each other in tiny products collapse when another process wants the same cores.
test: lint types
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

bench: $(BENCH_STAMP)
	$(BENCH_VENV)/bin/python -m benchmarks

# torch first and alone, so that the pinned build is there before anything asks for "any torch".
$(STAMP): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and f"coim needs Python >= 3.11, $(PYTHON) is {sys.version.split()[0]}; try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$$(grep '^torch==' constraints.txt)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[recipes,study,dev]'
	@touch $@

$(BENCH_STAMP): setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv $(BENCH_VENV)
	$(BENCH_VENV)/bin/python -m pip install --quiet --disable-pip-version-check "$$(grep '^torch==' constraints.txt)"
	$(BENCH_VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[recipes]' $(RIVALS)
	@touch $@

clean:
	rm -rf $(VENV) $(BENCH_VENV) *.egg-info .mypy_cache .ruff_cache .pytest_cache
