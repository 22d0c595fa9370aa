"""What depends on the instruction set, once more in a process that is limited to AVX2, as many laptops are.

One process for all of it: its start and its first compilation take most of the time.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from coim.products import kind_of_processor

ROOT = Path(__file__).parents[1]
LIMITS = {"ONEDNN_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"}
FILES = (
    "tests/test_products.py",
    "tests/models/test_stacked.py",
    "tests/objectives/test_gradients.py",
    "tests/objectives/test_dynamics_gradients.py",
    "tests/objectives/test_design.py",
    "tests/learners/test_native_sac_learner.py",
    "tests/learners/test_sac_learner.py",
    "tests/learners/test_dynamics_learner.py",
    "tests/experiments/run/test_choice_of_products.py",
)
KIND = "from coim.products import chosen, kind_of_processor; print(kind_of_processor(), *chosen())"


@pytest.mark.skipif("AVX-512" not in kind_of_processor(), reason="this process has no wider instructions to do without")
def test_what_depends_on_the_instruction_set_passes_without_avx_512() -> None:
    run = [sys.executable, "-c", f"{KIND}; import pytest, sys; sys.exit(pytest.main(sys.argv[1:]))", "-x", *FILES]
    # The suite is all right from any folder; torch reads these when it is loaded.
    found = subprocess.run(run, cwd=ROOT, env=os.environ | LIMITS, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout[-3000:] + found.stderr[-3000:]
    assert found.stdout.startswith("AVX2 torch emulated\n")
