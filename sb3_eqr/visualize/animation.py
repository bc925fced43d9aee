"""An animation of the environment next to the blocks of the latent state, current and predicted."""

import pathlib
import random
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_eqr.common.checks.arguments import check, integer, number
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.common.groups import NoGroup
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.common.saving.random_state import preserved_rng_state
from sb3_eqr.common.type_aliases import PyTorchObs
from sb3_eqr.visualize.canvas import Line, Painter
from sb3_eqr.visualize.latents import as_vec_env, check_agent, encode, eval_mode, group_model
from sb3_eqr.visualize.loading import action_names
from sb3_eqr.visualize.pixels import observed_pictures
from sb3_eqr.visualize.sketches import panels

MAX_PANELS = 36
MAX_LETTERS = 45  # of the group's name
FPS = 15  # Atari's 60 frames per second, of which an agent observes every fourth
FORMATS = ("mp4", "gif")
EVERY = {"mp4": 1, "gif": 2}  # write every n-th frame
OPTIONS: dict[str, dict[str, Any]] = {"mp4": {"quality": 8, "macro_block_size": 2}, "gif": {"loop": 0}}  # for imageio


class Film(NamedTuple):
    """T steps of one environment."""

    observations: PyTorchObs  # (T, *obs_shape): s_t, the network's input
    pictures: Sequence[np.ndarray]  # T of (height, width, 3), uint8
    actions: np.ndarray  # (T,), int64: a_t
    rewards: np.ndarray  # (T,): r_{t+1}, before normalisation
    starts: np.ndarray  # (T,), int64: the step at which each step's episode began
    action_names: list[str]  # one per action


def record(
    model: EqRAlgorithm,
    env: GymEnv | str,
    path: str | pathlib.Path,
    n_steps: int = 200,
    depth: int = 5,
    seed: int = 0,
    formats: Sequence[str] = FORMATS,
    fps: float | None = None,
    deterministic: bool = True,
) -> list[pathlib.Path]:
    """
    Write a video of the agent: the environment on the left, a panel per block of the latent state on the right. A rotation
    is an arrow, a translation a dot with a trail, a general matrix the images of the unit vectors; in three dimensions, the
    three axes (red, green, blue); without a group, the first two principal components. Orange or pale is what the latent
    model predicted ``depth`` steps before, from the latent state then and the actions since; a triangle marks a prediction
    beyond the edge. The line at the top has the action that the agent chooses in this frame, its reward, and the score
    including it.

    All random generators keep their states; the same seed gives the same frames.

    :param model: any EqR agent; its latent model predicts only if it was trained (``prediction_depth`` > 0)
    :param env: preprocessed as in training, but not the training environment itself; a VecNormalize with ``training=False``.
        Of several environments the first is shown, with ``render_mode="rgb_array"`` its rendering, else the observations
    :param path: path without suffix (.mp4 and .gif are removed); every format adds its own. Folders are created, and files
        are written to a temporary name and renamed
    :param n_steps: number of environment steps, one frame each; more than ``depth``
    :param depth: M ≥ 1
    :param seed: seed of the environment and of the agent's noise
    :param formats: "mp4" (H.264) and "gif" (every second frame)
    :param fps: frames per second; default 15, which is Atari's real speed
    :param deterministic: whether the agent acts without noise
    :return: the files, in the order of ``formats``
    :raises ValueError: for an argument out of range, or an environment with other spaces than the agent's
    :raises ImportError: without the extra "visualize"
    """
    check_agent("record", model)
    check("depth", depth, integer(1))
    check("n_steps", n_steps, integer(depth + 1))
    path = pathlib.Path(path)
    path = path.with_suffix("") if path.suffix[1:].lower() in FORMATS else path  # x.mp4 would become x.mp4.mp4
    fps = FPS if fps is None else fps
    check("fps", fps, number(1, 50))  # the limit of GIF
    if not formats or set(formats) - set(FORMATS):
        raise ValueError(f"formats must be one or more of {list(FORMATS)}, got {formats!r}.")
    with preserved_rng_state(model.action_space):
        film = shoot(model, env, n_steps, seed, deterministic)
    states = encode(model, film.observations)  # (T, D)
    ghosts = predictions(model, states, film.actions, film.starts, depth)
    shown = panels(model, states, ghosts, MAX_PANELS)
    painter = Painter(shown, film.starts, depth, describe(model, len(shown)))
    return write_video(frames(film, painter), path, formats, fps)


def shoot(model: EqRAlgorithm, env: GymEnv | str, n_steps: int, seed: int, deterministic: bool) -> Film:
    """
    Run the agent. Seeds the global generators.

    :param model: the agent
    :param env: see :func:`record`
    :param n_steps: T
    :param seed: seed of the environment and of the agent's noise
    :param deterministic: whether the agent acts without noise
    """
    env = as_vec_env(model, env)
    for what in ("observation_space", "action_space"):
        if getattr(env, what) != getattr(model, what):
            raise ValueError(
                f"env must have the agent's {what} {getattr(model, what)}, got {getattr(env, what)}. "
                "Wrap the environment as in training."
            )
    normalize = unwrap_vec_normalize(env)
    renders = env.render_mode == "rgb_array"
    random.seed(seed)
    np.random.seed(seed)
    th.manual_seed(seed)
    model.action_space.seed(seed)  # for ε-greedy actions
    env.seed(seed)
    obs: Any = env.reset()
    observations, pictures, actions, rewards, starts, start = [], [], [], [], [], 0
    for t in range(n_steps):
        observations.append(obs)
        if renders:
            pictures.append(np.asarray(env.get_images()[0], dtype=np.uint8))
        chosen, _ = model.predict(obs, deterministic=deterministic)
        obs, reward, dones, _ = env.step(chosen)
        actions.append(int(chosen[0]))
        rewards.append(float((reward if normalize is None else normalize.get_original_reward())[0]))
        starts.append(start)
        start = t + 1 if dones[0] else start
    seen = _first_envs(observations)
    if not renders:
        pictures = observed_pictures(seen, model.observation_space, model.frame_stack)
    names = [f"action {name}" if name.isdigit() else name for name in action_names(env, int(model.policy.action_space.n))]
    tensors = {key: th.as_tensor(x) for key, x in seen.items()} if isinstance(seen, dict) else th.as_tensor(seen)
    return Film(tensors, pictures, np.array(actions), np.array(rewards), np.array(starts), names)


def predictions(model: EqRAlgorithm, states: th.Tensor, actions: np.ndarray, starts: np.ndarray, depth: int) -> th.Tensor:
    """
    The latent model's predictions from ``depth`` steps before.

    :param model: the agent
    :param states: x₀ of consecutive steps, (T, D)
    :param actions: a_t, (T,)
    :param starts: the step at which each step's episode began, (T,)
    :param depth: M
    :return: x̂_M for each step, (T, D); NaN in the first M steps of an episode
    """
    n = len(states) - depth
    latent_model = model.policy.latent_model
    since = th.as_tensor(np.lib.stride_tricks.sliding_window_view(actions, depth)[:n].copy(), device=states.device)  # (n, M)
    with th.no_grad(), eval_mode(model):
        predicted = latent_model.rollout(states[:n], model.policy.embed_actions(since))[:, -1]
    old_enough = th.as_tensor(np.arange(depth, len(states)) - starts[depth:] >= depth, device=states.device)
    nothing = th.full_like(states, float("nan"))
    return th.cat([nothing[:depth], th.where(old_enough[:, None], predicted, nothing[depth:])])


def describe(model: EqRAlgorithm, n_shown: int) -> str:
    """
    :param n_shown: number of panels
    :return: a description of the agent in one line
    """
    group, n_blocks = group_model(model).group, group_model(model).n_blocks
    blocks = "no group" if isinstance(group, NoGroup) else f"{group}" if n_blocks == 1 else f"{n_blocks} blocks of {group}"
    blocks = blocks if len(blocks) < MAX_LETTERS else f"{blocks[:MAX_LETTERS]}..."
    return f"{type(model).__name__}, {blocks}{f', the first {MAX_PANELS}' if n_shown == MAX_PANELS else ''}"


def frames(film: Film, painter: Painter) -> Iterator[np.ndarray]:
    """
    :param film: T steps
    :param painter: painter with their latent states
    :return: T of (HEIGHT, WIDTH, 3), uint8
    """
    score = 0.0
    for t, (action, reward, start) in enumerate(zip(film.actions, film.rewards, film.starts, strict=True)):
        score = reward + (0.0 if t == start else score)
        yield painter.paint(t, film.pictures[t], Line(t - start, film.action_names[action], reward, score))


def write_video(images: Iterator[np.ndarray], path: pathlib.Path, formats: Sequence[str], fps: float) -> list[pathlib.Path]:
    """
    :param images: (HEIGHT, WIDTH, 3), uint8
    :param path: without suffix
    :param formats: some of :data:`FORMATS`
    :param fps: frames per second
    :return: the files
    """
    try:
        import imageio.v2 as imageio
    except ImportError as error:
        raise ImportError(
            'Videos need imageio and ffmpeg. Run pip install ".[visualize]" in a clone of the repository.'
        ) from error
    paths = [path.with_name(f"{path.name}.{suffix}") for suffix in formats]
    with tempfile.TemporaryDirectory() as folder:
        aside = {suffix: pathlib.Path(folder) / f"film.{suffix}" for suffix in formats}
        with ExitStack() as stack:
            rates = {"mp4": {"fps": fps}, "gif": {"duration": 1000 * EVERY["gif"] / fps}}
            writers: dict[str, Any] = {
                suffix: stack.enter_context(imageio.get_writer(file, mode="I", **{**OPTIONS[suffix], **rates[suffix]}))
                for suffix, file in aside.items()
            }
            for t, image in enumerate(images):
                for suffix, writer in writers.items():
                    if t % EVERY[suffix] == 0:
                        writer.append_data(image)
        for suffix, one in zip(formats, paths, strict=True):
            with atomic_write(one, suffix) as file:
                file.write(aside[suffix].read_bytes())
    return paths


def _first_envs(observations: list[Any]) -> Any:
    """
    :param observations: T of (n_envs, *obs_shape), or dicts of these
    :return: those of the first environment, (T, *obs_shape)
    """
    if isinstance(observations[0], dict):
        return {key: np.stack([obs[key][0] for obs in observations]) for key in observations[0]}
    return np.stack([obs[0] for obs in observations])
