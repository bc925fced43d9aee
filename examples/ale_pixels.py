"""
Compare the grey 84x84 screens of ALE's vector environment with those of SB3's wrappers, for the same actions.

    python examples/ale_pixels.py --games Pong Seaquest Qbert BattleZone MsPacman
"""

import argparse

import gymnasium as gym
import numpy as np
from stable_baselines3.common.atari_wrappers import MaxAndSkipEnv, WarpFrame

from sb3_eqr.envs.atari import FRAME_SKIP, SCREEN_SIZE, atari_env_id


def screens(game: str, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: screens of SB3's wrappers and of ALE's vector environment in the first episode, (steps, 84, 84) each
    """
    from ale_py.vector_env import AtariVectorEnv

    env_id = atari_env_id(game)
    ours = WarpFrame(
        MaxAndSkipEnv(gym.make(env_id, frameskip=1, repeat_action_probability=0.0), FRAME_SKIP), SCREEN_SIZE, SCREEN_SIZE
    )
    theirs = AtariVectorEnv(
        gym.spec(env_id).kwargs["game"], 1, stack_num=1, frameskip=FRAME_SKIP, noop_max=1, use_fire_reset=False
    )
    ours.reset(seed=0)
    theirs.reset(seed=0)
    rng = np.random.default_rng(0)
    found: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for _ in range(n_steps):
        action = int(rng.integers(ours.action_space.n))  # type: ignore[attr-defined]
        seen, _, terminated, _, _ = ours.step(action)
        stack = theirs.step(np.array([action]))[0]
        if terminated:
            break
        found[0].append(seen[:, :, 0])
        found[1].append(stack[0, -1])
    ours.close()
    theirs.close()
    return np.array(found[0], dtype=int), np.array(found[1], dtype=int)


def main() -> None:
    """Parse the command line, run the games, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n")[0])
    parser.add_argument("--games", nargs="+", default=["Pong", "Seaquest", "Qbert", "BattleZone", "MsPacman"])
    parser.add_argument("--steps", type=int, default=300)
    args = parser.parse_args()
    print(f"{'game':12}{'screens':>8}{'pixels that differ':>20}{'by at most':>12}{'screens that differ':>21}")
    for game in args.games:
        sb3, ale = screens(game, args.steps)
        differs = sb3 != ale
        print(
            f"{game:12}{len(sb3):8}{differs.mean():20.2%}{np.abs(sb3 - ale).max():12}{differs.any(axis=(1, 2)).mean():21.0%}"
        )


if __name__ == "__main__":
    main()
