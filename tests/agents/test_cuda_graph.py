"""Captured updates. With a GPU, the tests check the graph; without one, that updates need no GPU."""

import pickle

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.vec_env import VecFrameStack
from torch.utils._pytree import tree_map_only

from sb3_eqr.common.cuda_graph import CapturedUpdate
from tests.models import EITHER, all_finite, same
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
def test_an_update_reads_no_number_from_the_device(make, policy, network, monkeypatch):
    """The meta device has no numbers: reading one, or mixing in a CPU tensor, is an error. It has no fused Adam either."""
    kwargs = {"learning_starts": 1_000, "prioritized_replay": False, "max_grad_norm": None, "tau": 0.5}
    model = make(ENVS[policy](), policy, device="meta", policy_kwargs=network, **kwargs)
    model.replay_buffer.device = th.device("cpu")
    filler = make(ENVS[policy](), policy, learning_starts=1_000, prioritized_replay=False).learn(50)
    samples = filler.replay_buffer.sample(8)
    model.policy.set_training_mode(True)
    monkeypatch.setattr(model.policy.optimizer, "step", lambda: None)
    targets = {*model.policy.target.parameters(), *model.policy.latent_target.parameters()}
    model._trained = [p for p in model.policy.parameters() if p not in targets]  # PyTorch moves to meta by making new ones
    model._clipped = [model._trained]
    priorities, metrics = model._update(tree_map_only(th.Tensor, lambda value: value.to("meta"), samples))
    found = [priorities, *metrics.values(), *(p.grad for p in model._trained)]
    assert {tensor.device.type for tensor in found} == {"meta"} and len(metrics) > 8
    with pytest.raises(RuntimeError):
        metrics["loss"].item()


def same_within(a, b, tolerance):
    return all((x - y).abs().max() <= tolerance for x, y in zip(a.policy.parameters(), b.policy.parameters(), strict=True))


COUNTS = ["num_timesteps", "start_time", "exploration_rate"]  # numbers of an agent that are not settings


class Recorded(CapturedUpdate):
    """
    A stand-in for the graph on a CPU. As a graph does, a replay reads the inputs and learning rates from the tensors of its
    capture, writes its result there, and has the settings and trained parameters of that time; it is an error if the
    optimiser's state lies elsewhere by now.
    """

    captures = 0

    def _give_up(self, why):
        pass

    def _beside(self):
        return self._update(self._inputs)

    def _now(self):
        """Everything that the graph keeps: numbers of the agent, trained parameters, tensors of the optimiser."""
        values = vars(self._update.__self__).items()
        settings = {name: value for name, value in values if name[0] != "_" and isinstance(value, float | int | None)}
        tensors = [[id(tensor) for tensor in self._optimizer.state.get(p, {}).values()] for p in self._parameters]
        return settings | dict.fromkeys(COUNTS), [p.requires_grad for p in self._parameters], tensors

    def _capture(self):
        self.captures += 1
        self._graph, self._of_capture, self._result = self, self._now(), None
        return True

    def replay(self):
        assert self._now() == self._of_capture
        with self._capturable_optimizer():
            priorities, metrics = self._update(self._inputs)
        assert not any(isinstance(group["lr"], th.Tensor) or group["capturable"] for group in self._optimizer.param_groups)
        if self._result is None:
            self._result = priorities, metrics
        else:  # the tensors of the capture
            self._result[0].copy_(priorities)
            assert list(self._result[1]) == list(metrics)
            for name, value in metrics.items():
                self._result[1][name].copy_(value)


@pytest.fixture
def recorded(monkeypatch):
    monkeypatch.setattr("sb3_eqr.common.eqr_algorithm.CapturedUpdate", Recorded)


@EITHER
@pytest.mark.parametrize("kwargs", [{}, {"tau": 0.5}, {"target_update_interval": 8}], ids=str)
def test_a_run_needs_one_graph(make, kwargs, recorded):
    model = make(ChainEnv(), cuda_graph=True, learning_rate=lambda remaining: 1e-3 * remaining, **kwargs).learn(120)
    assert model._n_updates > 50 and model._captured.captures == 1


def changed_run(make, **kwargs):
    """
    A weight changes after 100 updates, the learning rate after 120, a network is frozen after 140, the target slows down
    after 180, gradients are clipped more after 190.
    """
    model = make(ChainEnv(), resets={"interval": 40}, tau=0.9, learning_rate=halved, **kwargs).learn(50)
    model._total_timesteps = 1_000  # as at the start of a longer run
    model.train(100 - model._n_updates, 8)
    model.aet_coef = 0.25
    model.train(20, 8)
    model._current_progress_remaining = 0.25
    model.train(20, 8)
    model.policy.freeze([model.policy.online.features_extractor])
    model.train(40, 8)
    model.tau = 0.5
    model.train(10, 8)
    model.max_grad_norm = 0.01
    model.train(20, 8)
    model._log_last_round()
    return model


def halved(progress_remaining):
    """A learning rate that float32 represents exactly, as the graph reads it in float32."""
    return 2**-10 if progress_remaining > 0.5 else 2**-11


@EITHER
def test_replays_equal_eager_updates_after_any_change(make, recorded):
    eager, replayed = changed_run(make), changed_run(make, cuda_graph=True)
    assert replayed._captured._graph is not None and replayed._resets.done == eager._resets.done == [40, 80, 120, 160, 200]
    assert replayed._captured.captures == 10  # one for each change but the learning rate's, and one for each reset
    assert same(eager, replayed)
    assert eager.logger.name_to_value == replayed.logger.name_to_value


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
    assert models[0]._resets.done == models[1]._resets.done == [40, 80, 120, 160, 200]
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
