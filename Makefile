# `make run` and `make test` do everything from a bare clone: Python >= 3.11, make and a C++ compiler are all they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# The benchmarks compare with other libraries, and the site needs Sphinx, which nothing else does: environments of their own.
BENCH_VENV := .venv-bench
BENCH_STAMP := $(BENCH_VENV)/.installed
DOCS_VENV := .venv-docs
DOCS_STAMP := $(DOCS_VENV)/.installed
RIVALS := stable-baselines3==2.9.2 sbx-rl==0.28.0 jax==0.10.2

# What a GPU needs: an environment beside the torch that is there, installed from the folder WHEELS where there is no network.
GPU_VENV := .venv-gpu
GPU_STAMP := $(GPU_VENV)/.installed
WHEELS ?=
GPU_PIP = $(GPU_VENV)/bin/python -m pip install --quiet --disable-pip-version-check $(if $(WHEELS),--no-index --find-links $(WHEELS),)

.PHONY: run test test-lowest test-highest lint types bench docs gpu clean

run: $(STAMP)
	$(BIN)/coim run half_cheetah --preset quick

# One thread: threads that wait for each other in tiny products collapse when another process wants the same cores.
# A process for each core instead, but no more than 4, as each takes 1.5 GB; the tests of a file stay together.
PROCESSES ?= -n auto --maxprocesses 4 --dist loadfile
test: lint types
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PROCESSES)

# The tests on the lowest versions that setup.cfg allows, and on the newest there are, each in an environment of its own.
# On another Python, torch, or on some tests: make test-lowest PYTHON=python3.13 TORCH=2.13.0 TESTS=tests/models
test-lowest: FLOORS = sed -nE 's/^ +([a-z-]+) >= ([0-9.]+)$$/\1==\2/p' setup.cfg | grep -v $(if $(TORCH),'^torch==','^$$')
test-highest: FLOORS = true
test-lowest test-highest: test-%:
	$(PYTHON) -m venv --clear .venv-$*
	{ $(FLOORS); } > .venv-$*/constraints.txt
	.venv-$*/bin/python -m pip install --quiet --disable-pip-version-check -c .venv-$*/constraints.txt "torch$(if $(TORCH),==$(TORCH))"
	.venv-$*/bin/python -m pip install --quiet --disable-pip-version-check -c .venv-$*/constraints.txt -e '.[experiments,dev]'
	.venv-$*/bin/python -m pip list --disable-pip-version-check
	OMP_NUM_THREADS=1 .venv-$*/bin/python -m pytest $(PROCESSES) $(TESTS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

bench: $(BENCH_STAMP)
	$(BENCH_VENV)/bin/python -m benchmarks

# Runs every tutorial and asks no network; DOCS=-Dplot_gallery=0 leaves the tutorials out. Then every internal link is followed.
docs: $(DOCS_STAMP)
	rm -rf docs/api/names  # or modules that are gone would keep their pages
	OMP_NUM_THREADS=1 $(DOCS_VENV)/bin/python -m sphinx -b html -W --keep-going -d docs/build/doctrees $(DOCS) docs docs/build/html
	$(DOCS_VENV)/bin/python docs/links.py docs/build/html

gpu:
	@$(PYTHON) benchmarks/missing.py
	@$(MAKE) --no-print-directory $(GPU_STAMP)
	$(GPU_VENV)/bin/python -m benchmarks.gpu

# torch first and alone, so that the pinned build is there before anything asks for "any torch".
$(STAMP): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and f"coim needs Python >= 3.11, $(PYTHON) is {sys.version.split()[0]}; try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$$(grep '^torch==' constraints.txt)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[experiments,dev]'
	@touch $@

$(BENCH_STAMP): setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv $(BENCH_VENV)
	$(BENCH_VENV)/bin/python -m pip install --quiet --disable-pip-version-check "$$(grep '^torch==' constraints.txt)"
	$(BENCH_VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[experiments]' $(RIVALS)
	@touch $@

$(DOCS_STAMP): setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv $(DOCS_VENV)
	$(DOCS_VENV)/bin/python -m pip install --quiet --disable-pip-version-check "$$(grep '^torch==' constraints.txt)"
	$(DOCS_VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[experiments,docs]'
	@touch $@

# torch, built for CUDA, is found where PYTHON has it, be that a system's folder or another environment's.
$(GPU_STAMP): setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv --system-site-packages $(GPU_VENV)
	$(PYTHON) -c 'import pathlib, torch; print(pathlib.Path(torch.__file__).parents[1])' > "$$($(GPU_VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/torch_there.pth"
	$(GPU_PIP) 'setuptools >= 68'
	$(GPU_PIP) --no-build-isolation -e '.[warp]' tyro pydantic pytest
	@touch $@

clean:
	rm -rf $(VENV) $(BENCH_VENV) $(DOCS_VENV) $(GPU_VENV) docs/build docs/gallery docs/api/names .venv-lowest .venv-highest *.egg-info .mypy_cache .ruff_cache .pytest_cache
