"""What users get besides the code: extras, docstrings, the command."""

import inspect
import os
import pathlib
import re
import subprocess
import sys

import pytest

import sb3_eqr
from sb3_eqr import EqRQRDQN, EqRRainbow
from sb3_eqr.common.latent.options import LatentOptions
from sb3_eqr.common.policies import EqRPolicy
from sb3_eqr.envs import make_atari100k_env

ROOT = pathlib.Path(__file__).parents[2]


EXTRAS = ("ale_py", "cv2", "matplotlib", "rl_zoo3", "ray", "rliable")


@pytest.mark.slow
@pytest.mark.parametrize(
    "missing, modules",
    [
        (EXTRAS, "sb3_eqr, sb3_eqr.envs, sb3_eqr.representation"),
        (EXTRAS[3:], "sb3_eqr.visualize.loading"),  # figures need no RL Zoo
    ],
)
def test_importing_works_without_extras(missing, modules):
    code = f"import sys; sys.modules.update(dict.fromkeys({missing})); import {modules}"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_missing_extras_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ale_py", None)
    with pytest.raises(ImportError, match=re.escape('pip install ".[atari]" in a clone of the repository')):
        make_atari100k_env("Pong")


def test_public_names_and_docstrings():
    for name in sb3_eqr.__all__:
        assert getattr(sb3_eqr, name).__doc__
    assert re.fullmatch(r"\d+\.\d+\.\d+", sb3_eqr.__version__)


@pytest.mark.parametrize("algorithm", [EqRQRDQN, EqRRainbow])
def test_every_argument_is_documented(algorithm):
    """help() has the arguments of the agent and of its policy, each once."""
    policy = algorithm.policy_aliases["MlpPolicy"]
    for callables in ([algorithm.__init__], [policy.__init__, EqRPolicy.__init__]):
        text = "".join(documented.__doc__ or "" for documented in (*callables, policy, EqRPolicy, LatentOptions))
        names = {name for function in callables for name in inspect.signature(function).parameters}
        for name in names - {"self", "kwargs"}:
            assert f":param {name}:" in text, name


@pytest.mark.parametrize("chosen", [None, pytest.param("ACTIVE", marks=pytest.mark.slow)])
def test_the_command_lets_waiting_threads_sleep_before_pytorch_is_loaded(chosen):
    """OpenMP reads the variable once, when PyTorch loads it. The user's choice is kept."""
    code = "import sys, os, atexit, sb3_eqr_command as command; print('torch' in sys.modules); sys.argv = ['', '--help']; "
    code += "atexit.register(lambda: print(os.environ['OMP_WAIT_POLICY'])); command.main()"
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {"OMP_WAIT_POLICY": chosen} if chosen else {}
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    lines = found.stdout.splitlines()
    assert lines[0] == "False" and lines[-1] == (chosen or "PASSIVE") and "usage" in found.stdout


def test_the_module_of_the_command_runs_it():
    found = subprocess.run([sys.executable, "-m", "sb3_eqr.cli", "--version"], capture_output=True, text=True, check=True)
    assert found.stdout.startswith("sb3_eqr ")
