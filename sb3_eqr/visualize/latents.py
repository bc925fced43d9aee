"""The latent states of an agent on windows of play: what every diagnostic, picture and animation looks at."""

from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.common.groups import SE, SO, Group, MatrixGroup, NoGroup, ProductGroup, T
from sb3_eqr.common.latent_model import GroupLatentModel
from sb3_eqr.common.random_state import preserved_rng_state
from sb3_eqr.common.replay.buffers import SequenceReplayBuffer
from sb3_eqr.common.type_aliases import PyTorchObs, SequenceReplayBufferSamples
from sb3_eqr.common.validation import check_number

CHUNK = 256  # observations encoded at once
# What an environment tells of its true state, under these keys of ``info``; the worlds of sb3_eqr.envs do.
FACTOR_KEYS = ("position", "angle", "velocity", "rotation", "translation")


class Play(NamedTuple):
    """Windows of play: N starts, M steps ahead of each."""

    samples: SequenceReplayBufferSamples
    factors: np.ndarray | None  # (N, F): the true state at each start, where the environment's ``info`` tells it


class Latents(NamedTuple):
    """Latent states of N windows. D = K · prod(element_shape)."""

    states: th.Tensor  # (N, D): x₀ = τ(s_t)
    next_states: th.Tensor  # (N, M, D): x₁ ... x_M, encoded
    predicted: th.Tensor  # (N, M, D): x̂₁ ... x̂_M, rolled out from x₀
    predicted_rewards: th.Tensor  # (N, M): r_ψ(x̂_m); the sign's expectation where the reward loss is categorical
    actions: th.Tensor  # (N, M), int64
    rewards: th.Tensor  # (N, M)
    mask: th.Tensor  # (N, M): 1 where the episode had not ended before step t+m


class Blocks(NamedTuple):
    """Blocks of one group."""

    group: Group
    elements: th.Tensor  # (..., K, *element_shape)


def check_agent(name: str, model: Any) -> None:
    """
    :param name: of what asks, for the message
    :raises ValueError: if the model is no EqR agent
    """
    if not isinstance(model, EqRAlgorithm):
        found = type(model).__name__
        raise ValueError(f"{name}: expected an EqR agent (EqRQRDQN, EqRRainbow), found {found}, which has no latent model.")


def as_vec_env(model: EqRAlgorithm, env: GymEnv | str) -> VecEnv:
    """
    :param env: or its id of gymnasium
    :return: images channels first, as the agent's own environment
    """
    return model._wrap_env(make_vec_env(env) if isinstance(env, str) else env, monitor_wrapper=False)


def play(
    model: EqRAlgorithm, env: GymEnv | str, n_steps: int = 1000, depth: int = 5, deterministic: bool = False, seed: int = 0
) -> Play:
    """
    Let the agent play, and cut the play into windows. Every random generator but the environments' is left as it was.

    :param model: any EqR agent
    :param env: with the agent's observations and actions, preprocessed as in training; or its id of gymnasium
    :param n_steps: over all environments, at least 2 · depth + 2 each
    :param depth: M ≥ 1, how many steps each window looks ahead
    :param deterministic: whether the agent acts without noise; else as it explores
    :param seed: of the environment and of the agent's noise
    :return: every window that was complete, in order
    :raises ValueError: if there are too few steps, or the agent is no EqR agent
    """
    check_agent("play", model)
    env = as_vec_env(model, env)
    check_number("depth", depth, 1, whole=True)
    check_number("n_steps", n_steps, (2 * depth + 2) * env.num_envs, whole=True)
    buffer = SequenceReplayBuffer(
        n_steps, env.observation_space, env.action_space, "cpu", n_envs=env.num_envs, prediction_depth=depth
    )
    factors: list[np.ndarray | None] = []
    with preserved_rng_state(model.action_space, env.action_space):  # a random action is drawn from the first
        set_random_seed(seed)
        model.action_space.seed(seed)
        env.seed(seed)
        obs: Any = env.reset()
        infos: list[dict[str, Any]] = env.unwrapped.reset_infos
        for _ in range(buffer.buffer_size):
            factors.append(_factors(infos))
            actions, _ = model.predict(obs, deterministic=deterministic)  # type: ignore[arg-type]
            new_obs, rewards, dones, infos = env.step(actions)
            buffer.add(obs, _true_next(new_obs, dones, infos), actions, rewards, dones, infos)
            infos = [
                env.unwrapped.reset_infos[i] if done else info for i, (done, info) in enumerate(zip(dones, infos, strict=True))
            ]
            obs = new_obs
    starts, envs = (grid.ravel() for grid in np.meshgrid(np.arange(buffer.n_starts), np.arange(env.num_envs), indexing="ij"))
    samples = buffer.windows(starts, envs)  # a VecNormalize has normalised them already
    known = all(found is not None for found in factors)
    return Play(samples, np.stack(factors)[starts, envs] if known else None)  # type: ignore[arg-type]


def replayed(model: EqRAlgorithm, n_windows: int, rng: np.random.Generator) -> Play:
    """
    Windows from the agent's own replay buffer, drawn uniformly; no global generator is used.

    :param model: an agent in training, with ``prediction_depth`` ≥ 1
    :param n_windows: N
    :param rng: draws them
    :raises ValueError: if there is no window yet
    """
    buffer = model.replay_buffer
    if buffer is None or buffer.prediction_depth == 0 or buffer.n_starts < 1:
        raise ValueError(
            "replayed: expected a replay buffer that holds whole windows, found none. Train the agent first, "
            "with prediction_depth >= 1; for an agent that was loaded, let it play (sb3_eqr.visualize.play)."
        )
    starts = rng.integers(0, buffer.n_starts, n_windows)
    envs = rng.integers(0, buffer.n_envs, n_windows)
    return Play(buffer.windows(starts, envs, model.get_vec_normalize_env()), None)


def group_model(model: EqRAlgorithm) -> GroupLatentModel:
    """
    The agent's latent model.

    :raises ValueError: if it is not one of groups
    """
    found = model.policy.latent_model
    if not isinstance(found, GroupLatentModel):
        raise ValueError(f"expected an agent whose latent model moves states by group elements, found {type(found).__name__}")
    return found


def encode(model: EqRAlgorithm, observations: PyTorchObs) -> th.Tensor:
    """
    x = τ(s), by the online encoder in eval mode.

    :param model: any EqR agent
    :param observations: as the replay buffer has them, (N, *obs_shape) or a dict of these
    :return: (N, D), without gradient
    :raises ValueError: if the agent is no EqR agent
    """
    check_agent("encode", model)
    n = len(next(iter(observations.values())) if isinstance(observations, dict) else observations)
    pieces = []
    with th.no_grad(), eval_mode(model):
        for start in range(0, n, CHUNK):
            piece = _map(observations, lambda obs, s=start: obs[s : s + CHUNK].to(model.device))
            pieces.append(model.policy.latent_model.embedding(model.policy.online.features(piece)))
    return th.cat(pieces)


def latents(model: EqRAlgorithm, samples: SequenceReplayBufferSamples) -> Latents:
    """
    :param model: any EqR agent
    :param samples: N windows with rollouts, M ≥ 1
    :return: without gradient, on the agent's device
    """
    assert samples.mask is not None and samples.rollout_actions is not None and samples.rollout_rewards is not None
    assert samples.rollout_observations is not None
    mask = samples.mask.to(model.device)
    actions = (samples.rollout_actions.to(model.device) * mask.long()).long()
    states = encode(model, samples.observations)
    following = encode(model, _map(samples.rollout_observations, lambda obs: obs.flatten(0, 1)))
    latent_model = model.policy.latent_model
    with th.no_grad(), eval_mode(model):
        predicted = latent_model.rollout(states, actions)
        outputs = latent_model.reward_net(predicted.flatten(0, 1))  # (N * M, 1 or 3)
        if outputs.shape[1] == 3:
            outputs = outputs.softmax(dim=1) @ outputs.new_tensor([[-1.0], [0.0], [1.0]])
    return Latents(
        states,
        following.unflatten(0, mask.shape),
        predicted,
        outputs.view(mask.shape),
        actions,
        samples.rollout_rewards.to(model.device),
        mask,
    )


def action_elements(model: EqRAlgorithm, states: th.Tensor) -> th.Tensor:
    """
    κ(x, a) of every action in every state.

    :param states: (N, D)
    :return: flat, as states are, (N, A, D), without gradient
    """
    latent_model = group_model(model)
    n, n_actions = len(states), latent_model.n_actions
    actions = th.arange(n_actions, device=states.device).repeat(n)  # (N * A,)
    with th.no_grad(), eval_mode(model):
        elements = latent_model.action_element(states.repeat_interleave(n_actions, dim=0), actions)
    return elements.flatten(1).unflatten(0, (n, n_actions))


def split(model: EqRAlgorithm, states: th.Tensor) -> list[Blocks]:
    """
    :param states: or actions' elements, (..., D)
    :return: the blocks, one entry per group: a product's factors one by one
    """
    latent_model = group_model(model)
    group = latent_model.group
    elements = states.unflatten(-1, (latent_model.n_blocks, *group.element_shape))
    if not isinstance(group, ProductGroup):
        return [Blocks(group, elements)]
    sizes = [count * prod(factor.element_shape) for factor, count in group.factors]
    pieces = elements.split(sizes, dim=-1)  # (..., K, count * prod(element_shape))
    found = []
    for (factor, count), piece in zip(group.factors, pieces, strict=True):
        blocks = piece.unflatten(-1, (count, *factor.element_shape))  # (..., K, count, *element_shape)
        found.append(Blocks(factor, blocks.flatten(-2 - len(factor.element_shape), -1 - len(factor.element_shape))))
    return found


def frame(group: Group, elements: th.Tensor) -> tuple[th.Tensor | None, th.Tensor | None]:
    """
    An element as a moving frame: what turns (or shears), and what shifts. An element that is no matrix is a vector.

    :param elements: (..., *element_shape)
    :return: a matrix, (..., n, n), or ``None``; a vector, (..., n), or ``None``
    """
    if not isinstance(group, MatrixGroup):  # T, none, and a group of one's own
        return None, elements.reshape(*elements.shape[: elements.dim() - len(group.element_shape)], -1)
    if group.is_affine:
        return elements[..., :-1], elements[..., -1]
    return elements, None


def coordinates(group: Group, elements: th.Tensor) -> th.Tensor:
    """
    An element in numbers that are 0 at the identity: the angles of a rotation's logarithm, radians in (-π, π], one per
    plane i < j; the entries less the identity's where the matrix is no rotation; then the translation. The entries less the
    identity's of an element that is no matrix.

    :param elements: (..., *element_shape)
    :return: (..., C), C = len(coordinate_names(group))
    """
    matrix, vector = frame(group, elements)
    parts = []
    if matrix is not None and isinstance(group, (SO, SE)):
        parts.append(_rotation_log(matrix))
    elif matrix is not None:
        parts.append((matrix - th.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)).flatten(-2))
    if vector is not None and _is_own(group):
        parts.append(vector - group.identity(dtype=vector.dtype, device=vector.device).flatten())
    elif vector is not None:
        parts.append(vector)
    return th.cat(parts, dim=-1)


def coordinate_names(group: Group) -> list[str]:
    """
    :return: "angle 0-1", ..., or "a 0-0", ...; then "t 0", ...; or "x 0", ... where an element is no matrix
    """
    matrix, vector = frame(group, th.zeros(group.element_shape))
    names = []
    if matrix is not None:
        n = matrix.shape[-1]
        rotation = isinstance(group, (SO, SE))
        pairs = [(i, j) for i in range(n) for j in range(n) if i < j or not rotation]
        names = [f"{'angle' if rotation else 'a'} {i}-{j}" for i, j in pairs]
    return names + ([] if vector is None else [f"{'x' if _is_own(group) else 't'} {i}" for i in range(vector.shape[-1])])


def _rotation_log(rotation: th.Tensor) -> th.Tensor:
    """
    :param rotation: (..., n, n)
    :return: the upper triangle of its logarithm, (..., n(n-1)/2)
    """
    n, dtype = rotation.shape[-1], rotation.dtype
    if n == 2:
        return th.atan2(rotation[..., 0, 1] - rotation[..., 1, 0], rotation[..., 0, 0] + rotation[..., 1, 1])[..., None]
    rotation = rotation.to(th.float64)
    # A half turn has -1 twice, which says nothing of its plane: 10⁻⁷ rad about an odd axis tell the two apart.
    aside = 1e-7 * th.linspace(0.5, 1, n * n, dtype=th.float64, device=rotation.device).sqrt().view(n, n).triu(1)
    values, vectors = th.linalg.eig(rotation @ th.matrix_exp(aside - aside.mT))  # a rotation is normal: these are a basis
    log = (vectors * (1j * values.angle())[..., None, :] @ th.linalg.inv(vectors)).real
    i, j = th.triu_indices(n, n, 1)
    return log[..., i, j].to(dtype)


def _is_own(group: Group) -> bool:
    """Whether it is a group of the user's own whose elements are no matrices."""
    return not isinstance(group, (MatrixGroup, T, NoGroup))


def _factors(infos: list[dict[str, Any]]) -> np.ndarray | None:
    """
    :return: (n_envs, F); ``None`` where an environment does not tell
    """
    found = [[np.ravel(info[key]) for key in FACTOR_KEYS if key in info] for info in infos]
    return np.array([np.concatenate(row) for row in found]) if all(found) else None


def _true_next(new_obs: Any, dones: np.ndarray, infos: list[dict[str, Any]]) -> Any:
    """The terminal observation where an episode has ended."""
    if isinstance(new_obs, dict):
        return {
            key: _true_next(
                obs, dones, [{**i, "terminal_observation": i.get("terminal_observation", {}).get(key)} for i in infos]
            )
            for key, obs in new_obs.items()
        }
    result = new_obs.copy()
    for i, done in enumerate(dones):
        if done:
            result[i] = infos[i]["terminal_observation"]
    return result


def _map(observations: PyTorchObs, function) -> Any:
    if isinstance(observations, dict):
        return {key: function(obs) for key, obs in observations.items()}
    return function(observations)


@contextmanager
def eval_mode(model: EqRAlgorithm) -> Iterator[None]:
    """The policy in eval mode within the ``with`` block, then as it was."""
    modes = [(module, module.training) for module in model.policy.modules()]
    model.policy.eval()
    try:
        yield
    finally:
        for module, training in modes:
            module.training = training
