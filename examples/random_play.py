"""
The scores of random play on the games of the suites `minatar` and `classic`, which are the 0 of their normalisation.

    python examples/random_play.py [--episodes 1000]
"""

import argparse

import gymnasium as gym
import numpy as np

from sb3_eqr.benchmark.suites import choose, load_suite


def play(env_id: str, n_episodes: int, max_steps: int | None) -> np.ndarray:
    """
    :param env_id: name of the environment
    :param n_episodes: number of episodes, with the seeds 0, 1, ...
    :param max_steps: maximum number of steps per episode
    :return: scores, (n_episodes,)
    """
    env = gym.make(env_id, max_episode_steps=max_steps)
    env.action_space.seed(0)
    scores = np.zeros(n_episodes)
    for episode in range(n_episodes):
        env.reset(seed=episode)
        over = False
        while not over:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            scores[episode] += float(reward)
            over = terminated or truncated
    return scores


def main() -> None:
    """Run the episodes and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=1_000)
    args = parser.parse_args()
    print("| game | mean | standard error |\n|---|---|---|")
    for name in ("classic", "minatar"):
        suite = choose(load_suite(name), None, None)
        for game in suite.games:
            scores = play(suite.env_id.format(game=game), args.episodes, suite.evaluation.max_steps)
            print(f"| {game} | {scores.mean():.2f} | {scores.std() / np.sqrt(len(scores)):.2f} |", flush=True)


if __name__ == "__main__":
    main()
