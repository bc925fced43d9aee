"""RL Zoo can build and train the agent of every entry of every hyperparameter file."""

import argparse
import pathlib

import pytest
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS

from sb3_eqr import zoo
from sb3_eqr.configurations import configuration_files
from sb3_eqr.zoo.entries import check_entry

GAMES = ("Asterix", "Breakout", "Freeway", "Seaquest", "SpaceInvaders")
ENVIRONMENTS = {
    "atari",
    "CartPole-v1",
    "LunarLander-v3",
    "MountainCar-v0",
    "Acrobot-v1",
    "BlindCliffwalk-v0",
    "SlidingBallDistractors-v0",
}
ENVIRONMENTS |= {f"MinAtar/{game}-v1" for game in GAMES}
MUJOCO = {f"{task}-v5" for task in ("HalfCheetah", "Ant", "Hopper", "Walker2d", "Humanoid", "Reacher")}
CONTINUOUS = {*MUJOCO, "Pendulum-v1", "LunarLanderContinuous-v3"}
ENTRIES = {name: yaml.safe_load(path.read_text(encoding="utf-8")) for name, path in configuration_files().items()}
GENERIC = {"default", "default-image", "default-small-image", "default-dict"}  # test_zoo.py trains by them
CASES = [  # an entry shared by several environments is one YAML object and built once
    (name, env_id)
    for name, entries in ENTRIES.items()
    for env_id in {id(entry): env_id for env_id, entry in entries.items()}.values()
    if env_id not in GENERIC
]


class Manager(ExperimentManager):
    """RL Zoo's manager, but entries with the same Atari environment share it, because ALE takes long to load a game."""

    built = {}

    def create_envs(self, n_envs, *args, **kwargs):
        if not self.env_name.gym_id.endswith("NoFrameskip-v4"):
            return super().create_envs(n_envs, *args, **kwargs)
        entry = yaml.safe_load(pathlib.Path(self.config).read_text(encoding="utf-8"))["atari"]
        asked = n_envs, *(str(entry.get(key)) for key in ("env_wrapper", "frame_stack", "normalize", "vec_env_wrapper"))
        if asked not in self.built:
            self.built[asked] = super().create_envs(n_envs, *args, **kwargs)
        return self.built[asked]


def algorithm_of(name):
    if name.startswith("stock/"):
        return name.removeprefix("stock/")
    if name in ("eqr_sac", "eqr_tqc"):
        return name
    return "eqr_qrdqn" if name in ("eqr_qrdqn", "qrdqn") else "eqr_rainbow"


def test_every_file_has_the_expected_environments():
    own, stock, continuous = {"eqr_qrdqn", "eqr_rainbow"}, {"stock/dqn", "stock/qrdqn"}, {"eqr_sac", "eqr_tqc"}
    assert {name for name, entries in ENTRIES.items() if entries.keys() == ENVIRONMENTS | GENERIC} == own
    assert {name for name, entries in ENTRIES.items() if entries.keys() == ENVIRONMENTS} == stock
    assert all(ENTRIES[name].keys() == CONTINUOUS | GENERIC for name in continuous)
    minatar = {"atari", *(env_id for env_id in ENVIRONMENTS if env_id.startswith("MinAtar/"))}
    rivals = {"qrdqn", "rainbow", "spr"}
    for name in rivals:
        assert ENTRIES[name].keys() == minatar and len({id(ENTRIES[name][env_id]) for env_id in minatar}) == 2
    assert all(
        entries.keys() == {"atari"} for name, entries in ENTRIES.items() if name not in own | stock | continuous | rivals
    )


@pytest.mark.parametrize("name, entry", CASES, ids=lambda value: value)
def test_every_entry_builds_its_agent(name, entry, tmp_path):
    zoo.register()
    path, algo = configuration_files()[name], algorithm_of(name)
    env_id = "PongNoFrameskip-v4" if entry == "atari" else entry
    manager = Manager(argparse.Namespace(), algo, env_id, str(tmp_path), eval_freq=-1, config=str(path), device="cpu")
    model, _ = manager.setup_experiment()
    assert type(model) is ALGOS[algo]
    written = yaml.safe_load(path.read_text(encoding="utf-8"))[entry]
    assert manager.n_timesteps == written["n_timesteps"]
    for key in ("batch_size", "buffer_size", "gamma", "n_steps", "learning_starts", "prediction_depth", "gradient_steps"):
        if key in written:
            assert getattr(model, key) == written[key], key
    if "env_wrapper" in written:
        space = model.observation_space
        assert space.dtype == "uint8" and (space.shape == (4, 84, 84) if entry == "atari" else space.shape[1:] == (10, 10))
    # It can act and be trained, here with a small batch to save time.
    model.learning_starts = 0
    model.train_freq = 24  # the longest n of these files is 20
    model._convert_train_freq()
    model.batch_size, model.gradient_steps = 4, 1
    model.learn(24)
    assert model._n_updates == 1


@pytest.mark.parametrize(
    "algo, key", [("eqr_sac", "log_std_init"), ("eqr_tqc", "n_quantiles"), ("eqr_rainbow", "net_arch"), ("sac", "n_critics")]
)
def test_an_entry_may_have_the_arguments_of_the_policy_of_sb3(algo, key, capsys):
    zoo.register()
    check_entry({"policy": "MlpPolicy", "policy_kwargs": {key: 1}}, algo, "file")
    with pytest.raises(SystemExit):
        check_entry({"policy": "MlpPolicy", "policy_kwargs": {f"{key}s": 1}}, algo, "file")
    assert f"Did you mean '{key}'?" in capsys.readouterr().err
