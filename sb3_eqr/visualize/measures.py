"""Deterministic functions of tensors for the diagnostics: errors, correlations, information, rank."""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch as th

ROUNDING = 1e-6  # relative variation below this is rounding in single precision
RANK_TOLERANCE = 1e-3  # directions in which a block varies by less than this fraction of its largest are ignored
BINS = 10  # of a true factor
CELLS = 32  # of a block
OPPOSITE = -0.8  # largest cosine between the effects of two actions that undo each other


class Transition(NamedTuple):
    """Errors of the rollout, one number per step ahead, m = 1 ... M."""

    error: np.ndarray  # (M,): mean ‖x̂_m − x_m‖²
    shuffled: np.ndarray  # (M,): the same with the x_m of any window, as for a prediction that ignores the state
    still: np.ndarray  # (M,): mean ‖x₀ − x_m‖², as for a prediction of no motion
    skill: np.ndarray  # (M,): 1 − error / shuffled; NaN if all states are equal
    gain: np.ndarray  # (M,): 1 − error / still; NaN if nothing moves
    n_windows: np.ndarray  # (M,), int: number of windows with at least m steps


class Rewards(NamedTuple):
    """Errors of the predicted reward, one number per step ahead, m = 1 ... M."""

    error: np.ndarray  # (M,): mean (r_ψ(x̂_m) − r_{t+m})²
    constant: np.ndarray  # (M,): the same for the mean reward
    explained: np.ndarray  # (M,): 1 − Var[r − r_ψ] / Var[r]; NaN if the reward is constant


def transition_error(states: th.Tensor, next_states: th.Tensor, predicted: th.Tensor, mask: th.Tensor) -> Transition:
    """
    Equivariance error of the transition, x̂_m against x_m, compared with two baselines that ignore the actions.
    The shuffled one is the mean over all pairs of windows, Var[x̂] + Var[x] + ‖mean x̂ − mean x‖², without sampling.

    :param states: x₀, (N, D)
    :param next_states: x₁ ... x_M, (N, M, D)
    :param predicted: x̂₁ ... x̂_M, (N, M, D)
    :param mask: (N, M), 1 where the window counts
    """
    rows = []
    for start, true, guess in _valid(mask, states[:, None].expand_as(next_states), next_states, predicted):  # (n, D) each
        error, still, size = (float(x.square().sum(dim=1).mean()) for x in (guess - true, start - true, true))
        shift = (guess.mean(dim=0) - true.mean(dim=0)).square().sum()
        rows.append((error, float(_variance(guess).sum() + _variance(true).sum() + shift), still, size, len(true)))
    error, shuffled, still, size, n = np.array(rows, dtype=np.float64).T  # (M,) each
    floor = ROUNDING**2 * size
    return Transition(error, shuffled, still, _one_less(error, shuffled, floor), _one_less(error, still, floor), n.astype(int))


def reward_error(predicted: th.Tensor, rewards: th.Tensor, mask: th.Tensor) -> Rewards:
    """
    Reward prediction, (N, M), compared with the constant mean, where the mask, (N, M), is 1; the explained variance is defined
    as in SB3.
    """
    errors = [(true - guess, true) for guess, true in _valid(mask, predicted, rewards)]  # (n,) each
    rows = [(float(error.square().mean()), float(_variance(true)), float(_variance(error))) for error, true in errors]
    found, constant, left = np.array(rows).T
    return Rewards(found, constant, _one_less(left, constant, np.full_like(constant, ROUNDING**2)))


def _valid(mask: th.Tensor, *values: th.Tensor) -> Iterator[list[th.Tensor]]:
    """For each step ahead, the rows of values, (N, M, ...), whose window counts."""
    for m in range(mask.shape[1]):
        yield [x[mask[:, m] > 0, m].double() for x in values]


def _variance(x: th.Tensor) -> th.Tensor:
    """The variance over rows; NaN without rows, without PyTorch's warning."""
    return x.var(dim=0, correction=0) if len(x) else x.mean(dim=0)


def _one_less(numerator: np.ndarray, denominator: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """1 − numerator / denominator, NaN where the denominator is only rounding."""
    known = denominator > floor
    return np.where(known, 1 - numerator / np.where(known, denominator, 1), np.nan)


def angle_moments(angles: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Circular mean and standard deviation, √(−2 ln R) with R the length of the mean unit vector (Mardia and Jupp 2000, §2.3), of
    angles in radians, over their first axis.
    """
    sin, cos = angles.double().sin().mean(dim=0), angles.double().cos().mean(dim=0)
    length = th.hypot(sin, cos).clamp(min=1e-12, max=1)
    return th.atan2(sin, cos), (2 * length.log()).abs().sqrt()


def concentration(weights: np.ndarray, axis: int) -> np.ndarray:
    """
    1 − H / log n of n weights ≥ 0 along an axis, normalised to sum to 1: 1 if one has all the weight, 0 if all are equal, NaN
    if n is 1 or all are 0.
    """
    total, n = weights.sum(axis=axis, keepdims=True), weights.shape[axis]
    if n < 2:
        return np.full(total.squeeze(axis).shape, np.nan)
    p = np.where(total > 0, weights / np.where(total > 0, total, 1), np.nan)
    return 1 + _p_log_p(p).sum(axis=axis) / np.log(n)


def _p_log_p(p: np.ndarray) -> np.ndarray:
    return p * np.log(np.where(p > 0, p, 1))


def opposites(generators: np.ndarray) -> list[int]:
    """
    Pairs of actions that undo each other: each has the lowest cosine with the other, and it is below ``OPPOSITE``.

    :param generators: mean coordinates of each action's element, (A, C)
    :return: for each action its opposite, or the action itself, (A,)
    """
    norms = np.linalg.norm(generators, axis=1, keepdims=True)
    unit = generators / np.where(norms > 0, norms, 1)
    cosine = unit @ unit.T  # (A, A)
    nearest = cosine.argmin(axis=1)
    return [int(b) if nearest[b] == a and cosine[a, b] < OPPOSITE else a for a, b in enumerate(nearest)]


def merged(weights: np.ndarray, pairs: list[int]) -> np.ndarray:
    """Weights of actions, (A, K), each action averaged with its opposite (see :func:`opposites`), (A', K)."""
    return np.stack([(weights[a] + weights[b]) / 2 for a, b in enumerate(pairs) if a <= b])


def canonical_correlations(blocks: list[th.Tensor]) -> np.ndarray:
    """
    Mean canonical correlation of every two blocks (Hotelling 1936): that of the best matched linear combinations, over the
    smaller of their numbers of directions. 1: one is a linear function of the other; 0: uncorrelated.

    :param blocks: K of (N, d), each with its own d
    :return: (K, K), in [0, 1], 1 on the diagonal; 0 if either is constant
    """
    found = np.eye(len(blocks))
    for (j, second), (i, first) in combinations(enumerate(map(_directions, blocks)), 2):
        values = th.linalg.svdvals(first.T @ second).clamp(max=1)
        found[i, j] = found[j, i] = float(values.mean()) if len(values) else 0
    return found


def _directions(x: th.Tensor) -> th.Tensor:
    """An orthonormal basis, (N, rank), of the variation of (N, d)."""
    x = x.double()
    left, values, _ = th.linalg.svd(x - x.mean(dim=0), full_matrices=False)
    kept = (values > RANK_TOLERANCE * values[0]) & (values > ROUNDING * th.linalg.matrix_norm(x))
    return left[:, kept]


def bins(values: np.ndarray, n_bins: int = BINS) -> np.ndarray:
    """
    Labels of at most ``n_bins`` bins with about equally many values each, (N,), int, of values, (N,). Angles need no special
    treatment, since a circle may be cut anywhere.
    """
    edges = np.unique(np.quantile(values, np.linspace(0, 1, n_bins + 1)[1:-1]))
    return np.searchsorted(edges, values, side="right")


def cells(points: th.Tensor, n_cells: int = CELLS) -> np.ndarray:
    """
    Bins in any number of dimensions: k-means (Lloyd 1982), initialised with points that are each the farthest from the
    previous ones. Applied to the entries of a rotation, it has no discontinuity on the circle.

    :param points: (N, d)
    :param n_cells: maximum number of cells
    :return: labels, (N,), int; all 0 if all points are equal
    """
    x = points.double()
    x = x - x.mean(dim=0)
    if float(x.norm()) <= ROUNDING * float(points.double().norm()):
        return np.zeros(len(x), dtype=int)
    chosen = [int(x.square().sum(dim=1).argmax())]
    nearest = (x - x[chosen[0]]).square().sum(dim=1)  # (N,)
    for _ in range(n_cells - 1):
        chosen.append(int(nearest.argmax()))
        nearest = th.minimum(nearest, (x - x[chosen[-1]]).square().sum(dim=1))
    centres = x[chosen]
    for _ in range(10):
        labels = th.cdist(x, centres).argmin(dim=1)  # (N,)
        counts = th.bincount(labels, minlength=n_cells)[:, None]
        sums = th.zeros_like(centres).index_add_(0, labels, x)
        centres = th.where(counts > 0, sums / counts.clamp(min=1), centres)
    return th.cdist(x, centres).argmin(dim=1).cpu().numpy()


def entropy(labels: np.ndarray) -> float:
    """Entropy in nats, with Miller's (1955) correction for few samples: (occupied labels − 1) / 2N is added."""
    _, counts = np.unique(labels, return_counts=True)
    return float(-_p_log_p(counts / len(labels)).sum() + (len(counts) - 1) / (2 * len(labels)))


def mutual_information(first: np.ndarray, second: np.ndarray) -> float:
    """I = H(a) + H(b) − H(a, b) of labels a and b, (N,), int ≥ 0, in nats; at least 0."""
    joint = first * (int(second.max()) + 1) + second
    return max(entropy(first) + entropy(second) - entropy(joint), 0.0)


def information_gap(information: np.ndarray) -> np.ndarray:
    """
    The mutual information gap: the information about each factor in the best block minus that in the second best (Chen et al.
    2018, Eq. 6, for blocks: https://arxiv.org/abs/1802.04942).

    :param information: normalised by each factor's entropy, (K, F)
    :return: (F,); NaN if there is only one block
    """
    if len(information) < 2:
        return np.full(information.shape[1], np.nan)
    *_, second, best = np.sort(information, axis=0)
    return best - second


def spectrum(states: th.Tensor) -> np.ndarray:
    """Standard deviations of states, (N, D), along their principal axes, (min(N, D),): singular values over √N."""
    x = states.double()
    return th.linalg.svdvals((x - x.mean(dim=0)) / len(x) ** 0.5).cpu().numpy()


def effective_rank(values: np.ndarray, size: float) -> float:
    """
    exp of the entropy of the normalised singular values (Roy and Vetterli 2007).

    :param values: singular values, ≥ 0
    :param size: size of the states; values that are rounding relative to it are ignored
    :return: in [1, len(values)]; 0 if no value is left
    """
    counted = values[values > ROUNDING * size]
    return float(np.exp(-_p_log_p(counted / counted.sum()).sum())) if counted.sum() else 0.0


def mean_of_known(values: np.ndarray) -> float:
    """The mean of the values that are not NaN; NaN if there are none, without NumPy's warning."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) > 0 else np.nan
