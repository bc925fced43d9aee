"""Videos of the environment beside the blocks of the latent state: now, and as predicted some steps before."""

import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import imageio.v2 as imageio
import numpy as np
import torch as th
from gymnasium import spaces
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import hsv_to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import unwrap_vec_normalize
from torch.utils.data import default_collate

from sb3_eqr.common.checks.arguments import check, integer
from sb3_eqr.common.groups import SE, SO, Group, NoGroup, T
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.common.saving.random_state import preserved_rng_state
from sb3_eqr.plot_style import GREY, INK
from sb3_eqr.visualize import latents
from sb3_eqr.visualize.loading import action_names

WIDTH, HEIGHT, DPI = 900, 500, 100  # pixels; even, as H.264 requires
FPS = 15  # Atari's 60 frames per second, of which an agent observes every fourth
MAX_PANELS, MAX_BARS, TRAIL = 36, 16, 12  # TRAIL: steps of the line behind a dot
ARROW, ROOM, GHOST_ROOM = 0.4, 0.85, 3.0  # arrow at a dot, largest coordinate, in half panels; growth for predictions
VIEW = np.array([[0.866, -0.211], [0.5, 0.366], [0.0, 0.906]])  # from 60° to the left and 25° above, as in matplotlib
LINE, NOW, PREDICTED = "#dadee3", "#1446a0", "#f49840"
AXES, PALE_AXES = ("#c82828", "#1e8c32", "#1e50c8"), ("#f2b2b2", "#acdcb4", "#b2c6f4")  # x, y, z
DOT: Any = {"color": NOW, "marker": "o", "linestyle": "", "markersize": 4.5}
GHOST: Any = {"color": PREDICTED, "marker": "o", "linestyle": "", "markersize": 7, "mfc": "none"}
TRACE: Any = {"color": NOW, "alpha": 0.35, "linewidth": 1}
UNITS: Any = {"units": "xy", "angles": "xy", "scale_units": "xy", "scale": 1}  # arrows as long as their vectors


class Film(NamedTuple):
    """T steps of one environment."""

    observations: Any  # (T, *obs_shape), or a dict of these: s_t, the network's input
    pictures: Sequence[np.ndarray]  # T of (height, width, 3), uint8, or of (n,): numbers in [-1, 1], drawn as bars
    titles: Sequence[str]  # (T,): the step of the episode, its action, its reward and the score
    actions: np.ndarray  # (T,), int64, or (T, action_dim): a_t, as in the replay buffer
    starts: np.ndarray  # (T,), int64: the step at which each step's episode began


class Panel(NamedTuple):
    """One block, in units of the panel: edges at ±1. First axis: now, predicted. NaN: not predicted, or not in the group."""

    name: str
    half_width: float  # of the panel, in latent units
    arrows: np.ndarray  # (2, T, 3, 2): images of the unit vectors, relative to the dot; of a rotation of the plane only one
    dots: np.ndarray  # (2, T, 2): translation, at the edge if it is beyond it


def record(
    model: EqROffPolicy,
    env: GymEnv | str,
    path: str | pathlib.Path,
    n_steps: int = 200,
    depth: int | None = None,
    seed: int = 0,
    deterministic: bool = True,
) -> list[pathlib.Path]:
    """
    Write a video of the agent: the environment on the left, a panel per block of the latent state on the right, as it is and
    as the latent model predicted it ``depth`` steps before, from the latent state then and the actions since (see
    docs/latent_states.md). All random generators keep their states.

    :param model: any EqR agent; its latent model predicts only if it was trained (``prediction_depth`` > 0)
    :param env: preprocessed as in training, but not the training environment itself; a VecNormalize with ``training=False``.
        Of several environments the first is shown, with ``render_mode="rgb_array"`` its rendering, else the observations
    :param path: of the files, without .mp4 and .gif; folders are created
    :param n_steps: number of environment steps, one frame each; more than ``depth``
    :param depth: M ≥ 1; ``None``: the agent's, or 5 if it has 0
    :param seed: seed of the environment and of the agent's noise
    :param deterministic: whether the agent acts without noise
    :return: the MP4 (H.264), and the GIF, which has every second frame
    :raises ValueError: for an argument out of range, or an environment with other spaces than the agent's
    """
    latents.check_agent("record", model)
    depth = latents.known_depth(model, depth)
    check("n_steps", n_steps, integer(depth + 1))
    with preserved_rng_state(model.action_space):
        film = shoot(model, env, n_steps, seed, deterministic)
    states = latents.encode(model, film.observations)  # (T, D)
    both = th.stack([states, predictions(model, states, film.actions, film.starts, depth)]).cpu()  # (2, T, D)
    blocks = latents.each_block(model, both)
    about = f"{type(model).__name__}, {min(len(blocks), MAX_PANELS)} of {len(blocks)} blocks"
    return write_video(frames(film, [panel(*block) for block in blocks[:MAX_PANELS]], about, depth), pathlib.Path(path))


def shoot(model: EqROffPolicy, env: GymEnv | str, n_steps: int, seed: int, deterministic: bool) -> Film:
    """Run the agent; parameters as in :func:`record`. Seeds the global generators."""
    env = latents.as_vec_env(model, env)
    normalize, obs = unwrap_vec_normalize(env), latents.reset(model, env, seed)
    names = action_names(env, model)
    can_render = env.render_mode == "rgb_array" and "rgb_array" in (env.get_attr("metadata", 0)[0] or {}).get(
        "render_modes", []
    )
    rows, start, score = [], 0, 0.0
    for t in range(n_steps):
        seen = latents.each_part(obs, lambda x: x[0])
        picture = np.asarray(env.get_images()[0], np.uint8) if can_render else None
        chosen, _ = model.predict(obs, deterministic=deterministic)
        obs, rewards, dones, _ = env.step(chosen)
        reward = float((rewards if normalize is None else normalize.get_original_reward())[0])
        score = reward + (0.0 if t == start else score)
        name = names[chosen[0]][:14] if np.ndim(chosen[0]) == 0 else " ".join(f"{part:+.1f}" for part in chosen[0][:3])
        title = f"step {t - start:<5d} action {name:<14s} reward {reward:<+8.3g} score {score:<8.4g}"
        rows.append((seen, picture, title, latents.stored(model, chosen)[0], start))
        start = t + 1 if dones[0] else start
    observations, pictures, titles, actions, starts = zip(*rows, strict=True)
    seen = default_collate(list(observations))
    if pictures[0] is None:
        pictures = tuple(observed_pictures(latents.each_part(seen, np.asarray), model.observation_space, model.frame_stack))
    return Film(seen, pictures, titles, np.array(actions), np.array(starts))


def predictions(model: EqROffPolicy, states: th.Tensor, actions: np.ndarray, starts: np.ndarray, depth: int) -> th.Tensor:
    """What was predicted M = ``depth`` steps before x₀, (T, D), was seen; NaN in the first M steps of an episode."""
    each = np.arange(len(states) - depth)[:, None] + np.arange(depth)
    since = th.as_tensor(actions[each], device=states.device)  # (T - M, M, ...)
    with th.no_grad(), latents.eval_mode(model):
        predicted = model.policy.latent_model.rollout(states[:-depth], model.policy.embed_actions(since))[:, -1]
    is_old = th.as_tensor(np.arange(len(states)) - starts >= depth, device=states.device)
    return th.where(is_old[:, None], th.cat([states[:depth], predicted]), th.nan)


def observed_pictures(observations: Any, space: spaces.Space, frame_stack: int) -> np.ndarray:
    """Observations, (T, *obs_shape) or a dict of these, as :class:`Film` has them."""
    if isinstance(space, spaces.Dict):
        key = max(space.spaces, key=lambda key: len(space[key].shape or ()) == 3)  # the first image, if any
        return observed_pictures(observations[key], space[key], frame_stack)
    if observations.ndim != 4:  # numbers, each at its own scale
        numbers = observations.reshape(len(observations), -1)[:, :MAX_BARS]  # (T, n)
        return numbers / np.maximum(np.abs(numbers).max(axis=0), 1e-9)
    ends = (0, 255) if is_image_space(space) else (observations.min(), observations.max())
    n = observations.shape[1] // frame_stack  # planes of the newest frame: RGB, or each in its own colour
    colors = np.eye(3) if n == 3 else hsv_to_rgb([(i / n, 0.75 if n > 1 else 0.0, 1.0) for i in range(n)])  # (n, 3)
    shades = np.interp(observations[:, -n:, ..., None], ends, (0, 255)) * colors[:, None, None]
    return shades.max(axis=1).astype(np.uint8)


def panel(name: str, group: Group, elements: th.Tensor) -> Panel:
    """The panel of a block, true and predicted, (2, T, *element_shape), at a constant scale."""
    parts: list[Any] = [None if part is None else part.double().numpy() for part in latents.frame(group, elements)]
    matrix, vector = parts  # (2, T, n, n), (2, T, n)
    arrows, dots = np.full((*elements.shape[:2], 3, 2), np.nan), np.full((*elements.shape[:2], 2), np.nan)
    n, is_rotation = (vector if matrix is None else matrix).shape[-1], isinstance(group, (SO, SE))
    plane = VIEW if n == 3 else np.eye(n, 2)  # (n, 2): of more than three dimensions, the first two are shown
    has_arrows = matrix is not None and not (is_rotation and n == 1)
    if has_arrows:
        images = matrix.swapaxes(2, 3)[:, :, : 1 if n == 2 and is_rotation else 3] @ plane  # (2, T, at most 3, 2)
        half_width = (1.0 if is_rotation else _extent(images)) / (ROOM if vector is None else ARROW)
        arrows[:, :, : images.shape[2]] = images / half_width
    if vector is not None:
        if (isinstance(group, NoGroup) and n > 2) or (isinstance(group, T) and n > 3):  # principal axes
            plane = np.linalg.svd(vector[0] - vector[0].mean(axis=0), full_matrices=False)[2][:2].T
        dots = vector @ plane
        dots -= (dots[0].min(axis=0) + dots[0].max(axis=0)) / 2
        half_width = _extent(dots) / (1 - ARROW if has_arrows else ROOM)  # leaves space for an arrow at the last dot
        dots = (dots / half_width).clip(-1, 1)
    feet = np.nan_to_num(dots)[:, :, None]
    return Panel(name, half_width, (feet + arrows).clip(-1, 1) - feet, dots)


def _extent(values: np.ndarray) -> float:
    """The half width that the true states need, or 98 % of the predictions, unless these are too far out."""
    needed, ghosts = max(float(np.abs(values[0]).max()), 1e-6), np.abs(values[1][np.isfinite(values[1])])
    wanted = float(np.quantile(ghosts, 0.98)) if len(ghosts) else 0.0
    return wanted if needed < wanted <= GHOST_ROOM * needed else needed


def still(panels: Sequence[Panel], about: str, depth: int) -> tuple[Figure, np.ndarray]:
    """What does not move: squares with their names, in one Axes, which is faster than one each. Also their centers, (K, 2)."""
    n = len(panels)
    columns = max(range(1, n + 1), key=lambda columns: min(1.3 / columns, 1 / -(-n // columns)))  # the largest squares
    centers = 2.1 * np.array([(k % columns, -(k // columns)) for k in range(n)])
    figure = Figure((WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
    figure.add_axes((0.01, 0.08, 0.37, 0.84)).set_axis_off()  # the environment's
    ax = figure.add_axes((0.4, 0.08, 0.59, 0.84), aspect="equal")
    ax.set(xlim=(-1.01, centers[:, 0].max() + 1.01), ylim=(centers[:, 1].min() - 1.01, 1.01))
    ax.set_axis_off()
    for panel, (x, y) in zip(panels, centers, strict=True):
        ax.add_patch(Rectangle((x - 1, y - 1), 2, 2, facecolor="#f6f7f9", edgecolor=LINE))
        if np.isnan(panel.dots).all():  # arrows begin in the middle
            ax.add_patch(Circle((x, y), ROOM, fill=False, edgecolor=LINE))
        ax.text(x - 0.94, y + 0.94, panel.name, va="top", color=GREY, fontsize=8 if n < 13 else 6)
        ax.text(x + 0.94, y - 0.94, f"edge ±{panel.half_width:.2g}", ha="right", color=GREY, fontsize=8 if n < 13 else 6)
    before = f"predicted {depth} step{'s' if depth > 1 else ''} before"
    has_axes = any(np.isfinite(panel.arrows[0, 0, 1]).all() for panel in panels)
    looks: dict[str, Any] = {} if has_axes else {"now": {"color": NOW}, before: {"color": PREDICTED}}  # single arrows
    if not all(np.isnan(panel.dots).all() for panel in panels):
        looks = {"now": DOT, before: GHOST, f"last {TRAIL} steps": TRACE}
    if has_axes:
        looks |= {name: {"color": color} for name, color in zip("xyz", AXES, strict=True)}
        looks[f"pale: {before}"] = {"color": PALE_AXES[0]}
    for label, look in looks.items():
        ax.plot([], [], label=label, **look)
    figure.legend(loc="lower right", ncols=len(looks), fontsize=8, handlelength=1.5, frameon=False)
    figure.text(0.988, 0.95, about, color=GREY, fontsize=8, ha="right")
    return figure, centers


def frames(film: Film, panels: Sequence[Panel], about: str, depth: int) -> Iterator[np.ndarray]:
    """The T frames, (HEIGHT, WIDTH, 3), uint8, of K panels, with a line about the agent."""
    figure, centers = still(panels, about, depth)
    canvas, (game, ax) = FigureCanvasAgg(figure), figure.axes
    canvas.draw()
    ground = canvas.copy_from_bbox(figure.bbox)  # restored for every frame: drawing it again would take longer than the rest
    arrows = np.stack([panel.arrows for panel in panels], axis=2)  # (2, T, K, 3, 2)
    dots = centers + np.stack([panel.dots for panel in panels], axis=2)  # (2, T, K, 2)
    feet = np.repeat(np.where(np.isnan(dots), centers, dots)[..., None, :], 3, axis=-2)  # (2, T, K, 3, 2)
    has_axes = np.isfinite(arrows[0, 0, :, 1:2, 0])  # (K, 1)
    for t, (picture, title) in enumerate(zip(film.pictures, film.titles, strict=True)):
        trails = dots[0, max(film.starts[t], t - TRAIL) : t + 1]  # (steps, K, 2)
        drawn: list[Any] = ax.plot(trails[..., 0], trails[..., 1], **TRACE)
        for which, look, axes, width in ((1, GHOST, PALE_AXES, 0.052), (0, DOT, AXES, 0.036)):
            shown = np.isfinite(arrows[which, t, ..., 0])  # (K, 3)
            colors = np.where(has_axes, axes, look["color"])[shown]
            drawn.append(ax.quiver(*feet[which, t][shown].T, *arrows[which, t][shown].T, color=colors, width=width, **UNITS))
            drawn += ax.plot(*dots[which, t].T, **look)
        drawn.append(figure.text(0.012, 0.95, title, fontsize=11, color=INK, family="monospace"))
        if picture.ndim == 1:
            game.set(xlim=(-1, 1), ylim=(len(picture) / 2 + 10, len(picture) / 2 - 10))
            drawn.append(game.hlines(range(len(picture)), 0, picture, colors=NOW, linewidth=11))
        else:
            drawn.append(game.imshow(picture))
            game.apply_aspect()
        canvas.restore_region(ground)
        for artist in drawn:
            artist.draw(canvas.get_renderer())
            artist.remove()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def write_video(images: Iterator[np.ndarray], path: pathlib.Path) -> list[pathlib.Path]:
    """Write images, (HEIGHT, WIDTH, 3), uint8, as MP4 and, every second one, as GIF; returns the files."""
    path = path.with_suffix("") if path.suffix.lower() in (".mp4", ".gif") else path  # x.mp4 would become x.mp4.mp4
    paths = [path.with_name(f"{path.name}.{suffix}") for suffix in ("mp4", "gif")]
    with (  # closes both writers before it renames the files
        atomic_write(paths[0], "mp4") as mp4,
        atomic_write(paths[1], "gif") as gif,
        imageio.get_writer(mp4, format="mp4", mode="I", fps=FPS, quality=8, macro_block_size=2) as all_frames,
        imageio.get_writer(gif, format="gif", mode="I", duration=2000 / FPS, loop=0) as every_second,
    ):
        for t, image in enumerate(images):
            all_frames.append_data(image)  # type: ignore[attr-defined]
            if t % 2 == 0:
                every_second.append_data(image)  # type: ignore[attr-defined]
    return paths
