"""Checkpoints: an interrupted and resumed run equals an uninterrupted one."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common import callbacks
from stable_baselines3.common.callbacks import (
    CallbackList,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecNormalize

import sb3_eqr
from sb3_eqr import EqRQRDQN, MatrixLieGroup
from sb3_eqr.common.saving.checkpoints import ExactCheckpointCallback, find_checkpoints, write_checkpoint
from sb3_eqr.envs import ResumableWrapper
from sb3_eqr.envs.minatar import ChannelsFirstImage
from tests.models import same
from tests.toys import FORK, ChainEnv, SampledEnv

STEPS = 110
SMALL = {"buffer_size": 300, "batch_size": 8, "learning_starts": 40, "n_steps": 3, "seed": 3, "device": "cpu"}
SMALL["policy_kwargs"] = {"net_arch": [8], "n_blocks": 2, "latent_hidden_dim": 8}
MINATAR = {"policy_kwargs": {**SMALL["policy_kwargs"], "features_extractor_kwargs": {"layers": [[4, 3, 1]]}}}


def minatar():
    pytest.importorskip("minatar")
    return VecFrameStack(make_vec_env("MinAtar/Breakout-v1", 1, wrapper_class=ChannelsFirstImage), 2)


WORLDS = {
    "EqRQRDQN": (lambda: VecNormalize(make_vec_env("CartPole-v1", 2)), "MlpPolicy", {"gradient_steps": 2, "train_freq": 3}),
    "EqRRainbow": (minatar, "CnnPolicy", {**MINATAR, "train_freq": 4}),
}


def resume(folder):
    """Run in another process: continue from the last checkpoints and save."""
    th.set_num_threads(1)
    for algorithm, (env, *_) in WORLDS.items():
        model = getattr(sb3_eqr, algorithm).resume(folder / algorithm, env())
        callback = ExactCheckpointCallback(30, folder / algorithm)
        model.learn(STEPS - model.num_timesteps, callback, reset_num_timesteps=False).save(folder / algorithm / "resumed")


@pytest.mark.slow
def test_resuming_in_a_new_process_is_bit_identical(tmp_path):
    models = {}
    for algorithm, (env, policy, settings) in WORLDS.items():
        kind, folder = getattr(sb3_eqr, algorithm), tmp_path / algorithm
        whole = kind(policy, env(), **{**SMALL, **settings}).learn(STEPS)
        stopped = kind(policy, env(), **{**SMALL, **settings}).learn(STEPS, ExactCheckpointCallback(30, folder, keep=3))
        models[algorithm] = whole, stopped
        found = sorted(path.name for path in folder.iterdir())
        assert len(found) == 3
        for later in found[1:]:  # as if the run had been killed after the first checkpoint
            shutil.rmtree(folder / later)
    command = f"import pathlib; from tests.agents.test_checkpoints import resume; resume(pathlib.Path({str(tmp_path)!r}))"
    subprocess.run([sys.executable, "-c", command], check=True)
    for algorithm, (whole, stopped) in models.items():
        resumed = type(whole).load(tmp_path / algorithm / "resumed")
        for model in (stopped, resumed):
            assert model.num_timesteps == whole.num_timesteps and model._n_updates == whole._n_updates > 20
            assert same(model, whole)
        assert not list((tmp_path / algorithm).glob(".*"))


class Falling(EvalCallback):
    """Finds a return of 9, and 1 less at each evaluation."""

    def _on_step(self):
        with pytest.MonkeyPatch.context() as patch:
            value = 9.0 - len(self.evaluations_results)
            patch.setattr(callbacks, "evaluate_policy", lambda *args, **kwargs: ([value], [5]))
            return super()._on_step()


def test_sb3s_callbacks_continue_in_a_resumed_run(tmp_path):
    def learn(model, n_steps):
        stopping = StopTrainingOnNoModelImprovement(max_no_improvement_evals=4)
        evaluation = Falling(
            make_vec_env(ChainEnv), None, stopping, eval_freq=8, log_path=tmp_path, best_model_save_path=tmp_path, verbose=0
        )
        calls = []
        every = EveryNTimesteps(25, callback=ConvertCallback(lambda *_: calls.append(model.num_timesteps) or True))
        checkpoints = ExactCheckpointCallback(20, tmp_path / "run")
        model.learn(n_steps, [evaluation, every, checkpoints], reset_num_timesteps=model.num_timesteps == 0)
        return calls, stopping

    assert learn(EqRQRDQN("MlpPolicy", make_vec_env(ChainEnv), **SMALL), 23)[0] == []  # the last checkpoint is of step 20
    best = (tmp_path / "best_model.zip").read_bytes()
    model = EqRQRDQN.resume(tmp_path / "run", make_vec_env(ChainEnv))
    calls, stopping = learn(model, 180)
    assert model.num_timesteps == 48  # the sixth evaluation is the fifth without improvement
    found = np.load(tmp_path / "evaluations.npz")
    assert found["timesteps"].tolist() == [8, 16, 24, 32, 40, 48] and found["results"].ravel().tolist() == [9, 8, 7, 6, 5, 4]
    assert (tmp_path / "best_model.zip").read_bytes() == best and stopping.no_improvement_evals == 5
    assert calls == [25]
    model = EqRQRDQN.resume(tmp_path / "run", make_vec_env(ChainEnv))
    new = Falling(make_vec_env(ChainEnv), eval_freq=8, verbose=0)
    model.learn(3, new)  # counts from 0, as SB3's learn without reset_num_timesteps=False
    assert new.n_calls == 3 and not new.evaluations_results


def test_evaluations_with_noise_continue_in_a_resumed_run(tmp_path):
    """They draw from the generators of training, as often as their episodes are long."""

    def learn(model, n_steps):
        evaluation = EvalCallback(
            make_vec_env("CartPole-v1", seed=9), eval_freq=20, deterministic=False, log_path=tmp_path / "log", verbose=0
        )
        callbacks = [evaluation, ExactCheckpointCallback(50, tmp_path / "run")]
        return model.learn(n_steps, callbacks, reset_num_timesteps=model.num_timesteps == 0), evaluation.evaluations_length

    whole, lengths = learn(EqRQRDQN("MlpPolicy", make_vec_env("CartPole-v1"), **SMALL), 99)
    resumed, found = learn(EqRQRDQN.resume(tmp_path / "run", make_vec_env("CartPole-v1")), 49)
    assert same(whole, resumed) and found == lengths and len(lengths) == 4


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("written")
    EqRQRDQN("MlpPolicy", ChainEnv(), **SMALL).learn(60, ExactCheckpointCallback(20, folder, keep=1))
    (found,) = folder.iterdir()
    return found


@pytest.fixture
def checkpoint(written, tmp_path):
    return shutil.copytree(written, tmp_path / written.name)


DAMAGES = {"flipped": lambda half, rest: half + bytes([rest[0] ^ 1]) + rest[1:], "truncated": lambda half, rest: half}


@pytest.mark.parametrize("name", ["model.zip", "replay_buffer.pkl", "manifest.json"])
@pytest.mark.parametrize("damage", [*DAMAGES, "gone"])
def test_a_damaged_checkpoint_raises(checkpoint, name, damage):
    path = checkpoint / name
    content = path.read_bytes()
    path.unlink()
    if damage in DAMAGES:
        path.write_bytes(DAMAGES[damage](content[: len(content) // 2], content[len(content) // 2 :]))
    with pytest.raises(ValueError, match=r"must be (unchanged|a complete checkpoint|a checkpoint or a folder)"):
        EqRQRDQN.resume(checkpoint, ChainEnv())


def test_the_last_complete_checkpoint_is_used(checkpoint):
    (checkpoint.parent / "checkpoint-000000000999").mkdir()  # not a checkpoint
    assert EqRQRDQN.resume(checkpoint.parent, ChainEnv()).num_timesteps == int(checkpoint.name.partition("-")[2])
    with pytest.raises(ValueError, match="got nothing"):
        EqRQRDQN.resume(checkpoint.parent / "none", ChainEnv())


def test_an_environment_of_an_unknown_class_is_resumed_with_new_episodes(tmp_path):
    def make_env():
        return VecNormalize(make_vec_env(lambda: SampledEnv(spaces.Box(-1, 1, (3,), np.float32))))

    message = r"The state of .*SampledEnv is not known.*state_dict and load_state_dict"
    with pytest.warns(UserWarning, match=message):  # when there is still time
        EqRQRDQN("MlpPolicy", make_env(), **SMALL).learn(60, ExactCheckpointCallback(45, tmp_path))
    with pytest.warns(UserWarning, match=message) as caught:
        model = EqRQRDQN.resume(tmp_path, make_env())
    assert sum("is not known" in str(warning.message) for warning in caught) == 1
    assert model._last_obs is None and model.get_vec_normalize_env().obs_rms.count > 45  # the statistics are not lost
    model.learn(20, reset_num_timesteps=False)
    rows = np.arange(model.replay_buffer.pos)
    stored = model.replay_buffer._stores[""].observations(rows, 0 * rows, following=False)
    assert len(rows) > 60 and (stored == stored[0]).all(axis=1).sum() == 1  # the run's first episode is not played again


def test_a_checkpoint_that_was_removed_in_part_is_removed(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.rmtree", lambda *_, **__: None)  # as if the process was killed here
    model = EqRQRDQN("MlpPolicy", ChainEnv(), **SMALL).learn(60, ExactCheckpointCallback(20, tmp_path, keep=1))
    left = list(tmp_path.glob(".checkpoint-*"))
    assert left and len(find_checkpoints(tmp_path)) == 1
    monkeypatch.undo()
    write_checkpoint(tmp_path, model)
    assert not list(tmp_path.glob(".*")) and len(find_checkpoints(tmp_path)) == 1


def test_checkpoints_are_counted_from_the_first_step_of_the_run(tmp_path):
    """A second call of learn from step 100: the next multiple of 40 is 120."""
    model, callback = EqRQRDQN("MlpPolicy", ChainEnv(), **SMALL).learn(100), ExactCheckpointCallback(40, tmp_path)
    model.learn(15, callback, reset_num_timesteps=False)
    assert find_checkpoints(tmp_path) == []
    model.learn(10, callback, reset_num_timesteps=False)
    assert [path.name for path in find_checkpoints(tmp_path)] == ["checkpoint-000000000120"]


def test_training_in_parts_writes_the_checkpoints_that_end_a_part(tmp_path):
    model, callback = EqRQRDQN("MlpPolicy", ChainEnv(), **SMALL), ExactCheckpointCallback(40, tmp_path, keep=9)
    for _ in range(3):
        model.learn(40, callback, reset_num_timesteps=False)
    assert [path.name[-3:] for path in find_checkpoints(tmp_path)] == ["040", "080"]


@pytest.mark.parametrize("name", ["manifest.json", "replay_buffer.pkl"])
def test_a_damaged_checkpoint_is_written_again_by_a_run_resumed_before_it(tmp_path, name):
    EqRQRDQN("MlpPolicy", ChainEnv(), **SMALL).learn(60, ExactCheckpointCallback(20, tmp_path, keep=9))
    first, second = find_checkpoints(tmp_path)
    (second / name).write_bytes((second / name).read_bytes()[:100])
    EqRQRDQN.resume(first, ChainEnv()).learn(40, ExactCheckpointCallback(20, tmp_path, keep=9), reset_num_timesteps=False)
    assert EqRQRDQN.resume(second, ChainEnv()).num_timesteps == 40


def test_a_folder_of_the_user_with_the_name_of_a_checkpoint_is_kept(tmp_path):
    mine = tmp_path / "checkpoint-000000000020" / "notes.txt"
    mine.parent.mkdir()
    mine.write_text("mine")
    with pytest.raises(ValueError, match=r"checkpoint-000000000020 must be a checkpoint, got one without manifest\.json"):
        EqRQRDQN("MlpPolicy", ChainEnv(), **SMALL).learn(40, ExactCheckpointCallback(20, tmp_path))
    assert mine.read_text() == "mine"


def test_different_runs_cannot_share_a_folder(checkpoint):
    folder = checkpoint.parent
    before = sorted(folder.iterdir())
    group = {**SMALL["policy_kwargs"], "group": "SO(3)"}
    for changes, why in (
        ({"gamma": 0.5}, "gamma = 0.99 there, 0.5 here"),
        ({"seed": None}, r"seed = 3 there, None here"),
        ({"policy_kwargs": group}, r"policy_kwargs = \{.*'latent_hidden_dim': 8,.*'group': 'SO\(3\)'"),
        ({"resets": {"interval": 5}}, r"resets = "),
        ({"learning_rate": lambda progress: 1e-3}, r"learning_rate = 0.0001 there, .*lambda"),
        ({"env": type("OtherEnv", (ChainEnv,), {})()}, r"environment = \{'id': 'ChainEnv'\} there, \{'id': 'OtherEnv'\} here"),
    ):
        other = EqRQRDQN("MlpPolicy", **{"env": ChainEnv(), **SMALL, **changes})
        with pytest.raises(ValueError, match=rf"must be empty or hold checkpoints of this run, .*{why}.*Pass another folder"):
            other.learn(60, ExactCheckpointCallback(20, folder))
    with pytest.raises(ValueError, match=r"observation_space = 'Box.*\(3,\), float32\)' there"):
        EqRQRDQN("MlpPolicy", "Acrobot-v1", **SMALL).learn(60, ExactCheckpointCallback(20, folder))
    assert sorted(folder.iterdir()) == before


def test_a_checkpoint_is_never_discarded_when_it_is_written(checkpoint):
    model = EqRQRDQN("MlpPolicy", ChainEnv(), **SMALL).learn(25)
    for keep, left in ((3, [25, 40]), (1, [25])):
        write_checkpoint(checkpoint.parent, model, keep=keep)
        assert [int(path.name.removeprefix("checkpoint-")) for path in find_checkpoints(checkpoint.parent)] == left


@pytest.mark.parametrize("seed", [0, None])
def test_a_run_cannot_restart_in_its_folder(seed, tmp_path):
    """``resume`` would choose the checkpoint with most steps, which the first run wrote."""
    first, second = (EqRQRDQN("MlpPolicy", ChainEnv(), **{**SMALL, "seed": seed}) for _ in range(2))
    first.learn(60, ExactCheckpointCallback(20, tmp_path))
    step = int(find_checkpoints(tmp_path)[-1].name.removeprefix("checkpoint-"))
    with pytest.raises(ValueError, match=f"it is at step {step}, this run begins.*Pass another folder, or resume that run"):
        second.learn(60, ExactCheckpointCallback(20, tmp_path))
    second.learn(25)
    if seed is None:
        with pytest.raises(ValueError, match="this run has no seed"):
            second.learn(20, ExactCheckpointCallback(20, tmp_path), reset_num_timesteps=False)
    assert int(find_checkpoints(tmp_path)[-1].name.removeprefix("checkpoint-")) == step


def test_the_environment_must_be_built_in_the_same_way(checkpoint):
    with pytest.raises(ValueError, match=r"must be DummyVecEnv, got VecNormalize in DummyVecEnv: .*including VecNormalize"):
        EqRQRDQN.resume(checkpoint, VecNormalize(make_vec_env(ChainEnv)))
    with pytest.raises(ValueError, match="env must be an environment, built as in the original run"):
        EqRQRDQN.resume(checkpoint, None)


def test_an_environment_of_another_id_is_refused_and_other_arguments_are_named(tmp_path):
    EqRQRDQN("MlpPolicy", "CartPole-v1", **SMALL).learn(60, ExactCheckpointCallback(50, tmp_path))
    with pytest.raises(ValueError, match=r"the environment of the original run.*'CartPole-v1' there, 'CartPole-v0' here"):
        EqRQRDQN.resume(tmp_path, make_vec_env("CartPole-v0"))
    shorter = make_vec_env("CartPole-v1", env_kwargs={"max_episode_steps": 50, "sutton_barto_reward": True})
    with pytest.warns(UserWarning, match=r"max_episode_steps = 500 there, 50 here, kwargs = .* there, .*sutton_barto"):
        model = EqRQRDQN.resume(tmp_path, shorter)
    model.learn(20, reset_num_timesteps=False)
    assert model.env.get_attr("_max_episode_steps") == [50]


def test_inside_another_callback_it_refuses_to_do_nothing(tmp_path):
    model = EqRQRDQN("MlpPolicy", ChainEnv(), **SMALL)
    with pytest.raises(ValueError, match="must be given to learn itself, alone or in a list, got it inside another callback"):
        model.learn(60, EveryNTimesteps(20, ExactCheckpointCallback(20, tmp_path)))
    model.learn(60, CallbackList([ExactCheckpointCallback(20, tmp_path)]))
    assert find_checkpoints(tmp_path)


def test_a_run_with_arrays_among_its_arguments_goes_on_in_its_folder(tmp_path):
    """JSON has no tuples, such as the shapes of arrays: the settings must be the same before and after."""
    turn = [[[0.0, 1.0], [-1.0, 0.0]]]
    settings = {**SMALL, "symmetry_coef": 0.0, "policy_kwargs": {**SMALL["policy_kwargs"], "group": MatrixLieGroup(turn)}}
    EqRQRDQN("MlpPolicy", ChainEnv(), **settings).learn(60, ExactCheckpointCallback(50, tmp_path))
    model = EqRQRDQN.resume(tmp_path, ChainEnv())
    model.learn(60, ExactCheckpointCallback(50, tmp_path), reset_num_timesteps=False)
    assert len(find_checkpoints(tmp_path)) == 2


def cartpoles():
    return make_vec_env("CartPole-v1", 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=FORK, wrapper_class=ResumableWrapper)


def test_environments_in_other_processes_are_resumed_exactly(tmp_path):
    env = cartpoles()
    whole = EqRQRDQN("MlpPolicy", env, **SMALL).learn(120, ExactCheckpointCallback(60, tmp_path, keep=1))
    env.close()
    env = cartpoles()
    resumed = EqRQRDQN.resume(tmp_path, env)
    assert 60 <= resumed.num_timesteps < 120
    resumed.learn(120 - resumed.num_timesteps, reset_num_timesteps=False)
    env.close()
    assert resumed._n_updates == whole._n_updates > 20 and same(resumed, whole)
    bare = make_vec_env("CartPole-v1", 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=FORK)
    with pytest.raises(ValueError, match=r"env must be Monitor in .*got SubprocVecEnv: the environment is not built as in"):
        EqRQRDQN.resume(tmp_path, bare)
    bare.close()


def test_stock_agents_cannot_resume(tmp_path):
    model = DQN("MlpPolicy", ChainEnv(), buffer_size=100, device="cpu")
    with pytest.raises(ValueError, match=r"must be one of this package.*got DQN. Use SB3's CheckpointCallback"):
        model.learn(5, ExactCheckpointCallback(2, tmp_path))
