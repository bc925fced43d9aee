"""Where gradients meet, compared with autograd; clipping them, compared with PyTorch's function."""

import pytest
import torch as th
from torch import nn

from sb3_eqr.common.latent.gradients import branch
from sb3_eqr.common.networks.optimizers import clip_grad_norm


def same(found, expected):
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        th.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


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
