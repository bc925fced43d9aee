"""The equations of the latent model. Where its embedding is the identity, features are latent states."""

import math

import numpy as np
import pytest
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_eqr.common.groups import GroupLayer, make_group
from sb3_eqr.common.latent.conv_latent_model import ConvLatentModel
from sb3_eqr.common.latent.latent_model import LatentModel, frozen_copy
from sb3_eqr.common.latent.options import LatentOptions

LOSSES = ("aet", "symmetry", "reward")


def make_model(group, n_blocks, n_actions, embedding=None, **options):
    return LatentModel(embedding or nn.Identity(), make_group(group), n_blocks, n_actions, LatentOptions(**options))


class KnownActions(LatentModel):
    """SO(2), one block. In every state κ turns by +θ for action 0 and by −θ for action 1."""

    def __init__(self, theta):
        options = LatentOptions(state_dependent_actions=False, projection="none", predictor=False)
        super().__init__(nn.Identity(), make_group("SO(2)"), 1, 2, options)
        self.theta = theta
        self.double()

    def action_element(self, state, action):
        return self.element(self.theta * (action[:, :1] - action[:, 1:]))


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
    model.action_symmetry = Constant(rho_angle)
    model.symmetry_projection = target.symmetry_projection = nn.Identity()
    model.reward_net = Constant(0.25)
    starts = np.array([0.0, 1.0, -2.5])
    actions = th.tensor([[0, 0, 1], [1, 1, 1], [0, 1, 0]])
    turns = np.cumsum(np.where(actions == 0, 0.7, -0.7), axis=1)
    angles = np.concatenate([starts[:, None], starts[:, None] + turns], axis=1)
    rewards = th.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.25, 0.25, 0.25]], dtype=th.float64)
    mask = th.ones(3, 3, dtype=th.float64) if mask is None else mask
    truth = rotation(angles)
    hot = F.one_hot(actions, 2).double()
    return model(LOSSES, rotation(starts), hot, rewards, mask, target, truth[:, 0], truth[:, 1:].flatten(0, 1)), turns


@pytest.mark.parametrize("theta, rho_angle, get", [(0.7, 0.0, 0.0), (0.0, 0.0, 0.7), (-0.7, 0.0, 1.4), (0.7, 0.4, 0.4)])
def test_transition_losses_by_hand(theta, rho_angle, get):
    """
    The loss of two normalised rotation matrices that differ by the angle δ is 2 − 2 cos δ. The true κ has no loss; the others
    never move or move the wrong way; a wrong ρ affects GET only.
    """
    losses, turns = rotation_world(theta, rho_angle)
    np.testing.assert_allclose(losses["aet"], (2 - 2 * np.cos((1 - theta / 0.7) * turns)).mean(axis=1), atol=1e-12)
    np.testing.assert_allclose(losses["symmetry"], [2 - 2 * math.cos(get)] * 3, atol=1e-12)


def test_reward_loss_by_hand():
    losses, _ = rotation_world(0.7)  # predicts 0.25 everywhere
    expected = [(0.75**2 + 2 * 0.25**2) / 3, (2 * 0.25**2 + 1.25**2) / 3, 0.0]
    np.testing.assert_allclose(losses["reward"], expected, atol=1e-12)


def test_every_loss_uses_the_mask():
    mask = th.tensor([[1.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 1.0, 0.0]], dtype=th.float64)
    losses, turns = rotation_world(0.0, mask=mask)
    costs = 2 - 2 * np.cos(turns)
    np.testing.assert_allclose(losses["aet"], [costs[0, 0], costs[1].mean(), costs[2, :2].mean()], atol=1e-12)
    np.testing.assert_allclose(losses["reward"], [0.75**2, (2 * 0.25**2 + 1.25**2) / 3, 0.0], atol=1e-12)
    losses, _ = rotation_world(0.0, mask=th.zeros(3, 3, dtype=th.float64))
    assert all((loss == 0).all() for loss in losses.values())


def random_case(group="SE(2)", n_blocks=3, batch=6, depth=4, seed=0, **options):
    """A model with an embedding, and a predictor that is not the identity; a different target; inputs for the losses."""
    th.manual_seed(seed)
    embeddings = [GroupLayer(7, group, n_blocks) for _ in range(2)]
    model, target = (make_model(group, n_blocks, 5, e, latent_hidden_dim=16, **options).double() for e in embeddings)
    with th.no_grad():
        model.predictor.weight.add_(0.3 * th.randn_like(model.predictor.weight))
    target = frozen_copy(target)
    case = {
        "names": LOSSES,
        "features": th.randn(batch, 7, dtype=th.float64),
        "actions": F.one_hot(th.randint(5, (batch, depth)), 5).double(),
        "rewards": th.randn(batch, depth, dtype=th.float64),
        "mask": th.ones(batch, depth, dtype=th.float64),
        "target": target,
        "target_state": target.embedding(th.randn(batch, 7, dtype=th.float64)),
        "target_states": target.embedding(th.randn(batch * depth, 7, dtype=th.float64)),
    }
    return model, case


def test_against_loops_over_samples_and_blocks():
    """All of Eq. 18 and 19, one sample and one 3×3 matrix at a time; SE(2) is not commutative, so the order matters."""
    model, case = random_case()
    target = case["target"]
    th.manual_seed(1)
    losses = model(**case)
    th.manual_seed(1)
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
        start = x = run(model.embedding, case["features"][i])
        aet = reward = 0.0
        predictions = []
        for m in range(4):
            action = case["actions"][i, m].numpy()
            moved = [k @ b for k, b in zip(elements(model.transition, x, action), blocks(x), strict=True)]
            x = entries(moved)
            predictions.append(x)
            truth = case["target_states"][4 * i + m].numpy()
            aet += distance(run(model.predictor, run(model.projection, x)), run(target.projection, truth))
            reward += (run(model.reward_net, x)[0] - case["rewards"][i, m].item()) ** 2
        assert losses["aet"][i].item() == pytest.approx(aet / 4, rel=1e-10)
        assert losses["reward"][i].item() == pytest.approx(reward / 4, rel=1e-10)

        partner = case["target_state"][partners[i]].numpy()
        symmetry = [p @ np.linalg.inv(s) for p, s in zip(blocks(partner), blocks(start), strict=True)]
        left = entries([g @ b for g, b in zip(symmetry, blocks(predictions[0]), strict=True)])
        rho = elements(model.action_symmetry, entries(symmetry))
        kappa = elements(target.transition, start, case["actions"][i, 0].numpy())
        right = entries([r @ k @ p for r, k, p in zip(rho, kappa, blocks(partner), strict=True)])
        get = distance(run(model.symmetry_projection, left), run(target.symmetry_projection, right))
        assert losses["symmetry"][i].item() == pytest.approx(get, rel=1e-10)


@pytest.mark.parametrize("options", [{}, {"reward_loss": "categorical", "aet_loss": "contrastive"}], ids=["default", "other"])
def test_masked_steps_have_no_influence(options):
    model, case = random_case(**options)
    case["mask"] = th.tensor([[1, 1, 1, 1]] * 4 + [[1, 0, 0, 0], [1, 1, 1, 0]], dtype=th.float64)
    case["features"].requires_grad_()

    def run(**changes):
        th.manual_seed(1)
        model.zero_grad()
        case["features"].grad = None
        losses = model(**{**case, **changes})
        sum(loss.sum() for loss in losses.values()).backward()
        return [*losses.values(), case["features"].grad.clone(), *(p.grad.clone() for p in model.parameters())]

    rewards, actions, targets = case["rewards"].clone(), case["actions"].clone(), case["target_states"].clone()
    hidden = case["mask"] == 0
    rewards[hidden], actions[hidden], targets[hidden.flatten()] = -77.0, 5.0, 123.0
    before, after = run(), run(rewards=rewards, actions=actions, target_states=targets)
    for a, b in zip(before, after, strict=True):
        th.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_an_unusual_state_changes_the_others_with_batch_norm_only(norm):
    model, case = random_case(latent_norm=norm)
    with th.no_grad():
        usual = model.embedding(case["features"])
        unusual = usual.clone()
        unusual[0] *= 100
        before, after = (model.rollout(state, case["actions"])[1:] for state in (usual, unusual))
        acting = model.eval().rollout(usual, case["actions"])[1:]
    assert th.equal(before, after) == (norm == "layer")
    assert th.equal(before, acting) == (norm == "layer")  # the same predictions in training and after it


def test_each_loss_trains_its_networks_only():
    model, case = random_case()
    target = case["target"].requires_grad_()  # in an agent it is frozen; here it shows where gradients would go
    inputs = {name: case[name].requires_grad_() for name in ("features", "target_state", "target_states")}
    inputs |= dict(model.named_parameters()) | {f"target {name}": p for name, p in target.named_parameters()}
    losses = model(**case)

    def grads(loss):
        found = th.autograd.grad(loss.sum(), list(inputs.values()), retain_graph=True, allow_unused=True)
        return {name.split(".")[0] for name, grad in zip(inputs, found, strict=True) if grad is not None}

    shared = {"features", "embedding", "transition"}
    assert grads(losses["aet"]) == shared | {"projection", "predictor"}
    assert grads(losses["reward"]) == shared | {"reward_net"}
    # the gradient of ρ passes through the target's b
    assert grads(losses["symmetry"]) == shared | {"action_symmetry", "symmetry_projection", "target symmetry_projection"}


def test_the_group_element_between_states_has_no_gradient():
    """
    On SO(2) with a κ that ignores the state, τ_g · κ · x₀ does not depend on the angle a of x₀, so if τ_g had a gradient,
    d GET / da would be 0. With τ_g held constant, GET = 2 − 2 cos(δ + a − a₀) with δ = −ρ, so d GET / da = −2 sin ρ.
    """
    model = KnownActions(0.3)
    model.symmetry_projection = nn.Identity()
    model.action_symmetry = Constant(0.9)
    angles = th.tensor([[0.2], [1.5], [-0.8]], dtype=th.float64, requires_grad=True)
    state = model.group.element(angles).flatten(1)
    action, zeros = th.tensor([[[1.0, 0.0]]] * 3, dtype=th.float64), th.zeros(3, 1, dtype=th.float64)
    losses = model(["symmetry"], state, action, zeros, zeros + 1, model, rotation(np.zeros(3)))
    assert losses.keys() == {"symmetry"}
    losses["symmetry"].sum().backward()
    np.testing.assert_allclose(angles.grad, np.full((3, 1), -2 * np.sin(0.9)), atol=1e-12)


@pytest.mark.parametrize("group", ["SE(2)", "SO(3)", "GL(2)", "T(2)", "SE(2)^2 x SO(3)"])
@pytest.mark.parametrize("state_dependent", [True, False])
def test_a_new_model_moves_states_a_little(group, state_dependent):
    """With PyTorch's initial weights, κ would move them ten times as far."""
    th.manual_seed(0)
    model = make_model(group, 4, 3, state_dependent_actions=state_dependent)
    elements = model.group.element(0.3 * th.randn(64, 4, model.group.num_params)).flatten(1)

    def motion():
        moved = model.rollout(elements, th.eye(3)[th.arange(64) % 3][:, None])[:, 0]
        return ((moved - elements).norm() / elements.norm()).item()

    near = motion()
    for layers in (model.transition, model.action_symmetry):
        layers[-1].reset_parameters()
    assert 0 < near < 0.05 and motion() > 10 * near


def test_losses_and_gradients_of_a_singular_state_are_finite():
    model, state = make_model("GL(2)", 2, 3), th.zeros(4, 8, requires_grad=True)
    actions, zeros = th.eye(3)[th.zeros(4, 2).long()], th.zeros(4, 2)
    losses = model(LOSSES, state, actions, zeros, zeros + 1, model, th.zeros(4, 8), th.zeros(8, 8))
    sum(loss.sum() for loss in losses.values()).backward()
    assert th.isfinite(state.grad).all() and all(th.isfinite(loss).all() for loss in losses.values())


def test_without_a_group_the_network_predicts_the_next_state():
    free = make_model("none(6)", 1, 3).eval()
    expected = free.transition(th.cat([th.ones(3, 6), th.eye(3)], dim=1))
    th.testing.assert_close(free.rollout(th.ones(3, 6), th.eye(3)[:, None])[:, 0], expected)
    assert not free.has_symmetry_loss and not hasattr(free, "action_symmetry")


def test_convolutional_transition_by_hand():
    """One channel and kernels with one nonzero weight: the next state is ReLU(s + the action's weight), scaled to [0, 1]."""
    model = ConvLatentModel((1, 2, 3), 2, LatentOptions(group=None, transition="convolutional")).double().eval()
    first, _, norm, second, _ = model.transition
    for layer in (first, second):
        nn.init.zeros_(layer.weight), nn.init.zeros_(layer.bias)
    with th.no_grad():
        first.weight[0, :, 1, 1] = th.tensor([1.0, -2.0, 3.0])  # the state, action 0, action 1
        second.weight[0, 0, 1, 1] = 1.0
        norm.running_var.fill_(1.0 - norm.eps)
    state = th.tensor([[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]], dtype=th.float64)
    found = model.rollout(state, th.eye(2, dtype=th.float64)[None])
    once = th.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 3.0], dtype=th.float64) / 3  # ReLU(s - 2)
    th.testing.assert_close(found[0, 0], once, atol=1e-5, rtol=0)
    th.testing.assert_close(found[0, 1], once, atol=1e-5, rtol=0)  # s + 3, scaled to [0, 1] again


@pytest.mark.parametrize("n_states", [2, 50])
def test_projection_and_predictor_as_one_product(n_states):
    """For many states, their weights are multiplied first."""
    model = LatentModel(nn.Identity(), make_group("SE(2)"), 2, 3, LatentOptions(latent_hidden_dim=5)).double()
    nn.init.normal_(model.predictor.weight)
    nn.init.normal_(model.predictor.bias)
    states = th.randn(n_states, model.state_dim, dtype=th.float64)
    parameters = [*model.projection.parameters(), *model.predictor.parameters()]
    outputs = [model.project(states), model.predictor(model.projection(states))]
    gradients = [th.autograd.grad(output.square().sum(), parameters) for output in outputs]
    th.testing.assert_close(*outputs, rtol=1e-12, atol=1e-12)
    th.testing.assert_close(*gradients, rtol=1e-11, atol=1e-11)
