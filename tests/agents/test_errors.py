"""Invalid input raises before the first step; errors during training do not damage the model."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib.qrdqn.policies import QRDQNPolicy
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from experiments.attacks.inputs import wrong_arguments
from sb3_eqr import EqRRainbow
from sb3_eqr.eqr_rainbow import eqr_rainbow
from tests.models import EITHER, PAPER, all_finite
from tests.toys import ChainEnv, ImageEnv, IntegerEnv, PoisonEnv, SampledEnv


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"buffer_size": 5}, "prediction_depth \\+ 1 = 6 transitions per environment, got 5"),
        ({"resets": {"initial_n_steps": 497}, "buffer_size": 499}, "depth \\+ 1 = 500 transitions per environment, got 499"),
        ({"resets": {"initial_gamma": 0.9}, "gamma": 1.0}, "initial_gamma and gamma must be < 1"),
        ({"resets": {"interval": 0}}, "resets: interval must be an integer >= 1"),
        ({"batch_size": 1}, "batch_size must be an integer >= 2"),
        ({"replay_buffer_class": "x"}, "replay_buffer_class must be SequenceReplayBuffer"),
        ({"replay_buffer_class": ReplayBuffer}, "replay_buffer_class must be SequenceReplayBuffer"),
        ({"replay_buffer_kwargs": {"n_steps": 1}}, "Pass n_steps=1 to EqR"),
        ({"replay_buffer_kwargs": {"n_envs": 7}}, "'n_envs'. Leave it out: it follows from env"),
        ({"replay_buffer_kwargs": {"buffer_size": 3}}, "Pass buffer_size=3 to EqR"),
        ({"policy": QRDQNPolicy}, "policy must be derived from EqR(QRDQN|Rainbow)Policy"),
        ({"policy": "MultiInputPolicy"}, "observation_space must be a Dict space"),
        ({"policy": "MLPPolicy"}, "policy must be one of .*got 'MLPPolicy'. Did you mean 'MlpPolicy'"),
        ({"policy_kwargs": {"group": "SO(1)"}}, "n is at least 2 for SO"),
        ({"policy_kwargs": {"group": None}}, "Pass symmetry_coef=0"),
        ({"policy_kwargs": {"group": "none"}}, "Pass symmetry_coef=0"),
        ({"policy_kwargs": {"group": None, "whiten": True}, "symmetry_coef": 0}, "group must not be None if whiten=True"),
        ({"policy_kwargs": {"parameterization": "angles"}}, "parameterization must be one of"),
        ({"td_coef": 0, "prediction_depth": 0}, "td_coef must be > 0 if all auxiliary losses are disabled"),
        ({"policy_kwargs": {**PAPER, "net_arch": []}}, "at least one hidden layer.*projection"),
        ({"policy_kwargs": {"optimizer_class": "LBFGS"}}, "optimizer_class must not be LBFGS"),
        ({"policy_kwargs": {"optimizer_class": th.optim.SparseAdam}}, "optimizer_class must not be SparseAdam"),
        ({"policy_kwargs": {"optimizer_class": "AdamV"}}, "must be a class or a name in torch.optim.*'AdamV'"),
        (
            {"policy_kwargs": {"features_extractor_class": "resnet"}},
            "one of \\['nature', .*'flatten'\\]",
        ),
    ],
    ids=str,
)
def test_arguments_out_of_range(make, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(ChainEnv(), **kwargs)


DICT, IMAGES, VECTORS = {"policy": "MultiInputPolicy"}, {"policy": "CnnPolicy"}, ("mlp", "flatten")
NO_DICTS = "must accept dicts, got .*Use MultiInputPolicy"
OUTSIDE = r"Use VecNormalize\(VecTransposeImage\(env\), norm_obs=False\)"


@pytest.mark.parametrize(
    "env, kwargs, message",
    [
        (lambda: ChainEnv, {}, r"env must be an environment or a VecEnv, got .*make_vec_env"),
        (lambda: 3, {}, r"env must be an environment or a VecEnv, got .*make_vec_env"),
        (lambda: SampledEnv(spaces.Discrete(5, start=1)), {}, "observation_space must start at 0"),
        (lambda: SampledEnv(spaces.MultiDiscrete([5, 2], start=[0, 1])), {}, "observation_space must start at 0"),
        (lambda: SampledEnv(spaces.MultiDiscrete([[5, 2], [2, 2]])), {}, "must be a MultiDiscrete of one dimension"),
        (lambda: SampledEnv(spaces.Box(-1, 1, ())), {}, "observation_space must have at least one axis"),
        (lambda: SampledEnv(spaces.Box(-1, 1, (0,))), {}, "observation_space must not be empty, got Box"),
        (lambda: SampledEnv(spaces.Dict()), DICT, r"observation_space must not be empty, got Dict\(\)"),
        (lambda: SampledEnv(spaces.Dict({"a": spaces.Box(-1, 1, ())})), DICT, r"\['a'\] must have at least one axis"),
        (lambda: make_vec_env(ChainEnv, 4), {"buffer_size": 23}, "buffer_size=24"),
        (ChainEnv, IMAGES, "MlpPolicy for vectors"),
        (lambda: ImageEnv((3, 20, 20)), IMAGES, "at least 36x36"),
        (lambda: ImageEnv((3, 40, 36), dtype=np.float32), IMAGES, "normalize_images=False"),
        (ImageEnv, IMAGES | {"replay_buffer_kwargs": {"frame_stack": 2}}, "frame_stack must divide"),
        (SimpleMultiObsEnv, {}, "MultiInputPolicy"),
        *((SimpleMultiObsEnv, DICT | {"policy_kwargs": {"features_extractor_class": trunk}}, NO_DICTS) for trunk in VECTORS),
        (lambda: VecNormalize(make_vec_env(IntegerEnv), norm_obs_keys=["count"]), DICT, "of 'count'. Pass norm_obs=False"),
        (lambda: VecNormalize(VecTransposeImage(make_vec_env(ImageEnv))), IMAGES, "normalise floats, .*DtypeObservation"),
        (lambda: VecNormalize(make_vec_env(ImageEnv), norm_obs=False), IMAGES, OUTSIDE),
        (lambda: VecNormalize(VecFrameStack(make_vec_env(ImageEnv), 2), norm_obs=False), IMAGES, OUTSIDE),
    ],
)
def test_environments_that_do_not_fit(make, env, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(env(), **kwargs)


def test_a_new_environment_is_checked_like_the_first(make):
    model = make(make_vec_env(ImageEnv), "CnnPolicy")
    with pytest.raises(ValueError, match="VecNormalize must normalise floats"):
        model.set_env(VecNormalize(make_vec_env(ImageEnv)))
    assert not isinstance(model.env, VecNormalize)


@pytest.mark.parametrize("stacked", [False, True])
def test_vec_normalize_outside_of_the_other_wrappers(make, stacked):
    env = VecFrameStack(make_vec_env(ImageEnv), 2) if stacked else make_vec_env(ImageEnv)
    assert make(VecNormalize(VecTransposeImage(env), norm_obs=False), "CnnPolicy").learn(60)._n_updates > 0


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"policy_kwargs": {"features_extractor_class": "flatten"}}, "'flatten' with layer_norm=True.* loses information"),
        ({"policy_kwargs": {"noisy": False}}, "exploration_final_eps"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage=True has no effect"),
    ],
    ids=str,
)
def test_arguments_that_warn(make, kwargs, message):
    with pytest.warns(UserWarning, match=message):
        make(ChainEnv(), **kwargs)


def test_greedy_exploration_with_resets_does_not_warn(make):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(ChainEnv(), resets={"interval": 100}, policy_kwargs={"noisy": False})


@pytest.mark.parametrize("low, high", [(10.0, 10.0), (3, 1)])
def test_a_support_without_values(low, high):
    with pytest.raises(ValueError, match=f"v_min must be a finite number < v_max = {high}, got {low}"):
        EqRRainbow("MlpPolicy", ChainEnv(), policy_kwargs={"v_min": low, "v_max": high})


def test_observations_that_are_not_a_frame_stack(make):
    model = make(ImageEnv((4, 40, 36)), "CnnPolicy", replay_buffer_kwargs={"frame_stack": 4})
    with pytest.raises(ValueError, match=r'frame_stack=4: each observation must.*"frame_stack": 1'):
        model.learn(50)
    assert model.num_timesteps == 1


@EITHER
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("where, what", [("obs", "next_obs"), ("reward", "reward"), ("terminal", "next_obs")])
def test_bad_values_from_the_environment(make, where, what, value, normalize):
    if normalize and where != "reward" and value == np.inf:
        return  # VecNormalize has clipped it, where the episode ends
    env = make_vec_env(lambda: PoisonEnv(where, value, at=60))
    model = make(VecNormalize(env) if normalize else env)
    with pytest.raises(ValueError, match=f"step 60: {what} must be finite, got (nan|-?inf)"):
        model.learn(100)
    assert model.replay_buffer.size() == 59 and model._n_updates > 0
    if normalize:
        return  # resuming with VecNormalize has its own test
    model.learn(5, reset_num_timesteps=False)  # resets the environment, so no transition crosses the error
    assert model.replay_buffer.timeouts[58].all() or model.replay_buffer.dones[58].all()
    assert all_finite(model)


@pytest.mark.parametrize("where", ["obs", "reward"])
def test_a_rejected_step_does_not_change_the_statistics_of_vec_normalize(make, where):
    env = VecNormalize(DummyVecEnv([lambda: PoisonEnv(where, at=50)]))
    model = make(env, learning_starts=1_000)  # only random actions, the same in both runs
    with pytest.raises(ValueError, match=r"step 50: .* must be finite"):
        model.learn(60)
    clean = VecNormalize(DummyVecEnv([lambda: PoisonEnv(where, at=1_000)]))
    make(clean, learning_starts=1_000).learn(49)
    for name in ("obs_rms", "ret_rms"):
        found, expected = getattr(env, name), getattr(clean, name)
        assert np.array_equal(found.mean, expected.mean) and np.array_equal(found.var, expected.var)
        assert found.count == expected.count


def test_integers_behind_vec_normalize(make):
    """SB3 would scale their terminal observations, clip them, scale them back and cut them to integers."""
    env = VecNormalize(make_vec_env(IntegerEnv), norm_obs=False)
    model = make(env, "MultiInputPolicy", learning_starts=1_000).learn(20)
    stored = model.replay_buffer.windows(np.array([6]), np.array([0])).rollout_observations["kind"]
    assert int(stored[0, 0]) == 7 and model.replay_buffer.dones[6] == 1


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_observations_of_predict_must_be_finite(make, value, dtype):
    model = make(ChainEnv())
    for observation in (np.array([0.0, value, 0.0], dtype=dtype), [0.0, value, 0.0], th.tensor([0.0, value, 0.0])):
        with pytest.raises(ValueError, match=f"observation must be finite, got {value}"):
            model.predict(observation)


def test_a_bad_first_observation_is_not_stored(make):
    model = make(PoisonEnv("reset"))
    with pytest.raises(
        ValueError, match=r"step 1: obs must be finite, got nan at \[0.*\]\. Nothing was stored\. .*VecCheckNan"
    ):
        model.learn(10)
    assert model.replay_buffer.size() == 0


def test_losses_that_are_not_finite_raise_and_the_model_is_never_saved(make, model, tmp_path):
    updates = model._n_updates
    model.save(tmp_path / "good")
    model.replay_buffer.rewards[:] = 3e38  # finite, but its square and its double are not
    model.train(gradient_steps=2, batch_size=8)
    for name in ("model", "good"):
        with pytest.raises(FloatingPointError, match=r"update \d+: (losses|parameters) must be finite, got .*checkpoint"):
            model.save(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["good.zip"]
    good = make.algorithm.load(tmp_path / "good", ChainEnv())
    good.replay_buffer.rewards[:] = 0.0
    good.learn(60, reset_num_timesteps=False)
    assert good._n_updates > updates and all_finite(good)


def test_the_first_bad_update_is_named(model):
    updates = model._n_updates
    model.train(gradient_steps=1, batch_size=8)
    model.replay_buffer.rewards[:] = 3e38
    model.train(gradient_steps=2, batch_size=8)
    with pytest.raises(FloatingPointError, match=rf"step 46, update {updates + 2}: losses .* got .*reward_loss = inf"):
        model.dump_logs()


def set_learning_rate(step, value):
    """A callback of ``learn``."""

    def callback(found, _):
        if found["self"].num_timesteps == step:
            found["self"].lr_schedule = lambda progress: value
        return True

    return callback


@EITHER
@pytest.mark.parametrize("gradient_steps", [1, 3])
def test_an_explosion_is_found_in_the_next_round(make, gradient_steps):
    """The losses of an update do not show the effect of its own step; those of the next round do."""
    model = make(ChainEnv(), gradient_steps=gradient_steps)
    with pytest.raises(FloatingPointError, match=r"must be finite, got .*lower learning_rate"):
        model.learn(200, set_learning_rate(44, 1e30))
    assert model.num_timesteps < 50


@EITHER
def test_the_last_update_is_checked_before_learn_returns(make):
    """Its losses are finite, and only the parameters show the effect of its step."""
    with pytest.raises(FloatingPointError, match=r"step 60, update \d+: parameters must be finite, got (nan|inf)\. The model"):
        make(ChainEnv(), gradient_steps=1).learn(60, set_learning_rate(60, float("inf")))


def test_parameters_that_are_not_finite_are_never_saved(make, tmp_path):
    model = make(ChainEnv())
    with th.no_grad():
        next(model.policy.parameters())[0] = float("nan")
    with pytest.raises(FloatingPointError, match="update 0: parameters must be finite, got nan"):
        model.save(tmp_path / "model")
    assert list(tmp_path.iterdir()) == []


def test_setting_n_steps_beyond_the_buffer_raises(make):
    model = make(ChainEnv(), buffer_size=50).learn(60)
    model.n_steps = 60
    with pytest.raises(ValueError, match="n_steps \\+ prediction_depth \\+ 1 = 63"):
        model.train(1, 8)


class ScriptedRewards(ChainEnv):
    def __init__(self, rewards):
        super().__init__()
        self.rewards = rewards

    def step(self, action):
        self.time += 1
        return self.observe() * 0, self.rewards[self.time - 1], self.time == len(self.rewards), False, {}


@pytest.mark.parametrize("td_coef", [1.0, 0.0])  # without a TD loss, nothing learns returns
@pytest.mark.parametrize(
    "rewards, step, value",
    [
        ([0.5, -25.0, 0.0], 2, "-25"),  # one reward suffices
        ([0.0] * 60 + [8.0, 8.0], 62, "15.92"),  # late in the episode, far from its start: 8 + 0.99 * 8
        ([1.0] * 11, 11, "10.47"),  # (1 - 0.99^11) / 0.01
        ([9.0, 5.0, -4.0, -5.0], None, None),  # a sum of 13.95 on the way, but the states' returns are 5.23, -3.81, -8.95, -5
        ([1.0] * 10, None, None),  # 9.56
    ],
)
def test_returns_outside_the_support_warn_once(rewards, step, value, td_coef):
    env = make_vec_env(lambda: ScriptedRewards(rewards))
    model = EqRRainbow("MlpPolicy", env, learning_starts=1_000, td_coef=td_coef, device="cpu")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(3 * len(rewards))
    found = [str(warning.message) for warning in caught if "discounted return" in str(warning.message)]
    if step is None or td_coef == 0:
        assert found == []
    else:
        assert len(found) == 1 and f"step {step}: a discounted return of {value} lies outside" in found[0]


def test_an_endless_episode_is_watched_in_parts(monkeypatch):
    """The memory is bounded, and the return of the first part is found: 6 rewards of 2, and none after them."""
    monkeypatch.setattr(eqr_rainbow, "WATCHED_STEPS", 12)
    env = make_vec_env(lambda: ScriptedRewards([2.0] * 6 + [0.0] * 1_000))
    model = EqRRainbow("MlpPolicy", env, learning_starts=1_000, device="cpu", policy_kwargs={"v_max": 11.0})
    with pytest.warns(UserWarning, match=r"step 12: a discounted return of 11.7 lies outside"):  # 2 (1 - 0.99^6) / 0.01
        model.learn(30)
    quiet = EqRRainbow("MlpPolicy", env, learning_starts=1_000, device="cpu", policy_kwargs={"v_max": 12.0})
    quiet.learn(30)
    assert len(quiet._episode_rewards[0]) == 30 - 2 * 12


def test_returns_within_the_support_do_not_warn():
    kwargs = {"learning_starts": 100, "seed": 0}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        EqRRainbow("MlpPolicy", "CartPole-v1", **kwargs, policy_kwargs={"v_min": 0, "v_max": 100}).learn(110)
        scaled = VecNormalize(make_vec_env(lambda: gym.make("CartPole-v1"), 2), norm_reward=True)
        EqRRainbow("MlpPolicy", scaled, **kwargs).learn(200)


def test_buffer_add_checks_its_arguments(make):
    buffer = make(ChainEnv()).replay_buffer
    obs, one, zero = np.zeros((1, *buffer.obs_shape)), np.ones(1), np.zeros(1)
    for action in (buffer.action_space.n, -1, np.nan):
        with pytest.raises(ValueError, match=rf"action must be integers in \[0, {buffer.action_space.n - 1}\], got"):
            buffer.add(obs, obs, np.array([action]), one, zero, [{}])
    with pytest.raises(ValueError, match="reward must be finite, got inf"):
        buffer.add(obs, obs, zero, one * np.inf, zero, [{}])
    with pytest.raises(ValueError, match=r"next_obs must be finite, got 1e\+39"):  # not representable in float32
        buffer.add(obs, obs + 1e39, zero, one, zero, [{}])
    for done in (["False"], [0.3], [np.nan], [None]):
        with pytest.raises(ValueError, match="done must be True or False, got"):
            buffer.add(obs, obs, zero, one, np.array(done), [{}])
    assert buffer.size() == 0


def test_a_call_of_learn_without_updates_warns(make):
    with pytest.warns(UserWarning, match=r"learning_starts=50 is not smaller than the last step, 50, so no updates"):
        make(ChainEnv(), learning_starts=50).learn(50)


def test_resuming_without_the_vec_normalize_or_the_replay_buffer_warns(make, tmp_path):
    model = make(VecNormalize(make_vec_env(ChainEnv)))
    model.learn(60)
    model.save(tmp_path / "model")
    bare = type(model).load(tmp_path / "model")
    with warnings.catch_warnings(), pytest.raises(AssertionError, match=r"must set the environment.*call set_env"):
        warnings.simplefilter("error")
        bare.learn(5)
    bare.set_env(make_vec_env(ChainEnv))
    with pytest.warns(UserWarning) as caught:
        bare.learn(5)
    said = " ".join(str(warning.message) for warning in caught)
    assert "trained with VecNormalize" in said and "The replay buffer is empty, but this agent has made" in said
    new = type(model).load(tmp_path / "model", VecNormalize(make_vec_env(ChainEnv)), force_reset=False)
    with pytest.warns(UserWarning, match="trained with VecNormalize, but this VecNormalize has no statistics"):
        new.learn(5)


def test_devices(make):
    with pytest.raises(ValueError, match=r"device must be 'auto' or a device of PyTorch such as .*, got 'nodevice'"):
        make(ChainEnv(), device="nodevice")
    if not th.cuda.is_available():
        with pytest.warns(UserWarning, match="cuda:0 was requested, but PyTorch finds no GPU"):
            make(ChainEnv(), device="cuda:0")


def test_every_error_names_the_wrong_argument():
    found = wrong_arguments()
    assert found.holds, found.details
