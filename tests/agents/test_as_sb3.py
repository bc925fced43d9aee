"""What users do with any SB3 model: copy it, average its parameters, misspell arguments, pass a custom extractor."""

import inspect
import pickle
from copy import deepcopy

import cloudpickle
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import NatureCNN
from torch.nn import functional as F

from sb3_eqr import EqRRainbow, GroupFeaturesExtractor
from sb3_eqr.common.networks.encoders import ConvExtractor, ImpalaExtractor
from tests.models import EITHER, MAKERS, same, tensors
from tests.toys import ChainEnv, DictEnv, ImageEnv, SampledEnv


def continued(model):
    """Some more updates on the stored transitions, independent of the environment and of the random generators' state."""
    th.manual_seed(0)
    model.replay_buffer._tree.set(th.arange(40).numpy(), 1.0)
    model.set_random_seed(0)
    model.train(3, 8)
    return model


@pytest.mark.parametrize(
    "copied", [deepcopy, lambda m: pickle.loads(pickle.dumps(m)), lambda m: cloudpickle.loads(cloudpickle.dumps(m))]
)
def test_a_model_can_be_copied_while_it_trains(make, copied, tmp_path):
    model = make(ChainEnv(), policy_kwargs={"projection": "own", "aet_loss": "contrastive"}).learn(46)
    model.set_logger(configure(str(tmp_path), ["stdout", "tensorboard", "csv"]))  # open files
    copy = copied(model)
    before = tensors(copy)
    ours = continued(model)
    assert same(before, copy)  # no tensor is shared
    assert same(ours, continued(copy)) and not same(before, copy)
    n_updates = copy._n_updates
    assert copy.learn(2, reset_num_timesteps=False)._n_updates == n_updates + 4 and copy.logger is not model.logger


@pytest.mark.parametrize("policy, env", [("MlpPolicy", ChainEnv), ("CnnPolicy", ImageEnv)])
def test_state_dicts_are_floats_and_counters(make, policy, env):
    """As required by sb3-contrib's tests that randomise and average parameters."""
    model, other = (make(env(), policy, policy_kwargs={"whiten": True}, seed=seed) for seed in (0, 1))
    state = model.policy.state_dict()
    counters = {name for name, value in state.items() if not value.is_floating_point()}
    assert all(name.endswith("num_batches_tracked") for name in counters)
    assert all(value.dtype == th.float32 for name, value in state.items() if name not in counters)
    mean = {name: (value + other.policy.state_dict()[name]) / 2 for name, value in state.items()}
    model.policy.load_state_dict(mean)
    model.policy.load_state_dict({name: th.rand_like(value.float()) for name, value in state.items()})
    model.set_parameters({"policy": {name: th.rand_like(v.float()) for name, v in state.items()}}, exact_match=False)
    assert model.predict(model.get_env().reset())[0].shape == (1,)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (
            {"prediction_dpeth": 3},
            r"^EqR(QRDQN|Rainbow) got .* argument 'prediction_dpeth'. Did you mean 'prediction_depth'\?",
        ),
        ({"get_coef": 3}, r"^EqR(QRDQN|Rainbow) got an unexpected argument 'get_coef'. Did you mean 'symmetry_coef'\?"),
        ({"reward_loss": "mse"}, r"got an unexpected argument 'reward_loss'. Pass policy_kwargs=dict\(reward_loss=...\)"),
        ({"layer_norm": 1}, r"got an unexpected argument 'layer_norm'. Pass policy_kwargs=dict\(layer_norm=...\)"),
        ({"alpha": 0.6}, r"got an unexpected argument 'alpha'. Pass replay_buffer_kwargs=dict\(alpha=...\)"),
        ({"bogus": 3}, r"^EqR(QRDQN|Rainbow) got an unexpected argument 'bogus'. It takes policy, env, learning_rate,.*seed"),
        ({"policy_kwargs": {"aet_coef": 3}}, r"^policy_kwargs: 'aet_coef' is an argument .* Pass aet_coef=... beside .*\.$"),
        ({"policy_kwargs": {"n_block": 3}}, r"^policy_kwargs: EqR.*Policy got .*'n_block'. Did you mean 'n_blocks'\?"),
        ({"replay_buffer_kwargs": {"alhpa": 3}}, r"^replay_buffer_kwargs: Prioritized.* 'alhpa'. Did you mean 'alpha'\?"),
        ({"prioritized_replay": False, "replay_buffer_kwargs": {"alpha": 0.7}}, "SequenceReplayBuffer got .* 'alpha'"),
    ],
)
def test_misspelt_arguments(make, kwargs, message):
    with pytest.raises(TypeError, match=message):
        make(ChainEnv(), **kwargs)


def test_arguments_of_the_other_agent_and_of_its_policy(make):
    own, other = make.n_atoms_name, next(maker.n_atoms_name for maker in MAKERS if maker is not make)
    with pytest.raises(TypeError, match=f"policy_kwargs: EqR.*Policy got an unexpected argument {other!r}"):
        make(ChainEnv(), policy_kwargs={other: 5})
    with pytest.raises(TypeError, match=rf"unexpected argument '{own}'. Pass policy_kwargs=dict\({own}=...\)"):
        make(ChainEnv(), **{own: 5})


def test_the_signature_shows_the_constructors_arguments(make):
    parameters = inspect.signature(make.algorithm).parameters
    assert len(parameters) <= 38 and list(parameters)[:3] == ["policy", "env", "learning_rate"]
    assert not any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    assert not any(name.startswith(("get_", "set_")) for name in parameters)


def trunk_of(model):
    return model.policy.online.features_extractor.trunk


@EITHER
@pytest.mark.parametrize("name, kind", [("nature", ConvExtractor), ("impala", ImpalaExtractor)])
def test_our_extractors_accept_features_dim(make, name, kind):
    network = {"features_extractor_class": name, "features_extractor_kwargs": {"features_dim": 24}}
    model = make(ImageEnv(), "CnnPolicy", policy_kwargs=network).learn(50)
    assert model.policy.group_layer.to_algebra.in_features == 24 and isinstance(trunk_of(model), kind)
    features = trunk_of(model)(th.rand(2, 1, 36, 36))
    assert features.shape == (2, 24) and (features >= 0).all()  # a ReLU, as in SB3's NatureCNN
    assert trunk_of(make(ImageEnv(), "CnnPolicy")).linear is None
    with pytest.raises(ValueError, match="features_dim"):
        make(ImageEnv(), "CnnPolicy", policy_kwargs={"features_extractor_kwargs": {"features_dim": 0}})


def test_the_group_encoder_passes_features_dim_to_its_trunk():
    encoder = GroupFeaturesExtractor(ImageEnv((3, 40, 36)).observation_space, n_blocks=2, features_dim=24)
    assert encoder.group_layer.to_algebra.in_features == 24 and encoder.features_dim == 12
    nature = GroupFeaturesExtractor(ImageEnv((3, 40, 36)).observation_space, trunk_class=NatureCNN, features_dim=24)
    assert nature.trunk.features_dim == 24


@EITHER
def test_dicts_may_hold_small_images(make):
    space = spaces.Dict({"image": spaces.Box(0, 255, (3, 10, 10), np.uint8), "place": spaces.Box(-1, 1, (3,), np.float32)})
    env = TransformObservation(ChainEnv(), lambda place: {"image": np.full((3, 10, 10), 7, np.uint8), "place": place}, space)
    network = {"features_extractor_kwargs": {"cnn_output_dim": 24}}
    trunk = trunk_of(make(env, "MultiInputPolicy", policy_kwargs=network, shift_pixels=0).learn(50))
    observations = {"image": th.rand(2, 3, 10, 10), "place": th.rand(2, 3)}
    convolution, linear, mlp = trunk.images[0].trunk[0], trunk.images[0].linear[0], trunk.mlp[0]
    patches = F.unfold(observations["image"], 3)  # (2, 27, 64): the convolution as a product of matrices
    maps = (convolution.weight.flatten(1) @ patches + convolution.bias[:, None]).relu().flatten(1)
    parts = [maps @ linear.weight.T + linear.bias, observations["place"] @ mlp.weight.T + mlp.bias]
    th.testing.assert_close(trunk(observations), th.cat(parts, dim=1).relu())
    network["features_extractor_kwargs"]["layers"] = [[32, 8, 4], [64, 4, 2]]
    with pytest.raises(ValueError, match="at least 20x20"):
        make(env, "MultiInputPolicy", policy_kwargs=network)


@pytest.mark.parametrize(
    "space", [spaces.Box(-1, 1, (1,), np.float32), spaces.Dict({"x": spaces.Box(-1, 1, (1,), np.float32)})]
)
def test_features_of_a_single_number_depend_on_it(make, space):
    """A layer norm of the number itself would give 0."""
    is_dict, values = isinstance(space, spaces.Dict), th.linspace(-1, 1, 9)[:, None]
    model = make(SampledEnv(space), "MultiInputPolicy" if is_dict else "MlpPolicy")
    features = model.policy.online.features_extractor({"x": values} if is_dict else values)
    assert features.var(dim=0).sum() > 0.1


@EITHER
def test_any_key_and_any_size_of_image_in_a_dict(make):
    """SB3's extractor fails for these keys, and for images smaller than 36×36."""
    env = DictEnv(("keys", "items", "a.b", "type"))
    env.observation_space.spaces["board"] = spaces.Box(0, 255, (7, 7, 3), np.uint8)
    model = make(env, "MultiInputPolicy").learn(50)
    assert model._n_updates > 0 and trunk_of(model).image_keys == ["board"]


@pytest.mark.parametrize("space", [spaces.Text(9), spaces.Sequence(spaces.Discrete(2)), spaces.Tuple([spaces.Discrete(2)])])
def test_spaces_without_a_shape_are_refused_by_name(space):
    env = DictEnv()
    env.observation_space.spaces["mission"] = space
    with pytest.raises(ValueError, match=r"observation_space\['mission'\] must be a Box, .* or a Dict of these, got "):
        EqRRainbow("MultiInputPolicy", env)
    env.observation_space = space
    with pytest.raises(ValueError, match=r"observation_space must be a Box, .* or a Dict of these, got "):
        EqRRainbow("MlpPolicy", env)


@EITHER
def test_a_rollout_that_is_stopped_takes_its_arguments_by_position(make):
    model = make(ChainEnv())
    _, callback = model._setup_learn(100, lambda *_: False)
    assert isinstance(callback, ConvertCallback)
    assert model.collect_rollouts(model.env, callback, model.train_freq, model.replay_buffer) == (1, 0, False)
