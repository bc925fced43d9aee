"""The latent states of an agent on windows of steps: the input of all metrics, figures and animations."""

from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_eqr.common.checks.arguments import check, integer
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.common.groups import SE, SO, Group, MatrixGroup, NoGroup, ProductGroup, T
from sb3_eqr.common.latent.conv_latent_model import ConvLatentModel
from sb3_eqr.common.latent.latent_model import LatentModel
from sb3_eqr.common.replay.buffers import SequenceReplayBuffer
from sb3_eqr.common.saving.random_state import preserved_rng_state
from sb3_eqr.common.type_aliases import PyTorchObs, SequenceReplayBufferSamples

CHUNK = 256  # observations encoded at once
# Keys of ``info`` under which an environment may report its true state, as those of sb3_eqr.envs do.
FACTOR_KEYS = ("position", "angle", "velocity", "rotation", "translation")


class Play(NamedTuple):
    """Windows of an agent's steps: N starts, with the M steps after each."""

    samples: SequenceReplayBufferSamples
    factors: np.ndarray | None  # (N, F): the true state at each start, if the environment's ``info`` reports it


class Latents(NamedTuple):
    """Latent states of N windows. D = K · prod(element_shape)."""

    states: th.Tensor  # (N, D): x₀ = τ(s_t)
    next_states: th.Tensor  # (N, M, D): x₁ ... x_M, encoded
    predicted: th.Tensor  # (N, M, D): x̂₁ ... x̂_M, rolled out from x₀
    predicted_rewards: th.Tensor  # (N, M): r_ψ(x̂_m); the expected sign if the reward loss is categorical
    actions: th.Tensor  # (N, M), int64
    rewards: th.Tensor  # (N, M)
    mask: th.Tensor  # (N, M): 1 where the episode had not ended before step t+m


class Blocks(NamedTuple):
    """Blocks of one group."""

    group: Group
    elements: th.Tensor  # (..., K, *element_shape)


def check_agent(name: str, model: Any) -> None:
    """
    :param name: name of the caller, for the message
    :raises ValueError: if the model is not an EqR agent
    """
    if not isinstance(model, EqRAlgorithm):
        found = type(model).__name__
        raise ValueError(f"{name} needs an EqR agent (EqRQRDQN, EqRRainbow), got {found}, which has no latent model.")


def as_vec_env(model: EqRAlgorithm, env: GymEnv | str) -> VecEnv:
    """
    :param env: the environment, or its gymnasium id
    :return: the environment, with images channels first as in training
    """
    return model._wrap_env(make_vec_env(env) if isinstance(env, str) else env, monitor_wrapper=False)


def play(
    model: EqRAlgorithm, env: GymEnv | str, n_steps: int = 1000, depth: int = 5, deterministic: bool = False, seed: int = 0
) -> Play:
    """
    Run the agent and collect windows of its steps. All random generators except the environments' keep their states.

    :param model: any EqR agent
    :param env: an environment with the agent's spaces, preprocessed as in training; or its gymnasium id
    :param n_steps: number of steps over all environments, at least 2 · depth + 2 each
    :param depth: M ≥ 1, number of steps in each window
    :param deterministic: whether the agent acts without noise instead of exploring
    :param seed: seed of the environment and of the agent's noise
    :return: all complete windows, in order
    :raises ValueError: if there are too few steps, or the agent is not an EqR agent
    """
    check_agent("play", model)
    env = as_vec_env(model, env)
    check("depth", depth, integer(1))
    check("n_steps", n_steps, integer((2 * depth + 2) * env.num_envs))
    space = normalized_space(env)
    buffer = SequenceReplayBuffer(n_steps, space, env.action_space, "cpu", n_envs=env.num_envs, prediction_depth=depth)
    factors: list[np.ndarray | None] = []
    with preserved_rng_state(model.action_space, env.action_space):  # the first draws random actions
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
    samples = buffer.windows(starts, envs)  # already normalised by a VecNormalize
    known = all(found is not None for found in factors)
    return Play(samples, np.stack(factors)[starts, envs] if known else None)  # type: ignore[arg-type]


def normalized_space(env: VecEnv) -> spaces.Space:
    """The space of what the environment returns: VecNormalize makes floats of integers, but keeps the space of vectors."""
    normalize, space = unwrap_vec_normalize(env), env.observation_space
    if normalize is None or not normalize.norm_obs:
        return space
    if isinstance(space, spaces.Dict):
        keys = normalize.norm_obs_keys or []
        return spaces.Dict(OrderedDict((key, _as_floats(part) if key in keys else part) for key, part in space.spaces.items()))
    return _as_floats(space)


def _as_floats(space: spaces.Space) -> spaces.Space:
    is_integer = isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.integer)
    return spaces.Box(-np.inf, np.inf, space.shape, np.float32) if is_integer else space


def replayed(model: EqRAlgorithm, n_windows: int, rng: np.random.Generator) -> Play:
    """
    Windows drawn uniformly from the agent's replay buffer; no global random generator is used.

    :param model: an agent in training, with ``prediction_depth`` ≥ 1
    :param n_windows: N
    :param rng: generator that draws the windows
    :raises ValueError: if there is no complete window yet
    """
    buffer = model.replay_buffer
    if buffer is None or buffer.prediction_depth == 0 or buffer.n_starts < 1:
        raise ValueError(
            "replayed needs a replay buffer with complete windows, got none. Train the agent first, with "
            "prediction_depth >= 1; for a loaded agent, use sb3_eqr.visualize.play instead."
        )
    starts = rng.integers(0, buffer.n_starts, n_windows)
    envs = rng.integers(0, buffer.n_envs, n_windows)
    return Play(buffer.windows(starts, envs, model.get_vec_normalize_env()), None)


def group_model(model: EqRAlgorithm) -> LatentModel:
    """
    The agent's latent model.

    :raises ValueError: if it does not use groups
    """
    found = model.policy.latent_model
    if isinstance(found, ConvLatentModel):
        raise ValueError(
            f"The agent's latent model must move states by a group, got {type(found).__name__}, whose states have no "
            'blocks to diagnose. policy_kwargs=dict(transition="group") has them.'
        )
    return found


def encode(model: EqRAlgorithm, observations: PyTorchObs) -> th.Tensor:
    """
    x = τ(s), computed by the online encoder in eval mode.

    :param model: any EqR agent
    :param observations: in the format of the replay buffer, (N, *obs_shape) or a dict of these
    :return: (N, D), without gradient
    :raises ValueError: if the agent is not an EqR agent
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
        predicted = latent_model.rollout(states, model.policy.embed_actions(actions))
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
    :return: flat like the states, (N, A, D), without gradient
    """
    latent_model = group_model(model)
    n, n_actions = len(states), latent_model.action_dim
    actions = th.arange(n_actions, device=states.device).repeat(n)  # (N * A,)
    with th.no_grad(), eval_mode(model):
        elements = latent_model.action_element(states.repeat_interleave(n_actions, dim=0), model.policy.embed_actions(actions))
    return elements.flatten(1).unflatten(0, (n, n_actions))


def split(model: EqRAlgorithm, states: th.Tensor) -> list[Blocks]:
    """
    :param states: states or elements of actions, (..., D)
    :return: the blocks, one entry per group; each factor of a product has its own entry
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
    An element as a frame: a matrix that rotates (or shears) and a translation. An element that is not a matrix is a vector.

    :param elements: (..., *element_shape)
    :return: a matrix, (..., n, n), or ``None``; a vector, (..., n), or ``None``
    """
    if not isinstance(group, MatrixGroup):  # T, none, and user-defined groups
        return None, elements.reshape(*elements.shape[: elements.dim() - len(group.element_shape)], -1)
    if group.is_affine:
        return elements[..., :-1], elements[..., -1]
    return elements, None


def coordinates(group: Group, elements: th.Tensor) -> th.Tensor:
    """
    Coordinates of an element that are 0 at the identity: for a rotation, the angles of its logarithm, radians in (-π, π], one
    per plane i < j; for another matrix, its entries minus the identity's; then the translation. For an element that is not a
    matrix, its entries minus the identity's.

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
    """:return: "angle 0-1", ..., or "a 0-0", ...; then "t 0", ...; or "x 0", ... if elements are not matrices"""
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
    # A half turn has the eigenvalue -1 twice, which does not determine its plane: a rotation by 10⁻⁷ rad separates the two.
    aside = 1e-7 * th.linspace(0.5, 1, n * n, dtype=th.float64, device=rotation.device).sqrt().view(n, n).triu(1)
    values, vectors = th.linalg.eig(rotation @ th.matrix_exp(aside - aside.mT))  # a basis, as a rotation is normal
    log = (vectors * (1j * values.angle())[..., None, :] @ th.linalg.inv(vectors)).real
    i, j = th.triu_indices(n, n, 1)
    return log[..., i, j].to(dtype)


def _is_own(group: Group) -> bool:
    """:return: whether this is a user-defined group whose elements are not matrices"""
    return not isinstance(group, (MatrixGroup, T, NoGroup))


def _factors(infos: list[dict[str, Any]]) -> np.ndarray | None:
    """:return: (n_envs, F); ``None`` if an environment does not report its true state"""
    found = [[np.ravel(info[key]) for key in FACTOR_KEYS if key in info] for info in infos]
    return np.array([np.concatenate(row) for row in found]) if all(found) else None


def _true_next(new_obs: Any, dones: np.ndarray, infos: list[dict[str, Any]]) -> Any:
    """:return: the next observations, with the terminal one where an episode has ended"""
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
    """Put the policy into eval mode, and restore its modes on exit."""
    modes = [(module, module.training) for module in model.policy.modules()]
    model.policy.eval()
    try:
        yield
    finally:
        for module, training in modes:
            module.training = training
