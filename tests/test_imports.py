"""Importing salver is cheap and silent: nothing heavy is loaded until it is needed."""

import json
import subprocess
import sys

import pytest

HEAVY = (
    "casadi",
    "coal",
    "matplotlib",
    "mujoco",
    "numpy",
    "pinocchio",
    "piqp",
    "pyarrow",
    "pydantic",
    "rosbags",
    "scipy",
    "trimesh",
)


def _run(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return json.loads(done.stdout)


@pytest.mark.parametrize("module", ["salver", "salver.cli"])
def test_importing_loads_nothing_heavy(module):
    loaded = _run(f"import json, sys; import {module}; print(json.dumps(sorted(sys.modules)))")
    assert module in loaded
    assert not set(HEAVY) & set(loaded)


def test_importing_changes_no_global_state():
    code = """
import json, random, sys, warnings
import numpy as np
before = (np.geterr(), np.get_printoptions(), random.getstate(), np.random.get_state()[1].tolist(), warnings.filters[:])
import salver, salver.cli, salver.scenario
after = (np.geterr(), np.get_printoptions(), random.getstate(), np.random.get_state()[1].tolist(), warnings.filters[:])
print(json.dumps(before == after))
"""
    assert _run(code) is True
