"""The pixel environments: sliding ball, pendulum, star field."""

import json
import warnings
from math import pi, sqrt

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.utils.env_checker import check_env
from scipy.linalg import expm
from stable_baselines3.common.env_util import make_vec_env

from sb3_eqr import EqRQRDQN, envs
from sb3_eqr.envs import PixelPendulum, PlanarBody, SlidingBall, StarField
from sb3_eqr.envs.star_field import MOVE, NEAR, STAR_RADIUS, TURN, VIEW, orthonormalized, quaternion_rotation
from tests.models import SMALL

IDS = ["SlidingBall-v0", "SlidingBallTorus-v0", "PixelPendulum-v0", "StarField-v0", "StarFieldRotations-v0"]
CHANNELS = dict(zip(IDS, [1, 1, 2, 3, 3], strict=True))
N_ACTIONS = dict(zip(IDS, [2, 4, 3, 12, 6], strict=True))
FORWARD, BACK, RIGHT, LEFT, UP, DOWN = range(6, 12)

on_every_world = pytest.mark.parametrize("env_id", IDS)


def assert_same_picture(picture, other):
    """Up to the rounding of pixels."""
    np.testing.assert_allclose(picture.astype(int), other.astype(int), atol=1)


@on_every_world
def test_the_environment_passes_the_checker(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id, render_mode="rgb_array").unwrapped)
    env = gym.make(env_id, render_mode="rgb_array")
    assert env.observation_space == gym.spaces.Box(0, 255, (48, 48, CHANNELS[env_id]), np.uint8)
    assert env.action_space == gym.spaces.Discrete(N_ACTIONS[env_id])
    assert env.spec.max_episode_steps == (200 if env_id == "PixelPendulum-v0" else 100)
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (192, 192, 3) and picture.dtype == np.uint8 and picture.max() > 100
    assert gym.make(env_id).unwrapped.render() is None
    gym.envs.registration.EnvSpec.from_json(env.spec.to_json())


@on_every_world
def test_the_seed_determines_the_episodes(env_id):
    def play(seed):
        env = gym.make(env_id)
        rng = np.random.default_rng(7)
        observations = [env.reset(seed=seed)[0], env.reset()[0]]
        for _ in range(20):
            observations.append(env.step(rng.integers(N_ACTIONS[env_id]))[0])
        return np.array(observations)

    first = play(3)
    assert (first == play(3)).all()
    assert (first[0] != play(4)[0]).any() and (first[0] != first[1]).any()
    assert first.max() > 100


@on_every_world
def test_an_agent_can_be_built(env_id):
    model = EqRQRDQN("CnnPolicy", make_vec_env(env_id), **SMALL)
    actions, _ = model.predict(model.env.reset())
    assert 0 <= actions[0] < N_ACTIONS[env_id]
    gym_env = gym.make(env_id)
    observation, _ = gym_env.reset(seed=0)
    gym_env.step(model.predict(observation)[0])  # an array of shape ()


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: SlidingBall(3), r"dimensions must be an integer in \[1, 2\], got 3"),
        (lambda: SlidingBall(size=35), "size must be an integer >= 36, got 35"),
        (lambda: SlidingBall(n_steps=2), "n_steps must be an integer >= 3, got 2"),
        (lambda: SlidingBall(n_distractors=-1), "n_distractors must be an integer >= 0, got -1"),
        (lambda: SlidingBall(goal=[1.0]), r"goal must be .* shape \(1,\) with values in \[0, 1\), got \[1.0\]"),
        (lambda: SlidingBall(goal=[0.1, 0.2]), r"goal must be .* shape \(1,\) .*, got \[0.1, 0.2\]"),
        (lambda: SlidingBall(2).draw([0.1, np.nan]), r"position must be .* shape \(2,\) .*, got \[0.1, nan\]"),
        (lambda: SlidingBall().reset(options={"position": ["a"]}), r"position must be an array of shape \(1,\)"),
        (lambda: SlidingBall().reset(options={"place": [0]}), "options must only contain position, got 'place'"),
        (lambda: SlidingBall().step(2), r"action must be in Discrete\(2\), got 2"),
        (lambda: PixelPendulum(size=35.0), "size must be an integer >= 36, got 35.0"),
        (lambda: PixelPendulum(n_torques=1), "n_torques must be an integer >= 3, got 1"),
        (lambda: PixelPendulum(n_torques=4), "n_torques must be odd, so that the middle torque is 0, got 4"),
        (lambda: PixelPendulum().reset(options={"velocity": 9}), r"velocity must be a finite number in \[-8, 8\], got 9"),
        (lambda: PixelPendulum().reset(options={"angle": np.inf}), "angle must be a finite number, got inf"),
        (lambda: PixelPendulum().step(-1), r"action must be in Discrete\(3\), got -1"),
        (lambda: StarField(size=0), "size must be an integer >= 36, got 0"),
        (lambda: StarField(n_stars=0), "n_stars must be an integer >= 1, got 0"),
        (lambda: StarField(layout_seed=-1), "layout_seed must be an integer >= 0, got -1"),
        (lambda: StarField().reset(options={"rotation": -np.eye(3)}), "rotation must be a .* rotation matrix"),
        (lambda: StarField().reset(options={"rotation": 2 * np.eye(3)}), "rotation must be a .* rotation matrix"),
        (lambda: StarField().reset(options={"translation": [0, 0, 1]}), r"translation must be an array of shape \(3,\)"),
        (lambda: StarField(False).reset(options={"translation": [0, 0, 0]}), "must only contain rotation, got 'translation'"),
        (lambda: StarField(False).step(6), r"action must be in Discrete\(6\), got 6"),
        (lambda: PlanarBody().reset(options={"position": (np.nan, 0.0)}), "position must be two finite numbers"),
        (lambda: PlanarBody().reset(options={"position": (0.0, 0.0, 0.0)}), "position must be two finite numbers"),
        (lambda: PlanarBody().reset(options={"pos": (0.0, 0.0)}), "must only contain position, angle, got 'pos'"),
    ],
)
def test_invalid_arguments_raise(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_the_ball_moves_one_step_per_action():
    env = SlidingBall(n_steps=5)
    first, info = env.reset(options={"position": [0.3]})
    assert info["position"] == [0.3]
    for place in (0.1, 0.9, 0.7, 0.5, 0.3):
        observation, reward, terminated, truncated, info = env.step(0)
        np.testing.assert_allclose(info["position"], [place])
        assert (reward, terminated, truncated) == (0.0, False, False)
        assert (observation == env.draw(info["position"])).all()
    assert info["position"] == [0.3] and (observation == first).all()
    assert (env.step(1)[0] != first).any()
    np.testing.assert_allclose(env.position, [0.5])
    assert (env.step(0)[0] == first).all()
    places = np.array([env.reset(seed=seed)[1]["position"][0] for seed in range(200)])
    assert (np.histogram(places, 4, (0, 1))[0] > 30).all()


def test_the_directions_of_the_torus_actions():
    env = SlidingBall(2, n_steps=8)
    for action, shift in enumerate([(-6, 0), (6, 0), (0, -6), (0, 6)]):  # 48 pixels in eight steps
        first, _ = env.reset(options={"position": [0.5, 0.25]})
        assert (env.step(action)[0] == np.roll(first, shift, axis=(0, 1))).all()


def test_the_disc_is_complete_everywhere():
    env = SlidingBall(2)
    middle = env.draw([0.5, 0.5])[:, :, 0]
    assert middle[24, 24] == 255 and middle[24, 19] == 255 and middle[24, 16] == 0  # radius 6 about (24, 24)
    assert (env.draw([0, 0])[:, :, 0] == np.roll(middle, (24, 24), axis=(0, 1))).all()
    sums = [env.draw(place).sum() / 255 for place in np.random.default_rng(0).random((200, 2))]
    np.testing.assert_allclose(sums, pi * 6**2, rtol=0.01)
    one = SlidingBall()
    assert (one.draw([0.5])[:, :, 0] == middle).all()
    np.testing.assert_allclose([one.draw([place]).sum() / 255 for place in np.linspace(0, 0.999, 97)], pi * 6**2, rtol=0.01)


def test_reaching_the_goal():
    env = SlidingBall(goal=[0.98], n_steps=10, render_mode="rgb_array")
    env.reset(options={"position": [0.15]})
    assert env.step(0)[1:3] == (0.0, False)  # at 0.05, which is 0.07 away across the edge
    assert env.step(0)[1:3] == (1.0, True)  # at 0.95
    assert (env.render()[:, :, 1].astype(int) - env.render()[:, :, 0]).max() > 80
    env = SlidingBall(2, n_steps=4, goal=(0.5, 0.5))
    env.reset(options={"position": [0.25, 0.75]})
    assert env.step(1)[1:3] == (0.0, False)  # at the goal in one axis only
    assert env.step(2)[1:3] == (1.0, True)
    env = SlidingBall(n_steps=3, goal=[0.5])
    starts = np.array([env.reset(seed=seed)[1]["position"][0] for seed in range(100)])
    assert (abs(starts - 0.5) > 1 / 6).all()


def test_distractors_jump_behind_the_ball():
    env, alone = SlidingBall(2, n_distractors=3), SlidingBall(2)
    observation, info = env.reset(seed=0, options={"position": [0.0, 0.0]})
    seen = []
    for action in (0, 1) * 150:
        ball = alone.draw(info["position"])
        assert (observation[ball == 255] == 255).all() and (observation >= ball).all()
        assert observation[ball == 0].max() == 204  # 0.8 of 255
        seen.append(observation[12:36, 12:36] > 0)  # where the ball never is
        observation, _, _, _, info = env.step(action)
    # A disc of radius 6 covers a pixel, at least in part, if its centre is nearer than 6.5; three do so independently.
    assert np.mean(seen) == pytest.approx(1 - (1 - pi * 6.5**2 / 48**2) ** 3, abs=0.01)
    assert np.mean(seen, axis=0).min() > 0.07 and np.mean(seen, axis=0).max() < 0.27  # everywhere as often: 0.163 ± 0.021
    again, _ = SlidingBall(2, n_distractors=3).reset(seed=0)
    assert (again == env.reset(seed=0)[0]).all()
    start = SlidingBall(2).reset(seed=7)[1]["position"]
    np.testing.assert_array_equal(env.reset(seed=7)[1]["position"], start)  # distractors do not change the ball's start


def test_the_pendulum_matches_gymnasiums():
    env, other = PixelPendulum(n_torques=5), PendulumEnv()
    rng = np.random.default_rng(0)
    for seed in range(3):
        _, info = env.reset(seed=seed)
        other.reset()
        other.state = np.array([info["angle"], info["velocity"]])
        for action in rng.integers(0, 5, 100):
            _, reward, terminated, truncated, info = env.step(action)
            _, expected, *_ = other.step(np.array([action - 2.0]))
            np.testing.assert_allclose(np.exp(1j * info["angle"]), np.exp(1j * other.state[0]), atol=1e-9)
            np.testing.assert_allclose([info["velocity"], reward], [other.state[1], expected], atol=1e-9)
            assert -pi <= info["angle"] <= pi and not (terminated or truncated)


def test_the_pendulum_without_gravity():
    env = PixelPendulum(gravity=False, n_torques=5)
    env.reset(options={"angle": 0.3, "velocity": 2.0})
    for _ in range(20):  # one second: the energy ω²/6 is constant, bit for bit
        _, reward, _, _, info = env.step(2)
        assert info["velocity"] == 2.0 and reward == 0
    np.testing.assert_allclose(info["angle"], 2.3)
    np.testing.assert_allclose(env.step(4)[4]["velocity"], 2.75)  # 3 · 5 · 0.05 more
    np.testing.assert_allclose(env.step(1)[4]["velocity"], 2.375)
    for _ in range(20):
        info = env.step(4)[4]
    assert info["velocity"] == 8  # clipped


@pytest.mark.parametrize("gravity", [True, False])
def test_the_mirrored_pendulum(gravity):
    env, mirror = PixelPendulum(gravity, n_torques=7), PixelPendulum(gravity, n_torques=7)
    first, info = env.reset(seed=2)
    other, _ = mirror.reset(options={key: -value for key, value in info.items()})
    assert (first == other[:, ::-1]).all()
    assert env.torques[3] == 0 and (env.torques == -env.torques[::-1]).all() and (np.diff(env.torques) > 0).all()
    for action in np.random.default_rng(3).integers(0, 7, 300):
        observation, reward, _, _, info = env.step(action)
        other, mirrored_reward, _, _, mirrored = mirror.step(6 - action)
        assert info == {key: -value for key, value in mirrored.items()} and reward == mirrored_reward
        assert (observation == other[:, ::-1]).all()


def test_rotating_the_pendulum_without_gravity_changes_no_torque():
    env, turned = PixelPendulum(gravity=False), PixelPendulum(gravity=False)
    _, info = env.reset(seed=4)
    turned.reset(options={"angle": info["angle"] + pi / 2, "velocity": info["velocity"]})
    for action in np.random.default_rng(3).integers(0, 3, 100):
        observation, other = env.step(action)[0], turned.step(action)[0]
        assert_same_picture(np.rot90(observation), other)  # anticlockwise


def test_the_velocity_is_observable():
    env = PixelPendulum()
    present, _ = env.reset(options={"angle": 3.0, "velocity": 5.0})
    for action in (2, 1, 0):
        previous, present = present, env.step(action)[0]
        assert_same_picture(present[:, :, 0], previous[:, :, 1])
    upright = env.draw(0.0, 0.0)
    assert (upright[:, :, 0] == upright[:, :, 1]).all()
    assert upright[6, 23:25].min() == 255 and upright[30:].max() == 0  # the rod ends at row 24 − 19
    left = env.draw(pi / 2, 0.0)[:, :, 1]
    assert left[23:25, 6].min() == 255 and left[:, 30:].max() == 0
    # The effect of an action is visible one step later.
    free = PixelPendulum(gravity=False)
    pictures = []
    for action in range(3):
        free.reset(options={"angle": 1.0, "velocity": 1.0})
        pictures.append(free.step(action)[0][:, :, 1].astype(int))
    assert min(abs(pictures[0] - pictures[1]).max(), abs(pictures[1] - pictures[2]).max()) > 60


def test_opposite_actions_cancel_in_the_star_field():
    env = StarField()
    first, info = env.reset(seed=0)
    for action in range(12):
        away, _, _, _, moved = env.step(action)
        assert (away != first).any()
        distance = moved["translation"] - info["translation"]
        np.testing.assert_allclose(np.linalg.norm(distance - np.rint(distance)), MOVE if action > 5 else 0, atol=1e-12)
        angle = np.arccos((np.trace(moved["rotation"].T @ info["rotation"]) - 1) / 2)
        np.testing.assert_allclose(angle, 0 if action > 5 else TURN, atol=1e-6)
        back, reward, terminated, truncated, _ = env.step(action ^ 1)
        assert_same_picture(first, back)
        assert (reward, terminated, truncated) == (0.0, False, False)


def test_a_full_turn_and_crossing_the_cube_return_to_the_start():
    env = StarField()
    for action in range(6):
        first, _ = env.reset(seed=action)
        for _ in range(32):
            observation = env.step(action)[0]
        assert_same_picture(first, observation)
    for action in range(6, 12):
        first, _ = env.reset(options={"rotation": np.eye(3)})
        for _ in range(20):
            observation, _, _, _, moved = env.step(action)
        assert_same_picture(first, observation)
        assert ((0 <= moved["translation"]) & (moved["translation"] < 1)).all()


def test_how_each_action_moves_a_star():
    """A single star ahead moves opposite to the camera; its position is computed by hand."""
    env = StarField(n_stars=1)
    env.colours[:] = 1
    ahead, angle = 0.25, TURN
    shift = 24 * np.tan(angle), 24 * MOVE / ahead  # pixels, for the focal length of 24 of a 90° view
    places = {0: (shift[0], 0), 1: (-shift[0], 0), 2: (0, -shift[0]), 3: (0, shift[0]), 4: (0, 0), 5: (0, 0)}
    places |= {FORWARD: (0, 0), BACK: (0, 0), RIGHT: (0, -shift[1]), LEFT: (0, shift[1])}
    places |= {UP: (shift[1], 0), DOWN: (-shift[1], 0)}
    for seed, (action, place) in enumerate(places.items()):
        _, info = env.reset(seed=seed)
        env.places[:] = (info["translation"] + ahead * info["rotation"][:, 2]) % 1
        picture = env.step(action)[0][:, :, 0].astype(float)
        rows, columns = np.indices(picture.shape) + 0.5 - 24
        centre = np.array([(rows * picture).sum(), (columns * picture).sum()]) / picture.sum()
        np.testing.assert_allclose(centre, place, atol=0.2, err_msg=f"action {action}")
    env.reset(options={"rotation": np.eye(3), "translation": [0, 0, 0]})
    sizes = []
    for depth in (0.15, 0.3):
        env.places[:] = (0, 0, depth)
        picture = env.draw(env.rotation, env.translation)
        np.testing.assert_allclose(picture.sum() / picture.max() / 3, pi * (24 * STAR_RADIUS / depth) ** 2, rtol=0.05)
        sizes.append(picture.max())
    assert sizes[0] > sizes[1]
    env.places[:] = (0, 0, -0.2)
    assert env.draw(env.rotation, env.translation).max() == 0  # behind the camera


def test_rolling_rotates_the_image():
    env = StarField(translations=False)
    for seed in range(3):
        first, _ = env.reset(seed=seed)
        for _ in range(8):  # a quarter turn
            observation = env.step(4)[0]
        assert_same_picture(np.rot90(first), observation)  # the camera turns clockwise, so the image turns anticlockwise


def picture_by_loops(env, rotation, translation):
    """The same image, computed for each pixel and star, from far to near."""
    inverse = np.linalg.inv(np.block([[rotation, translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))
    size = env.size
    copies = []
    for place, colour in zip(env.places, env.colours, strict=True):
        for cell in np.ndindex(3, 3, 3):
            x, y, z, _ = inverse @ np.append(place + cell - 1, 1)
            distance = sqrt(x * x + y * y + z * z)
            if distance < VIEW and z > NEAR:
                copies.append((distance, x, y, z, colour))
    picture = np.zeros((size, size, 3))
    for distance, x, y, z, colour in sorted(copies, key=lambda copy: -copy[0]):
        radius = STAR_RADIUS * size / 2 / z
        for row, column in np.ndindex(size, size):
            away = np.hypot(row + 0.5 - size / 2 * (1 + y / z), column + 0.5 - size / 2 * (1 + x / z))
            alpha = min(max(radius + 0.5 - away, 0), 1) * min(max(z / NEAR - 1, 0), 1)
            picture[row, column] += alpha * (colour * (1 - (distance / VIEW) ** 4) - picture[row, column])
    return picture


def test_the_image_matches_loops():
    env = StarField(size=36, n_stars=120)  # enough that some overlap
    for seed in range(2):
        observation, info = env.reset(seed=seed)
        expected = picture_by_loops(env, info["rotation"], info["translation"])
        np.testing.assert_allclose(observation, 255 * expected, atol=0.51)


def test_rotations_stay_orthogonal():
    env = StarField()
    env.reset(seed=0)
    for action in np.random.default_rng(0).integers(0, 12, 100_000):
        env._move(action)
    np.testing.assert_allclose(env.rotation.T @ env.rotation, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(env.rotation) > 0 and ((0 <= env.translation) & (env.translation < 1)).all()
    skewed = env.rotation + 1e-4 * np.random.default_rng(1).normal(size=(3, 3))
    left, _, right = np.linalg.svd(skewed)  # the nearest rotation
    np.testing.assert_allclose(orthonormalized(skewed), left @ right, atol=1e-6)


def test_poses_are_uniform():
    rng = np.random.default_rng(0)
    rotations = np.array([quaternion_rotation(rng.standard_normal(4)) for _ in range(4000)])
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (4000, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(rotations.mean(axis=0), np.zeros((3, 3)), atol=0.04)
    np.testing.assert_allclose((rotations**2).mean(axis=0), np.full((3, 3), 1 / 3), atol=0.02)
    # The angle of uniform rotations has the density (1 − cos)/π and the mean π/2 + 2/π.
    angles = np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
    np.testing.assert_allclose(angles.mean(), pi / 2 + 2 / pi, atol=0.05)


def test_layouts():
    env, same, other = StarField(), StarField(), StarField(layout_seed=1)
    assert (env.reset(seed=1)[0] == same.reset(seed=1)[0]).all()
    assert (env.reset(seed=1)[0] != other.reset(seed=1)[0]).any()
    still = StarField(translations=False)
    _, info = still.reset(seed=3)
    assert (info["translation"] == 0.5).all() and json.dumps(still.metadata)
    mean = np.mean([env.reset(seed=seed)[0].max(axis=2) > 40 for seed in range(50)])
    assert 0.03 < mean < 0.5  # neither empty nor full


@pytest.mark.parametrize("env_id", [name for name in envs.WORLDS if not name.startswith(("BlindCliffwalk", "PlanarBody"))])
def test_every_action_has_a_name(env_id):
    env = gym.make(env_id)
    names = env.unwrapped.get_action_meanings()
    assert len(names) == len(set(names)) == env.action_space.n


def test_the_planar_body_moves_by_elements_of_SE2():
    """Against the matrix exponential of the commanded velocity, multiplied from the right."""
    env = PlanarBody(n_noise=3)
    check_env(env)
    rng = np.random.default_rng(0)
    observation, info = env.reset(seed=1)

    def pose(info):
        c, s = np.cos(info["angle"]), np.sin(info["angle"])
        return np.array([[c, -s, info["position"][0]], [s, c, info["position"][1]], [0, 0, 1]])

    for step in range(30):
        forward, turn = command = rng.uniform(-1, 1, 2) if step else np.array([1.0, 0.0])
        velocity = np.array([[0, -0.5 * turn, 0.2 * forward], [0.5 * turn, 0, 0], [0, 0, 0]])
        expected = pose(info) @ expm(velocity)
        observation, reward, terminated, truncated, info = env.step(command)
        np.testing.assert_allclose(pose(info), expected, atol=1e-12)
        np.testing.assert_allclose(observation[:4], [*expected[:2, 2], expected[0, 0], expected[1, 0]], atol=1e-6)
        assert reward == pytest.approx(-np.hypot(*expected[:2, 2])) and not (terminated or truncated)
    _, info = env.reset(options={"position": (0.5, -0.25), "angle": 7.0})
    assert info["angle"] == pytest.approx(7.0 - 2 * pi) and tuple(info["position"]) == (0.5, -0.25)


def test_the_noise_of_the_planar_body_does_not_move_it():
    quiet, noisy = gym.make("PlanarBody-v0"), gym.make("PlanarBodyNoise-v0")
    for env in (quiet, noisy):
        env.reset(seed=0, options={"position": (0.1, 0.2), "angle": 0.3})
    one, many = (env.step(np.array([0.5, -1.0]))[0] for env in (quiet, noisy))
    assert one.shape == (4,) and many.shape == (24,) and np.array_equal(one, many[:4]) and np.std(many[4:]) > 0.5
