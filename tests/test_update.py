"""One update, taken apart: targets, weights, priorities, the way of the gradient."""

import numpy as np
import pytest
import torch as th

from tests.test_run import make
from tests.toys import ChainEnv, ImageEnv


def trained_model(**kwargs):
    policy_kwargs = {"noisy": False, **kwargs.pop("policy_kwargs", {})}
    settings = {"tau": 0.1, "exploration_final_eps": 0.1, **kwargs}
    return make(ChainEnv(), policy_kwargs=policy_kwargs, **settings).learn(120)


@pytest.mark.parametrize("double_q", [True, False])
@pytest.mark.parametrize("dueling", [True, False])
def test_td_loss_by_loops(double_q, dueling):
    model = trained_model(double_q=double_q, policy_kwargs={"dueling": dueling}, prediction_depth=0, gamma=0.9)
    model.policy.set_training_mode(False)
    samples = model.replay_buffer.sample(16)
    with th.no_grad():
        td, _ = model._compute_losses(samples)
        now = model.quantile_net(samples.observations).double().numpy()  # (16, 9, 3)
        online = model.quantile_net(samples.next_observations).double().numpy()
        target = model.quantile_net_target(samples.next_observations).double().numpy()
    assert not np.allclose(online, target)  # or the test could not tell double Q
    chosen = set()
    for b in range(16):
        best = int(np.argmax((online if double_q else target)[b].mean(axis=0)))
        chosen.add(best == int(np.argmax(target[b].mean(axis=0))))
        alive = 1 - samples.dones[b, 0].item()
        goal = samples.rewards[b, 0].item() + alive * samples.discounts[b, 0].item() * target[b, :, best]
        current = now[b, :, samples.actions[b, 0].item()]
        expected = 0.0
        for i in range(9):
            for j in range(9):
                u = goal[j] - current[i]
                huber = 0.5 * u * u if abs(u) <= 1 else abs(u) - 0.5
                expected += abs((i + 0.5) / 9 - (u < 0)) * huber / 9
        assert td.loss[b].item() == pytest.approx(expected, rel=1e-4)
        assert td.q_values[b].item() == pytest.approx(current.mean(), rel=1e-4, abs=1e-6)
    assert th.equal(td.priorities, td.loss)


def test_target_states_reach_the_latent_model_in_order(monkeypatch):
    """The online and target encodings of s_t, s_{t+1} ... s_{t+M}, each in its place."""
    model = trained_model()
    samples = model.replay_buffer.sample(8)
    seen = {}
    forward = type(model.policy.latent_model).forward
    monkeypatch.setattr(
        type(model.policy.latent_model), "forward", lambda self, *args: seen.update(args=args) or forward(self, *args)
    )
    model._compute_losses(samples)
    state, actions, rewards, mask, target_states = seen["args"][:5]
    th.testing.assert_close(state, model.quantile_net.features(samples.observations))
    assert actions is samples.rollout_actions and rewards is samples.rollout_rewards and mask is samples.mask
    assert target_states.shape[1] == 3 and not target_states.requires_grad
    target = model.quantile_net_target
    th.testing.assert_close(target_states[:, 0], target.features(samples.observations).detach())
    for m in range(2):
        expected = target.features(samples.rollout_observations[:, m]).detach()
        th.testing.assert_close(target_states[:, m + 1], expected)


def test_replay_weights_multiply_every_loss():
    model = trained_model(max_grad_norm=None, learning_rate=1e-3)
    samples = model.replay_buffer.sample(8)
    model.policy.set_training_mode(True)

    def gradients(weights):
        th.manual_seed(0)
        model._update(samples._replace(weights=weights))
        return [p.grad.clone() for p in model._trained]

    states = {name: p.clone() for name, p in model.policy.state_dict().items()}
    full = gradients(th.ones(8))
    model.policy.load_state_dict(states)
    half = gradients(th.full((8,), 0.5))
    model.policy.load_state_dict(states)
    none = gradients(th.zeros(8))
    assert all(th.isfinite(g).all() and g.abs().sum() > 0 for g in full)
    for f, h, n in zip(full, half, none, strict=True):
        th.testing.assert_close(h, f / 2)
        assert (n == 0).all()


def test_new_priorities_are_td_losses():
    model = trained_model(priority_alpha=0.5)
    samples = model.replay_buffer.sample(8)
    with th.no_grad():
        td, _ = model._compute_losses(samples)
    model._update(samples)
    found = model.replay_buffer._tree.get(samples.indices)
    last = {int(i): b for b, i in enumerate(samples.indices)}  # of a leaf drawn twice, the last counts
    for index, b in last.items():
        expected = (td.loss[b].item() + 1e-6) ** 0.5
        assert found[list(samples.indices).index(index)] == pytest.approx(expected, rel=1e-5)


def test_gradients_are_clipped_together():
    model = trained_model(max_grad_norm=0.01)
    model._update(model.replay_buffer.sample(8))
    norm = th.stack([p.grad.norm() for p in model._trained]).norm().item()
    assert norm == pytest.approx(0.01, rel=1e-3)
    trained = {id(p) for p in model._trained}
    latent = {id(p) for p in model.policy.latent_model.parameters()}
    assert latent < trained and {id(p) for p in model.quantile_net.parameters()} < trained


def test_one_features_pass_serves_both(monkeypatch):
    model = make(ImageEnv(), "CnnPolicy").learn(60)
    calls = []
    network = type(model.quantile_net)
    features = network.features
    monkeypatch.setattr(network, "features", lambda self, obs: calls.append((self, len(obs))) or features(self, obs))
    model.train(1, 8)
    # s_t with gradient, then everything that the target sees: s_{t+n} and M steps of rollout.
    assert calls == [(model.quantile_net, 8), (model.quantile_net_target, 8 * (1 + 2))]


def test_online_and_target_observations_are_augmented(monkeypatch):
    model = make(ImageEnv(), "CnnPolicy").learn(60)
    seen = []
    augment = model._augment.images
    monkeypatch.setattr(model._augment, "images", lambda x: seen.append(len(x)) or augment(x))
    model.train(1, 8)
    assert seen == [8, 24]


@pytest.mark.parametrize("off", [{"shift_pixels": 0}, {"intensity_scale": 0.0}, {}])
def test_augmentation_switches(off):
    model = make(ImageEnv(), "CnnPolicy", **off)
    images = th.randint(1, 256, (16, 1, 36, 36), dtype=th.uint8)
    found = model._augment(images)
    moved = not all(th.equal((f > 0), (i > 0)) for f, i in zip(found, images, strict=True))
    assert not moved  # every pixel is above 0 before and after
    integral = th.equal(found, found.float().round())
    assert integral == ("intensity_scale" in off)
    if "shift_pixels" in off:
        ratios = (found / images).flatten(1)
        th.testing.assert_close(ratios, ratios[:, :1].expand_as(ratios))
    else:
        assert not th.equal(found, images)
