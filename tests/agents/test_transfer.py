"""Transfer of a representation from one run to another."""

import pytest
import torch as th
from sb3_contrib import QRDQN as StockQRDQN

from sb3_eqr import EqRQRDQN, EqRRainbow
from sb3_eqr.common.groups import SO
from sb3_eqr.common.saving.transfer import representation
from tests.models import BOTH, EITHER, MAKERS, loss_terms, same, tensors
from tests.toys import ChainEnv, DictEnv

QRDQN, RAINBOW = MAKERS
WHITENED = {"whiten": True, "group": "SO(3)", "parameterization": "gram-schmidt"}


def states(model):
    """Copies of the parameters and statistics of every network of the representation."""
    return tensors(th.nn.ModuleDict(representation(model.policy)))


@pytest.fixture
def frozen(make, tmp_path):
    """An agent with the frozen representation of another one; both are whitened."""
    make(ChainEnv(), policy_kwargs=WHITENED, seed=1).learn(46).save(tmp_path / "old")
    return make(ChainEnv(), policy_kwargs=WHITENED).load_representation(tmp_path / "old", freeze=True)


@BOTH
@pytest.mark.parametrize("giver, taker", [(QRDQN, RAINBOW), (RAINBOW, QRDQN), (QRDQN, QRDQN)])
def test_only_encoder_and_latent_model_are_transferred(tmp_path, giver, taker, network):
    network = {**WHITENED, **network}
    old = giver(ChainEnv(), policy_kwargs=network, seed=1).learn(46)
    old.save(tmp_path / "old")
    new = taker(ChainEnv(), policy_kwargs=network).learn(46)
    own = [new.policy.online.head, new.policy.latent_model.reward_net]
    kept = [tensors(part) for part in own]
    assert not same(states(old), states(new))
    assert new.load_representation(tmp_path / "old") is new
    assert same(states(old), states(new))
    assert all(map(same, kept, own))
    target, online = new.policy.latent_target, new.policy.latent_model
    assert th.equal(target.transition[0].weight, online.transition[0].weight)
    pairs = [(old.policy.latent_model.embedding, target.embedding)]
    pairs.append((old.policy.online.features_extractor, new.policy.target.features_extractor))
    assert all(same(*pair) for pair in pairs)
    assert any("to_algebra" in key for given, _ in pairs for key in given.state_dict())
    assert not any(p in new.policy.optimizer.state for m in representation(new.policy).values() for p in m.parameters())
    before = states(new)
    new.learn(8, reset_num_timesteps=False)
    assert not same(before, states(new))  # training continues


def test_frozen_networks_survive_training_saving_and_resets(make, frozen, tmp_path):
    model = frozen
    model.resets = {"interval": 6}
    before, head = states(model), model.policy.online.head.advantage[0].weight.clone()
    model.learn(46)
    assert same(before, states(model)) and not th.equal(head, model.policy.online.head.advantage[0].weight)
    model.save(tmp_path / "new")
    logged = loss_terms(model, model.replay_buffer.sample(8)).metrics()
    assert not any("state_gradient" in name for name in logged)
    loaded = make.algorithm.load(tmp_path / "new", env=ChainEnv())
    loaded.learn(46)
    assert same(before, states(loaded)) and loaded._resets.done  # a reset does not change it either
    assert not th.equal(head, loaded.policy.online.head.advantage[0].weight)


@pytest.mark.parametrize(
    "changes, found",
    [
        ({"n_blocks": 4}, "group: parameters must be for 'SE\\(2\\)\\^4, euler', got"),
        ({"group": "T(9)", "n_blocks": 1}, "group: parameters must be for 'T\\(9\\)\\^1, euler', got"),
        ({"latent_hidden_dim": 8}, "load_representation: transition.* must be the same"),
        ({"state_dependent_actions": False}, "load_representation: transition.* must be the same"),
        ({"parameterization": "exp"}, "must be for 'SE\\(2\\)\\^3, exp', got parameters for 'SE\\(2\\)\\^3, euler'"),
        ({"whiten": True}, "missing"),
    ],
)
def test_a_representation_that_does_not_fit_changes_nothing(tmp_path, changes, found):
    QRDQN(ChainEnv(), seed=1).save(tmp_path / "old")
    model = QRDQN(ChainEnv(), policy_kwargs=changes)
    before = states(model)
    with pytest.raises(ValueError, match=found):
        model.load_representation(tmp_path / "old")
    assert same(before, states(model))


@EITHER
def test_keys_of_observations_must_have_the_same_order(make, tmp_path):
    """The encoder concatenates them, so weights would multiply the wrong numbers."""
    env, other = DictEnv(), DictEnv(("angle", "velocity"))
    make(env, "MultiInputPolicy").save(tmp_path / "old")
    make(env, "MultiInputPolicy").load_representation(tmp_path / "old")
    with pytest.raises(ValueError, match=r"keys: parameters must be for 'angle, velocity', got .*'velocity, angle'"):
        make(other, "MultiInputPolicy").load_representation(tmp_path / "old")


def test_files_that_are_not_agents(tmp_path):
    (tmp_path / "cut.zip").write_bytes(b"PK")
    with pytest.raises(ValueError, match="must be a complete file"):
        QRDQN(ChainEnv()).load_representation(tmp_path / "cut")
    StockQRDQN("MlpPolicy", ChainEnv(), device="cpu").save(tmp_path / "stock")
    with pytest.raises(ValueError, match="must be a file of EqRQRDQN or EqRRainbow"):
        QRDQN(ChainEnv()).load_representation(tmp_path / "stock")
    for algorithm in (EqRQRDQN, EqRRainbow):
        with pytest.raises(FileNotFoundError):
            algorithm("MlpPolicy", ChainEnv(), device="cpu").load_representation(tmp_path / "nothing")


def test_frozen_networks_can_be_unfrozen(make, frozen, tmp_path):
    model = frozen.learn(45)
    before = states(model)
    model.load_representation(tmp_path / "old", freeze=False)
    assert same(before, states(model)) and not model.representation_frozen
    fresh = make(ChainEnv(), policy_kwargs=WHITENED).policy.named_parameters()
    assert [p.requires_grad for p in model.policy.parameters()] == [p.requires_grad for _, p in fresh]
    model.learn(46)
    assert not same(before, states(model))


def test_a_frozen_representation_needs_a_loss_that_uses_it(frozen):
    frozen.td_coef = frozen.reward_coef = 0.0
    with pytest.raises(ValueError, match="td_coef must be > 0 with a frozen representation"):
        frozen.learn(46)
    with pytest.raises(ValueError, match="td_coef must be > 0 with a frozen representation"):
        QRDQN(ChainEnv(), td_coef=0.0, reward_coef=0.0).load_representation("nothing", freeze=True)


def test_a_group_given_as_an_object_is_compared_with_its_parameterization(tmp_path):
    network = {"n_blocks": 2, "group": SO(3, "exp")}
    QRDQN(ChainEnv(), policy_kwargs=network).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"must be for 'SO\(3\)\^2, euler', got parameters for 'SO\(3\)\^2, exp'"):
        QRDQN(ChainEnv(), policy_kwargs={**network, "group": SO(3, "euler")}).load_representation(tmp_path / "model")
