import pickle

import numpy as np
import pytest
import torch as th

from sb3_eqr.common.groups import SE, SO, GroupLayer, MatrixLieGroup, guarded_inverse, make_group
from sb3_eqr.common.groups.matrix import euler_rotation, exp_rotation
from sb3_eqr.common.saving.plain_data import encode

AFFINE_1D = [[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [0.0, 0.0]]]  # x -> a x + b with a > 0

GROUPS = [
    *[(name, "euler") for name in ("GL(1)", "GL(2)", "GL(4)", "T(1)", "T(5)", "SE(1)", "SE(2)", "SE(3)", "SE(5)")],
    *[(name, "euler") for name in ("SO(2)", "SO(3)", "SO(6)", "SE(2)^8 x SO(3)^4", "T(2) x GL(2)^3")],
    *[(name, "exp") for name in ("SO(2)", "SO(3)", "SO(6)", "SE(1)", "SE(2)", "SE(4)", "SE(2)^2 x SO(3)")],
    *[(name, "gram-schmidt") for name in ("SO(2)", "SO(3)", "SO(5)", "SE(1)", "SE(2)", "SE(3)", "SE(2)^2 x SO(3)")],
    (MatrixLieGroup(AFFINE_1D), "exp"),
]
IDS = [f"{name}-{parameterization}" for name, parameterization in GROUPS]


def random_elements(group, *batch, seed=0):
    return group.element(random_params(group, *batch, seed=seed))


def random_params(group, *batch, seed=0):
    """Those of GL are near a multiple of the identity, so that the matrices are well conditioned."""
    generator = th.Generator().manual_seed(seed)
    params = th.randn(*batch, group.num_params, generator=generator, dtype=th.float64)
    return params + 4 * group.identity_params()


@pytest.mark.parametrize("name, parameterization", GROUPS, ids=IDS)
def test_axioms(name, parameterization):
    group = make_group(name, parameterization)
    a, b, c = (random_elements(group, 3, 4, seed=s) for s in range(3))
    assert a.shape == (3, 4, *group.element_shape) and a.dtype == th.float64
    e = group.identity(3, 4, dtype=th.float64)
    assert e.shape == a.shape
    close = {"rtol": 1e-12, "atol": 1e-12}
    th.testing.assert_close(group.compose(e, a), a, **close)
    th.testing.assert_close(group.compose(a, e), a, **close)
    th.testing.assert_close(group.compose(a, group.inverse(a)), e, **close)
    th.testing.assert_close(group.compose(group.inverse(a), a), e, **close)
    scale = max(1.0, group.compose(a, group.compose(b, c)).abs().max().item())
    associator = group.compose(group.compose(a, b), c) - group.compose(a, group.compose(b, c))
    assert associator.abs().max().item() <= 1e-12 * scale


@pytest.mark.parametrize("name, parameterization", GROUPS, ids=IDS)
def test_gradients(name, parameterization):
    group = make_group(name, parameterization)
    params = [random_params(group, 1, seed=seed).requires_grad_() for seed in (0, 1)]

    def function(p, q):
        return group.compose(group.element(p), group.inverse(group.element(q)))

    assert th.autograd.gradcheck(function, params, fast_mode=group.num_params > 9)  # along random directions


@pytest.mark.parametrize("n", [2, 3, 6])
@pytest.mark.parametrize("kind", ["SO", "SE"])
@pytest.mark.parametrize("parameterization", ["euler", "exp", "gram-schmidt"])
def test_rotations_are_orthogonal_with_determinant_1(n, kind, parameterization):
    rotation = random_elements(make_group(f"{kind}({n})", parameterization), 7)[..., :n, :n]
    eye = th.eye(n, dtype=th.float64).expand(7, n, n)
    th.testing.assert_close(rotation @ rotation.mT, eye, rtol=0, atol=1e-12)
    th.testing.assert_close(th.linalg.det(rotation), th.ones(7, dtype=th.float64), rtol=0, atol=1e-12)


def test_gram_schmidt_against_the_qr_decomposition():
    for n in (2, 3, 5):
        columns = np.random.default_rng(n).normal(size=(n, n))
        q, r = np.linalg.qr(columns)
        q = q * np.sign(np.diag(r))  # with a positive diagonal, the decomposition is Gram-Schmidt's
        q[:, -1] *= np.linalg.det(q)  # of the two possible last columns, the one of a rotation
        params = th.as_tensor(columns[:, :-1].T.reshape(1, -1).copy())
        np.testing.assert_allclose(make_group(f"SO({n})", "gram-schmidt").element(params)[0].numpy(), q, atol=1e-12)


def test_gram_schmidt_is_continuous_and_defined_at_zero():
    group = make_group("SO(2)", "gram-schmidt")
    by_hand = th.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=th.float64)
    th.testing.assert_close(group.element(th.tensor([3.0, 4.0], dtype=th.float64)), by_hand)
    for dtype in (th.float32, th.float64):
        for name in ("SO(2)", "SO(3)", "SE(3)"):
            zero = make_group(name, "gram-schmidt")
            found = zero.element(th.zeros(1, zero.num_params, dtype=dtype))
            assert th.equal(found, zero.identity(1, dtype=dtype))
    loop = th.linspace(0, 2 * np.pi, 361, dtype=th.float64)
    elements = group.element(th.stack([loop.cos(), loop.sin()], dim=1))  # a closed curve, like a network's outputs on a loop
    assert (elements[1:] - elements[:-1]).abs().max() < 0.02  # no jump
    steps = th.atan2(elements[1:, 1, 0], elements[1:, 0, 0]) - th.atan2(elements[:-1, 1, 0], elements[:-1, 0, 0])
    assert abs(th.remainder(steps + np.pi, 2 * np.pi).sub(np.pi).sum().item() - 2 * np.pi) < 1e-9  # and one full turn


@pytest.mark.parametrize("n", [2, 3, 4])
def test_gram_schmidt_of_axes_and_of_linearly_dependent_columns(n):
    group = make_group(f"SO({n})", "gram-schmidt")
    axes = th.eye(n, dtype=th.float64)[: n - 1].reshape(1, -1) * th.tensor([2.0], dtype=th.float64)
    twice = th.tensor([[0.3, -0.2, 0.7, 1.0][:n] * (n - 1)], dtype=th.float64)  # all columns are equal
    for params in (axes, axes.flip(1), twice):
        for dtype, close in ((th.float64, 1e-12), (th.float32, 1e-5)):
            given = params.detach().to(dtype, copy=True).requires_grad_()
            rotation = group.element(given)[0]
            th.testing.assert_close(rotation @ rotation.mT, th.eye(n, dtype=dtype), rtol=0, atol=close)
            assert abs(th.linalg.det(rotation).item() - 1) < close
            rotation.square().sum().backward()
            assert given.grad.isfinite().all()
    assert th.autograd.gradcheck(group.element, axes.clone().requires_grad_())


def test_gram_schmidt_of_nearly_parallel_columns_in_float32():
    """Subtracting once would leave rounding errors of 1e-7 in a remainder of 1e-5: columns with a cosine of 0.01."""
    first = th.tensor([0.3, -0.2, 0.7])
    params = th.cat([first, first + 1e-5 * th.tensor([1.0, 2.0, -1.0])])[None]
    rotation = make_group("SO(3)", "gram-schmidt").element(params)[0]
    th.testing.assert_close(rotation.mT @ rotation, th.eye(3), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["SO(3)", "SE(2)", "SE(2)^2 x SO(3)", "T(2)", "GL(2)", "GL(2)^2 x SO(2)"])
def test_actions_are_parameterized_around_the_identity(name):
    group = make_group(name, "gram-schmidt")
    actions = group.for_actions
    assert actions.element_shape == group.element_shape and actions.name == group.name
    assert th.equal(actions.element(actions.identity_params()), group.identity())
    assert make_group(name, "exp").for_actions.num_params == actions.num_params
    params = th.randn(5, actions.num_params, dtype=th.float64)
    for parameterization in ("euler", "exp"):  # these are kept; Gram-Schmidt's actions have Euler angles
        group = make_group(name, parameterization)
        assert th.equal(group.for_actions.element(params), group.element(params))
    assert th.equal(actions.element(params), make_group(name).element(params))


def test_euler_and_exp_agree_on_so2():
    angles = th.linspace(-7, 7, 41, dtype=th.float64)[:, None]
    th.testing.assert_close(euler_rotation(angles, 2), exp_rotation(angles, 2), rtol=0, atol=1e-12)


def test_euler_is_the_product_over_planes_by_hand():
    a, b, c = 0.3, -1.1, 2.0  # planes (0, 1), (0, 2), (1, 2)
    r01 = np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])
    r02 = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    r12 = np.array([[1, 0, 0], [0, np.cos(c), np.sin(c)], [0, -np.sin(c), np.cos(c)]])
    found = SO(3).element(th.tensor([a, b, c], dtype=th.float64))
    np.testing.assert_allclose(found.numpy(), r01 @ r02 @ r12, atol=1e-15)


def test_se2_element_and_inverse_by_hand():
    group = make_group("SE(2)")
    element = group.element(th.tensor([np.pi / 2, 3.0, 4.0], dtype=th.float64))  # angle first
    th.testing.assert_close(element, th.tensor([[0.0, 1, 3], [-1, 0, 4]], dtype=th.float64))
    th.testing.assert_close(group.inverse(element), th.tensor([[0.0, -1, 4], [1, 0, -3]], dtype=th.float64))
    whole = th.tensor([[0.0, 1, 3], [-1, 0, 4], [0, 0, 1]], dtype=th.float64)
    th.testing.assert_close(group.matrix(element), whole)


@pytest.mark.parametrize("name", ["SE(2)", "SE(3)", "GL(2)", "SO(3)", "affine"])
def test_operations_match_those_of_the_matrices(name):
    """Elements leave out only constant rows of their matrix, so their operations match the matrix product and inverse."""
    affine = [[[0.0, 1, 0], [-1, 0, 0], [0, 0, 0]], [[0, 0, 1], [0, 0, 0], [0, 0, 0]], [[1, 0, 0], [0, 1, 0], [0, 0, 0]]]
    group = MatrixLieGroup(affine) if name == "affine" else make_group(name)
    params = th.randn(2, 5, group.num_params, generator=th.Generator().manual_seed(0), dtype=th.float64)
    left, right = group.element(params)
    product = group.matrix(left) @ group.matrix(right)
    th.testing.assert_close(group.matrix(group.compose(left, right)), product, rtol=0, atol=1e-12)
    th.testing.assert_close(group.matrix(group.inverse(left)), th.linalg.inv(group.matrix(left)), rtol=1e-9, atol=1e-9)
    if name == "affine":
        whole = th.matrix_exp(th.einsum("nd,dij->nij", params[0], th.tensor(affine, dtype=th.float64)))
        assert group.element_shape == (2, 3)
        th.testing.assert_close(group.matrix(left), whole, rtol=0, atol=1e-12)


@pytest.mark.parametrize("n", range(1, 7))
def test_parameter_counts_of_table_1(n):
    assert make_group(f"GL({n})").num_params == n**2
    assert make_group(f"SE({n})").num_params == n * (n - 1) // 2 + n
    assert make_group(f"T({n})").num_params == n
    if n >= 2:
        assert make_group(f"SO({n})").num_params == n * (n - 1) // 2


def test_element_shapes():
    assert make_group("GL(3)").element_shape == (3, 3)
    assert make_group("SE(3)").element_shape == (3, 4)  # the last row of the 4×4 matrix is constant
    assert make_group("T(3)").element_shape == (3,)
    product = make_group("SE(2)^8 x SO(3)^4")
    assert product.num_params == 8 * 3 + 4 * 3
    assert product.element_shape == (8 * 6 + 4 * 9,)


def test_a_product_concatenates_its_factors():
    product, se2, so3 = make_group("SE(2)^2 x SO(3)"), make_group("SE(2)"), make_group("SO(3)")
    p, q = th.randn(2, 5, 9, generator=th.Generator().manual_seed(0), dtype=th.float64)

    def pieces(params):
        first, second = params[:, :6].reshape(5, 2, 3), params[:, 6:]
        return se2.element(first), so3.element(second)

    (a, b), (c, d) = pieces(p), pieces(q)
    moved = (se2.matrix(a) @ se2.matrix(c))[..., :2, :]
    expected = th.cat([moved.flatten(1), (b @ d).flatten(1)], dim=1)
    found = product.compose(product.element(p), product.element(q))
    th.testing.assert_close(found, expected, rtol=0, atol=1e-14)


def test_a_group_as_an_object_is_kept_and_what_it_computes_is_not_saved_with_it():
    group = MatrixLieGroup([[[0.0, 1.0], [-1.0, 0.0]]])
    before = encode(group)
    assert make_group(group) is group
    group.element(th.ones(2, 1, dtype=th.float32))
    assert encode(group) == before
    assert len(pickle.dumps(group)) == len(pickle.dumps(MatrixLieGroup(group.generators)))


def test_without_a_group_the_transition_predicts_the_next_state():
    group = make_group("none(4)")
    left, right = th.randn(2, 3, 4)
    assert th.equal(group.compose(left, right), left)
    with pytest.raises(ValueError, match="symmetry_coef=0"):
        group.inverse(left)


@pytest.mark.parametrize("matrix", [th.zeros(2, 2), th.ones(3, 3), th.full((2, 2), 1e-30), th.diag(th.tensor([1.0, 1e-12]))])
def test_the_guarded_inverse_of_a_singular_matrix_is_finite(matrix):
    good = th.eye(len(matrix)) * 2
    batch = th.stack([matrix, good]).requires_grad_()
    inverse = guarded_inverse(batch)
    assert th.isfinite(inverse).all()
    assert th.equal(inverse[1], good / 4)
    inverse.sum().backward()
    assert th.isfinite(batch.grad).all()
    assert inverse.abs().max() < 1e6


def test_the_guarded_inverse_approximates_the_pseudo_inverse():
    matrix = th.diag(th.tensor([2.0, 0.0], dtype=th.float64))
    th.testing.assert_close(guarded_inverse(matrix), th.linalg.pinv(matrix), rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "name",
    ["SU(2)", "SE", "SE(0)", "SO(1)", "T(-1)", "GL(2.5)", "SE(2)^0", "SE(2) x ", "", "gl(2)", "SE(2)^8 + SO(3)", "GL(n)"],
)
def test_bad_names_raise_with_the_valid_ones(name):
    with pytest.raises(ValueError, match=r"GL\(n\), SE\(n\), T\(n\)") as error:
        make_group(name)
    assert repr(name) in str(error.value)


@pytest.mark.parametrize("name", ["SO3", "so(3)", "so3", "SO(3"])
def test_the_nearest_name_is_suggested(name):
    with pytest.raises(ValueError, match=r"Did you mean SO\(3\)\?$"):
        make_group(name)


def test_bad_parameterization_and_generators():
    with pytest.raises(ValueError, match="euler"):
        make_group("SO(3)", parameterization="quaternion")
    for generators in ([[1.0, 0.0]], [[[1.0, 0.0]]], [[[float("nan")]]]):
        with pytest.raises(ValueError, match=r"\(D, m, m\)"):
            MatrixLieGroup(generators)
    with pytest.raises(ValueError, match="generators must be linearly independent, got 2 linearly dependent matrices"):
        MatrixLieGroup([[[1.0]], [[2.0]]])


def test_the_inverse_of_a_far_translation_is_exact():
    turn, right, up = np.zeros((3, 3, 3))
    turn[:2, :2], right[0, 2], up[1, 2] = [[0, -1], [1, 0]], 1, 1
    group = MatrixLieGroup(np.stack([turn, right, up]))
    element = group.element(th.tensor([0.3, 3000.0, -2000.0]))
    whole = th.linalg.inv(group.matrix(element).double())
    th.testing.assert_close(group.matrix(group.inverse(element)).double(), whole, rtol=1e-6, atol=1e-3)


def test_generators_are_copied():
    """Those of the caller may change later, need a gradient, or be used first in inference mode."""
    turn = th.tensor([[[0.0, -1.0], [1.0, 0.0]]], dtype=th.float64, requires_grad=True)
    group, angle = MatrixLieGroup(turn), th.tensor([0.5], requires_grad=True)
    with th.inference_mode():
        turn.mul_(5)
        group.element(angle)
    found = group.element(angle)
    found[0, 0].backward()
    assert found[0, 0].item() == pytest.approx(np.cos(0.5), rel=1e-4)
    assert angle.grad.item() == pytest.approx(-np.sin(0.5), rel=1e-4)


def test_a_product_of_one_factor_is_that_group():
    layer, params = GroupLayer(4, "SE(2)^8"), th.randn(5, 8, 3)
    assert isinstance(layer.group, SE) and (layer.n_blocks, layer.state_dim) == (8, 48)
    assert layer.description == GroupLayer(4, "SE(2)", 8).description
    product = make_group("SE(2)^8").element(params.flatten(1))
    assert th.equal(layer.group.element(params).flatten(1), product)
