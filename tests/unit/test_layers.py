import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_eqr.common.augmentations import random_intensity, random_shift
from sb3_eqr.common.groups import GroupLayer, Whitening
from sb3_eqr.common.networks.encoders import ConvTrunk
from sb3_eqr.common.networks.layers import Centering, DistributionalHead, NoisyLinear, draw_noise


@pytest.mark.parametrize("batch", [NoisyLinear.SMALL_BATCH - 1, NoisyLinear.SMALL_BATCH])
def test_noisy_layer_by_its_formula(batch):
    """y = (μ_w + σ_w ⊙ f(ε_out) f(ε_in)ᵀ) x + μ_b + σ_b ⊙ f(ε_out), in both ways of computing it."""
    th.manual_seed(0)
    layer, inputs = NoisyLinear(6, 5).double().requires_grad_(False), th.randn(batch, 6, dtype=th.float64)
    layer.weight_sigma.uniform_(), layer.bias_sigma.uniform_()
    (noise,), (other,) = draw_noise([layer]), draw_noise([layer])
    assert not th.equal(noise[0], other[0]) and not th.equal(noise[1], other[1])
    weight = layer.weight.numpy() + layer.weight_sigma.numpy() * np.outer(*noise)
    bias = layer.bias + layer.bias_sigma * noise[0]
    np.testing.assert_allclose(layer(inputs, noise), inputs.numpy() @ weight.T + bias.numpy(), atol=1e-12)
    np.testing.assert_allclose(layer(inputs), inputs.numpy() @ layer.weight.numpy().T + layer.bias.numpy(), atol=1e-12)


def test_noise_does_not_depend_on_train_mode():
    head = DistributionalHead(4, 2, 3, [8], nn.ReLU, dueling=True, sigma_init=0.5).eval()
    inputs = th.randn(2, 4)
    assert not th.equal(head(inputs, head.draw_noise()), head(inputs, head.draw_noise()))
    head.train()
    assert th.equal(head(inputs), head(inputs))


@pytest.mark.parametrize("n_states", [3, 20])
def test_calls_share_one_draw_of_noise(n_states):
    head = DistributionalHead(4, 2, 3, [8], nn.ReLU, dueling=True, sigma_init=0.5).double()
    noise, inputs = head.draw_noise(), th.randn(n_states, 4, dtype=th.float64)
    noise = [type(one)(*(part.double() for part in one)) for one in noise]
    weights = head.with_noise(noise)
    th.testing.assert_close(head(inputs, noise), head(inputs, weights), rtol=1e-12, atol=1e-12)
    assert th.equal(head(inputs, weights), head(inputs, weights)) and not th.allclose(head(inputs, weights), head(inputs))


def test_noise_follows_the_paper_for_every_layer():
    """f(ε) = sign(ε) √|ε|, drawn once for all layers: the outputs of the first, its inputs, the outputs of the second, ..."""
    layers = [NoisyLinear(6, 5), NoisyLinear(5, 2)]
    th.manual_seed(0)
    (out_1, in_1), (out_2, in_2) = draw_noise(layers)
    th.manual_seed(0)
    epsilon = th.randn(18)
    assert th.equal(th.cat([out_1, in_1, out_2, in_2]), epsilon.sign() * epsilon.abs().sqrt())
    assert [len(noise) for noise in (out_1, in_1, out_2, in_2)] == [5, 6, 2, 5]


def test_noisy_initialisation_follows_the_paper():
    layer = NoisyLinear(16, 1000, sigma_init=0.5)
    assert layer.weight.abs().max() <= 0.25 and layer.bias.abs().max() <= 0.25  # 1 / sqrt(16)
    assert layer.weight.std() > 0.13  # of U(-0.25, 0.25): 0.144
    assert (layer.weight_sigma == 0.125).all() and (layer.bias_sigma == 0.125).all()


@pytest.mark.parametrize("net_arch", [[], [8], [8, 6]], ids=str)
def test_dueling_by_hand(net_arch):
    """Two separate networks whose first layers are concatenated into one: the advantage's first, then the value's."""
    head = DistributionalHead(2, 3, 4, net_arch, nn.ReLU, dueling=True, sigma_init=None)
    features = th.randn(5, 2)
    hidden = [features, features]
    if net_arch:
        weight, bias = head.first[0].weight, head.first[0].bias
        hidden = [nn.functional.linear(features, weight[part], bias[part]).relu() for part in (slice(8), slice(8, 16))]
    advantage = head.advantage(hidden[0]).view(5, 4, 3)
    value = head.value(hidden[1])  # (5, 4)
    found = head(features)
    for action in range(3):
        expected = value + advantage[:, :, action] - (advantage[:, :, 0] + advantage[:, :, 1] + advantage[:, :, 2]) / 3
        th.testing.assert_close(found[:, :, action], expected)


def test_conv_trunk_is_the_network_of_mnih_et_al_2015():
    trunk = ConvTrunk(4)
    assert sum(p.numel() for p in trunk.parameters()) == 4 * 32 * 64 + 32 + 32 * 64 * 16 + 64 + 64 * 64 * 9 + 64
    images = th.rand(2, 4, 84, 84)
    assert trunk(images).shape == (2, 3136)
    reference = nn.Sequential(nn.Conv2d(4, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU())
    reference.extend([nn.Conv2d(64, 64, 3), nn.ReLU(), nn.Flatten()]).load_state_dict(trunk.state_dict())
    th.testing.assert_close(trunk(images), reference(images), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 6])  # bytes are moved four channels at a time
@pytest.mark.parametrize("dtype", [th.uint8, th.float32])
def test_shift_is_a_crop_of_the_edge_padded_image(channels, dtype):
    th.manual_seed(0)
    images = th.randint(0, 256, (40, channels, 9, 7)).to(dtype)
    shifted = random_shift(images, pad=2)
    assert shifted.dtype == dtype and shifted.shape == images.shape
    padded = nn.functional.pad(images.float(), (2, 2, 2, 2), mode="replicate").to(dtype)
    offsets = set()
    for before, after in zip(padded, shifted, strict=True):
        crops = {(y, x): before[:, y : y + 9, x : x + 7] for y in range(5) for x in range(5)}
        fitting = [offset for offset, crop in crops.items() if th.equal(crop, after)]
        assert len(fitting) == 1  # all channels are shifted alike, by an integer number of pixels
        offsets.update(fitting)
    assert len(offsets) > 15  # of 25: each image has its own shift
    assert th.equal(random_shift(images, pad=0), images)


def test_intensity_scales_each_image_by_one_number():
    th.manual_seed(0)
    images = th.randint(1, 256, (200, 2, 6, 5), dtype=th.uint8)
    scaled = random_intensity(images, scale=0.05)
    assert scaled.dtype == th.float32
    ratios = (scaled / images).flatten(1)
    th.testing.assert_close(ratios, ratios[:, :1].expand_as(ratios))
    noise = (ratios[:, 0] - 1) / 0.05
    assert noise.abs().max() <= 2.0 + 1e-4 and 0.7 < noise.std() < 1.1  # a clipped normal distribution has 0.88
    before = images.float()
    random_intensity(before, scale=0.5)
    assert th.equal(before, images.float())  # the caller's images are unchanged


def correlated(n, dtype=th.float64):
    """Correlated features of very different scales, far from 0."""
    mixing = th.tensor([[1.0, 0.6, 0.0], [0.0, 0.8, 0.6], [0.0, 0.0, 0.8]], dtype=dtype) * th.tensor([1.0, 1e-3, 40.0])
    return th.randn(n, 3, dtype=dtype) @ mixing + 100.0


def test_whitened_features_have_mean_0_variance_1_and_no_correlation():
    th.manual_seed(0)
    whitening = Whitening(3).double()
    features = correlated(3000)
    white = whitening(features).detach().numpy()
    np.testing.assert_allclose(white.mean(axis=0), 0, atol=1e-10)
    np.testing.assert_allclose(np.cov(white.T, bias=True), np.eye(3), atol=0.02)  # correlations are shrunk by 3 / 3003
    for _ in range(100):
        whitening(correlated(3000))
    whitening.eval()
    before = whitening.running_mean.clone()
    np.testing.assert_allclose(np.cov(whitening(correlated(3000)).numpy().T), np.eye(3), atol=0.1)
    assert th.equal(before, whitening.running_mean)


def test_whitening_one_feature_equals_batch_norm():
    features = th.randn(16, 1, dtype=th.float64) * 7 + 3
    expected = nn.BatchNorm1d(1, affine=False, eps=1e-12).double()(features)
    th.testing.assert_close(Whitening(1).double()(features), expected, rtol=1e-4, atol=0)


def test_whitening_is_finite_for_equal_features_and_for_few_samples():
    whitening = Whitening(6)
    for features in (th.ones(4, 6), th.zeros(4, 6), th.randn(4, 1).expand(4, 6), th.randn(3, 6)):
        features = features.clone().requires_grad_()
        white = whitening(features)
        white.square().sum().backward()
        assert white.isfinite().all() and features.grad.isfinite().all()


def test_whitening_has_a_correct_gradient():
    th.manual_seed(1)
    assert th.autograd.gradcheck(Whitening(3).double(), th.randn(5, 3, dtype=th.float64, requires_grad=True))


def test_the_running_mean_by_hand():
    """
    The batch (0, 0), (4, 2) has the mean (2, 1); as its features have the variances 8 and 2, the squared error of this mean is
    (8 + 2) / 2 = 5. From (2, 11), at a squared distance of 100, the weight is 0.85; from (4, 1), at 4, the smallest, 0.01.
    """
    layer, batch = Centering(2).double(), th.tensor([[0.0, 0.0], [4.0, 2.0]], dtype=th.float64)
    for start, expected in ([2.0, 11.0], [2.0, 2.5]), ([4.0, 1.0], [3.98, 1.0]):
        layer.running_mean.copy_(th.tensor(start))
        for _ in range(2):  # a call does not change what the next one of the same update subtracts
            np.testing.assert_allclose(layer(batch), batch - th.tensor(start), atol=1e-12)
        with th.no_grad():
            layer(th.randn(5, 2, dtype=th.float64))  # not noted, such as encodings for the target
        layer.update()
        np.testing.assert_allclose(layer.running_mean, expected, atol=1e-12)
    layer(batch[:1])  # one observation does not move it
    layer.update()
    np.testing.assert_allclose(layer.running_mean, expected, atol=1e-12)
    layer.eval()
    layer(10 * batch)
    layer.update()
    np.testing.assert_allclose(layer.running_mean, expected, atol=1e-12)


@pytest.mark.parametrize("speed", [0.0, 0.1, 1.0, 10.0])
def test_the_running_mean_follows_features_that_move(speed):
    """It is not far behind, however fast they move; at rest it is more precise than the mean of a batch."""
    th.manual_seed(0)
    layer, errors = Centering(8), []
    for step in range(500):
        constant = speed * step
        errors.append((layer.running_mean - constant).norm().item())
        layer(constant + th.randn(32, 8))
        layer.update()
    of_batch = np.sqrt(8 / 32)
    assert np.mean(errors[100:]) < (0.2 * of_batch if speed == 0 else speed * np.sqrt(8) + 2 * of_batch)


def test_the_gradient_has_no_mean_over_the_batch():
    """As if the mean of the batch were subtracted: a loss must not ask for a constant that the running mean then removes."""
    layer, features = Centering(3), th.randn(5, 3, requires_grad=True)
    weights = th.randn(5, 3)
    layer(features).backward(weights)
    np.testing.assert_allclose(features.grad, weights - weights.mean(dim=0), atol=1e-6)
    (of_batch,) = th.autograd.grad((features - features.mean(dim=0)).mul(weights).sum(), features)
    np.testing.assert_allclose(features.grad, of_batch, atol=1e-6)
    layer.update()
    assert not layer.running_mean.requires_grad


def test_evaluation_changes_neither_the_running_mean_nor_the_gradient():
    layer, features = Centering(3), th.randn(5, 3, requires_grad=True)
    weights = th.randn(5, 3)
    layer.eval()(features + 9).backward(weights)
    th.testing.assert_close(features.grad, weights)
    layer.update()
    assert (layer.running_mean == 0).all()


def test_layers_print_their_sizes():
    assert repr(NoisyLinear(3, 5)) == "NoisyLinear(in_features=3, out_features=5)"
    assert "SE(2), n_blocks=4, state_dim=24" in repr(GroupLayer(7, "SE(2)", n_blocks=4))


@pytest.mark.parametrize("kwargs", [{"whiten": True}, {"parameterization": "exp"}, {"parameterization": "gram-schmidt"}])
def test_the_group_layer_computes_in_float32_among_bfloat16(kwargs):
    layer, features = GroupLayer(7, "SE(3)", n_blocks=4, **kwargs).eval(), th.randn(64, 7)
    with th.autocast("cpu", th.bfloat16):
        found = layer(features.bfloat16())
    assert th.equal(found, layer(features.bfloat16().float()))
