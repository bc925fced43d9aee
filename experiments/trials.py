"""
Trials of settings on small games, over games and seeds. A trial has a name and changes an entry of ``zoo_hyperparams``. Each
run appends a row to one file, so that no result is lost and no run is repeated.

    python -m experiments.trials experiments/settings/rainbow.yml --rows docs/results/minatar_trials.jsonl --seeds 0 1 2 --jobs 2
    python -m experiments.trials experiments/settings/rainbow.yml --rows docs/results/minatar_trials.jsonl --table

A file of trials gives the agent (a file of ``zoo_hyperparams``: eqr_rainbow, stock/qrdqn, ...) and the changes of each:

    no_noise: {agent: eqr_rainbow, changes: {exploration_final_eps: 0.01, policy_kwargs: {noisy: false}}}
"""

import argparse
import importlib
import json
import os
import pathlib
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import yaml
from scipy.stats import ttest_ind

GAMES = ("Breakout", "SpaceInvaders")  # for tuning; the other three are only for the final comparison
WORLDS: dict[str, tuple[str, dict[str, Any]]] = {  # environments with a known symmetry: name -> id, arguments
    "torus": ("SlidingBallTorus-v0", {"n_steps": 16, "goal": [0.25, 0.25]}),  # 256 positions, one is the goal
    "large_torus": ("SlidingBallTorus-v0", {"n_steps": 32, "goal": [0.25, 0.25], "max_episode_steps": 200}),  # 1,024 positions
    "torus_of_4": ("SlidingBallTorus-v0", {"n_steps": 16, "goal": [0.25, 0.25], "n_distractors": 4}),
    "torus_of_8": ("SlidingBallTorus-v0", {"n_steps": 16, "goal": [0.25, 0.25], "n_distractors": 8}),
    "pendulum": ("PixelPendulum-v0", {}),
}
N_PARTS = 10  # points of a learning curve


def run(trial: dict[str, Any], game: str, seed: int, steps: int) -> dict[str, Any]:
    """
    Train an agent, and evaluate its greedy policy over 100 episodes.

    :param trial: agent, changes
    :return: the results for its row
    """
    import torch as th
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.logger import KVWriter, Logger

    from experiments.probes import probe, scattered
    from sb3_eqr import envs
    from sb3_eqr.benchmark.evaluation import evaluate
    from sb3_eqr.benchmark.suites import choose, load_suite
    from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
    from sb3_eqr.common.latent.latent_model import GroupLatentModel
    from sb3_eqr.visualize.diagnostics import diagnose
    from sb3_eqr.visualize.latents import replayed

    class Means(KVWriter):
        """Collects the logged values, to average them."""

        def __init__(self) -> None:
            self.values: dict[str, list[float]] = defaultdict(list)

        def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
            for key, value in key_values.items():
                if isinstance(value, (int, float, np.floating)):
                    self.values[key].append(float(value))

        def close(self) -> None: ...

    th.set_num_threads(1)
    envs.register()
    model = make_agent(trial["agent"], game, seed, {"buffer_size": steps, **trial.get("changes", {})})
    env = model.get_env()
    means = Means()
    model.set_logger(Logger(folder=None, output_formats=[means]))
    started = time.monotonic()
    model.learn(steps, log_interval=4 if game in WORLDS else 20)
    seconds = time.monotonic() - started
    goals: dict[str, Any] = {}
    if game in WORLDS:
        env_id, env_kwargs = WORLDS[game]
        goals = rewards_found(env, steps)
        if isinstance(model, EqRAlgorithm):
            found_by_probes = probe(model, scattered(env_id, env_kwargs))["trunk"]
            goals["probe"] = round(float(np.mean(list(found_by_probes.values()))), 3)  # R² of the state from the features
        games = model._wrap_env(make_vec_env(env_id, 10, seed + 1_000, env_kwargs=env_kwargs), monitor_wrapper=False)
        scores, _ = evaluate_policy(model, games, 100, return_episode_rewards=True)
    else:
        scores, _ = evaluate(model, choose(load_suite("minatar"), [game], steps).protocol(game), 100, seed)
    skill = {}
    if getattr(model, "depth", 0) and isinstance(model.policy.latent_model, GroupLatentModel):
        found = diagnose(model, replayed(model, 512, np.random.default_rng(seed)), seed)
        skill = {"skill": [round(float(value), 3) for value in found.loss.skill]}  # one to M steps ahead
    curve = [float(np.mean(part)) for part in np.array_split(means.values["rollout/ep_rew_mean"], N_PARTS) if len(part)]
    logged = {key: float(np.median(values)) for key, values in means.values.items() if key.startswith("train/")}
    return {
        "score": float(np.mean(scores)),
        "seconds": round(seconds, 1),
        "curve": [round(value, 3) for value in curve],
        **skill,
        **goals,
        "train": {key.removeprefix("train/"): float(f"{value:.4g}") for key, value in logged.items()},
    }


def make_agent(agent: str, game: str, seed: int, changes: dict[str, Any]) -> Any:
    """
    :param agent: a file of zoo_hyperparams
    :param game: a game of MinAtar or Atari ("ALE/Pong") with the entry of that file, or a key of ``WORLDS``, without an entry
    :param changes: arguments that differ from the entry
    :return: an untrained agent
    """
    from sb3_contrib import QRDQN
    from stable_baselines3 import DQN
    from stable_baselines3.common.env_util import make_vec_env

    from sb3_eqr import EqRQRDQN, EqRRainbow, envs
    from sb3_eqr.configurations import ZOO_KEYS, configuration_files, with_schedule

    kinds = {"stock/qrdqn": QRDQN, "stock/dqn": DQN, "eqr_qrdqn": EqRQRDQN, "qrdqn": EqRQRDQN}
    arguments = dict(changes)
    if game in WORLDS:
        env_id, env_kwargs = WORLDS[game]
        env: Any = make_vec_env(env_id, seed=seed, env_kwargs=env_kwargs)
    else:
        if game.startswith("ALE/"):
            name, env = "atari", envs.make_atari100k_env(game.removeprefix("ALE/"), n_envs=1, seed=seed)
        else:
            name = f"MinAtar/{game}-v1"
            env = make_vec_env(name, seed=seed, wrapper_class=envs.minatar.ChannelsFirstImage)
        entry = yaml.safe_load(configuration_files()[agent].read_text(encoding="utf-8"))[name]
        arguments = merged({key: value for key, value in entry.items() if key not in ZOO_KEYS}, arguments)
    return kinds.get(agent, EqRRainbow)("CnnPolicy", env, seed=seed, device="cpu", **with_schedule(arguments))


def rewards_found(env: Any, steps: int) -> dict[str, Any]:
    """How often an environment whose only reward is at the end of an episode has paid one, and when."""
    returns, lengths = ([n for one in env.env_method(f"get_episode_{what}") for n in one] for what in ("rewards", "lengths"))
    found: dict[str, Any] = {"return_in_all": round(float(np.sum(returns)), 3), "episodes": len(returns)}
    paid = np.cumsum(lengths)[np.array(returns) > 0]
    if len(paid):
        found["first_reward_at"] = int(paid[0])
    return found | {"rewards_per_part": np.histogram(paid, N_PARTS, (0, steps))[0].tolist()}


def merged(entry: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """
    An entry with changes. Dictionaries are merged, except with an empty one, which replaces the entry's; "dict(...)" strings
    are evaluated as in RL Zoo.
    """
    result = {**entry, **changes}
    for key, old in entry.items():
        if isinstance(old, str) and old.startswith("dict("):
            old = eval(old, {"importlib": importlib})
        if isinstance(old, dict) and (key not in changes or changes[key]):
            result[key] = merged(old, changes.get(key, {}))
    return result


def content(trial: dict[str, Any]) -> str:
    """:return: what a trial is, apart from its name, as text to compare"""
    return json.dumps([trial["agent"], trial.get("changes", {})], sort_keys=True)


def check_names(
    rows: list[dict[str, Any]], trials: dict[str, dict[str, Any]], wanted: list[tuple[str, str, int]], steps: int
) -> None:
    """:raises SystemExit: if a file of rows has another trial of the same name, whose runs would count as those of this one"""
    for name, game, _ in wanted:
        others = [
            r
            for r in rows
            if (r["trial"], r["game"], r["steps"]) == (name, game, steps) and content(r) != content(trials[name])
        ]
        if others:
            raise SystemExit(
                f"{name}, {game}, {steps} steps: --rows must have no runs of another trial with this name, got "
                f"{content(others[0])} instead of {content(trials[name])}. Rename the trial, or choose another file of rows."
            )


def commit() -> str:
    """:return: the commit of the working folder, with "+" if files differ from it; "unknown" outside a clone"""
    found = subprocess.run(["git", "describe", "--always", "--dirty=+"], capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


def read_rows(path: pathlib.Path) -> list[dict[str, Any]]:
    """All rows of a file; an empty list if it does not exist."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.is_file() else []


def mean_and_error(values: list[float]) -> str:
    """Mean ± standard error; for a single value, the mean only."""
    error = f" ± {np.std(values, ddof=1) / np.sqrt(len(values)):.2f}" if len(values) > 1 else ""
    return f"{np.mean(values):.2f}{error}" if values else ""


def table(rows: list[dict[str, Any]], names: list[str], games: list[str], steps: int) -> str:
    """
    A Markdown table with a row per trial. Per game: the greedy policy's score ± its standard error over seeds, followed by
    the same for ``rollout/ep_rew_mean``, averaged over the last tenth of the times that it was logged; then, if games differ
    in it, the number of seeds.
    """
    lines = [f"| trial, {steps:,} steps | seeds | " + " | ".join(games) + " | seconds |", "|---" * (len(games) + 3) + "|"]
    for name in names:
        own = [row for row in rows if row["trial"] == name and row["steps"] == steps]
        cells = []
        seeds = len({row["seed"] for row in own if row["game"] in games})
        for game in games:
            found = [row for row in own if row["game"] == game]
            measures = ([row["score"] for row in found], [row["curve"][-1] for row in found if row["curve"]])
            fewer = f" ({len(found)})" if len(found) != seeds else ""
            cells.append(", ".join(map(mean_and_error, measures)) + fewer if found else "")
        if own:
            lines.append(
                f"| {name} | {seeds} | " + " | ".join(cells) + f" | {np.median([row['seconds'] for row in own]):.0f} |"
            )
    return "\n".join(lines)


def world_table(rows: list[dict[str, Any]], names: list[str], game: str, steps: int) -> str:
    """
    A Markdown table with a row per trial, for an environment with a reward of 1 at its goal: how often the goal was reached in
    training, when first (median over seeds), the steps per goal after that, and how often the greedy policy reaches it.
    """
    lines = ["| trial | seeds | goals reached | first one at step | steps per goal from there on | greedy policy |"]
    lines.append("|---" * 6 + "|")
    for name in names:
        own = [row for row in rows if (row["trial"], row["game"], row["steps"]) == (name, game, steps)]
        first = [row.get("first_reward_at", steps) for row in own]
        found = [row for row in own if row["return_in_all"] > 1 and "first_reward_at" in row]
        pace = [(steps - row["first_reward_at"]) / (row["return_in_all"] - 1) for row in found]
        cells = [mean_and_error([row[key] for row in own]) for key in ("return_in_all", "score")]
        if own:
            lines.append(
                f"| {name} | {len(own)} | {cells[0]} | {np.median(first):.0f} | {mean_and_error(pace)} | {cells[1]} |"
            )
    return "\n".join(lines)


def differences(rows: list[dict[str, Any]], names: list[str], baseline: str, game: str, steps: int) -> str:
    """
    A Markdown table of the differences from another trial's means over seeds in an environment of ``WORLDS``, each with its
    95 % interval (Welch 1947, https://doi.org/10.1093/biomet/34.1-2.28): goals reached or return of an episode in training,
    return of the greedy policy's, R² of the state from the features.
    """
    measures: dict[str, Callable[[dict[str, Any]], float]] = {
        "goals reached": lambda row: row["return_in_all"],
        "return in training": lambda row: row["return_in_all"] / row["episodes"],
        "greedy policy": lambda row: row["score"],
        "R²": lambda row: row["probe"],
    }
    del measures["return in training" if "torus" in game else "goals reached"]
    lines = [f"| compared with {baseline} | " + " | ".join(measures) + " |", "|---" * (len(measures) + 1) + "|"]
    for name in names:
        cells = []
        for measure in measures.values():
            both = [
                [measure(row) for row in rows if (row["trial"], row["game"], row["steps"]) == (one, game, steps)]
                for one in (name, baseline)
            ]
            if name != baseline and min(map(len, both)) > 1:
                interval = ""
                if max(map(np.ptp, both)) > 0:
                    found = ttest_ind(*both, equal_var=False).confidence_interval()
                    interval = f" [{found.low:.4g}, {found.high:.4g}]"
                cells.append(f"{np.mean(both[0]) - np.mean(both[1]):.4g}{interval}")
        if cells:
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Parse the command line, run what is missing, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trials", type=pathlib.Path, help="YAML file")
    parser.add_argument("--rows", type=pathlib.Path, required=True, help="JSON lines, read and appended to")
    parser.add_argument("--names", nargs="+", help="names of trials (default: all in the file)")
    parser.add_argument("--games", nargs="+", default=list(GAMES), help=f"MinAtar's games, or some of {', '.join(WORLDS)}")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=2, help="parallel runs, one thread each")
    parser.add_argument("--table", action="store_true", help="print the table of finished runs, run nothing")
    parser.add_argument("--baseline", metavar="NAME", help="also print the differences from this trial, in WORLDS")
    parser.add_argument("--one", nargs=3, metavar=("NAME", "GAME", "SEED"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    trials = yaml.safe_load(arguments.trials.read_text(encoding="utf-8"))
    names = arguments.names or list(trials)
    failed: list[tuple[str, str, int]] = []
    if arguments.one:
        name, game, seed = arguments.one
        row = {"trial": name, "game": game, "seed": int(seed), "steps": arguments.steps, **trials[name], "commit": commit()}
        row |= run(trials[name], game, int(seed), arguments.steps)
        with open(arguments.rows, "a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        return
    if not arguments.table:
        rows = read_rows(arguments.rows)
        done = {(r["trial"], r["game"], r["seed"], r["steps"]) for r in rows}
        wanted = [(name, game, seed) for seed in arguments.seeds for name in names for game in arguments.games]
        check_names(rows, trials, wanted, arguments.steps)
        left = [key for key in wanted if (*key, arguments.steps) not in done]
        command = [sys.executable, "-m", "experiments.trials", str(arguments.trials), "--rows", str(arguments.rows)]
        command += ["--steps", str(arguments.steps), "--one"]

        def start(key: tuple[str, str, int]) -> bool:
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            return subprocess.run([*command, *map(str, key)], check=False, env=environment).returncode == 0

        with ThreadPoolExecutor(arguments.jobs) as pool:
            failed = [key for key, succeeded in zip(left, pool.map(start, left), strict=True) if not succeeded]
    rows = read_rows(arguments.rows)
    print(table(rows, names, arguments.games, arguments.steps))
    for game in arguments.games:
        if "torus" in game:
            print(f"\n{game}\n", world_table(rows, names, game, arguments.steps), sep="\n")
        if game in WORLDS and arguments.baseline:
            print(f"\n{game}\n", differences(rows, names, arguments.baseline, game, arguments.steps), sep="\n")
    if failed:
        raise SystemExit(f"These runs failed, see their errors above: {', '.join(map(str, failed))}.")


if __name__ == "__main__":
    main()
