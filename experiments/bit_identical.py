"""
Check that a change of the code leaves training bit-identical.

Trains about thirty configurations for 200 updates or more each, and hashes parameters, batch statistics, optimiser state,
target copies, priorities and the random generators:

    python experiments/bit_identical.py --write docs/results/bit_identical.json    # before the change
    python experiments/bit_identical.py --check docs/results/bit_identical.json    # after it

Hashes depend on the CPU and the version of PyTorch: compare them on one machine.
"""

import argparse
import hashlib
import json
import pathlib
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch as th
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize

from sb3_eqr import EqRQRDQN, EqRRainbow, MatrixLieGroup

AGENTS = {"qrdqn": EqRQRDQN, "rainbow": EqRRainbow}
SCALES = MatrixLieGroup([[[0.0, 1.0], [-1.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]]])


def make_images() -> FakeImageEnv:
    """Reproducible random images: they are drawn by the observation space, which ``reset(seed)`` does not seed."""
    env = FakeImageEnv(4, 40, 40, n_channels=1, discrete=True)
    env.observation_space.seed(0)
    return env


ENVS: dict[str, tuple[str, Callable[[int], VecEnv]]] = {  # kind -> policy, environments of a given number
    "vectors": ("MlpPolicy", partial(make_vec_env, "CartPole-v1")),
    "normalized": ("MlpPolicy", lambda n: VecNormalize(make_vec_env("CartPole-v1", n))),
    "images": ("CnnPolicy", lambda n: VecFrameStack(make_vec_env(make_images, n), 4)),
    "dicts": ("MultiInputPolicy", partial(make_vec_env, partial(SimpleMultiObsEnv, channel_last=True))),
}
FILE = pathlib.Path(__file__).with_name("settings") / "bit_identical.yml"
CONFIGURATIONS: dict[str, dict[str, Any]] = yaml.safe_load(FILE.read_text(encoding="utf-8"))
COMMON = CONFIGURATIONS.pop("common")
OBJECTS = {"SCALES": SCALES, "RMSprop": th.optim.RMSprop}  # by their names in the file


def train(name: str) -> Any:
    """:return: the agent of a configuration after about 200 updates"""
    settings = CONFIGURATIONS[name]
    n_envs, (policy, make_env) = settings.get("n_envs", 1), ENVS[settings["env"]]
    network = {key: OBJECTS.get(str(value), value) for key, value in settings.get("policy_kwargs", {}).items()}
    arguments = {**COMMON, **settings.get("arguments", {}), "policy_kwargs": {**COMMON["policy_kwargs"], **network}}
    n_steps = 60 + 100 * n_envs * (4 if "train_freq" in arguments else 1)

    def made() -> Any:
        np.random.seed(0)
        return AGENTS[settings["agent"]](policy, make_env(n_envs), **arguments)

    model = made()
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "model.zip"
        if "elsewhere" in name:
            model.learn(90).save(file)
            model = made().load_representation(file, freeze=True)
        elif "continued" in name:
            env = model.get_env()
            model.learn(100)
            model.save(file)
            model.save_replay_buffer(file.with_suffix(".pkl"))
            model = type(model).load(file, env=env, device="cpu", force_reset=False)
            model.load_replay_buffer(file.with_suffix(".pkl"))
        model.set_logger(configure(None, []))
        return model.learn(n_steps, reset_num_timesteps="continued" not in name)


def pieces(model: Any) -> Iterator[np.ndarray]:
    """All arrays that the updates change."""
    policy = model.policy
    for group in policy.optimizer.param_groups:
        for parameter in group["params"]:
            yield parameter.detach().numpy()
            for _, value in sorted(policy.optimizer.state.get(parameter, {}).items()):
                yield value.numpy() if isinstance(value, th.Tensor) else np.asarray(value)
    for module in (policy.target, policy.latent_target, policy.latent_encoder):
        if module is not None:
            yield from (parameter.detach().numpy() for parameter in module.parameters())
    yield from (buffer.numpy() for buffer in policy.buffers())
    if hasattr(model.replay_buffer, "_tree"):
        yield model.replay_buffer._tree.get(np.arange(model.replay_buffer._tree.capacity))
    yield np.array([model._n_updates, model.num_timesteps])
    yield np.random.random(4)
    yield th.rand(4).numpy()


def digest(name: str) -> str:
    """:return: the first 16 digits of the SHA-256 of these arrays, for a configuration"""
    hashed = hashlib.sha256()
    for array in pieces(train(name)):
        hashed.update(np.ascontiguousarray(array).tobytes())
    return hashed.hexdigest()[:16]


def main() -> None:
    """Write the hashes, or compare them with earlier ones."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n")[0])
    parser.add_argument("--write", type=pathlib.Path, metavar="FILE", help="file to write the hashes to")
    parser.add_argument("--check", type=pathlib.Path, metavar="FILE", help="file of hashes to compare with")
    parser.add_argument("--only", nargs="+", choices=CONFIGURATIONS, default=list(CONFIGURATIONS), metavar="NAME")
    args = parser.parse_args()
    th.set_num_threads(1)
    before = json.loads(args.check.read_text())["hashes"] if args.check else {}
    found, n_identical = {}, 0
    for name in args.only:
        found[name] = digest(name)
        n_identical += found[name] == before.get(name)
        verdict = "identical" if found[name] == before.get(name) else "DIFFERENT"
        print(f"{name:28} {found[name]} {verdict if args.check else ''}", flush=True)
    if args.write:
        about = {"torch": th.__version__, "numpy": np.__version__, "updates": "200 and more", "hashes": found}
        args.write.write_text(json.dumps(about, indent=2) + "\n")
    if args.check:
        print(f"{n_identical} of {len(found)} identical")
        sys.exit(n_identical < len(found))


if __name__ == "__main__":
    main()
