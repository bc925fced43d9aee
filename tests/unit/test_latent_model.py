import math

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_eqr.common.groups import make_group
from sb3_eqr.common.latent.conv_latent_model import ConvLatentModel
from sb3_eqr.common.latent.latent_model import GroupLatentModel


def identity(states):
    return states


class KnownActions(GroupLatentModel):
    """SO(2), one block. In every state κ turns by +θ for action 0 and by −θ for action 1."""

    def __init__(self, theta):
        super().__init__(make_group("SO(2)"), 1, 2, state_dependent_actions=False)
        self.theta = theta
        self.double()

    def action_params(self, state, actions):
        return self.theta * (1.0 - 2.0 * actions[:, None].to(state.dtype))


class Constant(nn.Module):
    def __init__(self, *values):
        super().__init__()
        self.values = th.tensor([values], dtype=th.float64)

    def forward(self, inputs):
        return self.values.expand(len(inputs), -1)


def rotation(angles):
    cos, sin = np.cos(angles), np.sin(angles)
    return th.tensor(np.stack([cos, sin, -sin, cos], axis=-1))  # flattened [[cos, sin], [-sin, cos]]


def rotation_world(theta, rho_angle=0.0, mask=None):
    """Losses for three starts and a few actions, where the true rotation is ±0.7 radians."""
    model, target = KnownActions(theta), KnownActions(0.7)
    model.action_symmetry, model.projection, target.projection = Constant(rho_angle), nn.Identity(), nn.Identity()
    model.reward_net = Constant(0.25)
    starts = np.array([0.0, 1.0, -2.5])
    actions = th.tensor([[0, 0, 1], [1, 1, 1], [0, 1, 0]])
    turns = np.cumsum(np.where(actions == 0, 0.7, -0.7), axis=1)
    angles = np.concatenate([starts[:, None], starts[:, None] + turns], axis=1)
    rewards = th.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.25, 0.25, 0.25]], dtype=th.float64)
    mask = th.ones(3, 3, dtype=th.float64) if mask is None else mask
    truth = rotation(angles)
    return model(rotation(starts), actions, rewards, mask, truth[:, 0], truth[:, 1:], target, identity, identity), turns


def test_the_true_kappa_has_no_transition_loss():
    losses, _ = rotation_world(0.7)
    assert losses.aet.abs().max() < 1e-14
    assert losses.symmetry.abs().max() < 1e-14


def test_losses_of_wrong_kappas_by_hand():
    """The loss of two normalised rotation matrices that differ by the angle δ is 2 − 2 cos δ."""
    losses, turns = rotation_world(0.0)  # never moves
    np.testing.assert_allclose(losses.aet, (2 - 2 * np.cos(turns)).mean(axis=1), atol=1e-12)
    np.testing.assert_allclose(losses.symmetry, [2 - 2 * math.cos(0.7)] * 3, atol=1e-12)
    losses, turns = rotation_world(-0.7)  # moves the wrong way
    np.testing.assert_allclose(losses.aet, (2 - 2 * np.cos(2 * turns)).mean(axis=1), atol=1e-12)


def test_a_wrong_rho_affects_get_only():
    losses, _ = rotation_world(0.7, rho_angle=0.4)
    assert losses.aet.abs().max() < 1e-14
    np.testing.assert_allclose(losses.symmetry, [2 - 2 * math.cos(0.4)] * 3, atol=1e-12)


def test_reward_loss_by_hand():
    losses, _ = rotation_world(0.7)  # predicts 0.25 everywhere
    expected = [(0.75**2 + 2 * 0.25**2) / 3, (2 * 0.25**2 + 1.25**2) / 3, 0.0]
    np.testing.assert_allclose(losses.reward, expected, atol=1e-12)


def test_every_loss_uses_the_mask():
    mask = th.tensor([[1.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 1.0, 0.0]], dtype=th.float64)
    losses, turns = rotation_world(0.0, mask=mask)
    costs = 2 - 2 * np.cos(turns)
    np.testing.assert_allclose(losses.aet, [costs[0, 0], costs[1].mean(), costs[2, :2].mean()], atol=1e-12)
    np.testing.assert_allclose(losses.reward, [0.75**2, (2 * 0.25**2 + 1.25**2) / 3, 0.0], atol=1e-12)
    losses, _ = rotation_world(0.0, mask=th.zeros(3, 3, dtype=th.float64))
    assert all((loss == 0).all() for loss in losses)


def random_case(group="SE(2)", n_blocks=3, reward_loss="mse", norm="layer", batch=6, depth=4, seed=0):
    th.manual_seed(seed)
    made = make_group(group)
    model = GroupLatentModel(made, n_blocks, 5, hidden_dim=16, reward_loss=reward_loss, norm=norm).double()
    target = GroupLatentModel(made, n_blocks, 5, hidden_dim=16, reward_loss=reward_loss, norm=norm).double()
    target.requires_grad_(False).eval()
    params = th.randn(batch, depth + 1, n_blocks, made.num_params, dtype=th.float64)
    case = {
        "state": made.element(th.randn(batch, n_blocks, made.num_params, dtype=th.float64)).flatten(1),
        "actions": th.randint(5, (batch, depth)),
        "rewards": th.randn(batch, depth, dtype=th.float64),
        "mask": th.ones(batch, depth, dtype=th.float64),
        "target_state": made.element(params[:, 0]).flatten(1),
        "target_rollout": made.element(params[:, 1:]).flatten(2),
        "target": target,
        "project": nn.Linear(2 * n_blocks * 3, 7).double(),
        "target_project": nn.Linear(2 * n_blocks * 3, 7).double().requires_grad_(False),
    }
    return model, case


def test_against_loops_over_samples_and_blocks():
    """All of Eq. 18 and 19, one sample and one 3×3 matrix at a time; SE(2) is not commutative, so the order matters."""
    model, case = random_case()
    model.eval()
    state = th.get_rng_state()
    losses = model(**case)
    th.set_rng_state(state)
    partners = th.randint(6, (6,))

    def se2(params):
        c, s = np.cos(params[0]), np.sin(params[0])
        return np.array([[c, s, params[1]], [-s, c, params[2]], [0, 0, 1]])

    def run(network, *inputs):
        with th.no_grad():
            return network(th.tensor(np.concatenate(inputs))[None])[0].numpy()

    def elements(network, *inputs):
        return [se2(p) for p in run(network, *inputs).reshape(3, 3)]

    def blocks(flat):
        return [np.vstack([top, [0, 0, 1]]) for top in flat.reshape(3, 2, 3)]

    def entries(matrices):
        return np.stack(matrices)[:, :2].ravel()  # the last row is constant

    def distance(a, b):
        return np.sum((a / np.linalg.norm(a) - b / np.linalg.norm(b)) ** 2)

    for i in range(6):
        x = case["state"][i].numpy()
        aet = reward = 0.0
        predictions = []
        for m in range(4):
            action = np.eye(5)[case["actions"][i, m]]
            moved = [k @ b for k, b in zip(elements(model.transition, x, action), blocks(x), strict=True)]
            x = entries(moved)
            predictions.append(x)
            truth = case["target_rollout"][i, m].numpy()
            aet += distance(run(case["project"], x), run(case["target_project"], truth))
            reward += (run(model.reward_net, x)[0] - case["rewards"][i, m].item()) ** 2
        assert losses.aet[i].item() == pytest.approx(aet / 4, rel=1e-10)
        assert losses.reward[i].item() == pytest.approx(reward / 4, rel=1e-10)

        start, partner = case["state"][i].numpy(), case["target_state"][partners[i]].numpy()
        symmetry = [p @ np.linalg.inv(s) for p, s in zip(blocks(partner), blocks(start), strict=True)]
        left = entries([g @ b for g, b in zip(symmetry, blocks(predictions[0]), strict=True)])
        rho = elements(model.action_symmetry, entries(symmetry))
        kappa = elements(case["target"].transition, start, np.eye(5)[case["actions"][i, 0]])
        right = entries([r @ k @ p for r, k, p in zip(rho, kappa, blocks(partner), strict=True)])
        get = distance(run(model.projection, left), run(case["target"].projection, right))
        assert losses.symmetry[i].item() == pytest.approx(get, rel=1e-10)


@pytest.mark.parametrize("norm", ["layer", "batch"])
@pytest.mark.parametrize("reward_loss", ["mse", "categorical"])
def test_masked_steps_have_no_influence(reward_loss, norm):
    """Nor on the other samples, although batch norm sees all of them."""
    model, case = random_case(reward_loss=reward_loss, norm=norm)
    model.train()
    case["mask"] = th.tensor([[1, 1, 1, 1]] * 4 + [[1, 0, 0, 0], [1, 1, 1, 0]], dtype=th.float64)
    case["state"].requires_grad_()

    def run(**changes):
        th.manual_seed(1)
        model.zero_grad()
        case["state"].grad = None
        losses = model(**{**case, **changes})
        sum(loss.sum() for loss in losses).backward()
        return [*losses, case["state"].grad.clone(), *(p.grad.clone() for p in model.parameters())]

    rewards, actions, targets = case["rewards"].clone(), case["actions"].clone(), case["target_rollout"].clone()
    hidden = case["mask"] == 0
    rewards[hidden], actions[hidden] = -77.0, 4
    targets[hidden] = 123.0
    before = run()
    after = run(rewards=rewards, actions=actions, target_rollout=targets)
    assert all(th.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_an_unusual_state_changes_the_others_with_batch_norm_only(norm):
    model, case = random_case(norm=norm)
    usual = case["state"]
    unusual = usual.clone()
    unusual[0] *= 100
    with th.no_grad():
        before, after = (model.rollout(state, case["actions"])[1:] for state in (usual, unusual))
    assert th.equal(before, after) == (norm == "layer")
    with th.no_grad():
        acting = model.eval().rollout(usual, case["actions"])[1:]
    assert th.equal(before, acting) == (norm == "layer")  # the same predictions in training and after it


def test_each_loss_trains_its_networks_only():
    model, case = random_case()
    state = case["state"].requires_grad_()
    th.manual_seed(0)
    losses = model(**case)

    def grads(loss):
        inputs = {"state": state, **dict(model.named_parameters()), "p": case["project"].weight}
        found = th.autograd.grad(loss.sum(), list(inputs.values()), retain_graph=True, allow_unused=True)
        return {name.split(".")[0] for name, grad in zip(inputs, found, strict=True) if grad is not None}

    assert grads(losses.aet) == {"state", "transition", "p"}
    assert grads(losses.reward) == {"state", "transition", "reward_net"}
    assert grads(losses.symmetry) == {"state", "transition", "action_symmetry", "projection"}
    assert all(p.grad is None for p in case["target"].parameters())


def test_the_group_element_between_states_has_no_gradient():
    """
    On SO(2) with a κ that ignores the state, τ_g · κ · x₀ does not depend on the angle a of x₀, so if τ_g had a gradient,
    d GET / da would be 0. With τ_g held constant, GET = 2 − 2 cos(δ + a − a₀) with δ = −ρ, so d GET / da = −2 sin ρ.
    """
    model = KnownActions(0.3)
    model.projection = nn.Identity()
    model.action_symmetry = Constant(0.9)
    angles = th.tensor([[0.2], [1.5], [-0.8]], dtype=th.float64, requires_grad=True)
    state = model.group.element(angles).flatten(1)
    losses = model(state, th.zeros(3, 1).long(), None, th.ones(3, 1), rotation(np.zeros(3)), None, model, None, identity)
    assert losses.aet is None and losses.reward is None
    losses.symmetry.sum().backward()
    np.testing.assert_allclose(angles.grad, np.full((3, 1), -2 * np.sin(0.9)), atol=1e-12)


@pytest.mark.parametrize("group", ["GL(2)", "SE(2)", "SO(3)", "T(2)", "SE(2)^2 x SO(3)"])
def test_every_group_trains(group):
    made = make_group(group)
    th.manual_seed(0)
    model = GroupLatentModel(made, 2, 3)
    size = 2 * int(np.prod(made.element_shape))
    states = made.element(th.randn(8, 4, 2, made.num_params)).flatten(2)
    state = states[:, 0].clone().requires_grad_()
    projections = nn.Linear(size, 5), nn.Linear(size, 5)
    actions, rewards, mask = th.randint(3, (8, 3)), th.randn(8, 3), th.ones(8, 3)
    losses = model(state, actions, rewards, mask, states[:, 0], states[:, 1:], model, *projections)
    sum(loss.sum() for loss in losses).backward()
    assert all(loss.shape == (8,) and th.isfinite(loss).all() for loss in losses)
    assert th.isfinite(state.grad).all() and all(th.isfinite(p.grad).all() for p in model.parameters())


@pytest.mark.parametrize("group", ["SE(2)", "SO(3)", "GL(2)", "T(2)", "SE(2)^2 x SO(3)"])
@pytest.mark.parametrize("state_dependent", [True, False])
def test_a_new_model_moves_states_a_little(group, state_dependent):
    """With PyTorch's initial weights, κ would move them ten times as far."""
    th.manual_seed(0)
    model = GroupLatentModel(make_group(group), 4, 3, state_dependent_actions=state_dependent)
    elements = model.group.element(0.3 * th.randn(64, 4, model.group.num_params)).flatten(1)

    def motion():
        moved = model.rollout(elements, th.arange(64)[:, None] % 3)[:, 0]
        return ((moved - elements).norm() / elements.norm()).item()

    near = motion()
    for layers in (model.transition, model.action_symmetry):
        layers[-1].reset_parameters()
    assert 0 < near < 0.05 and motion() > 10 * near


def test_losses_and_gradients_of_a_singular_state_are_finite():
    made = make_group("GL(2)")
    model = GroupLatentModel(made, 2, 3)
    state = th.zeros(4, 8, requires_grad=True)
    actions, rewards, mask, targets = th.zeros(4, 2, dtype=th.int64), th.zeros(4, 2), th.ones(4, 2), th.zeros(4, 2, 8)
    losses = model(state, actions, rewards, mask, targets[:, 0], targets, model, identity, identity)
    sum(loss.sum() for loss in losses).backward()
    assert th.isfinite(state.grad).all() and all(th.isfinite(loss).all() for loss in losses)


def test_losses_without_their_inputs_are_off():
    model, case = random_case()
    th.manual_seed(0)
    full = model.eval()(**case)
    for name, absent in (("aet", "project"), ("symmetry", "target"), ("reward", "rewards")):
        th.manual_seed(0)
        losses = model(**{**case, absent: None})
        for field in losses._fields:
            found = getattr(losses, field)
            assert found is None if field == name else th.equal(found, getattr(full, field))
    with pytest.raises(ValueError, match=r"\['mse', 'categorical'\]"):
        GroupLatentModel(make_group("SE(2)"), 2, 3, reward_loss="huber")


def test_without_a_group_the_network_predicts_the_next_state():
    free = GroupLatentModel(make_group("none(6)"), 1, 3).eval()
    expected = free.transition(th.cat([th.ones(3, 6), th.eye(3)], dim=1))
    th.testing.assert_close(free.rollout(th.ones(3, 6), th.arange(3)[:, None])[:, 0], expected)


def test_convolutional_transition_by_hand():
    """One channel and kernels with one nonzero weight: the next state is ReLU(s + the action's weight), scaled to [0, 1]."""
    model = ConvLatentModel((1, 2, 3), n_actions=2).double().eval()
    first, _, norm, second, _ = model.transition
    for layer in (first, second):
        nn.init.zeros_(layer.weight), nn.init.zeros_(layer.bias)
    with th.no_grad():
        first.weight[0, :, 1, 1] = th.tensor([1.0, -2.0, 3.0])  # the state, action 0, action 1
        second.weight[0, 0, 1, 1] = 1.0
        norm.running_var.fill_(1.0 - norm.eps)
    state = th.tensor([[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]], dtype=th.float64)
    found = model.rollout(state, th.tensor([[0, 1]]))
    once = th.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 3.0], dtype=th.float64) / 3  # ReLU(s - 2)
    th.testing.assert_close(found[0, 0], once, atol=1e-5, rtol=0)
    th.testing.assert_close(found[0, 1], once, atol=1e-5, rtol=0)  # s + 3, scaled to [0, 1] again


def test_convolutional_transition_learns_to_shift_an_image():
    """The latent state is the image itself, and actions shift it by a column."""
    th.manual_seed(0)
    model = ConvLatentModel((1, 4, 4), n_actions=2)
    optimizer = th.optim.Adam(model.transition.parameters(), lr=1e-2)
    losses = []
    for _ in range(150):
        picture = th.rand(64, 4, 4)
        actions = th.randint(2, (64, 2))
        shifts = (2 * actions - 1).cumsum(dim=1)
        rolled = [th.stack([p.roll(int(n), dims=1) for p, n in zip(picture, shift, strict=True)]) for shift in shifts.T]
        truth = th.stack(rolled, dim=1).flatten(2)
        identity = nn.Identity()
        mask = th.ones(64, 2)
        found = model(picture.flatten(1), actions, None, mask, picture.flatten(1), truth, None, identity, identity)
        loss = found.aet.mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])
