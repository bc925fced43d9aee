"""Small agents of both algorithms, for tests that check both."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.envs import SimpleMultiObsEnv
from torch import nn

from sb3_eqr import EqRQRDQN, EqRRainbow
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from tests.toys import ChainEnv, ImageEnv

SMALL = {"learning_starts": 40, "buffer_size": 500, "batch_size": 8, "n_steps": 3, "prediction_depth": 2}
SMALL |= {"device": "cpu", "seed": 0}
N_ATOMS = 9

# policy_kwargs of the paper's network, without the changes of docs/gradients.md; PAPER_FLAT also has no trunk, for vectors.
PAPER = {"layer_norm": False, "head_input": "state", "latent_norm": "batch", "projection": "head"}
PAPER |= {"predictor": False, "latent_tau": None, "sigma_init": 0.5}
PAPER_FLAT = {**PAPER, "features_extractor_class": "flatten"}
# For tests that must pass with both networks.
NETWORKS = {"default": {}, "paper": PAPER}
BOTH = pytest.mark.parametrize("network", NETWORKS.values(), ids=NETWORKS.keys())


ENVS = [("MlpPolicy", ChainEnv), ("CnnPolicy", ImageEnv), ("MultiInputPolicy", SimpleMultiObsEnv)]
POLICIES = pytest.mark.parametrize("policy, env", ENVS)


@dataclass(frozen=True)
class Maker:
    """Makes small agents of one algorithm, and knows the names that differ between the algorithms."""

    algorithm: type[EqRAlgorithm]
    n_atoms_name: str

    def __call__(self, env, policy="MlpPolicy", **kwargs) -> EqRAlgorithm:
        network = {"net_arch": [32], "n_blocks": 3, "latent_hidden_dim": 16, self.n_atoms_name: N_ATOMS}
        policy_kwargs = {**network, **kwargs.pop("policy_kwargs", {})}
        return self.algorithm(policy, env, **{**SMALL, **kwargs}, policy_kwargs=policy_kwargs)


MAKERS = [Maker(EqRQRDQN, "n_quantiles"), Maker(EqRRainbow, "n_atoms")]

# For slow tests that do not depend on the head.
EITHER = pytest.mark.parametrize("make", MAKERS[1:], indirect=True, ids=["EqRRainbow"])


def tensors(part):
    """Copies of the tensors of an agent, a network, a state dict or a list of parameters, by name or number."""
    if isinstance(part, list):
        part = dict(enumerate(part))
    elif not isinstance(part, dict):
        part = getattr(part, "policy", part).state_dict()
    return {name: value.detach().clone() for name, value in part.items()}


def same(one, other):
    """Whether the tensors of two agents, networks, state dicts or lists of parameters are equal, bit for bit."""
    one, other = tensors(one), tensors(other)
    return one.keys() == other.keys() and all(th.equal(one[key], other[key]) for key in one)


def all_finite(model):
    """Whether all parameters of an agent are finite."""
    return all(th.isfinite(p).all() for p in model.policy.parameters())


def draw(buffer, n, seed=0, **kwargs):
    """Samples of a replay buffer, the same ones from buffers that should be equal."""
    np.random.seed(seed)
    return buffer.sample(n, **kwargs)


def loss_terms(model, samples):
    """The loss terms of an update on these samples."""
    return model.objective(samples, model.loss_coefs)


def untrained(model, before):
    """
    The names of the trainable parameters that equal those of the state dict ``before``. Batch norm subtracts the bias of the
    layer before it, so such a bias has no gradient, and may stay.
    """
    layers = [(name, m) for name, m in model.policy.named_modules() if isinstance(m, nn.Sequential) and len(m) > 1]
    without_gradient = {f"{name}.0.bias" for name, layer in layers if isinstance(layer[1], nn.BatchNorm1d)}
    trainable = {name: p for name, p in model.policy.named_parameters() if p.requires_grad and name not in without_gradient}
    return [name for name, parameter in trainable.items() if th.equal(before[name], parameter)]


def train_on(model, samples):
    """One update on the given samples."""
    model.replay_buffer.sample = lambda *args, **kwargs: samples
    try:
        model.train(1, len(samples.indices))
    finally:
        del model.replay_buffer.sample
