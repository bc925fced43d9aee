"""Components of EqRRainbow and options from later work, compared with hand-computed numbers or other implementations."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_eqr import EqRRainbow
from sb3_eqr.common.networks.encoders import ConvExtractor, ImpalaExtractor, ImpalaTrunk, rescaled
from sb3_eqr.common.networks.layers import NoisyLinear
from sb3_eqr.eqr_rainbow.policies import EqRRainbowPolicy
from tests.models import EITHER, MAKERS, PAPER, all_finite, loss_terms, same, tensors, untrained
from tests.toys import ChainEnv, ImageEnv

make_rainbow = MAKERS[1]


# ---------------------------------------------------------------------------------------------- C51, double Q, dueling


def set_head(stream, probabilities):
    """
    :param probabilities: one row per action, three numbers each
    """
    logs = th.tensor(probabilities).log()  # (A, 3)
    th.nn.init.zeros_(stream[-1].weight)
    with th.no_grad():
        stream[-1].bias.copy_(logs.T.flatten())  # (atoms, actions)


def outputs_of(network, obs):
    """The head's outputs without noise, (B, n_atoms, n_actions)."""
    return network.head(network.features(obs))


def test_dueling_by_hand():
    """
    The outputs are the biases. Value logits (ln 2, 0, 0); advantages (ln 2, 0, 0), 0 and 0, with the mean (ln 2 / 3, 0, 0). So
    the logits of atom -1 are 5/3 ln 2 for action 0 and 2/3 ln 2 for the others, and all other logits are 0.
    """
    network = {"n_atoms": 3, "v_min": -1.0, "v_max": 1.0, "net_arch": [], "noisy": False, "group": None, "dueling": True}
    model = make_rainbow(ChainEnv(), exploration_final_eps=0.1, prediction_depth=0, policy_kwargs=network)
    set_head(model.q_net.head.value, [[2.0, 1.0, 1.0]])
    set_head(model.q_net.head.advantage, [[2.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    weights = [2 ** (5 / 3), 2 ** (2 / 3), 2 ** (2 / 3)]
    expected = [(1 - w) / (w + 2) for w in weights]
    found = model.q_net(th.zeros(1, 3))
    np.testing.assert_allclose(found.detach().numpy(), [expected], rtol=1e-5)
    probabilities = outputs_of(model.q_net, th.zeros(1, 3)).softmax(dim=1)  # (1, 3 atoms, 3 actions)
    np.testing.assert_allclose(probabilities[0, :, 0].detach(), np.array([weights[0], 1, 1]) / (weights[0] + 2), rtol=1e-5)
    assert model.predict(np.zeros((1, 3), np.float32), deterministic=True)[0] in (1, 2)


@pytest.mark.parametrize("dueling", [True, False])
@pytest.mark.parametrize("v_min, v_max, centre", [(-4.0, 4.0, 0.0), (0.0, 8.0, 0.0), (2.0, 10.0, 2.0)])
def test_an_untrained_head_predicts_returns_near_0(dueling, v_min, v_max, centre):
    """Nine atoms with a spacing of 1, a spread of 2. The reference is PyTorch's Cauchy distribution."""
    network = {"v_min": v_min, "v_max": v_max, "dueling": dueling, "noisy": False}
    settings = {"exploration_final_eps": 0.1}
    plain, peaked = (
        make_rainbow(ChainEnv(), **settings, policy_kwargs={**network, "spread_init": spread}).q_net for spread in (None, 0.25)
    )
    obs = th.randn(5, 3)
    density = th.distributions.Cauchy(centre, 2.0).log_prob(th.linspace(v_min, v_max, 9))[None, :, None]
    expected = (outputs_of(plain, obs).log_softmax(dim=1) + density).log_softmax(dim=1)
    th.testing.assert_close(outputs_of(peaked, obs).log_softmax(dim=1), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("spread, lowest, highest", [(0.025, 50, 400), (None, 1.5, 5)])
def test_how_much_a_reward_raises_its_priority_at_first(spread, lowest, highest):
    """
    Rewards 1 and 0, γⁿ = 0.97, 51 atoms on [-20, 20]. By NumPy in float64, the KL divergences are 0.2241 and 0.000784 for the
    Cauchy distribution, 0.0420 and 0.0163 for equal probabilities; the random weights of the head change them a little.
    """
    network = {"n_atoms": 51, "v_min": -20.0, "v_max": 20.0, "noisy": False, "spread_init": spread}
    model = make_rainbow(ChainEnv(), exploration_final_eps=0.1, policy_kwargs=network)
    with th.no_grad():
        outputs = model.q_net.head(model.q_net.features(th.zeros(2, 3)))[:, :, 0]  # (2, 51)
        _, (paid, unpaid) = model.q_net.td_loss(outputs, outputs, th.tensor([[1.0], [0.0]]), th.full((2, 1), 0.97))
    assert lowest < paid / unpaid < highest


# ---------------------------------------------------------------------------------------------- exploration


@pytest.mark.parametrize("is_noisy", ["online", "target"])
def test_both_heads_are_noisy_in_an_update(make, is_noisy):
    """Without double Q, the target head alone chooses the next action, and without auxiliary losses nothing else is random."""
    model = make(ChainEnv(), prediction_depth=0, double_q=False).learn(46)
    for name in ("online", "target"):
        for layer in getattr(model.policy, name).head.modules():
            if isinstance(layer, NoisyLinear):
                th.nn.init.constant_(layer.weight_sigma, float(name == is_noisy))
                th.nn.init.constant_(layer.bias_sigma, float(name == is_noisy))
    samples = model.replay_buffer.sample(8)
    first, second = (loss_terms(model, samples).losses["td"] for _ in range(2))
    assert not th.allclose(first, second)


def test_acting_with_the_target_network():
    model = make_rainbow(ChainEnv(), tau=0.003, learning_rate=1e-3, policy_kwargs={"act_with_target": True}).learn(80)
    obs = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    with th.no_grad():
        online, target = (net(th.as_tensor(obs)).argmax(dim=1).numpy() for net in (model.q_net, model.q_net_target))
    assert (online != target).any()  # otherwise the test proves nothing
    assert np.array_equal(model.predict(obs, deterministic=True)[0], target)
    th.manual_seed(0)
    noisy = model.policy.predict(obs, deterministic=False)[0]
    th.manual_seed(0)
    assert np.array_equal(noisy, model.q_net_target._predict(th.as_tensor(obs), deterministic=False))
    model.policy.act_with_target = False
    assert np.array_equal(model.predict(obs, deterministic=True)[0], online)


# ---------------------------------------------------------------------------------------------- schedules


def test_the_buffer_uses_the_annealed_n_and_gamma(make, monkeypatch):
    resets = {"initial_n_steps": 8, "initial_gamma": 0.5, "annealing_steps": 10, "interval": 20}
    model = make(ChainEnv(), n_steps=2, gamma=0.95, resets=resets, seed=1)
    buffer, used = model.replay_buffer, []
    windows = buffer._windows

    def watched(*args):
        used.append((model._n_updates, buffer.n_steps, buffer.gamma))
        return windows(*args)

    monkeypatch.setattr(buffer, "_windows", watched)
    model.learn(80)
    assert model._resets.done == [20, 40, 60]
    assert [update for update, _, _ in used] == list(range(model._n_updates))
    for update, n_steps, gamma in used:
        share = min(update % 20, 10) / 10
        assert n_steps == round(8 * 0.25**share)
        assert gamma == pytest.approx(1 - 0.5 * 0.1**share)
    assert {n for _, n, _ in used} == {8, 7, 6, 5, 4, 3, 2}


# ---------------------------------------------------------------------------------------------- resets


@pytest.mark.parametrize("n_envs, train_freq, n_steps", [(1, 64, 65), (8, 8, 70)])
def test_the_last_round_is_whole_and_counts_for_resets(make, n_envs, train_freq, n_steps):
    """Two rounds of 128 updates, although few steps are left for the second: 64 updates follow each of three resets."""
    rounds = {"train_freq": train_freq, "gradient_steps": 128, "learning_starts": 0, "resets": {"interval": 64}}
    model = make(DummyVecEnv([ChainEnv] * n_envs), **rounds).learn(n_steps)
    assert model._n_updates == 256 and model._resets.done == [64, 128, 192]


class Thirteen(ChainEnv):
    """All episodes have 13 steps."""

    def step(self, action):
        self.position = 0.0
        observation, reward, *_ = super().step(action)
        return observation, reward, self.time == 13, False, {}


def test_the_last_episode_is_whole_and_counts_for_resets(make):
    """Episodes of 13 steps, of which the tenth ends at step 130: 7 updates after each."""
    rounds = {"train_freq": (1, "episode"), "gradient_steps": 7, "learning_starts": 0, "resets": {"interval": 10}}
    model = make(Thirteen(), **rounds).learn(120)
    assert model._n_updates == 70 and model._resets.done == [10, 20, 30, 40, 50, 60]


@pytest.mark.parametrize("alpha, projection", [(0.5, "head"), (0.2, "own"), (0.0, "none"), (1.0, "head")])
def test_a_reset_bit_for_bit(make, alpha, projection):
    network = PAPER if projection == "head" else {"projection": projection}
    model = make(ChainEnv(), resets={"interval": 20, "shrink_factor": alpha}, tau=0.1, policy_kwargs=network).learn(50)
    assert model._n_updates == 20 and model._resets.done == []  # a reset comes before the next update
    old = tensors(model)
    state = th.get_rng_state()
    fresh = make(ChainEnv(), policy_kwargs=network)  # sets the seed, so restore the generator's state for the reset
    th.set_rng_state(state)
    drawn = type(model.policy)(model.observation_space, model.action_space, lambda _: 0.0, **fresh.policy_kwargs).state_dict()
    th.set_rng_state(state)
    model._reset()
    online = "q_net" if make is make_rainbow else "quantile_net"
    kinds = {"fresh": 0, "perturbed": 0, "kept": 0}
    for name, value in model.policy.state_dict().items():
        if "_target" in name:
            continue
        if ".head." in name or name.startswith(("latent_model.projection.", "latent_model.predictor.")):
            assert th.equal(value, drawn[name]) and not th.equal(value, old[name])
            kinds["fresh"] += 1
        elif "running_" in name or "num_batches" in name:
            assert value == 0 if name.endswith("running_count") else th.equal(value, old[name])
            kinds["kept"] += 1
        else:
            assert name.startswith((f"{online}.features_extractor.", "latent_model."))
            assert th.equal(value, alpha * old[name] + (1 - alpha) * drawn[name]), name
            kinds["perturbed"] += 1
    assert min(kinds.values()) > 0
    assert len(model.policy.optimizer.state) == 0
    for pair in (*model.policy.target_copy.pairs, *model.policy.latent_target_copy.pairs):
        assert same(*(list(part.parameters()) for part in pair))
    before = tensors(model)
    model.learn(8, reset_num_timesteps=False)  # training continues
    assert untrained(model, before) == [] and all_finite(model)


@EITHER
def test_a_target_that_waits_is_copied_again_once_the_features_are_new(make):
    """One batch after the reset, which is before update 20: until then, its running mean is that of the old features."""
    model = make(ChainEnv(), resets={"interval": 20}, target_update_interval=1_000).learn(50)
    model.learn(18, reset_num_timesteps=False)
    assert model._resets.done == [20] and counts_of_features(model) == ({1}, {36})


@EITHER
def test_a_target_that_waits_has_the_statistics_of_the_first_batch(make):
    """Zeros would leave in its features what all observations have in common. Its parameters are the initial ones."""
    first, model = (make(ChainEnv(), target_update_interval=1_000, seed=0) for _ in range(2))
    model.learn(60)
    assert counts_of_features(model) == ({1}, {model._n_updates}) and model._n_updates > 1
    for initial, found in zip(first.policy.target.parameters(), model.policy.target.parameters(), strict=True):
        assert th.equal(initial, found)


def counts_of_features(model):
    """Numbers of batches in the statistics of the target's features, and of the others."""
    counts = {name: value.item() for name, value in model.policy.state_dict().items() if name.endswith("running_count")}
    return tuple(
        {count for name, count in counts.items() if ("net_target" in name) == is_target} for is_target in (True, False)
    )


@EITHER
def test_when_resets_happen(make):
    """As in BBF, only if a full interval of updates is left after the reset."""
    model = make(ChainEnv(), resets={"interval": 6}).learn(65)  # 50 updates in steps 41 to 65, two per step
    assert model._n_updates == 50
    assert model._resets.done == [6, 12, 18, 24, 30, 36, 42]  # after 42, 8 are left; after 48, 2
    assert make(ChainEnv(), resets={"interval": 25}).learn(65)._resets.done == [25]  # after which 25 are left
    within_rounds = make(ChainEnv(), resets={"interval": 7}, gradient_steps=3).learn(50)
    assert within_rounds._resets.done == [7, 14, 21]
    postponed = make(ChainEnv(), resets={"interval": 15}).learn(50)  # too few updates are left in this call of learn
    assert (postponed._n_updates, postponed._resets.done) == (20, [])
    assert postponed.learn(20, reset_num_timesteps=False)._resets.done == [20, 35]


@EITHER
def test_a_call_of_learn_that_is_too_short_for_a_reset_warns(make):
    """Two updates per step after step 40: 100 in one call, of which a reset after 50 leaves 50; 40 in each of two."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(ChainEnv(), resets={"interval": 50}).learn(90)
    model = make(ChainEnv(), resets={"interval": 50})
    for steps in (60, 20):
        with pytest.warns(UserWarning, match="interval=50 is too long for a reset in this call of learn"):
            model.learn(steps, reset_num_timesteps=False)
    assert model._resets.done == []


@EITHER
def test_episodes_are_counted_without_monitor(make):
    """Rounds of one episode of 5 steps, an update each: 18 after step 10 of 100; after 12 of these, 6 are left."""

    class Still(ChainEnv):
        def step(self, action):
            self.position = 0.0
            return super().step(1)

    env = DummyVecEnv([lambda: Still(5)])
    model = make(env, train_freq=(1, "episode"), gradient_steps=1, learning_starts=10, n_steps=1, resets={"interval": 4})
    assert model.learn(100)._n_updates == 18 and model._resets.done == [4, 8, 12]


def test_a_reset_that_waits_for_a_longer_window_is_done_once(make):
    """A reset after 4 updates raises n from 2 to 60, while the buffer has about 45 transitions; the target waits, too."""
    resets = {"interval": 4, "annealing_steps": 1}
    model = make(ChainEnv(), n_steps=2, resets=resets, target_update_interval=1_000).learn(42)
    assert model._n_updates == 4
    model.resets = replace(model.resets, initial_n_steps=60)
    model.learn(8, reset_num_timesteps=False)
    assert model._n_updates == 4 and model._resets.done == [4]
    model.resets = replace(model.resets, interval=1_000)
    model.learn(20, reset_num_timesteps=False)
    updates = model._n_updates - 4
    assert updates > 1 and counts_of_features(model) == ({1}, {updates})


def test_resets_do_not_change_frozen_parameters():
    model = make_rainbow(ChainEnv(), resets={"interval": 6}, policy_kwargs={"net_arch": [32, 32]})
    frozen = [*model.q_net.features_extractor.parameters(), *model.q_net.head.value[0].parameters()]
    for parameter in frozen:
        parameter.requires_grad_(False)
    before = tensors(frozen)
    model.learn(50)
    assert len(model._resets.done) > 0 and same(before, frozen)


class PolicyWithAnArgument(EqRRainbowPolicy):
    def __init__(self, *args, head_scale=1.0, **kwargs):
        self.head_scale = head_scale
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        with th.no_grad():
            for parameter in self.q_net.head.parameters():
                parameter.mul_(self.head_scale)


def test_a_reset_initialises_a_custom_policy_with_its_arguments():
    model = EqRRainbow(PolicyWithAnArgument, ChainEnv(), buffer_size=100, policy_kwargs={"head_scale": 0.0})
    model.set_logger(configure(None, []))
    model._reset()
    assert all((parameter == 0).all() for parameter in model.q_net.head.parameters())


# ---------------------------------------------------------------------------------------------- optimiser, trunk


@pytest.mark.parametrize("name", ["AdamW", th.optim.AdamW])
def test_weight_decay_applies_to_matrices_only(make, name):
    """With a learning rate of 1, no gradient and a decay of 1/4, one step leaves 3/4 of the decayed weights."""
    network = {"optimizer_class": name, "optimizer_kwargs": {"eps": 1.5e-4, "weight_decay": 0.25}}
    model = make(ChainEnv(), learning_rate=1.0, policy_kwargs=network)
    optimizer = model.policy.optimizer
    assert isinstance(optimizer, th.optim.AdamW) and optimizer.defaults["eps"] == 1.5e-4
    with th.no_grad():
        for p in model._trained:
            p.grad = th.zeros_like(p)
            p.fill_(1.0)
    optimizer.step()
    assert {p.ndim for p in model._trained} == {1, 2}
    policy = model.policy
    parts = [policy.online, policy.latent_model]
    for key, p in [named for part in parts for named in part.named_parameters()]:
        assert (p == (0.75 if p.ndim == 2 and "sigma" not in key else 1.0)).all(), key  # decay would remove the noise
    trained = {id(p) for group in optimizer.param_groups for p in group["params"]}
    assert trained == {id(p) for part in parts for p in part.parameters()}
    model.set_logger(configure(None, []))
    model.lr_schedule = lambda progress: 0.125
    model._update_learning_rate(optimizer)
    assert {group["lr"] for group in optimizer.param_groups} == {0.125}


def test_impala_follows_the_paper():
    """Espeholt et al. 2018: 15 convolutions in 3 stages, each with a pooling by 2; parameters counted by hand."""
    trunk = ImpalaTrunk(4)
    convolutions = [m for m in trunk.modules() if isinstance(m, th.nn.Conv2d)]
    assert len(convolutions) == 15
    widths = [(4, 16), (16, 32), (32, 32)]
    expected = sum(9 * a * b + b + 4 * (9 * b * b + b) for a, b in widths)
    assert sum(p.numel() for p in trunk.parameters()) == expected
    assert trunk(th.rand(2, 4, 84, 84)).shape == (2, 32 * 11 * 11)
    assert ImpalaTrunk(4, width_scale=4)(th.rand(1, 4, 36, 36)).shape == (1, 128 * 5 * 5)
    assert ImpalaTrunk(4, width_scale=0.5)(th.rand(1, 4, 36, 36)).shape == (1, 16 * 5 * 5)
    assert (trunk(th.rand(2, 4, 40, 40)) >= 0).all()
    x = th.rand(2, 4, 20, 20)
    by_hand = x
    for stage in range(3):
        conv, _, *blocks = list(trunk)[4 * stage : 4 * stage + 4]
        by_hand = th.nn.functional.max_pool2d(conv(by_hand), 3, 2, 1)
        for block in blocks:
            by_hand = by_hand + block.conv2(block.conv1(by_hand.clamp(min=0)).clamp(min=0))
    th.testing.assert_close(trunk(x), by_hand.clamp(min=0).flatten(1), rtol=1e-4, atol=1e-6)


def test_latents_are_scaled_to_the_unit_interval():
    features = th.tensor([[1.0, 3.0, 2.0], [-5.0, -5.0, 15.0], [4.0, 4.0, 4.0]])
    expected = th.tensor([[0.0, 1.0, 0.5], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    th.testing.assert_close(rescaled(features), expected, rtol=1e-4, atol=1e-4)
    space = ImageEnv((3, 40, 36)).observation_space
    for extractor in (ImpalaExtractor(space, rescale=True, width_scale=0.5), ConvExtractor(space, rescale=True)):
        found = extractor(th.rand(4, 3, 40, 36))
        assert found.amin() >= 0 and found.amax() <= 1 and (found.amax(dim=1) > 0.99).all() and found.shape[1] > 50
    with_layer, images = ConvExtractor(space, rescale=True, features_dim=8), th.rand(4, 3, 40, 36)
    th.testing.assert_close(with_layer(images), with_layer.linear(rescaled(with_layer.trunk(images))))


def test_custom_filters():
    """Such as the two 5x5 convolutions of data-efficient Rainbow."""
    space = ImageEnv((4, 84, 84)).observation_space
    extractor = ConvExtractor(space, layers=[[32, 5, 5], [64, 5, 5]])
    assert extractor.features_dim == 64 * 3 * 3
    with pytest.raises(ValueError, match=r"at least 25x25 pixels, got \(4, 24, 24\)"):
        ConvExtractor(ImageEnv((4, 24, 24)).observation_space, layers=[[32, 5, 5], [64, 5, 5]])
