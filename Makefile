# `make run` and `make test` do everything from a bare clone: Python >= 3.11, make and a C++ compiler are all they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# The benchmarks compare with other libraries, which nothing else needs: an environment of their own.
BENCH_VENV := .venv-bench
BENCH_STAMP := $(BENCH_VENV)/.installed
RIVALS := stable-baselines3==2.9.2 sbx-rl==0.28.0 jax==0.10.2

.PHONY: run test test-lowest test-highest lint types bench clean

run: $(STAMP)
	$(BIN)/python -m recipes.half_cheetah --preset quick

# One thread: threads that wait for each other in tiny products collapse when another process wants the same cores.
test: lint types
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest

# The tests on the lowest versions that setup.cfg allows, and on the newest there are, each in an environment of its own.
# On another Python, torch, or on some tests: make test-lowest PYTHON=python3.13 TORCH=2.13.0 TESTS=tests/models
test-lowest: FLOORS = sed -nE 's/^ +([a-z-]+) >= ([0-9.]+)$$/\1==\2/p' setup.cfg | grep -v $(if $(TORCH),'^torch==','^$$')
test-highest: FLOORS = true
test-lowest test-highest: test-%:
	$(PYTHON) -m venv --clear .venv-$*
	{ $(FLOORS); } > .venv-$*/constraints.txt
	.venv-$*/bin/python -m pip install --quiet --disable-pip-version-check -c .venv-$*/constraints.txt "torch$(if $(TORCH),==$(TORCH))"
	.venv-$*/bin/python -m pip install --quiet --disable-pip-version-check -c .venv-$*/constraints.txt -e '.[recipes,study,dev]'
	.venv-$*/bin/python -m pip list --disable-pip-version-check
	OMP_NUM_THREADS=1 .venv-$*/bin/python -m pytest $(TESTS)

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
	rm -rf $(VENV) $(BENCH_VENV) .venv-lowest .venv-highest *.egg-info .mypy_cache .ruff_cache .pytest_cache
