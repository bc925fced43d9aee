"""Hand-written gradients compared with autograd in float64; assigning and clipping compared with PyTorch's functions."""

from copy import deepcopy

import pytest
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_eqr.common.groups import MatrixLieGroup, make_group
from sb3_eqr.common.latent.gradients import assign_gradients, branch, clip_grad_norm
from sb3_eqr.common.latent.rollout import HiddenLayer, rollout
from sb3_eqr.common.losses import normalized_distance
from sb3_eqr.common.networks.layers import NoisyLinear, draw_noise

AFFINE = MatrixLieGroup([[[0.0, 1, 0], [-1, 0, 0], [0, 0, 0]], [[0, 0, 1], [0, 0, 0], [0, 0, 0]]])
GROUPS = ["GL(2)", "SE(2)", "SE(3)", "SO(2)", "SO(3)", "T(2)", "none(4)", "SE(2)^2 x SO(3)", AFFINE]
GROUPS += [make_group("SE(2)", "exp"), make_group("SO(2)", "exp"), make_group("SE(2)", "gram-schmidt")]


def same(found, expected):
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        th.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


def running_statistics(module):
    return [b for b in module.buffers() if b.is_floating_point()]


@pytest.mark.parametrize("name", GROUPS, ids=str)
def test_vector_jacobian_products_match_element_and_compose(name):
    group = make_group(name)
    th.manual_seed(0)
    params = th.randn(5, 3, group.num_params, dtype=th.float64, requires_grad=True)
    right = group.element(th.randn(5, 3, group.num_params, dtype=th.float64)).requires_grad_()
    expected = group.compose(group.element(params), right)
    gradient = th.randn_like(expected)
    with th.no_grad():
        moved, pull_back = group.act_vjp(params, right)
        found = pull_back(gradient)
    same([moved], [expected])
    same(found, th.autograd.grad(expected, [params, right], gradient, materialize_grads=True))
    if group.num_params < 10:
        assert th.autograd.gradcheck(group.element, params.detach()[:1, :1].requires_grad_())


@pytest.mark.parametrize("training", [True, False], ids=["train", "eval"])
@pytest.mark.parametrize("norm", ["layer", "batch"])
@pytest.mark.parametrize("name", GROUPS, ids=str)
def test_rollout_equals_single_steps(name, norm, training):
    """Compared with the plain modules on states and one-hot actions and the group's operations, under autograd."""
    group = make_group(name).for_actions
    th.manual_seed(0)
    n_blocks, n_actions, n_steps = 3, 4, 3
    blocks = group.element(th.randn(6, n_blocks, group.num_params, dtype=th.float64))
    state = blocks.flatten(1).requires_grad_()
    kappa = HiddenLayer(state.shape[1] + n_actions, 8, n_blocks * group.num_params, norm).double().train(training)
    plain = nn.Sequential(*deepcopy(kappa))
    actions = th.randint(n_actions, (6, n_steps))

    expected = [state]
    for m in range(n_steps):
        params = plain(th.cat([expected[-1], F.one_hot(actions[:, m], n_actions)], dim=1))
        elements = group.element(params.view(6, n_blocks, group.num_params))
        expected.append(group.compose(elements, expected[-1].view(blocks.shape)).flatten(1))
    expected = th.stack(expected[1:], dim=1)
    found = rollout(group, state, actions, kappa)
    weights = th.randn_like(found)
    same([found], [expected])
    gradients = [
        th.autograd.grad((x * weights).sum(), [state, *k.parameters()]) for x, k in ((found, kappa), (expected, plain))
    ]
    same(*gradients)
    same(running_statistics(kappa), running_statistics(plain))


@pytest.mark.parametrize("training", [True, False], ids=["train", "eval"])
@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_hidden_layer_equals_its_modules(norm, training):
    th.manual_seed(0)
    layer = HiddenLayer(5, 7, 3, norm).double().train(training)
    plain = nn.Sequential(*deepcopy(layer))
    inputs = th.randn(6, 5, dtype=th.float64, requires_grad=True)
    found, expected = layer(inputs), plain(inputs)
    weights = th.randn_like(found)
    same([found], [expected])
    same(*[th.autograd.grad((x * weights).sum(), [inputs, *k.parameters()]) for x, k in ((found, layer), (expected, plain))])
    same(running_statistics(layer), running_statistics(plain))


def test_noisy_layer_follows_its_formula():
    th.manual_seed(0)
    layer = NoisyLinear(5, 3).double()
    ((noise_out, noise_in),) = draw_noise([layer])
    inputs = th.randn(6, 5, dtype=th.float64, requires_grad=True)
    found = layer(inputs, (noise_out, noise_in))
    weight = layer.weight + layer.weight_sigma * noise_out[:, None] * noise_in
    expected = inputs @ weight.T + layer.bias + layer.bias_sigma * noise_out
    weights = th.randn_like(found)
    same([found], [expected])
    same(*[th.autograd.grad((x * weights).sum(), [inputs, *layer.parameters()]) for x in (found, expected)])


@pytest.mark.parametrize("target_is_trained", [True, False])
def test_distance_of_directions(target_is_trained):
    th.manual_seed(0)
    prediction = th.randn(4, 3, 5, dtype=th.float64, requires_grad=True)
    target = th.randn(4, 3, 5, dtype=th.float64, requires_grad=target_is_trained)
    found = normalized_distance(prediction, target)
    expected = (F.normalize(prediction, dim=-1) - F.normalize(target, dim=-1)).square().sum(dim=-1)
    weights = th.randn_like(found)
    same([found], [expected])
    inputs = [prediction, target] if target_is_trained else [prediction]
    same(*[th.autograd.grad((x * weights).sum(), inputs) for x in (found, expected)])


def test_assigned_gradients_equal_those_of_backward():
    th.manual_seed(0)
    network, frozen, unused = nn.Linear(3, 2), nn.Linear(2, 1).requires_grad_(False), nn.Linear(2, 2)
    parameters = [*network.parameters(), *frozen.parameters(), *unused.parameters()]
    inputs = th.randn(4, 3)
    for parameter in parameters:
        parameter.grad = th.ones_like(parameter)  # from an earlier update
    assign_gradients(frozen(network(inputs)).square().sum(), parameters)
    found = [parameter.grad for parameter in parameters]
    for parameter in parameters:
        parameter.grad = None
    frozen(network(inputs)).square().sum().backward()
    for gradient, parameter in zip(found, parameters, strict=True):
        assert (gradient is None) == (parameter.grad is None) and (gradient is None or th.equal(gradient, parameter.grad))


def test_gradients_have_the_strides_of_their_parameters():
    """A fused optimiser reads a parameter and its gradient in the order of memory, whatever their strides."""
    th.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(2, 3, 3), nn.ReLU(), nn.Conv2d(3, 4, 2))
    images = th.randn(5, 2, 6, 6).contiguous(memory_format=th.channels_last)
    parameters = list(network.parameters())
    raw = th.autograd.grad(network(images).square().sum(), parameters)
    assert any(a.stride() != b.stride() for a, b in zip(raw, parameters, strict=True)), "nothing is tested"
    assign_gradients(network(images).square().sum(), parameters)
    assert [p.grad.stride() for p in parameters] == [p.stride() for p in parameters]
    same([p.grad for p in parameters], raw)


@pytest.mark.parametrize("max_norm", [None, 0.1, 100.0])
def test_clipping_equals_pytorchs(max_norm):
    th.manual_seed(0)
    parameters = [nn.Parameter(th.zeros(3, 2)), nn.Parameter(th.zeros(4)), nn.Parameter(th.zeros(1))]
    for parameter in parameters[:2]:
        parameter.grad = th.randn_like(parameter)
    before = [parameter.grad.clone() for parameter in parameters[:2]]
    found = clip_grad_norm(parameters, max_norm)
    clipped = [parameter.grad.clone() for parameter in parameters[:2]]
    for parameter, gradient in zip(parameters, before, strict=False):
        parameter.grad = gradient
    expected = nn.utils.clip_grad_norm_(parameters, float("inf") if max_norm is None else max_norm)
    assert th.equal(found, expected) and parameters[2].grad is None
    assert all(th.equal(a, p.grad) for a, p in zip(clipped, parameters, strict=False))


@pytest.mark.parametrize("share", [None, 0.0, 0.3, 1e6])
def test_branch_limits_the_auxiliary_gradient(share):
    """The encoder gets the TD gradient and the auxiliary one up to its share; computed term by term with autograd."""
    th.manual_seed(0)
    inputs = th.randn(5, 4, dtype=th.float64)
    encoder, gram = nn.Linear(4, 6).double(), th.zeros(2, 2, dtype=th.float64)

    def td(features):
        return features.sin().sum()

    def auxiliary(state):
        return 7 * state.square().sum()

    features = encoder(inputs)
    of_td, of_auxiliary = (th.autograd.grad(f, features, retain_graph=True)[0] for f in (td(features), auxiliary(features)))
    ratio = (of_td.norm() / of_auxiliary.norm()).item()
    scale = 1.0 if share is None else min(1.0, share * ratio)
    expected = th.autograd.grad(features, encoder.weight, of_td + scale * of_auxiliary)
    features, state = branch(encoder(inputs), share, gram)
    found = th.autograd.grad(td(features) + auxiliary(state), encoder.weight)
    same(found, expected)
    flat = th.stack([of_td.flatten(), of_auxiliary.flatten()])
    th.testing.assert_close(gram, th.einsum("ik,jk->ij", flat, flat))


def test_a_zero_gradient_does_not_divide_by_zero():
    features = th.randn(3, 2, requires_grad=True)
    branched, state = branch(features, 0.5, th.zeros(2, 2))
    (found,) = th.autograd.grad(branched.sum() + 0 * state.sum(), features)
    assert th.equal(found, th.ones(3, 2))
