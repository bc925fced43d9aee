"""The linear probes of agents."""

import json

import numpy as np
import pytest
import torch as th

from experiments.probes import explained, make, probe
from sb3_eqr import EqRQRDQN
from tests.toys import ImageEnv


def test_probing_changes_nothing_and_separates_trunk_and_group():
    """The target is a linear function of the trunk's features: R² is 1 for them, less for 2 blocks of SO(2)."""
    network = {
        "group": "SO(2)",
        "n_blocks": 2,
        "whiten": True,
        "head_input": "state",
        "features_extractor_kwargs": {"features_dim": 8},
    }
    settings = {"learning_starts": 20, "buffer_size": 60, "batch_size": 8, "symmetry_coef": 0.0, "seed": 0}
    model = EqRQRDQN("CnnPolicy", ImageEnv(), **settings, policy_kwargs={**network, "projection": "none"}).learn(40)
    rng = np.random.default_rng(0)
    seen = rng.integers(0, 256, (6_000, 1, 36, 36), dtype=np.uint8)
    with th.no_grad():
        trunk = model.policy.online.features_extractor.trunk.eval()
        known = trunk(th.as_tensor(seen) / 255).double().numpy() @ rng.normal(size=8)
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    model.policy.train()
    found = probe(model, (seen, {"target": known}))
    assert json.dumps(list(found)) == '["trunk", "state"]'
    assert found["trunk"]["target"] > 0.95 and found["state"]["target"] < found["trunk"]["target"] - 0.02
    assert all(th.equal(value, before[key]) for key, value in model.policy.state_dict().items())
    assert model.policy.training


def test_r2_of_noise():
    """Two inputs with weights 3 and 4 and noise of variance 25: R² is 25 / 50."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(6_000, 2))
    assert explained(x, x @ [3.0, 4.0] + 5 * rng.normal(size=6_000)) == pytest.approx(0.5, abs=0.04)


def test_agents_of_the_benchmark_are_probed():
    """In random states of the torus, whose position untrained features hold."""
    model = make("eqr_qrdqn:experiments/settings/worlds.yml:plain", "torus", 0, 0)
    assert model.depth == 0 and model.n_steps == 3 and model.get_env().envs[0].unwrapped.n_steps == 16
