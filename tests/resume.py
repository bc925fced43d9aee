"""
The second half of the test of resuming, run in its own process: load what the first half saved, continue, save.

    python -m tests.resume ALGORITHM FOLDER STEPS
"""

import pathlib
import pickle
import sys

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import sb3_eqr
from tests.toys import ChainEnv


class Save(BaseCallback):
    """Save everything between two rounds of the training loop, after an update and before the next step."""

    def __init__(self, folder: pathlib.Path, at: int):
        super().__init__()
        self.folder, self.at = folder, at

    def _on_rollout_start(self) -> None:
        if self.num_timesteps == self.at:
            self.model.save(self.folder / "model")
            self.model.save_replay_buffer(self.folder / "buffer")
            env = self.model.get_env()
            (self.folder / "env.pkl").write_bytes(pickle.dumps(env.env_method("state_dict")))
            if isinstance(env, VecNormalize):
                env.save(str(self.folder / "normalize.pkl"))
                (self.folder / "returns.pkl").write_bytes(pickle.dumps(env.returns))  # SB3 does not save them

    def _on_step(self) -> bool:
        return True


def make_env(normalize: pathlib.Path | bool) -> VecEnv:
    env = make_vec_env(ChainEnv, 2)
    if normalize is True:
        return VecNormalize(env)
    return VecNormalize.load(str(normalize), env) if normalize else env


def main(algorithm: str, folder: pathlib.Path, steps: int) -> None:
    th.set_num_threads(1)
    normalize = folder / "normalize.pkl"
    env = make_env(normalize if normalize.exists() else False)
    env.unwrapped.reset()  # Monitor requires it; the states are set below
    if isinstance(env, VecNormalize):
        env.returns = pickle.loads((folder / "returns.pkl").read_bytes())
    model = getattr(sb3_eqr, algorithm).load(
        folder / "model", env=env, device="cpu", force_reset=False, trust=True
    )  # the file has a pickled lambda
    model.load_replay_buffer(folder / "buffer")
    for index, state in enumerate(pickle.loads((folder / "env.pkl").read_bytes())):
        env.env_method("load_state_dict", state, indices=index)
    model.learn(steps, reset_num_timesteps=False)
    model.save(folder / "continued")


if __name__ == "__main__":
    main(sys.argv[1], pathlib.Path(sys.argv[2]), int(sys.argv[3]))
