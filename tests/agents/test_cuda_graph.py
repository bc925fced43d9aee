"""The fast ways of an update: captured, overlapped, in bfloat16. Those that need a GPU are checked as far as a CPU goes."""

import contextlib
import copy
import subprocess
import sys

import numpy as np
import pytest
import torch as th
from sb3_eqr.common.captured_update import CapturedUpdate, StaticInputs
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_eqr.common.replay.buffers import SequenceReplayBuffer
from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples
from tests.models import EITHER
from tests.toys import ChainEnv, ImageEnv

ENVS = {
    "MlpPolicy": lambda: make_vec_env(ChainEnv, 2),
    "CnnPolicy": lambda: VecFrameStack(make_vec_env(ImageEnv, 2), 4),
    "MultiInputPolicy": lambda: np.random.seed(0) or SimpleMultiObsEnv(channel_last=True),  # draws its images when it is made
}


class FakeGraph:
    """What a CUDA graph does, on a CPU: to replay is to run what was captured, on the same tensors."""

    def __init__(self):
        self.replays = 0

    def replay(self):
        self.replays += 1
        new = self.function()
        for name, tensor in self.outputs.items():
            tensor.copy_(new[name])


@pytest.fixture
def fake_cuda(monkeypatch):
    """Captures are recorded instead of made; ``refuse`` holds an error that the next one raises."""
    made, refuse = [], []

    @contextlib.contextmanager
    def capture(graph):
        made.append(graph)
        if refuse:
            raise refuse.pop()
        yield

    def record(self, recorded):
        graph = FakeGraph()
        try:
            with self._capturable_optimizer(), capture(graph):
                assert all(group["capturable"] for group in self._optimizer.param_groups)
                graph.function = lambda: self._function(recorded.inputs.tensors)
        except RuntimeError as error:
            self.give_up(error)
            return
        recorded.graph = graph

        def first():  # its outputs are where later replays write
            recorded.outputs = graph.outputs = graph.function()
            graph.replays += 1
            del graph.replay

        graph.replay = first

    monkeypatch.setattr(CapturedUpdate, "_capture", record)
    monkeypatch.setattr(CapturedUpdate, "_run", lambda self, recorded: self._function(recorded.inputs.tensors))
    return made, refuse


def as_on_a_gpu(model, monkeypatch):
    monkeypatch.setattr(model, "_captures", lambda: model._captured.failure is None)
    return model


def assert_same(a, b):
    assert a._n_updates == b._n_updates > 20
    for (name, x), (_, y) in zip(a.policy.state_dict().items(), b.policy.state_dict().items(), strict=True):
        assert th.equal(x, y), name
    np.testing.assert_array_equal(a.replay_buffer._tree._leaves, b.replay_buffer._tree._leaves)


@pytest.mark.parametrize("policy", ENVS)
def test_captured_updates_are_the_same_updates(make, policy, monkeypatch, fake_cuda):
    """By indices and frames on the device, static inputs and static outputs: to the last bit, losses in the log included."""
    settings = {"buffer_size": 60, "learning_starts": 40}  # the ring comes round: frames are overwritten
    eager = make(ENVS[policy](), policy, **settings).learn(80)
    captured = as_on_a_gpu(make(ENVS[policy](), policy, **settings), monkeypatch).learn(80)
    assert_same(eager, captured)
    assert 1 <= len(fake_cuda[0]) <= 3  # another one where a store has grown
    logged = [model.logger.name_to_value for model in (eager, captured)]
    assert {k: v for k, v in logged[0].items() if "loss" in k} == {k: v for k, v in logged[1].items() if "loss" in k}


@EITHER
def test_what_changes_a_graph_is_captured_again(make, monkeypatch, fake_cuda):
    """n moves (another number of frames is not looked at), the head is reset, a weight is changed by a callback."""
    settings = {"initial_n_steps": 6, "n_steps": 3, "annealing_steps": 30, "reset_interval": 40, "tau": 0.9}
    graphs, models = [], []
    for captures in (False, True):
        model = make(ChainEnv(), **settings)
        model = as_on_a_gpu(model, monkeypatch) if captures else model
        model.learn(90)
        graphs.append(len(fake_cuda[0]))
        model.aet_coef = 0.25
        model.lr_schedule = lambda progress: 3e-3  # read at each replay, no reason for another graph
        models.append(model.learn(40, reset_num_timesteps=False))
    eager, captured = models
    assert eager._resets == captured._resets != []
    assert_same(eager, captured)
    assert graphs[0] == 0 and 2 <= graphs[1] < len(fake_cuda[0])  # before and after the reset, and with the other weight
    assert all(isinstance(g["lr"], float) and not g["capturable"] for g in captured.policy.optimizer.param_groups)


@EITHER
@pytest.mark.parametrize(
    "change",
    [
        lambda model: model.policy.latent_model.transition.requires_grad_(False),  # as train_representation does for a while
        lambda model: model.policy.freeze([model.policy.online.features_extractor]),
        lambda model: setattr(model, "bf16", True),
        lambda model: setattr(model, "tau", 0.5),
        lambda model: setattr(model, "reward_coef", 0.0),
        lambda model: model.policy.optimizer.load_state_dict(copy.deepcopy(model.policy.optimizer.state_dict())),
        lambda model: setattr(model, "replay_buffer", copy.deepcopy(model.replay_buffer)),
        lambda model: setattr(model.replay_buffer, "prediction_depth", 1),
    ],
)
def test_what_a_graph_would_hold_fast_is_in_its_key(make, monkeypatch, fake_cuda, change):
    """A real graph, unlike the fake one, would go on as it was."""
    model = as_on_a_gpu(make(ChainEnv(), tau=0.9), monkeypatch).learn(60)
    model.replay_buffer.update_device_frames()

    def key():
        places = model.replay_buffer.update_device_frames()
        return places, model._constants(), {k: a.shape for k, a in model.replay_buffer.draw(8).items()}

    assert key() == key()
    before = key()
    change(model)
    assert key() != before


@EITHER
def test_few_graphs_are_kept(make, monkeypatch, fake_cuda):
    model = as_on_a_gpu(make(ChainEnv(), tau=0.9), monkeypatch).learn(60)
    for coef in np.linspace(0.1, 1, 9):  # as a callback may anneal it
        model.aet_coef = coef
        model.train(1, 8)
    assert len(model._captured._captures) == CapturedUpdate.KEPT


@EITHER
def test_losses_that_come_and_go_keep_their_names(make, monkeypatch, fake_cuda):
    model = as_on_a_gpu(make(ChainEnv(), tau=0.9), monkeypatch).learn(60)
    for symmetry_coef, has_get in ((0.0, False), (1.0, True), (0.0, False)):
        model.symmetry_coef = symmetry_coef
        model.train(6, 8)
        assert ("symmetry_loss" in model._monitor.collect()) == has_get


@EITHER
def test_what_cannot_be_captured_runs_as_it_is(make, monkeypatch, fake_cuda):
    try:
        try:
            raise ValueError("no graph today")
        finally:
            raise RuntimeError("something went wrong before")
    except RuntimeError as error:
        fake_cuda[1].append(error)
    eager = make(ChainEnv()).learn(100)
    with pytest.warns(UserWarning, match="cannot be captured and run as they are: ValueError: no graph today"):
        captured = as_on_a_gpu(make(ChainEnv()), monkeypatch).learn(100)
    assert len(fake_cuda[0]) == 1  # tried once
    assert_same(eager, captured)


@EITHER
def test_frames_that_do_not_fit_on_the_gpu_stay_on_the_host(make, monkeypatch, fake_cuda):
    eager = make(ChainEnv()).learn(100)
    captured = as_on_a_gpu(make(ChainEnv()), monkeypatch)

    def too_many():
        raise th.cuda.OutOfMemoryError("7 GB")

    monkeypatch.setattr(captured.replay_buffer, "update_device_frames", too_many)
    with pytest.warns(UserWarning, match="OutOfMemoryError: 7 GB"):
        captured.learn(100)
    assert_same(eager, captured)


@EITHER
@pytest.mark.parametrize("fast", ["graph", "overlap"])
def test_no_gpu_is_said_once(make, fast):
    model = make(ChainEnv(), fast=fast)
    with pytest.warns(UserWarning, match="updates are not captured: CUDA graphs need a GPU, and device is 'cpu'") as caught:
        model.learn(80)
    assert len([w for w in caught if "captured" in str(w.message)]) == 1 and model._n_updates > 0


class BufferOfOnesOwn(SequenceReplayBuffer):
    def sample(self, batch_size, env=None):
        return super().sample(batch_size, env)


@EITHER
@pytest.mark.parametrize(
    "change, reason",
    [
        ({}, None),
        ({"env": VecNormalize}, "VecNormalize"),
        ({"policy_kwargs": {"optimizer_class": th.optim.RMSprop}}, "the optimiser keeps a part of its state on the host"),
        ({"policy_kwargs": {"optimizer_kwargs": {"foreach": True}}}, "the optimiser keeps"),
        (
            {"policy_kwargs": {"group": "SO(3)^2 x SE(2)", "parameterization": "exp"}},
            "elements of .* need a matrix exponential",
        ),
        ({"replay_buffer_class": BufferOfOnesOwn}, "BufferOfOnesOwn has a sample of its own"),
    ],
)
def test_reasons_why_not(make, change, reason, monkeypatch):
    change = dict(change)
    env = change.pop("env", lambda venv: venv)(make_vec_env(ChainEnv, 1))
    model = make(env, fast="graph", **change)
    monkeypatch.setattr(model, "device", th.device("cuda"))
    if reason is None:
        assert model._captures()
        return
    with pytest.warns(UserWarning, match=f"not captured: {reason}"):
        assert not model._captures()


@EITHER
def test_fast_is_checked(make):
    with pytest.raises(ValueError, match=r"fast: expected one of \['auto', 'off', 'graph', 'overlap'\], found 'very'"):
        make(ChainEnv(), fast="very")


@pytest.mark.parametrize("settings", [{}, {"policy_kwargs": {"group": "GL(2)", "whiten": True}, "aet_loss": "contrastive"}])
@pytest.mark.parametrize("policy", ENVS)
def test_an_update_needs_no_number_from_the_device(make, policy, settings):
    """On the meta device there are no numbers: to ask for one, or to mix in a tensor of the CPU, is an error."""
    model = make(ENVS[policy](), policy, device="cpu", **settings).learn(60)
    ghost = make(ENVS[policy](), policy, device="meta", **settings)
    ghost.replay_buffer = model.replay_buffer
    ghost.replay_buffer.device = ghost.device
    ghost.replay_buffer.update_device_frames()
    inputs = StaticInputs(model.replay_buffer.draw(8), ghost.device)
    samples = ghost.replay_buffer.samples_on_device(inputs.tensors)
    ghost.policy.set_training_mode(True)
    td, auxiliary = ghost._compute_losses(samples)
    total = sum((samples.weights * part).mean() for part in (td.loss, *auxiliary))
    total.backward()
    ghost.policy.update_target(0.5)
    gradients = [p.grad for p in ghost.policy.parameters() if p.grad is not None]
    assert {g.device.type for g in gradients} == {"meta"} == {td.priorities.device.type}
    assert len(gradients) == len(model._trained)
    with pytest.raises(RuntimeError):
        total.item()


@EITHER
@pytest.mark.parametrize("policy", ENVS)
def test_samples_on_the_device_are_the_samples(make, policy):
    model = make(ENVS[policy](), policy, buffer_size=60, prioritized_replay=False, learning_starts=1_000)
    buffer = model.replay_buffer
    for steps in (40, 60, 100):  # before and after the ring has come round
        model.learn(steps, reset_num_timesteps=False)
        buffer.update_device_frames()
        arrays = buffer.draw(32)
        inputs = StaticInputs(arrays, th.device("cpu"))
        inputs.load(arrays)
        found, expected = buffer.samples_on_device(inputs.tensors), buffer._samples(arrays, None)
        for name in SequenceReplayBufferSamples._fields:
            a, b = getattr(found, name), getattr(expected, name)
            parts = [(a[k], b[k]) for k in a] if isinstance(a, dict) else [(a, th.as_tensor(b))]
            assert all(x.dtype == y.dtype and th.equal(x, y) for x, y in parts), name


@EITHER
def test_overlap_starts_a_round_when_the_next_action_is_chosen(make, monkeypatch):
    """The action of a step is chosen by the networks before the round of the step before; nothing is lost in the end."""
    model = make(ChainEnv(), fast="overlap", learning_starts=40)
    seen, modes = [], set()
    store = model._store_transition

    def watched(*args):
        seen.append(model._n_updates)
        modes.add(model.policy.training)
        store(*args)

    monkeypatch.setattr(model, "_store_transition", watched)
    with pytest.warns(UserWarning, match="not captured"):
        model.learn(60)
    steps = {n: (0 if n <= 41 else 2 * (n - 41)) for n in range(1, 61)}  # rounds before the transition of step n is stored
    assert seen == list(steps.values()) and modes == {False}  # eval mode, as SB3's loop and callbacks know it
    assert model._n_updates == 2 * 20 and model._waiting_round is None


@EITHER
@pytest.mark.filterwarnings("ignore:fast=")
def test_overlap_writes_priorities_one_update_late_and_is_deterministic(make, monkeypatch):
    model = make(ChainEnv(), fast="overlap", gradient_steps=3)
    events = []
    draw, update = model.replay_buffer.draw, model.replay_buffer.update_priorities
    monkeypatch.setattr(model.replay_buffer, "draw", lambda *a: events.append("draw") or draw(*a))
    monkeypatch.setattr(model.replay_buffer, "update_priorities", lambda *a: events.append("write") or update(*a))
    model.learn(50)
    n_rounds = events.count("draw") // 3
    one = ["draw", "draw", "write", "draw", "write", "write"]
    assert events == one * n_rounds and n_rounds > 5
    again = make(ChainEnv(), fast="overlap", gradient_steps=3).learn(50)
    assert_same(model, again)
    other = make(ChainEnv(), gradient_steps=3).learn(50)
    assert not th.equal(model._trained[0], other._trained[0])


@EITHER
@pytest.mark.filterwarnings("ignore:fast=")
def test_overlap_survives_saving(make, tmp_path):
    """Also in the middle, by a callback, with a round that waits."""
    model = make(ChainEnv(), fast="overlap")
    callback = CheckpointCallback(60, str(tmp_path), save_replay_buffer=True)
    model.learn(61, callback)
    loaded = make.algorithm.load(tmp_path / "rl_model_60_steps", env=ChainEnv())
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_60_steps")
    assert loaded.fast == "overlap" and loaded._waiting_round is None  # of step 59: it was started when step 60 began
    n_updates = loaded._n_updates
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded._n_updates == n_updates + 2 * 20


@EITHER
@pytest.mark.filterwarnings("ignore:fast=")
def test_late_priorities_revive_nothing(make):
    """A ring that is full: what is overwritten while its priority is on the way cannot be drawn."""
    model = make(ChainEnv(), fast="overlap", buffer_size=50, batch_size=16).learn(200)
    tree, buffer = model.replay_buffer._tree, model.replay_buffer
    newest = (buffer.pos - 1 - np.arange(buffer.window - 1)) % buffer.buffer_size
    assert (tree.get(newest) == 0).all() and (tree.get(np.arange(50)) > 0).sum() == 50 - len(newest)


@EITHER
@pytest.mark.parametrize("policy", ["CnnPolicy", "MlpPolicy"])
def test_bfloat16_losses_agree(make, policy):
    """Eight bits of mantissa: losses agree to a few per cent, the group's parameters are computed in full."""
    kwargs = {"whiten": True, "group": "SO(3)", "parameterization": "gram-schmidt"}
    model = make(ENVS[policy](), policy, shift_pixels=0, intensity_scale=0.0, policy_kwargs=kwargs).learn(80)
    dtypes = set()
    model.policy.online.features_extractor.to_algebra.register_forward_hook(lambda m, i, out: dtypes.add(out.dtype))
    model.policy.set_training_mode(True)
    samples, losses = model.replay_buffer.sample(64), {}
    for model.bf16 in (False, True):
        th.manual_seed(0)
        td, auxiliary = model._compute_losses(samples)
        losses[model.bf16] = [part.mean() for part in (td.loss, *auxiliary)]
        assert all(loss.dtype == th.float32 for loss in losses[model.bf16])
    th.testing.assert_close(losses[True], losses[False], rtol=0.05, atol=1e-3)
    assert dtypes == {th.float32}
    if policy == "CnnPolicy":
        assert losses[True] != losses[False]  # the switch is wired


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("policy", ENVS)
def test_captured_is_eager_on_a_gpu(make, policy):
    models = [make(ENVS[policy](), policy, device="cuda", fast=fast).learn(150) for fast in ("off", "graph")]
    assert models[1]._captured.failure is None and models[0]._n_updates == models[1]._n_updates >= 100
    for a, b in zip(models[0].policy.parameters(), models[1].policy.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=0, atol=1e-5)


FAULTS = """
import resource
import statistics

import torch as th
from sb3_eqr.benchmark.speed.workload import EQR_AGENTS, make_trainable


def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt


th.set_num_threads(1)
for depth in (5, 10):
    model = make_trainable(EQR_AGENTS[0], prediction_depth=depth)
    found = []
    for _ in range(21):
        before = faults()
        model.train(1, 32)
        found.append(faults() - before)
    print(statistics.median(found))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="counts as Linux does")
def test_an_update_of_atari_frames_takes_no_fresh_memory():
    """In a process of its own, without settings for the C library. A page is 4 kB; such an update wrote 8,000 new ones."""
    run = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    assert max(map(float, run.stdout.split())) < 100
