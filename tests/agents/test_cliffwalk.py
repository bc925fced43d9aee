"""The blind cliffwalk, and the benefit of prioritised replay on it."""

import sys

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sb3_eqr.envs import BlindCliffwalk
from tests.tools.test_package import ROOT

sys.path.insert(0, str(ROOT / "examples"))
from blind_cliffwalk import make_model, updates_needed


def test_the_environment_passes_the_checker():
    check_env(BlindCliffwalk(4), skip_render_check=True)
    with pytest.raises(ValueError, match="n_states must be an integer >= 1, got 0"):
        BlindCliffwalk(0)


def test_transitions_and_rewards():
    env = BlindCliffwalk(3, seed=5)
    right = env.right_actions
    assert env.reset()[0] == 0
    assert env.step(right[0])[:4] == (1, 0.0, False, False)
    assert env.step(right[1])[:4] == (2, 0.0, False, False)
    assert env.step(right[2])[:4] == (2, 1.0, True, False)
    for wrong_at in range(3):
        env.reset()
        for state in range(wrong_at):
            env.step(right[state])
        assert env.step(1 - right[wrong_at])[1:4] == (0.0, True, False)
    assert {tuple(BlindCliffwalk(3, seed).right_actions) for seed in range(50)} == set(np.ndindex(2, 2, 2))
    values = env.q_values(0.5)
    assert [values[state, right[state]] for state in range(3)] == [0.25, 0.5, 1.0]
    assert [values[state, 1 - right[state]] for state in range(3)] == [0, 0, 0]


def test_the_replay_buffer_holds_every_sequence_once():
    buffer = make_model(5, seed=1, prioritized=True).replay_buffer
    # 2^5 sequences; 2^(5 - k) of them fail at step k, because all later actions are free.
    assert buffer.full and buffer.size() == 2**6 - 2
    assert buffer.rewards.sum() == 1 and buffer.dones.sum() == 2**5


def test_the_example_is_tabular():
    """One row of weights per state and action, and the first numbers of docs/results/cliffwalk.json."""
    parameters = dict(make_model(4, 0, True).policy.online.named_parameters())
    assert [tuple(value.shape) for value in parameters.values()] == [(2 * 51, 4), (2 * 51,)]
    assert (updates_needed(4, 0, False), updates_needed(4, 0, True)) == (162, 124)


@pytest.mark.slow
def test_prioritised_replay_needs_fewer_updates():
    """`python examples/blind_cliffwalk.py` tests this with 10 seeds and longer walks: docs/results/cliffwalk.md."""
    uniform, prioritized = (np.median([updates_needed(6, seed, way) for seed in range(5)]) for way in (False, True))
    assert prioritized < 0.9 * uniform
