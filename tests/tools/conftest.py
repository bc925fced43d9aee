"""Fixtures for tests of the command line and of environments that have an id."""

import sys

import gymnasium as gym
import pytest

from sb3_eqr import cli


@pytest.fixture
def sb3_eqr(monkeypatch, capfd):
    """Runs a command line, which must exit with ``code``, and returns what it prints, (out, err)."""

    def call(line, code=0):
        monkeypatch.setattr(sys, "argv", ["sb3-eqr", *line.split()])
        try:
            cli.main()
            left = 0
        except SystemExit as stopped:
            left = stopped.code
        shown = capfd.readouterr()
        assert left == code, shown
        return shown

    return call


@pytest.fixture
def register(monkeypatch):
    """Registers an environment until the end of the test, and returns its id."""

    def call(env_id, make):
        monkeypatch.setitem(gym.registry, env_id, gym.envs.registration.EnvSpec(env_id, entry_point=make))
        return env_id

    return call


@pytest.fixture
def own_extractor(tmp_path, monkeypatch):
    """A features extractor that only the user's module has, as an expression of ``policy_kwargs``."""
    code = "from stable_baselines3.common.torch_layers import FlattenExtractor\nclass Mine(FlattenExtractor): pass\n"
    (tmp_path / "my_extractor.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    return "dict(group=None, net_arch=[8], features_extractor_class=__import__('my_extractor').Mine)"
