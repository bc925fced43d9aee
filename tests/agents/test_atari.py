"""The Atari-100K protocol, compared with ALE controlled directly."""

import cv2
import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_eqr.envs import atari, make_atari100k_env
from sb3_eqr.envs.atari import Atari100kWrapper


def games(env):
    return env.venv.envs


def test_all_names_of_a_game_and_unknown_games():
    assert {atari.atari_env_id(name) for name in ("Pong", "PongNoFrameskip-v4", "ALE/Pong-v5", "pong")} == {"ALE/Pong-v5"}
    assert {atari.atari_env_id(name) for name in ("MsPacman", "ms_pacman", "Ms Pacman")} == {"ALE/MsPacman-v5"}
    with pytest.raises(ValueError, match="Did you mean 'Pong'"):
        make_atari100k_env("Pnog")
    for other in ("PongNoFrameskip-v9", "PongDeterministic-v4"):  # a different protocol
        with pytest.raises(ValueError, match="Atari game such as 'Pong', got 'Pong"):
            make_atari100k_env(other)
    with pytest.raises(ValueError, match="n_envs"):
        make_atari100k_env("Pong", n_envs=0)
    with pytest.raises(ValueError, match="Atari game such as 'Pong', got 'CartPole-v1'"):
        make_atari100k_env("CartPole-v1")


def test_observations_and_rewards_match_the_emulator():
    seed = 5
    env = make_atari100k_env("Breakout", seed=seed)
    raw = gym.make("ALE/Breakout-v5", frameskip=1, repeat_action_probability=0.0).unwrapped
    obs = env.reset()
    screen, _ = raw.reset(seed=seed)
    for _ in range(raw.np_random.integers(1, 31)):  # no-ops
        screen, *_ = raw.step(0)

    def grey(frame):
        return cv2.resize(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), (84, 84), interpolation=cv2.INTER_AREA)

    stack = [np.zeros((84, 84), np.uint8)] * 3 + [grey(screen)]
    assert obs.shape == (1, 84, 84, 4) and obs.dtype == np.uint8
    assert np.array_equal(obs[0], np.stack(stack, axis=-1))
    rng = np.random.default_rng(0)
    for _ in range(120):
        action = int(rng.integers(4))
        screens, reward = [], 0.0
        for _ in range(4):
            screen, r, terminated, _, _ = raw.step(action)
            screens.append(screen)
            reward += r
        obs, rewards, dones, infos = env.step(np.array([action]))
        if dones[0]:
            obs = infos[0]["terminal_observation"][None]
        stack = [*stack[1:], grey(np.maximum(*screens[-2:]))]
        assert np.array_equal(obs[0], np.stack(stack, axis=-1))
        assert rewards[0] == np.sign(reward)
        if dones[0]:
            return  # a life was lost: SB3's wrapper now makes one more step
        assert not terminated


def test_no_fire_no_sticky_actions():
    env = make_atari100k_env("Breakout", seed=0)
    ale = games(env)[0].unwrapped.ale
    assert ale.getFloat("repeat_action_probability") == 0.0
    env.reset()
    quiet, waited, fired = (
        [env.step(np.array([action]))[0].copy() for action in actions][-1] for actions in ([0] * 50, [0] * 5, [1, 1, 0, 0, 0])
    )
    assert np.array_equal(waited, quiet)  # nothing moves until the agent presses FIRE
    assert not np.array_equal(fired, quiet)


@pytest.mark.parametrize("training", [True, False])
def test_life_loss_ends_an_episode_in_training_only(training):
    env = make_atari100k_env("Breakout", seed=0, training=training)
    env.reset()
    dones, scores = 0, []
    rng = np.random.default_rng(0)
    for _ in range(2000):
        _, rewards, done, infos = env.step(np.array([int(rng.integers(4))]))
        assert rewards[0] in ((0.0, 1.0) if training else (0.0, 1.0, 4.0, 7.0))
        dones += done[0]
        if "episode" in infos[0]:
            scores.append(infos[0]["episode"])
            break
    assert dones == (5 if training else 1)  # Breakout has five lives
    assert scores[0]["l"] > 100 and scores[0]["r"] >= 0


def test_games_are_truncated_at_the_step_limit(monkeypatch):
    monkeypatch.setattr(atari, "MAX_STEPS", 30)
    env = make_atari100k_env("Pong", seed=0)
    env.reset()
    for step in range(1, 61):
        _, _, dones, infos = env.step(np.array([0]))
        assert dones[0] == (step % 30 == 0)
        if dones[0]:
            assert infos[0]["TimeLimit.truncated"] and infos[0]["episode"]["l"] == 30


def test_the_step_limit_follows_the_paper():
    env = make_atari100k_env("Pong", n_envs=2, seed=0)
    assert atari.MAX_STEPS * atari.FRAME_SKIP == 108_000 and env.num_envs == 2
    layer = games(env)[0]
    while not isinstance(layer, atari.TimeLimit):  # RL Zoo replaces the class in gymnasium.wrappers
        layer = layer.env
    assert layer._max_episode_steps == 27_000
    env.reset()
    first, second = (env.step(np.array([0, 0]))[0][i] for i in (0, 1))
    assert not np.array_equal(first, second)  # different seeds give different no-ops


def test_the_wrapper_for_rl_zoo_gives_the_training_environment():
    """The same random actions give the same observations, clipped rewards and ends, with other wrappers in between."""
    ours = make_atari100k_env("Breakout", seed=3)
    zoo = VecFrameStack(make_vec_env("BreakoutNoFrameskip-v4", seed=3, wrapper_class=Atari100kWrapper), 4)
    rng = np.random.default_rng(0)
    assert np.array_equal(ours.reset(), zoo.reset())
    ends = 0
    for _ in range(250):
        action = rng.integers(0, 4, 1)
        a, b = ours.step(action), zoo.step(action)
        assert np.array_equal(a[0], b[0]) and a[1] == b[1] and a[2] == b[2]
        ends += int(a[2][0])
    assert ends > 1


def test_the_wrapper_rejects_a_different_protocol():
    with pytest.raises(ValueError, match=r"got .*'repeat_action_probability': 0.25.*NoFrameskip-v4 name"):
        make_vec_env("ALE/Pong-v5", wrapper_class=Atari100kWrapper)
    kwargs = {"frameskip": 1, "repeat_action_probability": 0.0}
    env = make_vec_env("ALE/Pong-v5", env_kwargs=kwargs, wrapper_class=Atari100kWrapper)
    assert env.observation_space.shape == (84, 84, 1)
