"""Videos of latent states, and the callback that logs them: mostly what is drawn, not how."""

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_eqr import EqRRainbow, load_configuration
from sb3_eqr.common.groups import make_group
from sb3_eqr.common.saving.plain_data import encode as encode_plain
from sb3_eqr.common.saving.random_state import get_rng_state
from sb3_eqr.visualize import film as film_module
from sb3_eqr.visualize.callback import LatentCallback
from sb3_eqr.visualize.film import ARROW, AXES, HEIGHT, ROOM, WIDTH, Film, Panel, frames, panel, record, shoot, still
from sb3_eqr.visualize.latents import encode
from tests.models import EITHER
from tests.toys import ChainEnv, ImageEnv

STEPS, DEPTH = 30, 3


def rotation(angle):
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def elements(name, n=7):
    """Elements of a group with random parameters, (n, ...)."""
    group = make_group(name)
    return group, group.element(th.randn(n, group.num_params, generator=th.Generator().manual_seed(0)))


def drawn(panels, picture=None, depth=2):
    """The frames of some panels in one episode."""
    n = panels[0].dots.shape[1]
    picture = np.zeros((4, 4, 3), np.uint8) if picture is None else picture
    return list(frames(Film(None, [picture] * n, ["up"] * n, None, np.zeros(n, int)), panels, "about", depth))


def test_an_arrow_shows_the_rotation():
    """The element of SO(2) with the angle θ maps (1, 0) to (cos θ, -sin θ)."""
    angles = np.linspace(-3, 3, 13)
    group = make_group("SO(2)")
    shown = panel("SO(2) 0", group, group.element(th.as_tensor(angles)[None, :, None]).expand(2, -1, -1, -1))
    assert np.isnan(shown.dots).all()
    np.testing.assert_allclose(np.arctan2(shown.arrows[0, :, 0, 1], shown.arrows[0, :, 0, 0]), -angles, atol=1e-6)


def test_a_dot_shows_the_translation_and_its_arrow_the_rotation():
    group = make_group("SE(2)")
    both = th.tensor([[[0.5, 3.0, -4.0], [0.5, -3.0, 4.0]]], dtype=th.float64).expand(2, -1, -1)
    shown = panel("SE(2) 0", group, group.element(both))
    np.testing.assert_allclose(shown.dots[0] * shown.half_width, [[3, -4], [-3, 4]])
    np.testing.assert_allclose(shown.arrows[0, :, 0], ARROW * np.stack([rotation(0.5)[:, 0]] * 2))


@pytest.mark.parametrize(
    ("name", "n_arrows", "has_dot"),
    [
        ("SO(2)", 1, False),
        ("SE(2)", 1, True),
        ("GL(2)", 2, False),
        ("GL(1)", 1, False),
        ("SO(3)", 3, False),
        ("SE(3)", 3, True),
        ("SO(4)", 3, False),
        ("SE(1)", 0, True),
        ("T(1)", 0, True),
        ("T(2)", 0, True),
        ("T(5)", 0, True),
        ("none(6)", 0, True),
    ],
)
def test_every_group_is_drawn_inside_its_panel(name, n_arrows, has_dot):
    group, found = elements(name)
    ghost = found.clone()
    ghost[:2] = float("nan")
    shown = panel("1", group, th.stack([found, ghost]))
    assert np.isfinite(shown.arrows[0, :, :, 0]).sum(axis=1).tolist() == [n_arrows] * len(found)
    assert np.isfinite(shown.dots[0]).all() if has_dot else np.isnan(shown.dots).all()
    feet = np.nan_to_num(shown.dots)[0]
    assert np.abs(feet).max() <= 1 and np.abs(feet[:, None] + np.nan_to_num(shown.arrows[0])).max() <= 1 + 1e-9
    for both in (shown.arrows, shown.dots):
        np.testing.assert_array_equal(both[1, 2:], both[0, 2:])  # both have the same scale
        assert np.isnan(both[1, :2]).all()
    assert len(drawn([shown])) == len(found)


@pytest.mark.parametrize("name, length", [("SO(2)", ROOM), ("SE(2)", ARROW)])
def test_arrows_of_rotations_have_a_fixed_length(name, length):
    group, found = elements(name)
    arrows = panel("1", group, th.stack([found, found])).arrows[:, :, 0]
    np.testing.assert_allclose(np.linalg.norm(arrows, axis=-1), length, rtol=1e-6)


def test_a_panel_grows_for_predictions_except_outliers():
    group = make_group("T(2)")
    truth = th.tensor([[-1.0, 0.0], [1.0, 0.0]])
    assert panel("1", group, th.stack([truth, 2 * truth])).half_width == pytest.approx(2 / ROOM, rel=0.1)
    beyond = panel("1", group, th.stack([truth, 100 * truth]))
    assert beyond.half_width == pytest.approx(1 / ROOM)
    np.testing.assert_array_equal(beyond.dots[1], [[-1, 0], [1, 0]])  # at the edge


@pytest.mark.parametrize("group", ["none(4)", "T(4)"])
def test_of_many_numbers_two_principal_components_are_drawn(group):
    t = th.linspace(-1, 1, 9)
    vectors = th.outer(t, th.tensor([0.0, 3.0, 4.0, 0.0])) + th.tensor([7.0, 7.0, 7.0, 7.0])
    dots = panel("1", make_group(group), th.stack([vectors, vectors])).dots[0]
    np.testing.assert_allclose(dots * np.sign(dots[-1, 0]), np.stack([t * ROOM, 0 * t], axis=1), atol=1e-6)


def rollout(model, state, actions):
    """x̂ after some actions, with the paper's recursion: κ in eval mode is applied to the state for each action."""
    latent_model = model.policy.latent_model
    latent_model.eval()
    with th.no_grad():
        for action in actions:
            one_hot = th.nn.functional.one_hot(th.tensor([int(action)]), latent_model.action_dim).float()
            params = latent_model.transition(th.cat([state, one_hot], dim=1))
            group = latent_model.group
            element = group.element(params.reshape(1, latent_model.n_blocks, group.num_params))
            state = group.compose(element, state.reshape(1, latent_model.n_blocks, *group.element_shape)).reshape(1, -1)
    return state


def test_a_ghost_is_the_prediction_made_some_steps_before(make):
    model = make(ChainEnv(8))
    model.exploration_rate = 1.0  # random actions
    film = shoot(model, ChainEnv(8), STEPS, 0, False)
    states = encode(model, film.observations)
    ghosts = film_module.predictions(model, states, film.actions, film.starts, DEPTH)
    assert len(set(film.starts.tolist())) > 2  # several episodes
    for t in range(STEPS):
        if t - film.starts[t] < DEPTH:  # includes the first frames of the video
            assert th.isnan(ghosts[t]).all()
        else:
            expected = rollout(model, states[t - DEPTH : t - DEPTH + 1], film.actions[t - DEPTH : t])
            th.testing.assert_close(ghosts[t : t + 1], expected)


@EITHER
def test_a_film_shows_what_happened(make):
    """Compared with a loop over the environment."""
    model = make(ChainEnv(8))
    film = shoot(model, ChainEnv(8), STEPS, 3, True)
    env = DummyVecEnv([lambda: ChainEnv(8)])
    env.seed(3)
    obs, start, score = env.reset(), 0, 0
    for t in range(STEPS):
        np.testing.assert_array_equal(film.observations[t], obs[0])
        action, _ = model.predict(obs, deterministic=True)
        obs, reward, done, _ = env.step(action)
        assert (film.actions[t], film.starts[t]) == (action[0], start)
        score = reward[0] + (0 if t == start else score)
        assert (
            film.titles[t].split() == f"step {t - start} action {action[0]} reward {reward[0]:+.3g} score {score:.4g}".split()
        )
        start = t + 1 if done[0] else start


@EITHER
@pytest.mark.parametrize("group", ["SE(2)^2 x SO(3) x T(2)", None])
def test_files_have_the_frames_and_the_global_generators_are_unchanged(make, group, tmp_path):
    model = make(ChainEnv(8), symmetry_coef=0, policy_kwargs={"group": group, "n_blocks": None})
    before = encode_plain(get_rng_state(model.action_space))
    paths = record(model, ChainEnv(8), tmp_path / "new" / "v1.5", 11, 3)
    assert encode_plain(get_rng_state(model.action_space)) == before
    assert [path.name for path in paths] == ["v1.5.mp4", "v1.5.gif"]
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["v1.5.gif", "v1.5.mp4"]
    movie = imageio.get_reader(paths[0])
    assert movie.count_frames() == 11 and movie.get_data(10).shape == (HEIGHT, WIDTH, 3)
    assert len(imageio.mimread(paths[1], memtest=False)) == 6  # every second frame


@EITHER
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_suffix_is_removed(make, suffix, tmp_path):
    paths = record(make("CartPole-v1"), "CartPole-v1", tmp_path / f"v{suffix}", 7, 2)
    assert [path.name for path in paths] == ["v.mp4", "v.gif"]


@pytest.mark.parametrize(
    "name, has_dots, letters", [("SO(3)", 0, "xyz"), ("SE(3)", 1, "xyz"), ("SE(2)", 1, ""), ("SO(2)", 0, "")]
)
def test_the_legend_matches_what_is_drawn(name, has_dots, letters):
    """Each axis has its own colour; only translations have dots and trails; the arrow of a plane is blue, its ghost orange."""
    group, found = elements(name)
    figure, _ = still([panel("0", group, th.stack([found, found]))], "about", 2)
    (legend,) = figure.legends
    said = {text.get_text(): line for text, line in zip(legend.get_texts(), legend.get_lines(), strict=True)}
    expected = {"now", "predicted 2 steps before"} if has_dots or not letters else set()
    expected |= {"last 12 steps"} if has_dots else set()
    assert set(said) == expected | set(letters) | ({"pale: predicted 2 steps before"} if letters else set())
    assert [said[letter].get_color() for letter in letters] == list(AXES[: len(letters)])
    assert {said[label].get_marker() for label in expected - {"last 12 steps"}} == (
        {"o"} if has_dots else {"None"} if expected else set()
    )


@EITHER
def test_the_same_seed_draws_the_same_frames(make, tmp_path, monkeypatch):
    model = make(ImageEnv(), "CnnPolicy")
    model.exploration_rate = 1.0  # ε-greedy actions use their own generator
    seen = []
    monkeypatch.setattr(film_module, "write_video", lambda images, *_: seen.append(np.stack(list(images))))
    for seed in (0, 0, 1):
        th.rand(1)
        model.action_space.sample()
        record(model, ImageEnv(), tmp_path / "v", 8, 2, seed=seed, deterministic=False)
    np.testing.assert_array_equal(seen[0], seen[1])
    assert (seen[0] != seen[2]).any()


@EITHER
def test_the_environment_is_rendered_if_possible(make):
    model = make("CartPole-v1")
    rendered = shoot(model, gym.make("CartPole-v1", render_mode="rgb_array"), 3, 0, True).pictures
    assert rendered[0].shape == (400, 600, 3)
    bars = shoot(model, gym.make("CartPole-v1"), 3, 0, True).pictures
    assert bars[0].shape == (4,) and (bars[0] != bars[2]).any()
    env = gym.make("CartPole-v1", render_mode="rgb_array")
    env.unwrapped.metadata = {"render_modes": []}
    assert shoot(model, env, 3, 0, True).pictures[0].shape == (4,)


@EITHER
def test_several_normalised_environments(make):
    """The first environment is filmed, with its raw rewards."""
    env = VecNormalize(DummyVecEnv([lambda: ChainEnv(8), lambda: ChainEnv(8)]))
    model = make(env)
    plain = VecNormalize(DummyVecEnv([lambda: ChainEnv(8), lambda: ChainEnv(8)]), training=False)
    film = shoot(model, plain, 9, 0, True)
    alone = shoot(model, ChainEnv(8), 9, 0, True)
    assert film.observations.shape == (9, 3) and len(film.titles) == 9
    assert film.titles[0] == alone.titles[0] and "reward" in film.titles[0]


def test_observations_as_images():
    stack = np.arange(4, dtype=np.uint8)[None, :, None, None] * np.ones((2, 4, 5, 6), np.uint8)
    newest = film_module.observed_pictures(stack, spaces.Box(0, 255, (4, 5, 6), np.uint8), 4)
    assert len(newest) == 2 and newest[0].shape == (5, 6, 3) and (newest[0] == 3).all()
    planes = np.zeros((1, 4, 5, 6), np.uint8)
    planes[0, 1, 2, 3] = 255
    (picture,) = film_module.observed_pictures(planes, spaces.Box(0, 255, (4, 5, 6), np.uint8), 1)
    assert picture[2, 3].max() == 255 and len(set(picture[2, 3].tolist())) > 1 and picture.sum() == picture[2, 3].sum()
    space = spaces.Dict({"a": spaces.Box(-1, 1, (3,)), "b": spaces.Box(-1, 1, (20,))})
    (numbers,) = film_module.observed_pictures({"a": np.array([[1.0, 0.0, -4.0]]), "b": np.ones((1, 20))}, space, 1)
    np.testing.assert_array_equal(numbers, [1, 0, -1])


@EITHER
def test_a_failed_video_leaves_no_files(make, tmp_path, monkeypatch):
    model = make(ChainEnv(8))
    old = tmp_path / "v.gif"
    old.write_bytes(b"old")

    def fail(*_):
        yield from np.zeros((5, HEIGHT, WIDTH, 3), np.uint8)
        raise RuntimeError("the disk is full")

    monkeypatch.setattr(film_module, "frames", fail)
    with pytest.raises(RuntimeError, match="the disk is full"):
        record(model, ChainEnv(8), tmp_path / "v", 9, 2)
    assert [path.name for path in tmp_path.iterdir()] == ["v.gif"] and old.read_bytes() == b"old"


@EITHER
def test_invalid_arguments_raise(make, tmp_path):
    model = make(ChainEnv(8))
    with pytest.raises(ValueError, match="n_steps must be an integer >= 6"):
        record(model, ChainEnv(), tmp_path / "v", n_steps=5, depth=5)
    with pytest.raises(ValueError, match="env must have the agent's spaces"):
        record(model, ImageEnv(), tmp_path / "v")


def test_a_frame_shows_truth_and_ghost():
    """Blue along the arrow, orange along the ghost's; nothing is orange without a ghost. Images keep their aspect ratio."""
    arrows = np.full((2, 2, 3, 2), np.nan)
    arrows[0, :, 0], arrows[1, 1, 0] = (0, 0.85), (0.85, 0)
    shown = Panel("1", 1.0, arrows, np.full((2, 2, 2), np.nan))
    first, second = (frame.astype(int) for frame in drawn([shown], np.full((50, 100, 3), (0, 255, 0), np.uint8), depth=1))
    figure, _ = still([shown], "about", 1)
    figure.draw_without_rendering()

    def pixel(frame, x, y):
        """The colour at a position in the panel, whose edges are at ±1."""
        column, row = figure.axes[1].transData.transform((x, y))
        return frame[HEIGHT - round(row), round(column)]

    assert pixel(second, 0, 0.5)[2] > pixel(second, 0, 0.5)[0] + 50
    assert pixel(second, 0.5, 0)[0] > pixel(second, 0.5, 0)[2] + 50
    assert not (first[:, 400:][..., 0] > first[:, 400:][..., 2] + 50)[60:-60].any()  # except in the legend
    green = (first == (0, 255, 0)).all(axis=2)
    assert green.any(axis=0).sum() == pytest.approx(2 * green.any(axis=1).sum(), abs=4)


# --- the callback


def trained(make, callback, tmp_path=None, **kwargs):
    model = make(ChainEnv(), tensorboard_log=None if tmp_path is None else str(tmp_path), learning_starts=20, **kwargs)
    model.learn(45, callback=callback)
    return model


@EITHER
def test_the_callback_does_not_change_training_and_logs_to_tensorboard(make, tmp_path):
    plain = trained(make, None)
    watched = trained(make, LatentCallback(log_freq=15, n_windows=16), tmp_path)
    for (name, a), (_, b) in zip(plain.policy.state_dict().items(), watched.policy.state_dict().items(), strict=True):
        assert th.equal(a, b), name
    (folder,) = tmp_path.iterdir()
    events = EventAccumulator(str(folder))
    events.Reload()
    assert [event.step for event in events.Images("latent/blocks")] == [15, 30, 45]
    for name in ("skill", "gain", "effective_rank", "spread", "dead_units", "specificity", "redundancy", "symmetry_distance"):
        assert [event.step for event in events.Scalars(f"latent/{name}")] == [15, 30, 45]
        assert np.isfinite([event.value for event in events.Scalars(f"latent/{name}")]).all()


@EITHER
def test_the_callback_waits_for_a_complete_window(make, tmp_path, monkeypatch):
    looks = []
    monkeypatch.setattr("sb3_eqr.visualize.callback.diagnose", lambda model, play: looks.append(play) or 1 / 0)
    every = LatentCallback(log_freq=1, n_windows=16)
    make(ChainEnv(), tensorboard_log=str(tmp_path)).learn(1, callback=every)  # a window needs three steps
    assert not looks
    with pytest.raises(ZeroDivisionError):  # this call evaluates
        make(ChainEnv(), tensorboard_log=str(tmp_path)).learn(9, callback=every)
    assert len(looks) == 1


@EITHER
@pytest.mark.parametrize("off", [{"prediction_depth": 0}, {"aet_coef": 0, "symmetry_coef": 0, "reward_coef": 0}])
def test_an_agent_without_latent_losses_warns_once(make, off):
    with pytest.warns(UserWarning, match="LatentCallback logs nothing") as told:
        trained(make, LatentCallback(log_freq=10), **off)
    assert len([warning for warning in told if "LatentCallback" in str(warning.message)]) == 1


def test_spr_is_refused_at_the_start():
    model = EqRRainbow("CnnPolicy", make_vec_env(ImageEnv), device="cpu", **load_configuration("spr", buffer_size=100))
    with pytest.raises(ValueError, match="must move states by a group, got ConvLatentModel, whose states have no blocks"):
        model.learn(10, callback=LatentCallback(log_freq=1_000))
    assert model.num_timesteps == 0
