"""The comparison with peers: its table is made from rounds, and a peer that is missing or fails is reported."""

import json
import sys

import numpy as np
import pytest

from experiments import peer_speed
from experiments.peer_calls import PEERS, reachable_bytes, stacks_of_frames
from experiments.peer_speed import ENVIRONMENTS, measure, parse, row_of, table

ABOUT = {"version": "pfrl 1", "note": "slow", "bytes_per_transition": 8_000.0}


def test_rows_and_table_by_hand():
    rounds = [{"update": [0.2, 0.1], "act": [0.01, 0.01]}, {"update": [0.4, 0.1], "act": [0.01, 0.01]}]
    baseline = [{"update": [0.1, 0.1]}, {"update": [0.1, 0.1]}]
    row = row_of("PFRL Rainbow", ABOUT, rounds, baseline)
    assert row["ms_update"] == pytest.approx(300) and row["times_DQN"] == pytest.approx(3)
    assert row["steps_per_s"] == pytest.approx(100) and row["us_add"] is None
    text = table([row])
    assert "| PFRL Rainbow | pfrl 1 | 10 | 64 | 32 | 300 | 100 | 3.00 | - | - | 8,000 | 100 |" in text
    assert text.endswith("- PFRL Rainbow: slow.")


def test_missing_peer_is_reported(tmp_path):
    (row,) = measure(["SBX DQN"], tmp_path, 1, 1)
    assert row["ms_update"] is None and "peer_speed env" in row["note"] and row["note"].endswith("--only sbx")
    assert json.loads(json.dumps(row)) == row


def test_failing_peer_is_reported(tmp_path, monkeypatch):
    failing = tmp_path / "python"
    failing.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('no such module')\n")
    failing.chmod(0o755)
    monkeypatch.setattr(peer_speed, "python_of", lambda folder, environment: failing)
    (row,) = measure(["SBX DQN"], tmp_path, 1, 1)
    assert row["note"] == "failed: no such module"


def test_reachable_bytes_counts_shared_memory_once():
    frames = np.zeros((10, 1_000), dtype=np.uint8)
    assert 10_000 <= reachable_bytes([frames[0], frames[1], {"again": frames}]) < 11_000


def test_environments_and_frames():
    assert {peer.environment for peer in PEERS.values()} - {None} == set(ENVIRONMENTS)
    stacks = stacks_of_frames()
    assert np.array_equal(stacks[1:, :-1], stacks[:-1, 1:])  # one new frame a step
    with pytest.raises(SystemExit):
        parse(["run", "folder", "--rounds", "0"])
