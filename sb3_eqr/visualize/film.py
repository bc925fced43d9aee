"""A film of the environment beside the blocks of the latent state: now, and as predicted some steps before."""

import colorsys
import pathlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import unwrap_vec_normalize
from torch.utils.data import default_collate

from sb3_eqr.common.checks.arguments import check, integer, number
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.common.groups import SE, SO, Group, NoGroup
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.common.saving.random_state import preserved_rng_state
from sb3_eqr.common.type_aliases import PyTorchObs
from sb3_eqr.plot_style import GREY, INK, styled
from sb3_eqr.visualize import latents
from sb3_eqr.visualize.loading import action_names

WIDTH, HEIGHT, DPI = 900, 500, 100  # pixels; even, as H.264 requires
EVERY = {"mp4": 1, "gif": 2}  # write every n-th frame
FORMATS = tuple(EVERY)
FPS = 15  # Atari's 60 frames per second, of which an agent observes every fourth
MAX_PANELS, MAX_BARS, TRAIL = 36, 16, 12  # TRAIL: steps of the line behind a dot
ARROW, ROOM, GHOST_ROOM = 0.4, 0.85, 3.0  # arrow at a dot, largest coordinate, in half panels; growth for predictions
VIEW = np.array([[0.866, -0.211], [0.5, 0.366], [0.0, 0.906]])  # from 60° to the left and 25° above, as in matplotlib
AXES, PALE_AXES = ("#c82828", "#1e8c32", "#1e50c8"), ("#f2b2b2", "#acdcb4", "#b2c6f4")  # x, y, z
LINE, NOW, PREDICTED = "#dadee3", "#1446a0", "#f49840"
NOW_DOT: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 4.5}
GHOST_DOT: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 7, "mfc": "none"}


class Film(NamedTuple):
    """T steps of one environment."""

    observations: PyTorchObs  # (T, *obs_shape): s_t, the network's input
    pictures: Sequence[np.ndarray]  # T of (height, width, 3), uint8
    actions: np.ndarray  # (T,), int64: a_t
    rewards: np.ndarray  # (T,): r_{t+1}, before normalisation
    starts: np.ndarray  # (T,), int64: the step at which each step's episode began
    action_names: list[str]  # one per action


class Panel(NamedTuple):
    """One block, in units of the panel: edges at ±1. First axis: now, predicted (NaN where there is no prediction)."""

    name: str
    kind: str  # "arrow", "parallelogram", "axes", or "dot" if there is no rotation
    arrows: np.ndarray | None  # (2, T, A, 2): images of the unit vectors, relative to the dot
    dots: np.ndarray | None  # (2, T, 2): translation
    half_width: float | None  # of the panel, in latent units; None if lengths are meaningless


def record(
    model: EqRAlgorithm,
    env: GymEnv | str,
    path: str | pathlib.Path,
    n_steps: int = 200,
    depth: int = 5,
    seed: int = 0,
    formats: Sequence[str] = FORMATS,
    fps: float = FPS,
    deterministic: bool = True,
) -> list[pathlib.Path]:
    """
    Write a video of the agent: the environment on the left, a panel per block of the latent state on the right. A rotation
    is an arrow, a translation a dot with a trail, a general matrix the images of the unit vectors; in three dimensions, the
    three axes (red, green, blue); without a group, the first two principal components. Orange or pale is what the latent
    model predicted ``depth`` steps before, from the latent state then and the actions since; a triangle marks a prediction
    beyond the edge. The line at the top has the action that the agent chooses in this frame, its reward, and the score
    including it. All random generators keep their states; the same seed gives the same frames.

    :param model: any EqR agent; its latent model predicts only if it was trained (``prediction_depth`` > 0)
    :param env: preprocessed as in training, but not the training environment itself; a VecNormalize with ``training=False``.
        Of several environments the first is shown, with ``render_mode="rgb_array"`` its rendering, else the observations
    :param path: path without suffix (.mp4 and .gif are removed); every format adds its own. Folders are created, and files
        are written to a temporary name and renamed
    :param n_steps: number of environment steps, one frame each; more than ``depth``
    :param depth: M ≥ 1
    :param seed: seed of the environment and of the agent's noise
    :param formats: "mp4" (H.264) and "gif" (every second frame)
    :param fps: frames per second, 1 to 50 (the limit of GIF); 15 is Atari's real speed
    :param deterministic: whether the agent acts without noise
    :return: the files, in the order of ``formats``
    :raises ValueError: for an argument out of range, or an environment with other spaces than the agent's
    :raises ImportError: without the extra "visualize"
    """
    latents.check_agent("record", model)
    check("depth", depth, integer(1))
    check("n_steps", n_steps, integer(depth + 1))
    check("fps", fps, number(1, 50))
    if not formats or set(formats) - set(FORMATS):
        raise ValueError(f"formats must be one or more of {list(FORMATS)}, got {formats!r}.")
    path = pathlib.Path(path)
    path = path.with_suffix("") if path.suffix[1:].lower() in FORMATS else path  # x.mp4 would become x.mp4.mp4
    with preserved_rng_state(model.action_space):
        film = shoot(model, env, n_steps, seed, deterministic)
    states = latents.encode(model, film.observations)  # (T, D)
    shown = panels(model, th.stack([states, predictions(model, states, film.actions, film.starts, depth)]).cpu())
    return write_video(Painter(shown, film.starts, depth, describe(model, len(shown))).frames(film), path, formats, fps)


def shoot(model: EqRAlgorithm, env: GymEnv | str, n_steps: int, seed: int, deterministic: bool) -> Film:
    """Run the agent; parameters as in :func:`record`. Seeds the global generators."""
    env = latents.as_vec_env(model, env)
    for what in ("observation_space", "action_space"):
        wanted, got = getattr(model, what), getattr(env, what)
        if got != wanted:
            raise ValueError(f"env must have the agent's {what} {wanted}, got {got}. Wrap the environment as in training.")
    normalize, obs = unwrap_vec_normalize(env), latents.reset(model, env, seed)
    rows, pictures, actions, rewards, starts = [], [], [], [], [0]
    for t in range(n_steps):
        rows.append(latents.each_part(obs, lambda x: x[0]))
        if env.render_mode == "rgb_array":
            pictures.append(np.asarray(env.get_images()[0], dtype=np.uint8))
        chosen, _ = model.predict(obs, deterministic=deterministic)
        obs, reward, dones, _ = env.step(chosen)
        actions.append(int(chosen[0]))
        rewards.append(float((reward if normalize is None else normalize.get_original_reward())[0]))
        starts.append(t + 1 if dones[0] else starts[-1])
    seen = default_collate(rows)
    pictures = pictures or observed_pictures(latents.each_part(seen, np.asarray), model.observation_space, model.frame_stack)
    names = [f"action {name}" if name.isdigit() else name for name in action_names(env, int(model.policy.action_space.n))]
    return Film(seen, pictures, np.array(actions), np.array(rewards), np.array(starts[:-1]), names)


def predictions(model: EqRAlgorithm, states: th.Tensor, actions: np.ndarray, starts: np.ndarray, depth: int) -> th.Tensor:
    """What was predicted M = ``depth`` steps before x₀, (T, D), was seen; NaN in the first M steps of an episode."""
    since = th.as_tensor(actions, device=states.device).unfold(0, depth, 1)[:-1]  # (T - M, M)
    with th.no_grad(), latents.eval_mode(model):
        predicted = model.policy.latent_model.rollout(states[:-depth], model.policy.embed_actions(since))[:, -1]
    is_old = th.as_tensor(np.arange(len(states)) - starts >= depth, device=states.device)
    return th.where(is_old[:, None], th.cat([states[:depth], predicted]), th.nan)


def describe(model: EqRAlgorithm, n_shown: int) -> str:
    """A description of the agent in one line, of which ``n_shown`` blocks are shown."""
    group, n_blocks = latents.group_model(model).group, latents.group_model(model).n_blocks
    blocks = "no group" if isinstance(group, NoGroup) else f"{group}" if n_blocks == 1 else f"{n_blocks} blocks of {group}"
    blocks = blocks if len(blocks) < 45 else f"{blocks[:45]}..."
    return f"{type(model).__name__}, {blocks}{f', the first {MAX_PANELS}' if n_shown == MAX_PANELS else ''}"[:60]


def panels(model: EqRAlgorithm, states: th.Tensor) -> list[Panel]:
    """One panel per block of ``states``, true and predicted, (2, T, D)."""
    has_one_group = len(latents.split(model, states)) == 1
    blocks = latents.each_block(model, states)[:MAX_PANELS]
    return [panel(f"{k}" if has_one_group else f"{k} {group}", group, block) for k, (_, group, block) in enumerate(blocks)]


def panel(name: str, group: Group, elements: th.Tensor) -> Panel:
    """The panel of one block, true and predicted, (2, T, *element_shape), at a constant scale."""
    arrows, dots = in_plane(group, elements)
    kind = "dot" if arrows is None else ["arrow", "parallelogram", "axes"][arrows.shape[2] - 1]
    half_width = None
    if arrows is not None:
        is_rotation = isinstance(group, (SO, SE))
        scale = (ROOM if dots is None else ARROW) / (1.0 if is_rotation else _extent(arrows))
        arrows, half_width = arrows * scale, None if is_rotation else 1 / scale
    if dots is not None:
        dots = dots - (dots[0].min(axis=0) + dots[0].max(axis=0)) / 2
        half_width = _extent(dots) / (ROOM if arrows is None else 1 - ARROW)  # leaves space for an arrow at the last dot
        dots = dots / half_width
    return Panel(name, kind, arrows, dots, half_width)


def in_plane(group: Group, elements: th.Tensor) -> tuple[np.ndarray | None, np.ndarray | None]:
    """
    Elements, (2, T, *element_shape), as arrows, (2, T, A, 2), and dots, (2, T, 2), in latent units. A rotation of the plane is
    one arrow, its first column; any other 2×2 matrix is both columns; three dimensions are projected; of more dimensions only
    the first two coordinates are shown; vectors without a group are projected onto their principal axes.
    """
    matrix, vector = latents.frame(group, elements)
    arrows = dots = None
    if matrix is not None and not (isinstance(group, SE) and matrix.shape[-1] == 1):  # no rotation in one dimension
        n_arrows = 1 if isinstance(group, (SO, SE)) and matrix.shape[-1] == 2 else 3
        arrows = _seen(matrix.mT.double().numpy())[..., :n_arrows, :]  # row i is the image of the i-th unit vector
    if vector is not None:
        values = vector.double().numpy()
        dots = _seen(values)
        if isinstance(group, NoGroup) and values.shape[-1] > 2:
            mean = values[0].mean(axis=0)
            axes = np.linalg.svd(values[0] - mean, full_matrices=False)[2][:2].T  # (n, 2)
            dots = (values - mean) @ (axes * np.sign(axes[np.abs(axes).argmax(axis=0), [0, 1]]))
    return arrows, dots


def _seen(vectors: np.ndarray) -> np.ndarray:
    """(..., n) -> (..., 2)"""
    n = vectors.shape[-1]
    return np.concatenate([vectors, 0 * vectors], axis=-1) if n == 1 else vectors @ VIEW if n == 3 else vectors[..., :2]


def _extent(values: np.ndarray) -> float:
    """The half width that the true states need, or 98 % of the predictions, unless these are too far out."""
    needed, ghosts = max(float(np.abs(values[0]).max()), 1e-6), np.abs(values[1][np.isfinite(values[1])])
    wanted = float(np.quantile(ghosts, 0.98)) if len(ghosts) else 0.0
    return wanted if needed < wanted <= GHOST_ROOM * needed else needed


class Painter:
    """
    Draws the frames of one film: a panel per block, and an image of the environment. ``starts`` has the frame at which each
    frame's episode began, (T,); the legend has M, ``depth``, and the line at the bottom is ``about``.
    """

    def __init__(self, panels: Sequence[Panel], starts: np.ndarray, depth: int, about: str):
        self.panels, self.starts, n = panels, starts, len(panels)
        columns = max(range(1, n + 1), key=lambda columns: min(1.3 / columns, 1 / -(-n // columns)))  # the largest squares
        rows = -(-n // columns)
        side = min(0.59 * WIDTH / columns, 0.82 * HEIGHT / rows)  # of a panel, in pixels
        x, y = columns * side / WIDTH / 2, rows * side / HEIGHT / 2  # half of all panels, as fractions of the frame
        with styled():
            self.figure = Figure((WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
            self.canvas: Any = FigureCanvasAgg(self.figure)
            self.game = self.figure.add_axes((0.01, 0.08, 0.37, 0.84))
            self.game.set_axis_off()
            ends = {"left": 0.695 - x, "right": 0.695 + x, "bottom": 0.51 - y, "top": 0.51 + y}
            grid = self.figure.add_gridspec(rows, columns, wspace=0.05, hspace=0.05, **ends)
            self.axes = [self.figure.add_subplot(grid[k // columns, k % columns]) for k in range(n)]
            self.artists = [self._start(ax, one) for ax, one in zip(self.axes, panels, strict=True)]
            self.title = self.figure.text(0.012, 0.95, "", fontsize=11, color=INK, animated=True, family="monospace")
            self.figure.text(0.012, 0.025, about, color=GREY, fontsize=8)
            self._legend(depth)
        self.picture: Any = None
        self.canvas.draw()
        self.ground = self.canvas.copy_from_bbox(self.figure.bbox)

    def _start(self, ax: Axes, panel: Panel) -> list[dict[str, Any]]:
        """Draw what stays of a panel; return what moves: its true and its predicted block."""
        ax.set(xlim=(-1, 1), ylim=(-1, 1), xticks=[], yticks=[], aspect="equal", facecolor="#f6f7f9")
        ax.spines[:].set(visible=True, color=LINE)
        if panel.dots is None:
            ax.axhline(0, color=LINE, linewidth=1)
            ax.axvline(0, color=LINE, linewidth=1)
            if panel.kind == "arrow":  # a circle for the arrow's tip
                turn = np.linspace(0, 2 * np.pi, 100)
                ax.plot(ROOM * np.cos(turn), ROOM * np.sin(turn), color=LINE, linewidth=1)
        size = 8 if len(self.panels) < 13 else 6
        ax.text(-0.94, 0.94, panel.name, color=GREY, fontsize=size, va="top")
        if panel.half_width is not None:
            ax.text(0.94, -0.94, f"edge ±{panel.half_width:.2g}", color=GREY, fontsize=size, ha="right")
        found = []
        for color, axes, dot, line, width in ((NOW, AXES, NOW_DOT, 1.5, 0.018), (PREDICTED, PALE_AXES, GHOST_DOT, 3, 0.026)):
            looks: dict[str, Any] = {
                "dot": {"color": color, **dot},
                "beyond": {"color": color, "linestyle": "", "markersize": 7},
                "sides": {"color": color, "linewidth": line},
                "trail": {"color": NOW, "alpha": 0.35, "linewidth": 1},
            }
            moving: dict[str, Any] = {name: ax.plot([], [], animated=True, **look)[0] for name, look in looks.items()}
            if panel.arrows is not None:
                zeros, colors = np.zeros(panel.arrows.shape[2]), axes if panel.kind == "axes" else color
                scale: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1}
                moving["arrows"] = ax.quiver(*[zeros] * 4, color=colors, width=width, animated=True, **scale)
            found.append(moving)
        return found

    def _legend(self, depth: int) -> None:
        predicted = f"predicted {depth} step{'' if depth == 1 else 's'} before"
        kinds = {panel.kind for panel in self.panels}
        dots = [panel.dots for panel in self.panels if panel.dots is not None]
        looks: dict[str, dict[str, Any]] = {}
        if "axes" not in kinds or dots:  # blue and orange are drawn
            looks |= {"now": {"color": NOW, **NOW_DOT}, predicted: {"color": PREDICTED, **GHOST_DOT}}
        if "arrow" in kinds:
            looks["rotation"] = {"color": NOW, "marker": r"$\rightarrow$", "linestyle": "", "markersize": 9}
        if dots:
            looks[f"last {TRAIL} steps"] = {"color": NOW, "alpha": 0.35}
        if "axes" in kinds:
            looks |= {name: {"color": color} for name, color in zip("xyz", AXES, strict=True)}
            looks[f"pale: {'predicted' if dots else predicted}"] = {"color": PALE_AXES[0]}
        if any((np.abs(both[1]) > 1).any() for both in dots):
            looks["beyond the edge"] = {"color": PREDICTED, "marker": "^", "linestyle": ""}
        handles = [Line2D([], [], label=label, **look) for label, look in looks.items()]
        self.figure.legend(handles=handles, loc="lower right", ncols=len(handles), fontsize=8, handlelength=1.5)

    def frames(self, film: Film) -> Iterator[np.ndarray]:
        """The T frames, (HEIGHT, WIDTH, 3), uint8."""
        score = 0.0
        for t, (action, reward, start) in enumerate(zip(film.actions, film.rewards, film.starts, strict=True)):
            score = reward + (0.0 if t == start else score)
            did = f"step {t - start:<5d} {film.action_names[action][:14]:<14s}"
            yield self.paint(t, film.pictures[t], f"{did} reward {reward:<+8.3g} score {score:<8.4g}")

    def paint(self, t: int, picture: np.ndarray, title: str) -> np.ndarray:
        """The frame of step t, (HEIGHT, WIDTH, 3), uint8, with the environment's image, (height, width, 3), uint8."""
        self.canvas.restore_region(self.ground)
        if self.picture is None:  # small images are enlarged without smoothing
            smooth = "antialiased" if min(picture.shape[:2]) > 100 else "nearest"
            self.picture = self.game.imshow(picture, interpolation=smooth, animated=True)
            self.game.apply_aspect()
        self.picture.set_data(picture)
        self.game.draw_artist(self.picture)
        self.title.set_text(title)
        self.figure.draw_artist(self.title)
        first = max(int(self.starts[t]), t - TRAIL)
        for ax, panel, (now, predicted) in zip(self.axes, self.panels, self.artists, strict=True):
            if panel.dots is not None:
                now["trail"].set_data(*panel.dots[0, first : t + 1].T)
                ax.draw_artist(now["trail"])
            for which, artists in ((1, predicted), (0, now)):
                for artist in moved(panel, which, t, artists):
                    ax.draw_artist(artist)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()


def moved(panel: Panel, which: int, t: int, artists: dict[str, Any]) -> list[Any]:
    """The artists to draw at step t: none without a prediction, a triangle at the edge for a block beyond it."""
    arrows, at = (None if part is None else part[which, t] for part in (panel.arrows, panel.dots))
    foot = np.zeros(2) if at is None else at
    if not np.isfinite(foot if arrows is None else foot + arrows).all():
        return []
    if np.abs(foot).max() > 1:
        artists["beyond"].set_data(*(0.95 * foot / np.abs(foot).max())[:, None])
        artists["beyond"].set_marker((3, 0, round(np.degrees(np.arctan2(foot[1], foot[0]))) - 90))  # its tip outwards
        return [artists["beyond"]]
    drawn = []
    if arrows is not None:
        artists["arrows"].set_offsets(np.repeat(foot[None], len(arrows), axis=0))
        artists["arrows"].set_UVC(*arrows.T)
        drawn.append(artists["arrows"])
        if panel.kind == "parallelogram":
            corners = np.stack([0 * arrows[0], arrows[0], arrows[0] + arrows[1], arrows[1], 0 * arrows[0]])
            artists["sides"].set_data(*(foot + corners).T)
            drawn.append(artists["sides"])
    if at is not None:
        artists["dot"].set_data(*at[:, None])
        drawn.append(artists["dot"])
    return drawn


def write_video(images: Iterator[np.ndarray], path: pathlib.Path, formats: Sequence[str], fps: float) -> list[pathlib.Path]:
    """Write images, (HEIGHT, WIDTH, 3), uint8, to a path without suffix, in some of :data:`FORMATS`; returns the files."""
    try:
        import imageio.v2 as imageio
    except ImportError as error:
        raise ImportError(
            'Videos need imageio and ffmpeg. Run pip install ".[visualize]" in a clone of the repository.'
        ) from error
    options: dict[str, dict[str, Any]] = {"mp4": {"quality": 8, "macro_block_size": 2, "fps": fps}}
    options["gif"] = {"loop": 0, "duration": 1000 * EVERY["gif"] / fps}
    paths = {suffix: path.with_name(f"{path.name}.{suffix}") for suffix in formats}
    with ExitStack() as stack:  # closes all writers before it renames the files
        files = {suffix: stack.enter_context(atomic_write(file, suffix)) for suffix, file in paths.items()}
        writers: dict[str, Any] = {
            suffix: stack.enter_context(imageio.get_writer(file, format=suffix, mode="I", **options[suffix]))
            for suffix, file in files.items()
        }
        for t, image in enumerate(images):
            for suffix, writer in writers.items():
                if t % EVERY[suffix] == 0:
                    writer.append_data(image)
    return [paths[suffix] for suffix in formats]


def observed_pictures(observations: Any, space: spaces.Space, frame_stack: int) -> list[np.ndarray]:
    """
    Observations, (T, *obs_shape) or a dict of these, as T images, (height, width, 3), uint8: the newest of stacked frames;
    planes other than RGB each in its own colour; of a dict the first image; numbers as bars, each at its own scale.
    """
    if isinstance(space, spaces.Dict):
        images = [key for key, part in space.spaces.items() if part.shape is not None and len(part.shape) == 3]
        if images:
            return observed_pictures(observations[images[0]], space[images[0]], frame_stack)
        return _bars(np.concatenate([x.reshape(len(x), -1) for x in observations.values()], axis=1))
    if observations.ndim != 4:
        return _bars(observations.reshape(len(observations), -1))
    planes = observations.astype(np.float64)  # (T, channels, height, width)
    if not is_image_space(space):  # floats
        planes = 255 * (planes - planes.min()) / max(np.ptp(planes), 1e-9)
        if space.shape is not None and space.shape[2] < space.shape[0]:  # SB3 transposes images only
            planes = planes.transpose(0, 3, 1, 2)
    planes = planes[:, -(planes.shape[1] // frame_stack) :]
    n = planes.shape[1]
    if n == 3:
        return list(planes.transpose(0, 2, 3, 1).astype(np.uint8))
    colours = np.array([(1.0, 1.0, 1.0) if n == 1 else colorsys.hsv_to_rgb(i / n, 0.75, 1.0) for i in range(n)])
    return list((planes[..., None] * colours[:, None, None]).max(axis=1).astype(np.uint8))


def _bars(values: np.ndarray) -> list[np.ndarray]:
    """Numbers, (T, n), as bars from 0, in the middle; rows of 22 pixels, half a width of 170."""
    shown, place = values[:, :MAX_BARS], np.arange(-170, 171)
    ends = 170 * shown / np.maximum(np.abs(shown).max(axis=0), 1e-9)  # (T, n)
    inside = (place >= np.minimum(ends, 0)[..., None]) & (place <= np.maximum(ends, 0)[..., None])  # (T, n, width)
    pictures = np.full((*inside.shape[:2], 22, len(place), 3), 255, dtype=np.uint8)
    pictures[:, :, 3:-3] = np.where(inside[:, :, None, :, None], np.array([20, 70, 160], np.uint8), pictures[:, :, 3:-3])
    pictures[:, :, :, 170] = 160
    return list(pictures.reshape(len(shown), -1, len(place), 3))
