"""
An EqR agent on one environment, from training to a plot and a video of what it observes and predicts.

    python examples/demo.py --game CartPole-v1                # EqRQRDQN, 15,000 steps
    python examples/demo.py --game Pong                       # as many steps as fit into --minutes
    python examples/demo.py --game Boxing --steps 100000      # the full benchmark
    python examples/demo.py --config eqr_rainbow --steps 3000
    python examples/demo.py --config eqr_bbf --width-scale 1 --steps 3000    # narrow enough for two cores

Writes model.zip, progress.csv, training.png, latents.mp4 and latents.gif to --out, and prints what the latent states have
learned. The video shows the environment on the left and the blocks of the agent's latent state on the right, both current
and as predicted by the latent model five steps before.
"""

import argparse
import pathlib
import time

import gymnasium as gym
import matplotlib
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from sb3_eqr import EqRQRDQN, EqRRainbow, load_configuration
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.configurations import STOCK, configuration_files
from sb3_eqr.envs import make_atari100k_env
from sb3_eqr.envs.atari import atari_env_id
from sb3_eqr.visualize import diagnose, play, record

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import pandas as pd

LOSSES = {
    "train/td_loss": "TD loss",
    "train/aet_loss": "AET loss",
    "train/symmetry_loss": "GET loss",
    "train/reward_loss": "reward loss",
}
EVALUATION_SECONDS = 60  # reserved at the end of --minutes
DIAGNOSIS_STEPS = 500
CLASSIC_STEPS = 15_000  # as in CartPole's entry
ANIMATION_SECONDS = 15  # reserved at the end of --minutes
ANIMATION_STEPS = 200
RESULTS = ("training.png", "latents.mp4", "latents.gif")
CHECKPOINT_STEPS = 10_000
FULL_STEPS = 100_000  # number of steps that the configurations are for
SHORT_LEARNING_STARTS = 400  # for runs of a few minutes; Table 5's 2,000 would be most of their steps


class Demo(BaseCallback):
    """Writes a row of metrics every ``log_every`` steps, records the score of every episode, stops after ``seconds``."""

    def __init__(self, log_every: int, seconds: float | None):
        super().__init__()
        self.log_every = log_every
        self.deadline = None if seconds is None else time.monotonic() + seconds
        self.scores: list[tuple[int, float]] = []  # (step, raw score of a full episode)

    def _on_training_end(self) -> None:
        if self.deadline is not None and time.monotonic() >= self.deadline:
            print(f"Stopped at {self.num_timesteps} steps: the time is up.", flush=True)

    def _on_step(self) -> bool:
        self.scores += [(self.num_timesteps, info["episode"]["r"]) for info in self.locals["infos"] if "episode" in info]
        if self.num_timesteps % self.log_every == 0:
            self.model.dump_logs()
        return self.deadline is None or time.monotonic() < self.deadline


def is_atari(game: str) -> bool:
    """Whether it is an Atari game, rather than a gymnasium environment with an entry of its own."""
    return game.startswith("ALE/") or game not in gym.registry


def make_env(game: str, n_envs: int = 1, seed: int = 0, training: bool = False, render_mode: str | None = None) -> VecEnv:
    """The environment, preprocessed for its policy."""
    if is_atari(game):
        return make_atari100k_env(game, n_envs=n_envs, seed=seed, training=training, render_mode=render_mode)
    return make_vec_env(game, n_envs, seed, env_kwargs={"render_mode": render_mode})


def make_model(config: str, width_scale: float | None, game: str, seed: int, **changes) -> EqRAlgorithm:
    """
    :param config: a file in zoo_hyperparams
    :param width_scale: width of an "impala" trunk; its head has 512 times as many units, as in BBF
    """
    if width_scale is not None:
        network = {"features_extractor_kwargs": {"width_scale": width_scale}, "net_arch": [round(512 * width_scale)]}
        changes["policy_kwargs"] = network
    policy, entry = ("CnnPolicy", "atari") if is_atari(game) else ("MlpPolicy", game)
    settings = load_configuration(config, entry, **changes)
    algorithm = EqRQRDQN if config in ("eqr_qrdqn", "qrdqn") else EqRRainbow
    return algorithm(policy, make_env(game, seed=seed, training=True), seed=seed, **settings)


def steps_that_fit(config: str, width_scale: float | None, game: str, seconds: float) -> int:
    """
    :return: number of steps that fit into ``seconds`` on this machine, estimated from a few updates
    """
    model = make_model(config, width_scale, game, 0, learning_starts=30, buffer_size=100)
    model.learn(36)  # warm up
    start = time.monotonic()
    model.learn(12, reset_num_timesteps=False)
    per_step = (time.monotonic() - start) / 12
    return SHORT_LEARNING_STARTS + max(200, int(seconds / per_step))


def draw(
    progress: pd.DataFrame,
    scores: list[tuple[int, float]],
    evaluation: float,
    learning_starts: int,
    title: str,
    path: pathlib.Path,
) -> None:
    """Plot the scores of episodes, the final evaluation, and the losses over steps."""
    shown = {key: name for key, name in LOSSES.items() if key in progress}  # absent without updates, or if a loss is off
    figure, axes = plt.subplots(1 + len(shown), 1, figsize=(7, 3 + 2 * len(shown)), sharex=True, layout="constrained")
    axes = np.atleast_1d(axes)
    figure.suptitle(title)
    steps, raw = np.array(scores).reshape(-1, 2).T
    axes[0].plot(steps, raw, "o", color="0.6", markersize=4, label="episodes in training")
    axes[0].plot(steps, pd.Series(raw).rolling(10, min_periods=1).mean(), color="C0", label="mean of the last 10")
    axes[0].plot(progress["time/total_timesteps"].max(), evaluation, "*", color="C3", markersize=10, label="evaluation")
    axes[0].set_ylabel("raw score")
    axes[0].legend(loc="best", fontsize="small")
    for axis, (key, name) in zip(axes[1:], shown.items(), strict=True):
        losses = progress.dropna(subset=key)
        axis.plot(losses["time/total_timesteps"], losses[key], color="C1")
        axis.set_ylabel(name)
        axis.set_ylim(bottom=0)
    axes[-1].set_xlabel("steps")
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.axvline(learning_starts, color="0.4", linestyle=":")
    axes[-1].set_xlim(left=0)
    late = learning_starts > progress["time/total_timesteps"].max() / 2
    place = {"textcoords": "offset points", "ha": "right" if late else "left", "color": "0.4", "fontsize": "small"}
    axes[0].annotate(
        "learning starts",
        (learning_starts, axes[0].get_ylim()[0]),
        (-4 if late else 4, 4),
        **place,  # type: ignore[arg-type]
    )
    beside = path.with_name(f".{path.name}")
    figure.savefig(beside, dpi=110, format="png")
    beside.replace(path)


def show(model: EqRAlgorithm, args: argparse.Namespace, scores: list[tuple[int, float]], out: pathlib.Path) -> None:
    """
    Evaluate the agent, plot, record a video, print the diagnostics.

    :param scores: scores of the training episodes, (step, raw score)
    """
    env = make_env(args.game, args.eval_episodes, args.seed + 10_000)
    with tqdm(total=args.eval_episodes, desc="evaluation", unit="episode") as bar:
        found, _ = evaluate_policy(
            model,
            env,
            args.eval_episodes,
            callback=lambda here, _: bar.update(int(here["done"])),
            return_episode_rewards=True,
        )
    assert isinstance(found, list)
    each = f"mean {np.mean(found):.1f}, lowest {min(found):g}, highest {max(found):g}"
    print(f"score of {len(found)} episodes after {model.num_timesteps} steps: {each}")
    title = f"{args.config} on {args.game}, {model.num_timesteps} steps, {model._n_updates} updates"
    progress = pd.read_csv(out / "progress.csv")
    draw(progress, scores, float(np.mean(found)), model.learning_starts, title, out / "training.png")
    env = make_env(args.game, render_mode="rgb_array")
    # With exploration noise: without it, an agent after little training repeats one action.
    record(model, env, out / "latents", ANIMATION_STEPS, seed=args.seed + 20_000, deterministic=False)
    print(diagnose(model, play(model, env, DIAGNOSIS_STEPS, seed=args.seed + 30_000)).summary)
    if is_atari(args.game) and model.num_timesteps < FULL_STEPS / 10:
        print(f"{model.num_timesteps} steps are far too few to learn a game of Atari: the benchmark has {FULL_STEPS:,}.")


def main() -> None:
    """Train, save, evaluate, plot, record a video, print the diagnostics."""
    parser = argparse.ArgumentParser(
        description=__doc__.strip().split("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--game", default="Pong", help="any of ALE's games, or CartPole-v1")
    ours = [name for name in configuration_files() if not name.startswith(f"{STOCK}/")]
    parser.add_argument("--config", choices=ours, default="eqr_qrdqn", help="see docs/choosing.md")
    parser.add_argument(
        "--width-scale", type=float, help="width of eqr_bbf's networks; its paper has 4, and 1 is fast enough on two cores"
    )
    parser.add_argument("--steps", type=int, help="100000 is the benchmark; if not given, as many as fit into --minutes")
    parser.add_argument("--minutes", type=float, default=5.5, help="total time, if --steps is not given")
    parser.add_argument(
        "--eval-episodes", type=int, help="episodes of the final evaluation; if not given, 3 on Atari, else 20"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of all random generators")
    parser.add_argument(
        "--out",
        type=pathlib.Path,
        help="folder for model.zip, progress.csv, training.png, latents.mp4 and latents.gif; if not given, "
        "demo_results/<game> or demo_results/<game>-<config>",
    )
    args = parser.parse_args()
    if args.width_scale is not None and args.config != "eqr_bbf":
        parser.error(f"--config must be eqr_bbf with --width-scale, got {args.config}")
    game = atari_env_id(args.game)[4:-3] if is_atari(args.game) else args.game
    out = args.out or pathlib.Path("demo_results") / (game if args.config == "eqr_qrdqn" else f"{game}-{args.config}")
    settings: dict = {}
    seconds, start = None, time.monotonic()
    args.eval_episodes = args.eval_episodes or (3 if is_atari(game) else 20)
    if not is_atari(game):
        args.steps = args.steps or CLASSIC_STEPS
    elif args.steps is None:
        seconds = args.minutes * 60 - EVALUATION_SECONDS - ANIMATION_SECONDS
        args.steps = steps_that_fit(args.config, args.width_scale, args.game, 0.9 * seconds)
        settings = {"learning_starts": SHORT_LEARNING_STARTS}
    if is_atari(game) and "exploration_fraction" in (config := load_configuration(args.config)):
        share = config["exploration_fraction"] * FULL_STEPS / args.steps  # the same number of steps
        settings["exploration_fraction"] = min(share * settings.get("learning_starts", 2_000) / 2_000, 1.0)
    print(f"{args.config} on {args.game}: {args.steps} steps on {th.get_num_threads()} thread(s)", flush=True)

    model = make_model(args.config, args.width_scale, args.game, args.seed, **settings)
    model.set_logger(configure(str(out), ["csv"]))
    demo = Demo(max(args.steps // 200, 20), None if seconds is None else seconds - (time.monotonic() - start))
    callbacks: list[BaseCallback] = [demo]
    if args.steps > CHECKPOINT_STEPS:
        callbacks.append(CheckpointCallback(CHECKPOINT_STEPS, str(out / "checkpoints"), save_replay_buffer=True))
    for name in RESULTS:  # of an earlier run
        (out / name).unlink(missing_ok=True)
    model.learn(args.steps, callback=callbacks, progress_bar=True)
    if model._n_updates == 0:
        print("No update was made: this configuration is too slow here. Try --width-scale 1 with eqr_bbf, or more --minutes.")
    model.dump_logs()
    model.logger.close()
    model.save(out / "model")

    show(model, args, demo.scores, out)
    files = ", ".join(f"{out}/{name}" for name in ("model.zip", "progress.csv", *RESULTS))
    print(f"{files}; {(time.monotonic() - start) / 60:.1f} minutes")


if __name__ == "__main__":
    main()
