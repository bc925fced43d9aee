"""Every argument of every constructor rejects invalid values with an error that names it."""

import inspect
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_eqr import EqRQRDQN, EqRRainbow, EqRSAC, PrioritizedSequenceReplayBuffer
from sb3_eqr.common.checks.arguments import ALGORITHM, BUFFER, POLICY, a_list, integer, number, one_of, rules_of
from sb3_eqr.common.latent.options import LatentOptions
from sb3_eqr.common.policies import EqRPolicy
from sb3_eqr.common.resets import ResetSchedule
from sb3_eqr.eqr_qrdqn import EqRQRDQNPolicy
from sb3_eqr.eqr_rainbow import EqRRainbowPolicy
from tests.models import EITHER, same
from tests.toys import ChainEnv, ImageEnv

NOT_IN_A_TABLE = {
    # the algorithm: checked by SB3 or by sb3_eqr.common.checks.validation, which know the context
    *("self", "policy", "env", "replay_buffer_class", "resets", "device", "_init_setup_model"),
    # the policy: set by the algorithm, or parsed by make_group
    *("observation_space", "action_space", "lr_schedule", "group", "kwargs", "stock_kwargs"),
    # the buffer: set by the algorithm, or without effect
    *("buffer_size", "optimize_memory_usage", "handle_timeout_termination"),
}
NAN = float("nan")
# Values of many kinds; each is tested against every rule that rejects it.
STRANGERS = [NAN, float("inf"), -float("inf"), -1, -0.5, 1e400, 0.5, 3.0, 7, "many", "", True, None, [], {}, (), object]
STRANGERS += [b"1", 1j, np.array([1.0, 2.0]), [0], [1, "x"], (0, "step"), (1, "hour"), timedelta(1)]
STRANGERS += [np.float64(NAN), np.int64(-3)]


def make(place, name, value):
    if place == "resets":
        return ResetSchedule(**{name: value})
    if place == "algorithm":
        return EqRRainbow("MlpPolicy", ChainEnv(), **{"buffer_size": 200, name: value})
    kind = EqRQRDQN if name == "n_quantiles" else EqRRainbow
    return kind("MlpPolicy", ChainEnv(), buffer_size=200, **{place: {name: value}})


OWN_BUFFER = ("frame_stack", "alpha", "beta", "final_beta")  # the others are the algorithm's
PLACES = {"algorithm": ALGORITHM, "policy_kwargs": POLICY | rules_of(LatentOptions), "resets": rules_of(ResetSchedule)}
PLACES["replay_buffer_kwargs"] = {name: BUFFER[name] for name in OWN_BUFFER}
ARGUMENTS = [(place, name) for place, rules in PLACES.items() for name in rules]


@pytest.mark.parametrize("place, name", ARGUMENTS)
def test_invalid_values_raise_and_name_the_argument(place, name):
    rule = PLACES[place][name]
    wrong = [value for value in STRANGERS if not rule.holds(value)]
    assert len(wrong) > 10
    for value in wrong:
        with pytest.raises(ValueError, match=rf"\b{name} must be .*, got ") as caught:
            make(place, name, value)
        assert rule.says in str(caught.value)


def test_every_argument_has_a_rule():
    signatures = {
        EqRRainbow: ALGORITHM,
        EqRPolicy: POLICY | rules_of(LatentOptions),
        EqRRainbowPolicy: POLICY,
        EqRQRDQNPolicy: POLICY,
        PrioritizedSequenceReplayBuffer: BUFFER,
        ResetSchedule: rules_of(ResetSchedule),
        LatentOptions: rules_of(LatentOptions),
    }
    for kind, rules in signatures.items():
        missing = inspect.signature(kind.__init__).parameters.keys() - rules.keys() - NOT_IN_A_TABLE
        assert not missing, (kind, missing)


@EITHER
def test_steps_may_be_a_float(make, tmp_path):
    model = make(ChainEnv(), learning_starts=None).learn(5e1)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model")
    assert (model.learning_starts, loaded.learning_starts) == (5, 5) and isinstance(loaded.learning_starts, int)
    model.learn(1e1, reset_num_timesteps=False)


@EITHER
def test_actions_may_have_any_integer_type(make):
    env = ChainEnv()
    env.action_space = spaces.Discrete(3, dtype=np.int32)
    model = make(env).learn(46)
    samples = model.replay_buffer.sample(4)
    assert model._n_updates > 0 and samples.actions.dtype == samples.rollout_actions.dtype == th.int64


@pytest.mark.parametrize("kind", [EqRQRDQN, EqRSAC])
def test_numbers_of_numpy_are_numbers(kind):
    env = "CartPole-v1" if kind is EqRQRDQN else "Pendulum-v1"
    model = kind("MlpPolicy", env, seed=np.int64(3), learning_rate=np.float32(0.5), stats_window_size=np.int64(5))
    assert (model.seed, model.learning_rate, model._stats_window_size) == (3, 0.5, 5)


def test_combinations_of_attributes_set_later_are_checked_when_learning_starts():
    model = EqRRainbow("MlpPolicy", ChainEnv(), buffer_size=200, learning_starts=10)
    model.td_coef, model.prediction_depth = 0.0, 0
    with pytest.raises(ValueError, match="td_coef must be > 0 if all auxiliary losses are disabled"):
        model.learn(20)
    assert model.num_timesteps == 0
    model = EqRRainbow("MlpPolicy", ChainEnv(), buffer_size=200, symmetry_coef=0.0, policy_kwargs={"group": "none(8)"})
    model.symmetry_coef = 1.0
    with pytest.raises(ValueError, match="group must have inverses for the GET loss"):
        model.learn(20)
    with pytest.raises(ValueError, match="and for whiten=True, got 1"):
        EqRRainbow("MlpPolicy", ChainEnv(), batch_size=1, prediction_depth=0, policy_kwargs={"whiten": True})


LATER = {"aux_gradient_share": 0.5, "double_q": False, "intensity_scale": 0.1, "n_steps": 3, "gamma": 0.5}


@pytest.mark.parametrize("name, value", LATER.items())
def test_an_attribute_set_later_has_the_effect_of_the_argument(name, value):
    def train(**given):
        model = EqRRainbow("CnnPolicy", ImageEnv(), buffer_size=200, learning_starts=20, batch_size=8, seed=0, **given)
        if not given:
            setattr(model, name, value)
        return model.learn(24).policy.state_dict()

    given, later = train(**{name: value}), train()
    assert same(given, later)


OUT_OF_RANGE = {
    "algorithm": {"tau": 1.5, "gamma": 1.01, "aet_coef": -1.0, "td_coef": None, "batch_size": 32.0, "n_steps": 0}
    | {"shift_pixels": 2.5, "prediction_depth": -1, "target_update_interval": 0, "train_freq": (1, "hour")},
    "policy_kwargs": {"n_blocks": 0, "latent_hidden_dim": 0, "sigma_init": -1.0, "n_atoms": 1, "n_quantiles": 0}
    | {"v_max": float("inf"), "reward_loss": "huber", "aet_loss": "nce", "projection": "mine"},
    "replay_buffer_kwargs": {"alpha": -1.0, "beta": 1.4, "final_beta": 1.5, "frame_stack": 0},
    "resets": {"interval": 0, "initial_n_steps": 0, "initial_gamma": -0.1, "annealing_steps": 0, "shrink_factor": 1.5},
}


def test_ranges_by_hand():
    """The tables decide what the tests above try; here is what they must reject."""
    for place, values in OUT_OF_RANGE.items():
        assert not [name for name, value in values.items() if PLACES[place][name].holds(value)]


@pytest.mark.parametrize(
    "given, wanted", [([2, "step"], (2, "step")), (np.int64(3), (3, "step")), ((1, "episode"), (1, "episode"))]
)
def test_lists_and_numpys_integers_are_frequencies(given, wanted):
    found = EqRQRDQN("MlpPolicy", "CartPole-v1", train_freq=given, gradient_steps=1).train_freq
    assert (found.frequency, found.unit.value) == wanted and type(found.frequency) is int


def test_attributes_that_learn_reads_again():
    """A frequency is converted, a path was, and the replay buffer cannot become one of another kind."""
    model = EqRQRDQN("MlpPolicy", "CartPole-v1", gradient_steps=1, tensorboard_log=Path("logs"))
    assert model.tensorboard_log == "logs"
    model.tensorboard_log, model.train_freq = None, 4
    model.learn(4)
    assert (model.train_freq.frequency, model.train_freq.unit.value) == (4, "step")
    model.prioritized_replay = False
    with pytest.raises(ValueError, match="prioritized_replay must be True, as when the replay buffer was made, got False"):
        model.learn(4)


def test_rules_by_hand():
    assert number(0, 1).holds(1) and not number(0, 1).holds(1.1) and not number(0, above=True).holds(0)
    assert integer(1).holds(np.int64(1)) and not integer(1).holds(1.0) and not integer(0).holds(True)
    assert a_list(integer(1)).holds([64, 64]) and a_list(integer(1)).holds([]) and not a_list(integer(1)).holds([64.0])
    assert (integer(1) | one_of(["auto"])).holds("auto") and not one_of(["auto"]).holds(None)
    assert number(0, above=True).says == "a finite number > 0" and number(0, 1).says == "a finite number in [0, 1]"
    assert a_list(integer(1)).says == "a list of integers >= 1"
