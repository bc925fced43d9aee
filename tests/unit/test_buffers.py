import itertools
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_eqr import PrioritizedSequenceReplayBuffer, SequenceReplayBuffer
from sb3_eqr.common.replay import buffers
from sb3_eqr.common.replay.frame_store import FrameStore
from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples as Samples
from tests.models import draw

ACTIONS = spaces.Discrete(4)
FORCES = spaces.Box(-1, 1, (2,), np.float32)
VECTOR = spaces.Box(-np.inf, np.inf, (3,), np.float32)
IMAGES = spaces.Box(0, 255, (4, 6, 5), np.uint8)
BOTH = pytest.mark.parametrize("buffer_class", [SequenceReplayBuffer, PrioritizedSequenceReplayBuffer])


class Stream:
    """Random episodes in several environments, recorded completely and simply, to compare buffers with."""

    def __init__(self, space, n_envs, seed=0, padding="zero", mean_length=6, channels=1, actions=ACTIONS):
        self.space, self.n_envs, self.padding, self.mean_length, self.actions = space, n_envs, padding, mean_length, actions
        self.channels = channels  # per frame
        self.rng = np.random.default_rng(seed)
        self.steps = []  # one dict of arrays per call of add
        self.obs = np.stack([self.first() for _ in range(n_envs)])

    def frame(self):
        if self.space is IMAGES:
            return self.rng.integers(0, 256, (self.channels, 6, 5), dtype=np.uint8)
        return self.rng.normal(size=3).astype(np.float32)

    def action(self):
        if self.actions is FORCES:
            return self.rng.uniform(-1, 1, (self.n_envs, 2)).astype(np.float32)
        return self.rng.integers(0, 4, self.n_envs)

    def first(self):
        if self.space is not IMAGES:
            return self.frame()
        frame = self.frame()
        padding = {"zero": np.zeros_like(frame), "repeat": frame, "other": self.frame()}[self.padding]
        return np.concatenate([padding] * (4 // self.channels - 1) + [frame])

    def following(self, obs):
        return np.concatenate([obs[self.channels :], self.frame()]) if self.space is IMAGES else self.frame()

    def feed(self, n_steps, *buffers):
        for _ in range(n_steps):
            next_obs = np.stack([self.following(obs) for obs in self.obs])
            done = self.rng.random(self.n_envs) < 1 / self.mean_length
            timeout = done & (self.rng.random(self.n_envs) < 0.5)
            step = {
                "obs": self.obs,
                "next_obs": next_obs,
                "action": self.action(),
                "reward": self.rng.normal(size=self.n_envs).astype(np.float32),
                "done": done,
                "infos": [{"TimeLimit.truncated": bool(t)} for t in timeout],
            }
            for buffer in buffers:
                buffer.add(**step)
            self.steps.append({**step, "timeout": timeout})
            self.obs = np.stack([self.first() if d else o for d, o in zip(done, next_obs, strict=True)])

    def window(self, position, env, size, n, depth, gamma):
        """The window that starts at a position of the ring, with loops in float64; ``None`` if it crosses the write head."""
        start = max(k for k in range(position, len(self.steps), size))
        taken = []
        for k in range(start, start + max(n, depth)):
            if k == len(self.steps):
                return None
            taken.append(self.steps[k])
            if taken[-1]["done"][env]:
                break
        steps = taken[:n]
        expected = {
            "observations": taken[0]["obs"][env],
            "actions": np.atleast_1d(taken[0]["action"][env]),
            "next_observations": steps[-1]["next_obs"][env],
            "dones": [float(steps[-1]["done"][env] and not steps[-1]["timeout"][env])],
            "rewards": [sum(gamma**k * float(s["reward"][env]) for k, s in enumerate(steps))],
            "discounts": [gamma ** len(steps)],
        }
        if depth:
            padded = taken[:depth] + [taken[-1]] * (depth - len(taken))
            expected["mask"] = [1.0] * len(taken[:depth]) + [0.0] * (depth - len(taken))
            expected["rollout_observations"] = np.stack([s["next_obs"][env] for s in padded])
            expected["rollout_actions"] = [s["action"][env] for s in padded]
            expected["rollout_rewards"] = [float(s["reward"][env]) * m for s, m in zip(padded, expected["mask"], strict=True)]
        return expected


@pytest.mark.parametrize("actions", [ACTIONS, FORCES], ids=["Discrete", "Box"])
@pytest.mark.parametrize("n_steps", [1, 3, 7])
@pytest.mark.parametrize("n_envs, n_adds", [(1, 30), (1, 97), (3, 97)])
def test_without_rollout_it_equals_sb3s_n_step_buffer(n_steps, n_envs, n_adds, actions):
    """Every field of every sample, before and after wrap-around, with time-outs."""
    stream = Stream(VECTOR, n_envs, actions=actions)
    theirs = NStepReplayBuffer(40 * n_envs, VECTOR, actions, "cpu", n_envs, n_steps=n_steps, gamma=0.9)
    ours = SequenceReplayBuffer(40 * n_envs, VECTOR, actions, "cpu", n_envs, n_steps=n_steps, gamma=0.9)
    stream.feed(n_adds, theirs, ours)
    for seed in range(20):
        expected, found = draw(theirs, 64, seed), draw(ours, 64, seed)
        for field in expected._fields:
            assert th.equal(getattr(found, field), getattr(expected, field)), field
            assert getattr(found, field).dtype == getattr(expected, field).dtype
    assert th.equal(found.weights, th.ones(64)) and found.mask is None


def test_one_step_without_rollout_equals_sb3s_plain_buffer():
    stream = Stream(IMAGES, 2)
    theirs = ReplayBuffer(40, IMAGES, ACTIONS, "cpu", 2)
    ours = SequenceReplayBuffer(40, IMAGES, ACTIONS, "cpu", 2, frame_stack=4)
    stream.feed(57, theirs, ours)
    expected, found = draw(theirs, 500), draw(ours, 500)
    for field in ("observations", "actions", "next_observations", "dones", "rewards"):
        assert th.equal(getattr(found, field), getattr(expected, field)), field


STACKS = [(VECTOR, 1, ""), (IMAGES, 4, "zero"), (IMAGES, 1, "zero"), (IMAGES, 2, "zero")]
STACKS += [(IMAGES, 4, "repeat"), (IMAGES, 4, "other")]
WINDOWS = [(3, 5), (6, 2), (1, 1)]
RINGS = [(3, 101), (1, 25)]  # environments and steps: one buffer is overwritten three times, the other is not full yet
# Every kind of stack with the first window and ring; two kinds with all windows and rings.
CASES = [(*stack, *WINDOWS[0], *RINGS[0]) for stack in STACKS[2:]]
CASES += [(*stack, *window, *ring) for stack in STACKS[:2] for window in WINDOWS for ring in RINGS]
CASES = [(ACTIONS, *case) for case in CASES] + [(FORCES, *STACKS[0], *WINDOWS[0], *ring) for ring in RINGS]


@BOTH
@pytest.mark.parametrize("actions, space, frame_stack, padding, n_steps, depth, n_envs, n_adds", CASES)
def test_every_sample_matches_what_was_added(
    buffer_class, actions, space, frame_stack, padding, n_steps, depth, n_envs, n_adds
):
    stream = Stream(space, n_envs, padding=padding, mean_length=5, channels=4 // frame_stack, actions=actions)
    settings = {"n_steps": n_steps, "prediction_depth": depth, "gamma": 0.9, "frame_stack": frame_stack}
    buffer = buffer_class(30 * n_envs, space, actions, "cpu", n_envs, **settings)
    stream.feed(n_adds, buffer)
    samples = draw(buffer, 800)
    starts, first, which = np.unique(samples.indices, return_index=True, return_inverse=True)
    for field, value in samples._asdict().items():  # a start that is sampled again gives the same window
        if field != "weights":
            assert np.array_equal(np.asarray(value), np.asarray(value)[first][which]), field
    for b, index in zip(first, starts, strict=True):
        position, env = divmod(int(index), n_envs)
        expected = stream.window(position, env, 30, n_steps, depth, 0.9)
        assert expected is not None, "a window crosses the write head"
        for field, value in expected.items():
            found = getattr(samples, field)[b].numpy()
            if field in ("rewards", "discounts"):
                np.testing.assert_allclose(found, value, rtol=1e-5, atol=1e-6)
            else:
                assert np.array_equal(found, np.asarray(value, dtype=found.dtype)), field
    assert len(starts) == (min(n_adds, 30) - max(n_steps, depth) + 1) * n_envs  # every legal start and no others


def test_axes_and_mask_by_hand():
    """Environment b observes 10·b + t at step t, so swapped axes give other numbers."""
    space = spaces.Box(0, 255, (1,), np.float32)
    n_envs, depth, lengths = 4, 3, [2, 1, 5, 3]
    buffer = SequenceReplayBuffer(100, space, ACTIONS, "cpu", n_envs, n_steps=2, prediction_depth=depth, gamma=0.5)
    for t in range(6):
        obs = np.array([[10 * b + t] for b in range(n_envs)], dtype=np.float32)
        done = np.array([t + 1 == length for length in lengths])
        action = np.array([(b + t) % 4 for b in range(n_envs)])
        buffer.add(obs, obs + 1, action, 100 * np.arange(n_envs) + t, done, [{}] * n_envs)
    samples = draw(buffer, 500)
    rows = [int(np.flatnonzero(samples.indices == b)[0]) for b in range(n_envs)]  # the windows that start at t = 0
    assert samples.mask[rows].tolist() == [[1, 1, 0], [1, 0, 0], [1, 1, 1], [1, 1, 1]]
    assert samples.rollout_observations[rows, :, 0].tolist() == [[1, 2, 2], [11, 11, 11], [21, 22, 23], [31, 32, 33]]
    assert samples.rollout_rewards[rows].tolist() == [[0, 1, 0], [100, 0, 0], [200, 201, 202], [300, 301, 302]]
    assert samples.rollout_actions[rows].tolist() == [[0, 1, 1], [1, 1, 1], [2, 3, 0], [3, 0, 1]]
    assert samples.next_observations[rows, 0].tolist() == [2, 11, 22, 32]
    assert samples.rewards[rows, 0].tolist() == [0.5, 100, 300.5, 450.5]
    assert samples.discounts[rows, 0].tolist() == [0.25, 0.5, 0.25, 0.25]
    assert samples.dones[rows, 0].tolist() == [1, 1, 0, 0]


def test_nothing_is_sampled_before_the_first_window_is_complete():
    stream = Stream(VECTOR, 2, mean_length=1000)
    buffer = SequenceReplayBuffer(60, VECTOR, ACTIONS, "cpu", 2, n_steps=4, prediction_depth=2)
    stream.feed(3, buffer)
    assert not buffer.can_sample()
    stream.feed(1, buffer)
    assert buffer.can_sample() and set(buffer.sample(50).indices) == {0, 1}


@BOTH
def test_n_and_gamma_are_read_at_sampling_time(buffer_class):
    stream = Stream(VECTOR, 1, mean_length=1000)
    buffer = buffer_class(50, VECTOR, ACTIONS, "cpu", 1, n_steps=10, prediction_depth=2, gamma=0.9)
    stream.feed(70, buffer)
    for n_steps, gamma in [(10, 0.9), (3, 0.97), (8, 0.5), (12, 0.9), (1, 0.0)]:
        buffer.n_steps, buffer.gamma = n_steps, gamma
        samples = buffer.sample(4000)
        for b in range(0, 4000, 100):
            expected = stream.window(int(samples.indices[b]), 0, 50, n_steps, 2, gamma)
            assert expected is not None
            np.testing.assert_allclose(samples.rewards[b], expected["rewards"], rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(samples.discounts[b], expected["discounts"], rtol=1e-6)
        stream.feed(3, buffer)  # also between two samples
        samples = buffer.sample(4000)
        # The newest transition is at 19; windows start at the positions of age max(n, M) - 1 and above.
        assert len(set(samples.indices)) == 50 - max(n_steps, 2) + 1


def test_a_reset_in_the_middle_of_an_episode_ends_its_windows():
    """A second call of ``learn`` resets the environment, and nothing notifies the buffer."""
    stream = Stream(VECTOR, 2, mean_length=10**9)
    buffer = SequenceReplayBuffer(60, VECTOR, ACTIONS, "cpu", 2, n_steps=3, prediction_depth=3)
    stream.feed(5, buffer)
    stream.obs = np.stack([stream.first(), stream.obs[1]])  # environment 0 only
    stream.feed(5, buffer)
    samples = buffer.sample(500)
    row = {int(index): b for b, index in enumerate(samples.indices)}
    assert samples.mask[row[4 * 2 + 0]].tolist() == [1, 0, 0]
    assert samples.mask[row[4 * 2 + 1]].tolist() == [1, 1, 1]
    assert samples.dones.sum() == 0
    assert np.array_equal(samples.next_observations[row[3 * 2]].numpy(), stream.steps[4]["next_obs"][0])


def test_dict_and_discrete_observations():
    space = spaces.Dict({"image": IMAGES, "vector": VECTOR, "number": spaces.Discrete(7)})
    buffer = SequenceReplayBuffer(40, space, ACTIONS, "cpu", 2, n_steps=2, prediction_depth=2)
    space.seed(0)
    made = [{key: np.stack([part.sample(), part.sample()]) for key, part in space.items()} for _ in range(12)]
    rest = (np.array([0, 1]), np.zeros(2), np.zeros(2, dtype=bool), [{}, {}])
    for now, then in itertools.pairwise(made):
        with pytest.raises(ValueError, match="must have the replay buffer's shape"):  # before anything is stored
            buffer.add(now, {**then, "vector": np.zeros((2, 1), np.float32)}, *rest)
        buffer.add(now, then, *rest)
    assert not buffer.timeouts.any()
    samples = buffer.sample(100)
    for b, index in enumerate(samples.indices):
        t, env = divmod(int(index), 2)
        for key in space.spaces:
            expected = np.stack([made[t + m][key][env] for m in (1, 2)]).reshape(2, *buffer.obs_shape[key])
            assert np.array_equal(samples.rollout_observations[key][b].numpy(), expected)
            assert np.array_equal(samples.next_observations[key][b].numpy(), expected[1])


def test_vec_normalize_is_applied_to_every_observation_and_to_one_step_rewards():
    class Halve(VecNormalize):
        def __init__(self):  # only the two methods below are used
            pass

        def normalize_obs(self, obs):
            return obs / 2

        def normalize_reward(self, reward):
            return np.clip(reward, -0.5, 0.5)

    stream = Stream(VECTOR, 1)
    buffer = SequenceReplayBuffer(50, VECTOR, ACTIONS, "cpu", 1, n_steps=3, prediction_depth=2, gamma=0.9)
    stream.feed(40, buffer)
    raw, found = draw(buffer, 30), draw(buffer, 30, env=Halve())
    for field in ("observations", "next_observations", "rollout_observations"):
        assert th.equal(getattr(found, field), getattr(raw, field) / 2)
    assert th.equal(found.rollout_rewards, raw.rollout_rewards.clamp(-0.5, 0.5))
    start = int(raw.indices[0])
    rewards = []
    for step in stream.steps[start : start + 3]:
        rewards.append(float(np.clip(step["reward"][0], -0.5, 0.5)))
        if step["done"][0]:
            break
    expected = sum(0.9**k * r for k, r in enumerate(rewards))
    assert found.rewards[0, 0].item() == pytest.approx(expected, rel=1e-5)


def test_memory_per_transition_at_atari_size():
    space = spaces.Box(0, 255, (4, 84, 84), np.uint8)
    buffer = PrioritizedSequenceReplayBuffer(500, space, ACTIONS, "cpu", n_steps=10, prediction_depth=5, frame_stack=4)
    frames = np.random.default_rng(0).integers(0, 256, (50, 84, 84), dtype=np.uint8)
    stack = np.zeros((1, 4, 84, 84), dtype=np.uint8)
    for t in range(1_100):  # wraps around twice; episodes of 40 steps, far shorter than a life in Atari
        following = np.concatenate([stack[:, 1:], frames[None, None, t % 50]], axis=1)
        done = t % 40 == 39
        buffer.add(stack, following, np.zeros(1), np.zeros(1), np.array([done]), [{}])
        stack = np.zeros_like(stack) if done else following
    assert buffer.nbytes / 500 <= 8_500  # SB3's: 56,000


@BOTH
def test_a_buffer_too_large_for_the_machine_warns(buffer_class, monkeypatch):
    """psutil is only installed where Ray is."""
    memory = SimpleNamespace(virtual_memory=lambda: SimpleNamespace(available=1_000))
    monkeypatch.setattr(buffers, "psutil", memory)
    with pytest.warns(UserWarning, match="not have apparently enough memory"):
        buffer_class(100, spaces.Box(0, 1, (3,)), spaces.Discrete(2), "cpu")


def test_memory_does_not_grow_once_the_ring_is_full():
    stream = Stream(IMAGES, 2, mean_length=4)
    buffer = SequenceReplayBuffer(60, IMAGES, ACTIONS, "cpu", 2, frame_stack=4)
    stream.feed(90, buffer)
    before = buffer.nbytes
    stream.feed(900, buffer)
    assert buffer.nbytes <= before * 1.15


def prioritized(n_adds, **kwargs):
    """A buffer of one environment with α = 0.5, and the stream that fed it; leaf i has the priority of position i."""
    stream = Stream(VECTOR, 1)
    buffer = PrioritizedSequenceReplayBuffer(5, VECTOR, ACTIONS, "cpu", alpha=0.5, **kwargs)
    stream.feed(n_adds, buffer)
    return buffer, stream


def leaves(buffer):
    return buffer._tree.get(np.arange(5)).tolist()


def test_priorities_of_overwritten_starts_are_ignored():
    buffer, stream = prioritized(5, n_steps=2)
    assert leaves(buffer) == [1, 1, 1, 1, 0]  # the window of the newest is not complete
    stream.feed(1, buffer)
    buffer.update_priorities(np.array([0, 1]), th.tensor([100.0, 9.0]))
    np.testing.assert_allclose(leaves(buffer), [0, 3, 1, 1, 1], atol=1e-6)
    buffer.update_priorities(np.array([1]), th.tensor([0.25]))
    stream.feed(1, buffer)  # a new one gets the largest priority so far, which is not that of the overwritten start
    np.testing.assert_allclose(leaves(buffer), [3, 0, 1, 1, 1], atol=1e-6)


def test_starts_that_a_shorter_window_completes_get_the_largest_priority():
    buffer, _ = prioritized(4, n_steps=3)
    buffer.update_priorities(np.array([0]), th.tensor([16.0]))
    np.testing.assert_allclose(leaves(buffer), [4, 1, 0, 0, 0], atol=1e-6)
    buffer.n_steps = 1
    buffer.sample(2)
    np.testing.assert_allclose(leaves(buffer), [4, 1, 4, 4, 0], atol=1e-6)
    buffer.n_steps = 2
    buffer.sample(2)
    np.testing.assert_allclose(leaves(buffer), [4, 1, 4, 0, 0], atol=1e-6)


@pytest.mark.parametrize("handle, expected", [(True, 0.0), (False, 1.0)])
def test_timeouts_are_terminal_only_if_they_are_not_handled(handle, expected):
    buffer = SequenceReplayBuffer(5, VECTOR, ACTIONS, "cpu", handle_timeout_termination=handle)
    zeros, one = np.zeros((1, 3), dtype=np.float32), np.ones(1)
    buffer.add(zeros, zeros, np.zeros(1), one, one, [{"TimeLimit.truncated": True}])
    assert buffer.sample(1).dones.item() == expected


def test_the_zeros_of_padding_are_never_overwritten():
    """In a long episode, no stored stack holds the zero frame, and all frames of the ring are reused."""
    store = FrameStore(4, 1, (2, 1), np.dtype(np.uint8), n_stack=2)
    stacks = [[0, 1], *([i, i + 1] for i in range(1, 20)), [0, 50], [50, 51], [51, 52]]
    for i, (stack, following) in enumerate(itertools.pairwise(stacks)):
        if following[0] != stack[1]:  # the end of an episode
            following = [stack[1], 99]
        pair = np.array([stack, following], dtype=np.uint8)[:, None, :, None]
        store.add(i % 4, *pair, overwrite=i >= 4)
        found = store.observations(np.array([i % 4]), np.array([0]), following=False)
        assert found.ravel().tolist() == stack


@pytest.mark.parametrize("name", ["_release", "_take_slots", "_put"])
def test_a_step_that_is_interrupted_damages_no_other(name, monkeypatch):
    """Of a full ring: its position keeps the zeros until it is written again, in an episode of its own."""
    store = FrameStore(8, 1, (1,), np.dtype(np.int64))

    def add(i, obs):
        store.add(i % 8, np.array([[obs]]), np.array([[obs + 1]]), overwrite=i >= 8)

    for i in range(11):
        add(i, i)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        original = getattr(store, name)

        def interrupted(*args):
            original(*args)
            raise KeyboardInterrupt

        patch.setattr(store, name, interrupted)
        add(11, 11)
    for i in range(11, 17):
        add(i, 100 + i)
        positions = np.arange(8)
        shown = [int(j) if j < 11 else int(100 + j) for j in i - (i - positions) % 8]
        for following in (False, True):
            found = store.observations(positions, np.zeros(8, int), following).ravel().tolist()
            assert found == [value + following for value in shown]


def test_a_first_stack_may_hold_any_frames():
    """Only neighbours that are equal share a slot."""
    store = FrameStore(4, 1, (4, 1), np.dtype(np.uint8), n_stack=4)
    stack = [7, 8, 7, 7]
    store.add(0, *np.array([stack, [*stack[1:], 9]], dtype=np.uint8)[:, None, :, None], overwrite=False)
    for following, expected in ((False, stack), (True, [*stack[1:], 9])):
        assert store.observations(np.array([0]), np.array([0]), following).ravel().tolist() == expected


@pytest.mark.parametrize("n_adds", [7, 95])
def test_a_reset_buffer_equals_a_new_one(n_adds):
    settings = (40, IMAGES, ACTIONS, "cpu", 2)
    kwargs = {"n_steps": 2, "prediction_depth": 3, "frame_stack": 4}
    used, new = (PrioritizedSequenceReplayBuffer(*settings, **kwargs) for _ in range(2))
    Stream(IMAGES, 2, seed=1).feed(n_adds, used)
    used.update_priorities(np.array([0]), th.tensor([16.0]))
    used.reset()
    Stream(IMAGES, 2, mean_length=3).feed(10, used, new)
    a, b = draw(used, 100), draw(new, 100)
    assert np.array_equal(a.indices, b.indices) and th.equal(a.rollout_observations, b.rollout_observations)
    assert np.array_equal(used._tree.get(np.arange(40)), new._tree.get(np.arange(40))) and used.nbytes == new.nbytes


@pytest.mark.parametrize("n_adds", [7, 95])
def test_a_loaded_buffer_continues_like_the_saved_one(n_adds):
    stream = Stream(IMAGES, 2, mean_length=3)
    buffer = PrioritizedSequenceReplayBuffer(40, IMAGES, ACTIONS, "cpu", 2, n_steps=2, prediction_depth=3, frame_stack=4)
    stream.feed(n_adds, buffer)
    buffer.update_priorities(buffer.sample(10).indices, th.rand(10))
    copy = pickle.loads(pickle.dumps(buffer))
    copy.device = th.device("meta")  # as after a copy on a GPU
    assert {part.device.type for part in copy.sample(4) if isinstance(part, th.Tensor)} == {"meta"}
    copy.device = buffer.device
    stream.feed(50, buffer, copy)
    for seed in range(3):
        for field, ours, theirs in zip(Samples._fields, draw(buffer, 100, seed), draw(copy, 100, seed), strict=True):
            assert np.array_equal(ours, theirs), field


def test_a_partly_filled_buffer_makes_a_small_file():
    space = spaces.Box(0, 255, (4, 84, 84), np.uint8)
    buffer = SequenceReplayBuffer(2_000, space, ACTIONS, "cpu", frame_stack=4)
    stack = np.zeros((1, 4, 84, 84), dtype=np.uint8)
    for _ in range(20):
        buffer.add(stack, stack, np.zeros(1), np.zeros(1), np.zeros(1, dtype=bool), [{}])
    assert len(pickle.dumps(buffer)) < 400_000


def stratified(**kwargs):
    """A full buffer of two environments with its 36 starts of windows."""
    buffer = PrioritizedSequenceReplayBuffer(40, VECTOR, ACTIONS, "cpu", 2, n_steps=3, prediction_depth=2, **kwargs)
    Stream(VECTOR, 2).feed(60, buffer)
    starts = np.unique(buffer.sample(1000).indices)
    assert len(starts) == 36
    return buffer, starts


def test_draws_and_weights_by_hand():
    buffer, starts = stratified(alpha=0.5, beta=0.4)
    buffer.update_priorities(starts, th.tensor(np.arange(1.0, 37.0) ** 2))
    samples = draw(buffer, 36_000)
    expected = np.arange(1.0, 37.0) / (36 * 37 / 2)  # P ∝ p^0.5
    counts = np.array([(samples.indices == s).sum() for s in starts])
    np.testing.assert_allclose(counts / 36_000, expected, atol=2 / 36_000)  # stratified: nearly exact
    weights = (36 * expected) ** -0.4
    weights /= weights.max()
    np.testing.assert_allclose(samples.weights, weights[np.searchsorted(starts, samples.indices)], rtol=1e-5)


def test_alpha_zero_is_uniform_and_beta_zero_has_no_weights():
    buffer, starts = stratified(alpha=0.0, beta=0.0)
    buffer.update_priorities(starts, th.rand(36) * 100)
    samples = buffer.sample(3600)
    assert th.equal(samples.weights, th.ones(3600))
    assert np.bincount(samples.indices)[starts].min() >= 98


def test_priorities_that_are_not_finite_are_ignored():
    buffer, starts = stratified()
    buffer.update_priorities(starts[:3], th.tensor([float("nan"), float("inf"), 0.0]))
    samples = buffer.sample(5000)
    assert th.isfinite(samples.weights).all()
    assert (samples.indices == starts[0]).any()


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"buffer_size": 8}, "n_steps \\+ prediction_depth \\+ 1 = 9"),
        ({"prediction_depth": -1}, "prediction_depth must be an integer >= 0, got -1"),
        ({"frame_stack": 3}, "frame_stack must divide"),
    ],
)
def test_arguments_out_of_range_raise(kwargs, message):
    arguments = {"buffer_size": 100, "n_steps": 3, "prediction_depth": 5, **kwargs}
    with pytest.raises(ValueError, match=message):
        PrioritizedSequenceReplayBuffer(observation_space=IMAGES, action_space=ACTIONS, device="cpu", **arguments)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_box_actions_must_be_finite(wrong):
    buffer = SequenceReplayBuffer(20, VECTOR, FORCES, "cpu")
    obs, zero = np.zeros((1, 3), dtype=np.float32), np.zeros(1, dtype=np.float32)
    with pytest.raises(ValueError, match="action must be finite, got"):
        buffer.add(obs, obs, np.array([[wrong, 0.0]]), zero, zero, [{}])
    assert buffer.size() == 0


NEEDS_GPU = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, NEEDS_GPU])])
def test_frames_in_a_tensor_equal_those_in_an_array(device):
    """As on a GPU; episodes of three steps make the store grow."""
    kwargs = {"n_steps": 2, "prediction_depth": 3, "frame_stack": 4}
    plain, other = (SequenceReplayBuffer(300, IMAGES, ACTIONS, where, 2, **kwargs) for where in ("cpu", device))
    store = other._stores[""]
    if device == "cpu":
        store._frames = th.from_numpy(store._frames)
    capacity = len(store._frames)
    Stream(IMAGES, 2, mean_length=3).feed(400, plain, other)
    assert len(store._frames) > capacity and isinstance(store._frames, th.Tensor)
    a, b = draw(plain, 100), draw(other, 100)
    assert th.equal(a.observations, b.observations.cpu()) and th.equal(a.rollout_observations, b.rollout_observations.cpu())
    np.testing.assert_array_equal(store.__getstate__()["_frames"], plain._stores[""].__getstate__()["_frames"])


def test_frames_that_a_gpu_has_no_room_for_stay_in_the_computer(monkeypatch):
    monkeypatch.setattr(th.cuda, "mem_get_info", lambda device: (1000, 2000))
    with pytest.warns(UserWarning, match=r"need 0.00 GB, and cuda has 0.00 GB left, also for updates, so they stay"):
        store = FrameStore(40, 1, (4, 84, 84), np.dtype(np.uint8), 4, "cuda")
    assert isinstance(store._frames, np.ndarray)


@pytest.mark.parametrize("kind", [SequenceReplayBuffer, PrioritizedSequenceReplayBuffer])
def test_a_buffer_without_a_whole_window_says_so(kind):
    buffer = kind(20, spaces.Box(-1, 1, (2,)), spaces.Discrete(2), n_steps=1, prediction_depth=4)
    for steps in (0, 3):
        with pytest.raises(ValueError, match=f"must hold 4 steps, a whole window, got {steps}"):
            buffer.sample(2)
        for _ in range(3):
            buffer.add(np.zeros((1, 2)), np.ones((1, 2)), np.zeros(1), np.zeros(1), np.zeros(1), [{}])
