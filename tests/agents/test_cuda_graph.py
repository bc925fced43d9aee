"""Captured updates. With a GPU, the tests check the graph; without one, that updates need no GPU."""

import pickle

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.vec_env import VecFrameStack
from torch.utils._pytree import tree_map_only

from sb3_eqr.common.cuda_graph import CapturedGradients
from tests.models import EITHER, all_finite, loss_terms, same
from tests.toys import ChainEnv, ImageEnv

ENVS = {
    "MlpPolicy": lambda: make_vec_env(ChainEnv, 2),
    "CnnPolicy": lambda: VecFrameStack(make_vec_env(ImageEnv, 2), 4),
    "MultiInputPolicy": lambda: np.random.seed(0) or SimpleMultiObsEnv(channel_last=True),  # its constructor draws the images
}
POLICIES = pytest.mark.parametrize("policy", ENVS)
NEEDS_GPU = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")


@EITHER
def test_without_a_gpu_updates_are_eager_and_a_warning_says_why(make):
    eager = make(ChainEnv()).learn(46)
    with pytest.warns(UserWarning, match="updates run eagerly, because a CUDA graph needs a GPU.* 'cpu'") as caught:
        asked = make(ChainEnv(), cuda_graph=True).learn(46)
    assert len([w for w in caught if "cuda_graph" in str(w.message)]) == 1 and asked._n_updates == 12
    assert same(eager, asked)
    with pytest.warns(UserWarning, match="cuda_graph"):
        copy = pickle.loads(pickle.dumps(asked))
    assert copy.cuda_graph and copy._captured is not None


@pytest.mark.parametrize(
    "network", [{}, {"group": "GL(2)", "whiten": True, "aet_loss": "contrastive"}], ids=["default", "whitened"]
)
@POLICIES
def test_the_objective_reads_no_number_from_the_device(make, policy, network):
    """The meta device has no numbers: reading one, or mixing in a CPU tensor, is an error."""
    model = make(ENVS[policy](), policy, device="meta", policy_kwargs=network, learning_starts=1_000, prioritized_replay=False)
    model.replay_buffer.device = th.device("cpu")
    filler = make(ENVS[policy](), policy, learning_starts=1_000, prioritized_replay=False).learn(50)
    samples = filler.replay_buffer.sample(8)
    model.policy.set_training_mode(True)
    terms = loss_terms(model, tree_map_only(th.Tensor, lambda value: value.to("meta"), samples))
    terms.loss.backward()
    model.policy.update_target(0.5)
    gradients = [p.grad for p in model.policy.parameters() if p.grad is not None]
    assert {g.device.type for g in gradients} == {"meta"} == {terms.priorities.device.type}
    assert len(gradients) == len(model._trained)
    with pytest.raises(RuntimeError):
        terms.loss.item()


def same_within(a, b, tolerance):
    return all((x - y).abs().max() <= tolerance for x, y in zip(a.policy.parameters(), b.policy.parameters(), strict=True))


class Recorded(CapturedGradients):
    """
    A stand-in for the graph on a CPU. As a graph does, a replay reads the inputs' tensors and writes the gradients' tensors
    of its capture, with the weights and the trained parameters of that time.
    """

    captures = 0

    def _give_up(self, why):
        pass

    def _beside(self, coefs):
        return self._eager(self._inputs, coefs)

    def _capture(self, coefs):
        self.captures += 1
        self._graph, self._of_capture = self, (coefs, [p.requires_grad for p in self._parameters])
        self._gradients = [th.zeros_like(p) if p.requires_grad else None for p in self._parameters]
        return True

    def replay(self):
        coefs, trained = self._of_capture
        now = [p.requires_grad for p in self._parameters]
        grads = [p.grad for p in self._parameters]
        for parameter, was_trained in zip(self._parameters, trained, strict=True):
            parameter.requires_grad_(was_trained)
        self._terms = self._eager(self._inputs, coefs)
        for parameter, gradient, of_before, is_trained in zip(self._parameters, self._gradients, grads, now, strict=True):
            if gradient is not None:
                gradient.copy_(parameter.grad)
            parameter.grad = of_before
            parameter.requires_grad_(is_trained)


@EITHER
@pytest.mark.parametrize("kwargs", [{}, {"tau": 0.5}, {"target_update_interval": 8}], ids=str)
def test_a_run_needs_few_graphs(make, kwargs, monkeypatch):
    monkeypatch.setattr("sb3_eqr.common.eqr_algorithm.CapturedGradients", Recorded)
    model = make(ChainEnv(), cuda_graph=True, **kwargs).learn(120)
    assert model._n_updates > 50 and 1 <= model._captured.captures <= 2


def changed_run(make, **kwargs):
    """A weight changes after 100 updates and a network is frozen after 140, both halfway between two resets."""
    model = make(ChainEnv(), resets={"interval": 40}, tau=0.9, **kwargs).learn(50)
    model._total_timesteps = 1_000  # as at the start of a longer run
    model.train(100 - model._n_updates, 8)
    model.aet_coef = 0.25
    model.train(40, 8)
    model.policy.freeze([model.policy.online.features_extractor])
    model.train(40, 8)
    return model


@EITHER
def test_replays_use_the_samples_weights_and_parameters_of_their_call(make, monkeypatch):
    monkeypatch.setattr("sb3_eqr.common.eqr_algorithm.CapturedGradients", Recorded)
    eager, replayed = changed_run(make), changed_run(make, cuda_graph=True)
    assert replayed._captured._graph is not None and replayed._resets.done == eager._resets.done == [40, 80, 120, 160]
    assert same(eager, replayed)


@pytest.mark.gpu
@NEEDS_GPU
@POLICIES
def test_captured_updates_equal_eager_ones_to_rounding(make, policy):
    models = [make(ENVS[policy](), policy, device="cuda", cuda_graph=asked).learn(120) for asked in (False, True)]
    assert models[1]._captured.failure is None and models[1]._captured._graph is not None
    assert models[0]._n_updates == models[1]._n_updates >= 30
    assert same_within(*models, 1e-4)


@pytest.mark.gpu
@NEEDS_GPU
def test_changes_that_a_graph_depends_on_recapture_it(make):
    models = [changed_run(make, device="cuda", cuda_graph=asked) for asked in (False, True)]
    assert models[0]._resets.done == models[1]._resets.done == [40, 80, 120, 160]
    assert models[1]._captured.failure is None and same_within(*models, 1e-4)


@pytest.mark.gpu
@NEEDS_GPU
def test_updates_that_cannot_be_captured_run_eagerly(make):
    """A matrix exponential reads a number back."""
    network = {"group": "SO(3)", "parameterization": "exp"}
    with pytest.warns(UserWarning, match="cuda_graph: updates run eagerly, because"):
        model = make(ChainEnv(), device="cuda", cuda_graph=True, policy_kwargs=network).learn(80)
    assert model._captured.failure is not None and model._n_updates == 80
    assert all_finite(model)
