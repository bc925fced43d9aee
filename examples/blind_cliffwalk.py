"""
Prioritised compared with uniform replay on the blind cliffwalk (Schaul et al. 2016, Figure 1).

    python examples/blind_cliffwalk.py --seeds 10

The replay buffer holds the full episodes of all 2ⁿ action sequences, in random order: the only success is a single
transition among 2ⁿ⁺¹ - 2. The script counts the updates of a tabular EqRRainbow until the mean square error of all its
Q values is below 0.001.
"""

import argparse
import itertools
import json
import time

import numpy as np
import torch as th
from stable_baselines3.common.logger import configure

from sb3_eqr import EqRRainbow
from sb3_eqr.envs import BlindCliffwalk

TOLERANCE = 1e-3  # mean square error of the Q values, as in the paper
MOST_UPDATES = 100_000


def make_model(n_states: int, seed: int, prioritized: bool) -> EqRRainbow:
    """
    :return: an agent without hidden layers on one-hot states, with a full replay buffer
    """
    env = BlindCliffwalk(n_states, seed)
    model = EqRRainbow(
        "MlpPolicy",
        env,
        learning_rate=0.03,
        buffer_size=2 ** (n_states + 1) - 2,
        gamma=1 - 1 / n_states,  # as in the paper
        n_steps=1,
        prediction_depth=0,
        target_update_interval=None,
        exploration_final_eps=0.1,
        prioritized_replay=prioritized,
        seed=seed,
        policy_kwargs={
            "group": None,
            "features_extractor_class": "flatten",
            "layer_norm": False,
            "net_arch": [],
            "noisy": False,
            "dueling": False,
            "spread_init": None,
            "v_min": 0.0,
            "v_max": 1.0,
        },
    )
    model.set_logger(configure(None, []))
    sequences = list(itertools.product((0, 1), repeat=n_states))
    for index in np.random.default_rng(seed).permutation(len(sequences)):
        state, _ = env.reset()
        for action in sequences[index]:
            following, reward, done, _, _ = env.step(action)
            model.replay_buffer.add(*(np.array([x]) for x in (state, following, action, reward, done)), [{}])
            state = following
            if done:
                break
    return model


def updates_needed(n_states: int, seed: int, prioritized: bool) -> int:
    """
    :return: number of updates until the error of the Q values is below ``TOLERANCE``
    """
    model = make_model(n_states, seed, prioritized)
    states = th.arange(n_states)
    truth = th.as_tensor(BlindCliffwalk(n_states, seed).q_values(model.gamma))
    for update in range(1, MOST_UPDATES + 1):
        model.train(1, model.batch_size)
        with th.no_grad():
            if (model.q_net(states) - truth).square().mean() < TOLERANCE:
                return update
    return MOST_UPDATES


def milliseconds_per_sample(n_states: int, rounds: int = 200) -> dict[str, float]:
    """
    :return: median time of a batch for each way of sampling, including new priorities; the two are timed alternately
    """
    buffers = {way: make_model(n_states, 0, way == "prioritised").replay_buffer for way in ("uniform", "prioritised")}
    timings: dict[str, list[float]] = {way: [] for way in buffers}
    priorities = th.rand(32)
    for _ in range(rounds):
        for way, buffer in buffers.items():
            start = time.perf_counter()
            for _ in range(20):
                samples = buffer.sample(32)
                if way == "prioritised":
                    buffer.update_priorities(samples.indices, priorities)
            timings[way].append((time.perf_counter() - start) / 20 * 1e3)
    return {way: float(np.median(values)) for way, values in timings.items()}


def main() -> None:
    """Count the updates for each way of sampling, print medians."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n")[0])
    parser.add_argument("--states", type=int, nargs="+", default=[6, 8, 10])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--json", metavar="FILE", help="also write the counts to this file")
    args = parser.parse_args()
    th.set_num_threads(1)
    results = []
    for n_states in args.states:
        row: dict = {"n_states": n_states, "transitions": 2 ** (n_states + 1) - 2}
        for way in ("uniform", "prioritised"):
            row[way] = [updates_needed(n_states, seed, way == "prioritised") for seed in range(args.seeds)]
        row["milliseconds_per_sample"] = milliseconds_per_sample(n_states)
        medians = {way: float(np.median(row[way])) for way in ("uniform", "prioritised")}
        cost = row["milliseconds_per_sample"]
        print(
            f"{n_states:3} states: updates, median of {args.seeds}: uniform {medians['uniform']:.0f}, "
            f"prioritised {medians['prioritised']:.0f}; ms per batch: uniform {cost['uniform']:.3f}, prioritised "
            f"{cost['prioritised']:.3f} ({cost['prioritised'] / cost['uniform']:.2f} times)",
            flush=True,
        )
        results.append(row)
    if args.json:
        with open(args.json, "w") as file:
            json.dump(results, file, indent=1)


if __name__ == "__main__":
    main()
