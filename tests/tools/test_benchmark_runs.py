"""One run of a benchmark: its protocol, its checkpoints and its files."""

import json
import pathlib
import threading
import time

import gymnasium as gym
import numpy as np
import pytest
import yaml
from filelock import FileLock
from rl_zoo3.utils import create_test_env, get_saved_hyperparams
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_eqr.benchmark import runs, training
from sb3_eqr.benchmark.agents import Agent, find_agent
from sb3_eqr.benchmark.evaluation import evaluate, make_evaluation_env
from sb3_eqr.benchmark.runs import ERROR, LOCK, RESULT, STOPPED, SUITE, Run, Settings
from sb3_eqr.benchmark.suites import choose, load_suite, read_suite
from sb3_eqr.benchmark.training import execute
from sb3_eqr.common.saving.checkpoints import find_checkpoints
from sb3_eqr.envs import make_atari100k_env
from tests.toys import ChainEnv

STEPS = 160
OFTEN = Settings(checkpoint_seconds=0.0)
SHARED = "policy: MlpPolicy\n  n_timesteps: 1000\n  policy_kwargs: {net_arch: [16]}\n"
OFF_POLICY = "  learning_starts: 40\n  batch_size: 8\n  train_freq: 8\n  gradient_steps: 2\n  buffer_size: 100\n"
NORMALISED = "  normalize: {norm_obs: true, norm_reward: true}\n"
EQR = SHARED.replace("[16]", "[16], n_blocks: 2") + OFF_POLICY + "  n_steps: 3\n  prediction_depth: 2\n"
AGENTS = {
    "eqr_rainbow": EQR.replace("}", ", v_min: 0.0, v_max: 100.0}") + NORMALISED + "  resets: {interval: 12}\n",
    "qrdqn": SHARED + OFF_POLICY + "  n_steps: 3\n",
    "dqn": SHARED + OFF_POLICY + "  n_envs: 2\n" + NORMALISED,
    "ppo": SHARED + "  n_envs: 2\n  n_steps: 16\n  batch_size: 8\n  n_epochs: 1\n",
}


def protocol(steps=STEPS, env_id="CartPole-v1", epsilon=0.0, n_envs=2, max_steps=40, points=4):
    evaluation = {"episodes": 5, "n_envs": n_envs, "epsilon": epsilon, "max_steps": max_steps, "preprocessing": {}}
    evaluation["curve"] = {"points": points, "episodes": 3}
    return {"env_id": env_id, "steps": steps, "preprocessing": {}, "evaluation": evaluation}


def make_run(folder, algo, entry=None, game="CartPole-v1", command="", **kwargs):
    find_agent(algo)  # registers the agents of this package
    entry = yaml.safe_load(f"  {AGENTS[algo] if entry is None else entry}")
    return Run(folder / "run", Agent(algo, algo, folder), "own", game, 3, protocol(env_id=game, **kwargs), entry, command)


def result_of(run):
    return json.loads((run.folder / RESULT).read_text())


def scores_of(run):
    result = result_of(run)
    return result["evaluations"], result["training"]


def interrupt(run, step, settings=OFTEN):
    """Execute the run until an exception at a step."""
    on_step = training.RunCallback._on_step

    def step_or_stop(self):
        if self.num_timesteps >= step:
            raise KeyError(f"stopped at {step}")
        return on_step(self)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="stopped at"):
        patch.setattr(training.RunCallback, "_on_step", step_or_stop)
        execute(run, settings)


def test_environments_of_a_package(tmp_path, monkeypatch):
    """Registered when the package is imported, in the process of the run; a package that is missing is named."""
    pole = "gymnasium.envs.classic_control:CartPoleEnv"
    code = f"import gymnasium\ngymnasium.register('OwnPole-v0', '{pole}', max_episode_steps=40)"
    (tmp_path / "grid_package.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    run = make_run(tmp_path, "dqn", game="OwnPole-v0")
    try:
        assert execute(run, Settings(gym_packages=["grid_package"])) == "finished"
    finally:
        gym.registry.pop("OwnPole-v0", None)
    assert len(result_of(run)["evaluations"][-1]["scores"]) == 5
    with pytest.raises(ValueError, match=r"--gym-packages: 'no_package' cannot be imported .* add its folder to PYTHONPATH"):
        execute(make_run(tmp_path / "other", "dqn"), Settings(gym_packages=["no_package"]))


@pytest.mark.parametrize("algo", AGENTS)
def test_an_interrupted_run_has_the_scores_of_an_uninterrupted_one(algo, tmp_path):
    undisturbed, stopped = make_run(tmp_path / "undisturbed", algo), make_run(tmp_path / "stopped", algo)
    assert execute(undisturbed, Settings()) == "finished"
    for step in (70, 130):
        interrupt(stopped, step)
        assert "stopped at" in (stopped.folder / ERROR).read_text() and len(find_checkpoints(stopped.folder)) == 1
    assert execute(stopped, OFTEN) == "finished"
    assert scores_of(stopped) == scores_of(undisturbed)
    result = result_of(stopped)
    assert result["attempts"] == 3 and result["resumed_exactly"]
    assert 0 < result["resumed_at"][0] < 70 < result["resumed_at"][1] < 130
    assert sorted(path.name for path in stopped.folder.iterdir()) == [LOCK, RESULT]
    assert execute(stopped, OFTEN) == "finished"


def test_the_contents_of_the_result(tmp_path):
    run = make_run(tmp_path, "eqr_rainbow", points=4, command="sb3-eqr benchmark run x")
    execute(run, Settings())
    result = result_of(run)
    found = [(row["step"], row["kind"], len(row["scores"])) for row in result["evaluations"]]
    assert found == [(40, "curve", 3), (80, "curve", 3), (120, "curve", 3), (160, "final", 5)]
    training = result["training"]
    assert training["step"] == np.cumsum(training["length"]).tolist() and training["step"][-1] <= STEPS
    assert training["score"] == training["length"]  # raw scores of CartPole, although the agent learns from normalised rewards
    assert result["entry"]["hyperparameters"] == run.entry and result["protocol"] == run.protocol
    machine = {"device": "cpu", "threads": 1, "updates": "eager"}
    assert result["versions"]["torch"] and result["machine"].items() >= machine.items()
    assert result["wall_clock_s"] >= result["training_seconds"] > 0
    assert result["steps_per_second"] == pytest.approx(STEPS / result["training_seconds"], abs=0.01)
    assert {"aet_loss", "symmetry_loss", "reward_loss", "td_loss", "td_state_gradient", "step"} <= result["losses"][-1].keys()


def test_saved_models_are_the_evaluated_agents_in_the_format_of_rl_zoo(tmp_path):
    """With the normalisation of the observations; an interrupted run leaves no second copy."""
    run, settings = make_run(tmp_path, "dqn", command="made by"), Settings(save_models=True)
    interrupt(run, STEPS // 2, settings)
    execute(run, settings)
    assert sorted(path.name for path in run.folder.iterdir()) == [LOCK, "models", RESULT]
    folder = run.folder / "models" / "dqn" / "CartPole-v1_1"
    hyperparams, statistics = get_saved_hyperparams(str(folder / "CartPole-v1"))
    env = create_test_env("CartPole-v1", stats_path=statistics, hyperparams=hyperparams)
    model = DQN.load(folder / "CartPole-v1.zip", env=env)
    assert model.num_timesteps == STEPS and env.obs_rms.count > STEPS
    scores, lengths = evaluate(model, run.protocol, run.protocol["evaluation"]["episodes"], run.seed)
    final = result_of(run)["evaluations"][-1]
    assert (scores, lengths) == (final["scores"], final["lengths"])
    assert yaml.unsafe_load((folder / "CartPole-v1" / "args.yml").read_text())["env"] == "CartPole-v1"
    assert (folder / "CartPole-v1" / "command.txt").read_text() == "made by"


def test_evaluations_do_not_change_training(tmp_path):
    """Training and the final scores do not depend on the number of evaluations."""
    few, many = (make_run(tmp_path / str(points), "eqr_rainbow", points=points) for points in (1, 9))
    for run in (few, many):
        execute(run, Settings())
    few, many = result_of(few), result_of(many)
    assert len(few["evaluations"]) == 1 and len(many["evaluations"]) > 5
    assert few["training"] == many["training"] and few["losses"] == many["losses"]
    assert few["evaluations"][-1] == many["evaluations"][-1]


class Corridor(gym.Env):
    """The seed determines the length of episodes, so the environments of a batch end at different times."""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(2)
    episodes = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.length = 3 if seed % 2 else 30
        self.left = self.length
        return np.zeros(2, dtype=np.float32), {}

    def step(self, action):
        self.left -= 1
        return np.zeros(2, dtype=np.float32), float(action), self.left == 0, False, {}


class Fixed:
    """An agent that always takes action 0."""

    action_space = Corridor.action_space

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        return np.zeros(len(observation), dtype=int), None

    def get_vec_normalize_env(self):
        return None


@pytest.fixture
def corridor(register):
    return register("Corridor-v0", Corridor)


def test_short_episodes_are_not_counted_more_often(corridor):
    """Ten episodes in two environments are five of 30 steps and five of 3; the first ten to end would be mostly short."""
    state = np.random.get_state()[1].copy()
    scores, lengths = evaluate(Fixed(), protocol(env_id=corridor), 10, seed=0)
    assert sorted(lengths) == [3] * 5 + [30] * 5 and scores == [0.0] * 10
    assert (np.random.get_state()[1] == state).all()


def test_no_two_runs_are_evaluated_on_the_same_episodes(corridor, monkeypatch):
    seeds, reset = [], Corridor.reset
    monkeypatch.setattr(Corridor, "reset", lambda env, *, seed=None, **kwargs: seeds.append(seed) or reset(env, seed=seed))
    for seed in (0, 1, 2):
        evaluate(Fixed(), protocol(env_id=corridor, n_envs=4), 4, seed)
    given = [seed for seed in seeds if seed is not None]
    assert len(given) == len(set(given)) == 3 * 4
    assert min(given) >= 1_000_000  # training has smaller seeds


def test_epsilon_and_the_step_limit(corridor):
    """Half of the random actions are 1, and only they score."""
    limited = protocol(env_id=corridor, epsilon=0.4, max_steps=20)
    scores, lengths = evaluate(Fixed(), limited, 200, seed=0)
    assert set(lengths) == {3, 20}
    assert sum(scores) / sum(lengths) == pytest.approx(0.2, abs=0.025)  # three standard deviations of 2,300 steps
    few = [evaluate(Fixed(), limited, 10, seed) for seed in (0, 0, 1)]
    assert few[0] == few[1] != few[2]


def test_evaluations_wait_after_a_reset(tmp_path):
    """
    From step 48 on, two updates follow each round of 8 steps. The round after step 96 starts with the 13th update, before
    which the network is reset; after three rounds half of the 12 updates to the next reset are done. Skipped evaluations are
    not made up for.
    """
    run = make_run(tmp_path, "eqr_rainbow", points=20)
    execute(run, Settings())
    steps = [row["step"] for row in result_of(run)["evaluations"] if row["kind"] == "curve"]
    assert steps == [*range(8, 97, 8), 96 + 2 * 8 + 1, *range(120, 160, 8)]


def test_a_run_locked_by_another_process_is_skipped(tmp_path):
    run = make_run(tmp_path, "dqn")
    run.folder.mkdir(parents=True)
    with FileLock(run.folder / LOCK):
        assert execute(run, Settings()) == "busy"
    assert not (run.folder / RESULT).exists()


def test_a_full_disk_stops_the_run_and_keeps_its_last_checkpoint(tmp_path, monkeypatch):
    undisturbed, full = make_run(tmp_path / "undisturbed", "qrdqn"), make_run(tmp_path / "full", "qrdqn")
    execute(undisturbed, Settings())
    save, calls = training.write_checkpoint, []

    def no_space_at_the_fifth(folder, model, record, with_buffer=True):
        calls.append(model.num_timesteps)
        if len(calls) == 5:
            monkeypatch.setattr(type(model), "save_replay_buffer", no_space)
        save(folder, model, record, with_buffer=with_buffer)

    def no_space(self, path):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(training, "write_checkpoint", no_space_at_the_fifth)
    with monkeypatch.context(), pytest.raises(OSError, match="No space left"):
        execute(full, OFTEN)
    assert [path.name for path in full.folder.glob("*checkpoint*")] == [f"checkpoint-{calls[3]:012d}"]
    monkeypatch.undo()
    execute(full, Settings())
    assert scores_of(full) == scores_of(undisturbed)


def atari_protocol(game, n_envs=2, **evaluation):
    """The protocol of the suite with fewer environments."""
    found = choose(load_suite("atari100k"), [game], None).protocol(game)
    return found | {"evaluation": found["evaluation"] | {"n_envs": n_envs, **evaluation}}


def test_atari_is_evaluated_on_full_games_as_in_the_paper():
    """The protocol of the suite gives the same environment as ``make_atari100k_env(training=False)``."""
    env = make_evaluation_env(atari_protocol("Boxing"), Fixed(), seed=4)
    plain = make_atari100k_env("Boxing", n_envs=2, seed=4, training=False)
    rng = np.random.default_rng(0)
    assert np.array_equal(env.reset(), plain.reset())
    total = np.zeros(2)
    for _ in range(50):
        actions = rng.integers(0, env.action_space.n, 2)
        (obs, rewards, dones, _), (plain_obs, plain_rewards, plain_dones, _) = env.step(actions), plain.step(actions)
        assert np.array_equal(obs, plain_obs) and np.array_equal(rewards, plain_rewards) and np.array_equal(dones, plain_dones)
        total += rewards
    assert np.abs(total).max() > 0


@pytest.mark.parametrize("normalize", [{"norm_obs": False}, {"norm_obs_keys": ["vec"]}, {}], ids=str)
def test_evaluation_normalises_what_training_did(register, normalize):
    class Trained(Fixed):
        def get_vec_normalize_env(self):
            return trained

    def same():
        np.random.seed(0)  # the constructor draws the observations
        return SimpleMultiObsEnv(channel_last=False, random_start=False)

    register("Multi-v0", same)
    trained = VecNormalize(make_vec_env("Multi-v0", seed=3), **{"norm_obs_keys": ["vec"], **normalize})
    trained.reset()
    trained.step(np.array([1]))
    env = make_evaluation_env(protocol(env_id="Multi-v0", n_envs=1, max_steps=None), Trained(), seed=4)
    plain = make_vec_env("Multi-v0", seed=4)
    assert np.array_equal(env.reset()["vec"], trained.normalize_obs(plain.reset())["vec"])


def test_evaluation_has_the_wrapper_of_the_vectorised_environment(register):
    wrapper = {"stable_baselines3.common.vec_env.VecExtractDictObs": {"key": "vec"}}
    given = protocol(env_id=register("Multi-v0", lambda: SimpleMultiObsEnv(channel_last=False)), max_steps=None)
    given["preprocessing"] = {"vec_env_wrapper": [wrapper]}
    assert make_evaluation_env(given, Fixed(), seed=4).observation_space.shape == (5,)


def test_scores_and_lengths_of_atari_are_those_of_full_games():
    """Random play of Breakout lasts about 120 to 300 steps."""
    state = np.random.get_state()[1].copy()
    scores, lengths = evaluate(Fixed(), atari_protocol("Breakout", epsilon=1.0), 3, seed=0)
    assert len(scores) == len(lengths) == 3 and len(set(lengths)) > 1
    assert all(100 < length < 500 for length in lengths) and 0 < sum(scores) < 50
    assert (np.random.get_state()[1] == state).all()


def timeout_of_the_last(checkpoint, run, folder, done, timeout):
    """The time-out of the last stored transition after an inexact resume."""
    load = DQN.load_replay_buffer

    def ended(model, *args):
        load(model, *args)
        last = model.replay_buffer.pos - 1
        model.replay_buffer.dones[last], model.replay_buffer.timeouts[last] = done, timeout

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DQN, "load_replay_buffer", ended)
        model = training.load_checkpoint(checkpoint, training.build(run, Settings(), folder / "logs")[0])[0]
    return float(model.replay_buffer.timeouts[model.replay_buffer.pos - 1, 0])


def test_box2d_resumes_with_a_new_episode_and_reports_it(tmp_path, monkeypatch):
    """LunarLander cannot be saved in the middle of an episode."""
    run = make_run(tmp_path, "dqn", game="LunarLander-v3", steps=300)
    interrupt(run, 100)
    ends = [(1, 0), (1, 1), (0, 0)]  # done and time-out of the last transition: only what has not ended is cut here
    assert [timeout_of_the_last(find_checkpoints(run.folder)[-1], run, tmp_path, *end) for end in ends] == [0, 1, 1]
    counts, count = [], lambda self: counts.append(self.model.get_vec_normalize_env().obs_rms.count)
    monkeypatch.setattr(training.RunCallback, "_on_training_start", count)
    monkeypatch.setattr(training.RunCallback, "note_progress", lambda self: None)
    execute(run, Settings())
    assert counts == [pytest.approx(96, abs=10)]  # the statistics of observations are restored
    result = result_of(run)
    assert not result["resumed_exactly"] and result["resumed_at"] == [96]
    assert result["training"]["step"] and result["evaluations"][-1]["step"] == 300


def test_a_run_is_stopped_after_a_time_and_continues(tmp_path, monkeypatch):
    """With a row and a checkpoint; then it has the scores of a run that was not stopped."""
    undisturbed, stopped = make_run(tmp_path / "undisturbed", "qrdqn"), make_run(tmp_path / "stopped", "qrdqn")
    execute(undisturbed, Settings())
    ends = iter([False] * 10 + [True])
    with monkeypatch.context() as patch:
        patch.setattr(Settings, "is_over", lambda settings: next(ends))
        assert execute(stopped, Settings()) == "stopped"
    row = json.loads((stopped.folder / STOPPED).read_text())
    assert row["stopped_at"] == 80 and row["training"]["step"][-1] <= 80 and row["machine"]["threads"] == 1
    assert [path.name for path in find_checkpoints(stopped.folder)] == ["checkpoint-000000000080"]
    assert stopped.state().name == "waiting" and stopped.state().step == 80
    assert execute(stopped, Settings(stop_at=time.time() + 600)) == "finished"
    assert scores_of(stopped) == scores_of(undisturbed) and not (stopped.folder / STOPPED).exists()


@pytest.mark.parametrize("algo, n_updates", [("eqr_rainbow", 30), ("qrdqn", 30), ("ppo", 5)])
def test_the_evaluated_agent_has_made_all_its_updates(algo, n_updates, tmp_path, monkeypatch):
    """By hand: (160 - 40) / 8 rollouts after the start with 2 updates each; PPO's 160 / (16 * 2) with one epoch each."""
    seen, add = {}, training.add_evaluation

    def watched(model, run, record, kind, n_episodes):
        seen[kind] = model._n_updates, model.num_timesteps
        add(model, run, record, kind, n_episodes)

    monkeypatch.setattr(training, "add_evaluation", watched)
    execute(make_run(tmp_path, algo), Settings())
    assert seen["final"] == (n_updates, STEPS)


def test_a_run_that_ends_while_its_state_is_read_is_running(tmp_path, monkeypatch):
    """Its progress is removed between two looks."""
    run = make_run(tmp_path, "dqn")
    run.folder.mkdir(parents=True)
    monkeypatch.setattr(Run, "is_locked", lambda self: True)
    monkeypatch.setattr(pathlib.Path, "is_file", lambda path: path.name == "progress.json")
    assert run.state().name == "running"


def test_two_commands_can_plan_games_in_one_folder(tmp_path, monkeypatch):
    """The second one waits until the first one has written its games, which it keeps."""
    suite, write = load_suite("minatar"), runs.write_suite
    games = ["Breakout", "Asterix", "Freeway", "Seaquest"]

    def slow(*args):
        time.sleep(0.05)
        write(*args)

    monkeypatch.setattr(runs, "write_suite", slow)
    threads = [threading.Thread(target=runs.write_plan, args=(tmp_path, choose(suite, [game], 9), [])) for game in games]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(read_suite(tmp_path / SUITE).games) == sorted(games)


def test_an_agent_with_a_class_of_its_own_resumes(own_extractor, tmp_path):
    """Its checkpoint holds a pickle of the class, which the entry has already run."""
    entry = (
        "{policy: MlpPolicy, n_timesteps: 1000, prediction_depth: 0, learning_starts: 40, train_freq: 20, gradient_steps: 1, "
    )
    entry += f'policy_kwargs: "{own_extractor}"}}'
    run = make_run(tmp_path, "eqr_qrdqn", entry)
    interrupt(run, 100)
    assert execute(run, Settings()) == "finished" and result_of(run)["resumed_exactly"]


def test_the_noise_of_gsde_is_not_restored(tmp_path):
    entry = "{policy: MlpPolicy, n_timesteps: 1000, n_steps: 32, batch_size: 8, n_epochs: 1, use_sde: true}"
    run = make_run(tmp_path, "ppo", entry, game="Pendulum-v1")
    interrupt(run, 100)
    execute(run, Settings())
    assert not result_of(run)["resumed_exactly"]


def test_models_of_runs_without_wrappers_are_saved_without_them(tmp_path):
    """RL Zoo reads "null" in a saved entry as a wrapper or a number of frames."""
    run = make_run(tmp_path, "dqn", AGENTS["dqn"] + "  frame_stack: null\n  vec_env_wrapper: null\n")
    execute(run, Settings(save_models=True))
    folder = next(run.folder.glob("models/dqn/*/CartPole-v1"))
    hyperparams, stats = get_saved_hyperparams(str(folder))
    env = create_test_env("CartPole-v1", 1, stats, 0, hyperparams=hyperparams, vec_env_cls=DummyVecEnv, should_render=False)
    assert env.observation_space.shape == (4,) and not isinstance(env, VecFrameStack)
    env.close()


def test_resuming_needs_the_package_that_registers_the_environment(tmp_path, sb3_eqr, register):
    """Said before a run starts, as when the benchmark was planned."""
    evaluation = {"episodes": 1, "n_envs": 1, "epsilon": 0.0, "curve": {"points": 1, "episodes": 1}}
    own = {"mine": {"games": ["Mine"], "env_id": register("Mine-v0", ChainEnv), "steps": 60, "evaluation": evaluation}}
    (tmp_path / "own.yml").write_text(yaml.safe_dump(own))
    suite = load_suite("mine", tmp_path / "own.yml")
    runs.write_plan(tmp_path / "b", suite, runs.plan_runs(tmp_path / "b", suite, ["eqr_qrdqn"], [0], ""))
    del gym.registry["Mine-v0"]
    shown = sb3_eqr(f"benchmark run {tmp_path / 'b'}", code=2)
    assert "'Mine-v0' is not registered with gymnasium" in shown.err and "--gym-packages PACKAGE, also to resume" in shown.err
