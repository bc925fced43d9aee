"""The latent states of an agent on windows of steps: the input of all metrics, figures and videos."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces, set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_eqr.common.checks.arguments import check, integer
from sb3_eqr.common.groups import SE, SO, Group, MatrixGroup, NoGroup, ProductGroup, T
from sb3_eqr.common.latent.conv_latent_model import ConvLatentModel
from sb3_eqr.common.latent.latent_model import LatentModel
from sb3_eqr.common.objective import flat, valid_actions
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.common.replay.buffers import SequenceReplayBuffer
from sb3_eqr.common.saving.random_state import preserved_rng_state
from sb3_eqr.common.type_aliases import PyTorchObs, SequenceReplayBufferSamples

CHUNK = 256  # observations encoded at once
DEPTH = 5  # for agents without latent losses
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
    predicted_rewards: th.Tensor  # (N, M): r_ψ(x̂_m), in units of rewards; the expected sign if that loss is categorical
    actions: th.Tensor  # (N, M), int64, or (N, M, action_dim) for Box actions
    rewards: th.Tensor  # (N, M)
    mask: th.Tensor  # (N, M): 1 where the episode had not ended before step t+m


class Blocks(NamedTuple):
    """Blocks of one group."""

    group: Group
    elements: th.Tensor  # (..., K, *element_shape)


def check_agent(name: str, model: Any) -> None:
    """Raise a ValueError, with the name of the caller, if the model is not an EqR agent."""
    if not isinstance(model, EqROffPolicy) or not hasattr(model.policy, "latent_model"):
        found = type(model).__name__
        raise ValueError(f"{name} needs an EqR agent with a latent model, got {found}, which has none.")


def known_depth(model: EqROffPolicy, depth: int | None) -> int:
    """M as given, or that of the agent, or ``DEPTH``; a ValueError if it is not a positive integer."""
    depth = (model.prediction_depth or DEPTH) if depth is None else depth
    check("depth", depth, integer(1))
    return depth


def as_vec_env(model: EqROffPolicy, env: GymEnv | str) -> VecEnv:
    """The environment, or that with this gymnasium id, with images channels first; a ValueError if its spaces are others."""
    found = model._wrap_env(make_vec_env(env) if isinstance(env, str) else env, monitor_wrapper=False)
    try:
        check_for_correct_spaces(found, model.observation_space, model.action_space)
    except ValueError as error:
        raise ValueError(f"env must have the agent's spaces. {error}. Make it with the arguments of training.") from error
    return found


def reset(model: EqROffPolicy, env: VecEnv, seed: int) -> Any:
    """Seed the environment and all generators, including that of the agent's ε-greedy actions; returns the observations."""
    set_random_seed(seed)
    model.action_space.seed(seed)
    env.seed(seed)
    return env.reset()


def play(
    model: EqROffPolicy,
    env: GymEnv | str,
    n_steps: int = 1000,
    depth: int | None = None,
    deterministic: bool = False,
    seed: int = 0,
) -> Play:
    """
    Run the agent and collect windows of its steps. All random generators except the environments' keep their states.

    :param model: any EqR agent
    :param env: an environment with the agent's spaces, preprocessed as in training; or its gymnasium id
    :param n_steps: number of steps over all environments, at least 2 · depth + 2 each
    :param depth: M ≥ 1, number of steps in each window; ``None``: the agent's, or 5 if it has 0
    :param deterministic: whether the agent acts without noise instead of exploring
    :param seed: seed of the environment and of the agent's noise
    :return: all complete windows, in order
    :raises ValueError: if there are too few steps, or the agent is not an EqR agent
    """
    check_agent("play", model)
    env = as_vec_env(model, env)
    depth = known_depth(model, depth)
    check("n_steps", n_steps, integer((2 * depth + 2) * env.num_envs))
    factors: list[np.ndarray | None] = []
    with preserved_rng_state(model.action_space, env.action_space):
        obs = reset(model, env, seed)
        buffer = SequenceReplayBuffer(
            n_steps, env.observation_space, env.action_space, "cpu", n_envs=env.num_envs, prediction_depth=depth
        )
        infos: list[dict[str, Any]] = env.unwrapped.reset_infos
        for _ in range(buffer.buffer_size):
            factors.append(_factors(infos))
            actions, _ = model.predict(obs, deterministic=deterministic)
            new_obs, rewards, dones, infos = env.step(actions)
            buffer.add(obs, _true_next(new_obs, dones, infos), stored(model, actions), rewards, dones, infos)
            infos = [
                env.unwrapped.reset_infos[i] if done else info for i, (done, info) in enumerate(zip(dones, infos, strict=True))
            ]
            obs = new_obs
    starts, envs = np.indices((buffer.n_starts, env.num_envs)).reshape(2, -1)
    samples = buffer.windows(starts, envs)  # already normalised by a VecNormalize
    shapes = {None if found is None else found.shape for found in factors}
    known = len(shapes) == 1 and None not in shapes
    return Play(samples, np.stack(factors)[starts, envs] if known else None)  # type: ignore[arg-type]


def stored(model: EqROffPolicy, actions: np.ndarray) -> np.ndarray:
    """Actions as the replay buffer has them: those of a Box are scaled to [-1, 1]."""
    return model.policy.scale_action(actions) if isinstance(model.action_space, spaces.Box) else actions


def _factors(infos: list[dict[str, Any]]) -> np.ndarray | None:
    """The true states, (n_envs, F); ``None`` if an environment does not report it in numbers."""
    found = [[np.ravel(info[key]) for key in FACTOR_KEYS if key in info] for info in infos]
    rows = [np.concatenate(row) for row in found if row]
    are_numbers = all(row.dtype.kind in "biuf" and row.shape == rows[0].shape for row in rows)
    return np.array(rows, dtype=np.float64) if len(rows) == len(found) and are_numbers else None


def names_of_factors(n_factors: int, names: Sequence[str]) -> list[str]:
    """The names if their number is right, or else numbers."""
    return list(names) if len(names) == n_factors else [f"factor {i}" for i in range(n_factors)]


def _true_next(new_obs: Any, dones: np.ndarray, infos: list[dict[str, Any]]) -> Any:
    """The next observations, with the terminal one where an episode has ended."""
    found = deepcopy(new_obs)
    for i in np.flatnonzero(dones):
        terminal = infos[i]["terminal_observation"]
        if isinstance(found, dict):
            for key, obs in found.items():
                obs[i] = terminal[key]
        else:
            found[i] = terminal
    return found


def replayed(model: EqROffPolicy, n_windows: int, rng: np.random.Generator) -> Play:
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


def group_model(model: EqROffPolicy) -> LatentModel:
    """The agent's latent model; raises a ValueError if it does not use groups."""
    found = model.policy.latent_model
    if isinstance(found, ConvLatentModel):
        raise ValueError(
            f"The agent's latent model must move states by a group, got {type(found).__name__}, whose states have no "
            'blocks to diagnose. policy_kwargs=dict(transition="group") has them.'
        )
    return found


def encode(model: EqROffPolicy, observations: PyTorchObs) -> th.Tensor:
    """
    x = τ(s), computed by the online encoder in eval mode.

    :param model: any EqR agent
    :param observations: in the format of the replay buffer, (N, *obs_shape) or a dict of these
    :return: (N, D), without gradient
    :raises ValueError: if the agent is not an EqR agent
    """
    check_agent("encode", model)
    n = len(next(iter(observations.values())) if isinstance(observations, dict) else observations)
    policy: Any = model.policy
    states = []
    with th.no_grad(), eval_mode(model):
        for start in range(0, n, CHUNK):
            chunk = each_part(observations, lambda obs, s=start: obs[s : s + CHUNK].to(model.device))
            states.append(policy.latent_model.embedding(policy.extract_features(chunk, policy.encoder)))
    return th.cat(states)


def each_part(observations: Any, function: Any) -> Any:
    """Apply a function to observations, or to each entry of a dict of these."""
    if isinstance(observations, dict):
        return {key: function(obs) for key, obs in observations.items()}
    return function(observations)


def latents(model: EqROffPolicy, samples: SequenceReplayBufferSamples) -> Latents:
    """
    :param model: any EqR agent
    :param samples: N windows with rollouts, M ≥ 1
    :return: without gradient, on the agent's device
    """
    assert samples.mask is not None and samples.rollout_actions is not None and samples.rollout_rewards is not None
    assert samples.rollout_observations is not None
    mask = samples.mask.to(model.device)
    actions = valid_actions(samples.rollout_actions.to(model.device), mask)
    states = encode(model, samples.observations)
    following = encode(model, flat(samples.rollout_observations))  # (N * M, D)
    rewards, latent_model = samples.rollout_rewards.to(model.device), model.policy.latent_model
    with th.no_grad(), eval_mode(model):
        predicted = latent_model.rollout(states, model.policy.embed_actions(actions))
        outputs = latent_model.reward_net(predicted.flatten(0, 1))  # (N * M, 1 or 3)
        if outputs.shape[1] == 3:
            outputs = outputs.softmax(dim=1) @ outputs.new_tensor([[-1.0], [0.0], [1.0]])
        else:
            outputs = model.reward_mean + model.reward_scale * outputs
    following = following.unflatten(0, mask.shape)
    return Latents(states, following, predicted, outputs.view(mask.shape), actions, rewards, mask)


def action_elements(model: EqROffPolicy, states: th.Tensor) -> th.Tensor:
    """
    κ(x, a) of every typical action in every state.

    :param states: (N, D)
    :return: flat like the states, (N, A, D), without gradient
    """
    latent_model = group_model(model)
    n, typical = len(states), model.policy.typical_actions
    n_actions = len(typical)
    actions = typical.repeat(n, *[1] * (typical.ndim - 1))  # (N * A, ...)
    with th.no_grad(), eval_mode(model):
        elements = latent_model.action_element(states.repeat_interleave(n_actions, dim=0), model.policy.embed_actions(actions))
    return elements.flatten(1).unflatten(0, (n, n_actions))


def nearest_typical(model: EqROffPolicy, actions: th.Tensor) -> th.Tensor:
    """The number of the typical action that is nearest to each action, (N,), of discrete actions, (N,), or others, (N, A)."""
    typical = model.policy.typical_actions
    return actions if typical.ndim == 1 else (actions @ typical.mT).argmax(dim=1)


def split(model: EqROffPolicy, states: th.Tensor) -> list[Blocks]:
    """
    :param states: states or elements of actions, (..., D)
    :return: the blocks, one entry per group; each factor of a product has its own entry
    """
    latent_model = group_model(model)
    group = latent_model.group
    elements = states.unflatten(-1, (latent_model.n_blocks, *group.element_shape))
    if not isinstance(group, ProductGroup):
        return [Blocks(group, elements)]
    factors = [factor for factor, _ in group.factors]
    pieces = zip(factors, group._unflatten(elements), strict=True)  # (..., K, count, *element_shape) each
    return [Blocks(factor, piece.flatten(states.dim() - 1, states.dim())) for factor, piece in pieces]


def each_block(model: EqROffPolicy, states: th.Tensor) -> list[tuple[str, Group, th.Tensor]]:
    """Name, such as "SE(2) 0", group and elements, (..., *element_shape), of each block of states, (..., D)."""
    return [
        (f"{group} {i}", group, block)
        for group, elements in split(model, states)
        for i, block in enumerate(elements.unbind(-1 - len(group.element_shape)))
    ]


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
    if isinstance(group, NoGroup):  # has no identity
        return elements
    matrix, vector = frame(group, elements)
    identity: Any = frame(group, group.identity(dtype=elements.dtype, device=elements.device))
    parts = []
    if matrix is not None:
        parts.append(_rotation_log(matrix) if isinstance(group, (SO, SE)) else (matrix - identity[0]).flatten(-2))
    if vector is not None:
        parts.append(vector - identity[1])
    return th.cat(parts, dim=-1)


def coordinate_names(group: Group) -> list[str]:
    """:return: "angle 0-1", ..., or "a 0-0", ...; then "t 0", ...; or "x 0", ... if elements are not matrices"""
    matrix, vector = frame(group, th.zeros(group.element_shape))
    n, n_shifts = (0 if part is None else part.shape[-1] for part in (matrix, vector))
    is_rotation = isinstance(group, (SO, SE))
    entries = [(i, j) for i in range(n) for j in range(n) if i < j or not is_rotation]
    kind = "t" if isinstance(group, (MatrixGroup, T, NoGroup)) else "x"
    return [f"{'angle' if is_rotation else 'a'} {i}-{j}" for i, j in entries] + [f"{kind} {i}" for i in range(n_shifts)]


def _rotation_log(rotation: th.Tensor) -> th.Tensor:
    """The upper triangle, (..., n(n-1)/2), of the logarithm of rotations, (..., n, n)."""
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


@contextmanager
def eval_mode(model: EqROffPolicy) -> Iterator[None]:
    """Put the policy into eval mode, and restore its modes on exit."""
    modes = [(module, module.training) for module in model.policy.modules()]
    model.policy.eval()
    try:
        yield
    finally:
        for module, training in modes:
            module.training = training
