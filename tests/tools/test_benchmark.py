"""The command line of the benchmark, from an empty folder to a report."""

import dataclasses
import json
import pathlib
import signal
import subprocess
import sys
import time

import pytest
import yaml
from filelock import FileLock
from gymnasium import spaces
from ray.cluster_utils import Cluster
from rich.console import Console
from rl_zoo3.utils import ALGOS

from sb3_eqr import benchmark, cli
from sb3_eqr.benchmark import dispatch
from sb3_eqr.benchmark.agents import find_agent, hyperparameters
from sb3_eqr.benchmark.commands import read_seeds
from sb3_eqr.benchmark.evaluation import make_game
from sb3_eqr.benchmark.runs import Settings, plan_runs, read_plan, with_present_defaults, write_plan
from sb3_eqr.benchmark.selection import settings_differences
from sb3_eqr.benchmark.suites import choose, load_suite, make_suite, merge, read_suite, write_suite
from sb3_eqr.benchmark.training import execute
from sb3_eqr.configurations import ZOO_KEYS, with_schedule
from sb3_eqr.eqr_rainbow.policies import EqRRainbowPolicy

FAST = (
    "{policy: MlpPolicy, n_timesteps: 9, learning_starts: 9, batch_size: 4, buffer_size: 99, policy_kwargs: {net_arch: [8]}}"
)
SUITE = {
    "env_id": "{game}-v1",
    "games": ["CartPole", "Acrobot"],
    "steps": 60,
    "evaluation": {"episodes": 2, "n_envs": 2, "max_steps": 30, "curve": {"points": 2, "episodes": 1}},
    "normalisation": {"unit": "unit", "source": "test", "scores": {"CartPole": [0, 30], "Acrobot": [-30, 0]}},
}


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    pathlib.Path("own.yml").write_text(yaml.safe_dump({"tiny": SUITE}))
    named = "three: {base: fast.yml, changes: {gamma: 0.3}}\ntwo: {base: fast.yml, changes: {gamma: 0.2}}\n"
    pathlib.Path("named.yml").write_text(named)
    pathlib.Path("fast.yml").write_text(f"CartPole-v1: {FAST}\nAcrobot-v1: {FAST}\n")
    return tmp_path


@pytest.fixture(scope="module")
def cluster():
    """The address of a Ray cluster with one CPU."""
    started = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    yield started.address
    started.shutdown()


@pytest.fixture
def call(sb3_eqr):
    return lambda line, code=0: sb3_eqr(f"benchmark {line}", code)


@pytest.fixture
def suite(files):
    return choose(load_suite("tiny", files / "own.yml"), ["CartPole"], None)


@pytest.mark.slow
def test_from_an_empty_folder_to_scores(files, call, cluster):
    line = "run b --suite tiny --suite-file own.yml --agents dqn:fast.yml qrdqn:fast.yml"
    assert "qrdqn:fast, CartPole, seed 0: finished" in call(f"{line} --games cartpole --seeds 1").out
    before = {path: path.stat().st_mtime for path in files.glob("b/runs/*/*/*/result.json")}
    shown = call(f"{line} --seeds 2 --ray {cluster}").out  # more seeds and another game
    assert "2 of 8 runs are already finished." in shown and "CartPole, seed 0: finished" not in shown
    results = {path: json.loads(path.read_text()) for path in files.glob("b/runs/*/*/*/result.json")}
    assert len(results) == 8 and all(path.stat().st_mtime == time for path, time in before.items())
    assert results[files / "b/runs/dqn-fast/Acrobot/1/result.json"]["command"].startswith(f"sb3-eqr benchmark {line}")
    rows = [row.split() for row in call("status b").out.splitlines()]
    assert ["dqn:fast", "4/4", "100%"] in rows and ["all", "8/8", "100%"] in rows
    scores = benchmark.load_scores("b")
    assert scores.columns.tolist() == ["agent", "game", "seed", "step", "kind", "episode", "score", "length"]
    counts = scores[scores["kind"] != "training"].groupby(["agent", "game", "seed", "step", "kind"]).size()
    expected = {(a, g, s): {30: 1, 60: 2} for a in ("dqn:fast", "qrdqn:fast") for g in ("CartPole", "Acrobot") for s in (0, 1)}
    assert counts.droplevel("kind").to_dict() == {(*run, step): n for run, row in expected.items() for step, n in row.items()}
    assert read_suite(files / "b" / "suite.yml").games == ["CartPole", "Acrobot"]
    assert "8 of 8 runs are already finished." in call("run b").out
    assert "8 runs in b.jsonl.xz" in call("pack b b.jsonl.xz").out
    (files / "b/runs/dqn-fast/Acrobot/1/result.json").unlink()
    assert "1 of 8 runs are left" in call("run b --stop-after 0.001").out
    assert "All runs are finished" in call("run b").out
    result = json.loads((files / "b/runs/dqn-fast/Acrobot/1/result.json").read_text())
    assert result["command"].startswith(f"sb3-eqr benchmark {line}")  # not the command that resumed it


BROKEN = f"CartPole-v1: {FAST.replace('batch_size: 4', 'batch_size: 4, max_grad_norm: wrong')}\n"


@pytest.mark.slow
def test_processes_that_crash_or_lose_their_parent(files, call):
    (files / "broken.yml").write_text(BROKEN)
    shown = call(f"{RUN} dqn:broken.yml --games CartPole --seeds 1 --jobs 2", code=1).out
    assert shown.count("crashed (ValueError: could not convert") == 2
    assert "dqn:fast, CartPole, seed 0: finished" in shown and "failed: dqn:broken, CartPole, seed 0:" in shown
    result = json.loads((files / "b/runs/dqn-fast/CartPole/0/result.json").read_text())
    assert result["machine"]["threads"] == 1
    assert "could not convert" in (files / "b/runs/dqn-broken/CartPole/0/log.txt").read_text()
    code = "import sys; sys.argv = sys.argv[:1] + {}; from sb3_eqr.cli import main; main()"
    words = ["benchmark", *f"{RUN} --games CartPole --seeds 1 --steps 1000000".replace(" b ", " c ").split()]
    run = files / "c/runs/dqn-fast/CartPole/0"
    for sent, status in ((signal.SIGINT, 2), (signal.SIGKILL, -signal.SIGKILL)):
        process = subprocess.Popen([sys.executable, "-c", code.format(words)], stderr=subprocess.PIPE, start_new_session=True)
        wait_until(lambda: (run / "progress.json").is_file())
        process.send_signal(sent)
        shown = process.communicate(timeout=60)[1].decode()
        assert process.returncode == status and "Traceback" not in shown
        assert ("interrupted. The same command continues" in shown) == (status == 2)
        wait_until(lambda: not read_plan(files / "c")[0].is_locked())
        (run / "progress.json").unlink(missing_ok=True)


def wait_until(holds, seconds=60):
    until = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.1)


class InThisProcess:
    """Executes a run when its outcome is requested."""

    slots = 1

    def __init__(self):
        self.started = []

    def start(self, run):
        self.started.append(run)
        return len(self.started) - 1

    def wait(self, handles, timeout):
        return handles[:1]

    def outcome(self, handle):
        try:
            return execute(self.started[handle], Settings())
        except ValueError as error:
            raise dispatch.Crash(f"ValueError {error}") from error


def test_a_crashed_run_is_tried_twice_and_reported_while_the_others_continue(files, suite, call, capfd):
    (files / "broken.yml").write_text(BROKEN)

    def all_runs():
        runs = plan_runs(files / "b", suite, ["dqn:broken.yml", "dqn:fast.yml"], [0])
        write_plan(files / "b", suite, runs)
        waiting = [run for run in runs if run.state().name != "done"]
        failed = dispatch.finish(InThisProcess(), runs, waiting, Settings(), Console())
        return [run.agent.name for run in failed], capfd.readouterr().out

    failed, out = all_runs()
    assert failed == ["dqn:broken"]
    assert out.count("dqn:broken, CartPole, seed 0: crashed (ValueError") == 2
    assert "dqn:fast, CartPole, seed 0: finished" in out
    assert json.loads((files / "b/runs/dqn-fast/CartPole/0/result.json").read_text())["attempts"] == 1
    assert "failed: dqn:broken, CartPole, seed 0: ValueError: could not convert" in call("status b").out
    (files / "broken.yml").write_text((files / "fast.yml").read_text())
    failed, out = all_runs()
    assert failed == [] and "dqn:broken, CartPole, seed 0: finished" in out and "dqn:fast, CartPole, seed 0" not in out
    assert [run.state().name for run in read_plan(files / "b")] == ["done", "done"]


RUN = "run b --suite tiny --suite-file own.yml --agents dqn:fast.yml"


@pytest.mark.parametrize(
    "line, message",
    [
        ("run b --suite atari10k --agents dqn", "no suite 'atari10k'. Did you mean 'atari100k'? Choose from atari100k, atari"),
        ("run b --suite atari100k --games Pnog --agents dqn", "suite 'atari100k' has no game 'Pnog'. Did you mean 'Pong'?"),
        ("run b --suite smoke --agents dnq", "there is no algorithm 'dnq'. Did you mean 'dqn'?"),
        ("run b --suite smoke --agents ppo:stock", "'ppo:stock': there are no hyperparameters 'stock'. Use 'ppo' alone"),
        ("run b --suite smoke --agents sac", "sac does not support discrete actions"),
        ("run b --suite smoke --agents ppo --steps 2001", "steps must be a multiple of n_envs = 8, got 2001"),
        ("run b --suite smoke --agents eqr_rainbow:se2+ate", "no hyperparameters 'se2+ate'. Did you mean 'se2+aet'?"),
        ("run b --suite minatar --agents eqr_rainbow:der", "no section for 'MinAtar/Asterix-v1'"),
        ("run b --suite smoke --agents dqn dqn", "--agents must be different agents, got dqn more than once"),
        ("run b --suite smoke", "--suite and --agents must be given together"),
        ("run b", "got one without runs"),
        ("run b --steps 30", "--steps needs --suite and --agents"),
        ("run b --suite smoke --agents dqn:stock/dqn", "no hyperparameters 'stock/dqn'. Did you mean 'stock'?"),
        ("run b --suite smoke --agents dqn:other.yml", "'dqn:other.yml': there is no file other.yml"),
        ("status b", "got one without runs"),
        (f"{RUN} --seeds 0", "--seeds must be >= 1, or different seeds >= 0 such as 1,3; got 0"),
        (f"{RUN} --jobs 0", "--jobs must be >= 1, got 0"),
        (f"{RUN} --stop-after 0", "--stop-after must be > 0 seconds, got 0"),
        (f"{RUN} --gpus-per-run 1", "--gpus-per-run needs --ray, got 1 without it"),
        (f"{RUN} --episodes 0", "--episodes must be >= 1, got 0"),
        ("run b --suite tiny --suite-file own.yml --agents dqn:named.yml:thre", "has no agent 'thre'. Did you mean 'three'"),
        (f"{RUN} --steps 0", "--steps must be >= 1, got 0"),
        (f"{RUN} --cpus-per-run 0", "--cpus-per-run"),
        (f"{RUN} --device cuda:7", "PyTorch finds no GPU"),
        (f"{RUN} --suite-file other.yml", "there is no file other.yml"),
        ("report b --reference x", "--reference must be NAME=FILE, got 'x'"),
    ],
)
def test_wrong_use_prints_an_error(files, call, line, message):
    shown = call(line, code=2).err
    assert message in shown and "Traceback" not in shown


@pytest.mark.slow
def test_runs_that_need_too_many_cpus_print_an_error(files, call, cluster):
    shown = call(f"{RUN} --seeds 1 --cpus-per-run 2 --ray {cluster}", code=2).err
    assert "--cpus-per-run must be <= 1, the CPUs of the largest machine, got 2" in shown


def test_an_unreachable_cluster_prints_an_error(files, call):
    assert "127.0.0.1:1" in call(f"{RUN} --seeds 1 --ray 127.0.0.1:1", code=2).err


def test_runs_with_different_settings_cannot_share_a_folder(files, suite):
    benchmark_plan = plan_runs(files / "b", suite, ["dqn:fast.yml"], [0])
    write_plan(files / "b", suite, benchmark_plan)
    plan_runs(files / "b", choose(suite, None, 70), ["dqn:fast.yml"], [0])  # no run has started yet
    (benchmark_plan[0].folder / "result.json").write_text("{}")
    with pytest.raises(ValueError, match="steps must be 60, as when the run was started, got 70"):
        plan_runs(files / "b", choose(suite, None, 70), ["dqn:fast.yml"], [0])
    (files / "fast.yml").write_text(f"CartPole-v1: {FAST.replace('batch_size: 4', 'batch_size: 8')}")
    with pytest.raises(ValueError, match=r"hyperparameters.batch_size must be 4, as when the run was started, got 8"):
        plan_runs(files / "b", suite, ["dqn:fast.yml"], [0])
    with pytest.raises(ValueError, match="must be of suite 'tiny', as those that are there, got 'smoke'"):
        write_plan(files / "b", load_suite("smoke"), [])


def test_null_is_not_the_default(files, suite):
    """group: null is no group; without the key, the agent has SE(2)."""
    text = "base: eqr_qrdqn\nchanges: {gradient_steps: 1"
    (files / "one.yml").write_text(text + "}")
    runs = plan_runs(files / "b", suite, ["eqr_qrdqn:one.yml"], [0])
    write_plan(files / "b", suite, runs)
    (runs[0].folder / "result.json").write_text("{}")
    (files / "one.yml").write_text(text + ", policy_kwargs: {group: null}}")
    with pytest.raises(ValueError, match=r"policy_kwargs.group must be .*, as when the run was started, got None"):
        plan_runs(files / "b", suite, ["eqr_qrdqn:one.yml"], [0])
    entries = [{"policy_kwargs": {"net_arch": [8]}}, {"policy_kwargs": {"net_arch": [8], "group": None}}]
    results = [{"agent": "a", "game": "g", "entry": {"hyperparameters": entry}} for entry in entries]
    assert settings_differences(results) == ["a: its runs differ in policy_kwargs.group."]


@pytest.mark.parametrize(
    "base, changes, message",
    [
        ("eqr_qrdqn", "frame_stack: 2", "must not change the suite's environment, got its own frame_stack"),
        ("eqr_qrdqn", "gradient_stepz: 3", "'gradient_stepz' is not an argument of EqRQRDQN"),
        ("text.yml", "policy_kwargs: {net_arch: [8]}", "policy_kwargs must be a mapping in text.yml"),
    ],
)
def test_changes_of_an_entry_are_checked(files, suite, base, changes, message, capsys):
    (files / "text.yml").write_text('CartPole-v1: {policy: MlpPolicy, n_timesteps: 60, policy_kwargs: "dict(net_arch=[4])"}')
    (files / "one.yml").write_text(f"base: {base}\nchanges: {{{changes}}}")
    protocol = {**suite.protocol("CartPole"), "preprocessing": {"frame_stack": None}}
    with pytest.raises((ValueError, SystemExit)) as found:
        hyperparameters(find_agent("eqr_qrdqn:one.yml"), protocol, spaces.Discrete(2))
    assert message in str(found.value) + capsys.readouterr().err


def test_runs_of_a_version_with_other_defaults_cannot_share_a_folder(files, suite, monkeypatch):
    (run,) = plan_runs(files / "b", suite, ["eqr_rainbow"], [0])
    assert run.defaults["td_coef"] == 1.0 and run.defaults["policy_kwargs"]["n_atoms"] == 51
    assert "learning_starts" not in run.defaults  # which the entry has
    write_plan(files / "b", suite, [run])
    (run.folder / "result.json").write_text("{}")
    monkeypatch.setattr(EqRRainbowPolicy.__init__, "__defaults__", (11, *EqRRainbowPolicy.__init__.__defaults__[1:]))
    with pytest.raises(ValueError, match=r"policy_kwargs.n_atoms must be 51, as when the run was started, got 11"):
        plan_runs(files / "b", suite, ["eqr_rainbow"], [0])
    assert with_present_defaults([run]) == [run]  # it is finished
    (run.folder / "result.json").unlink()
    (waiting,) = with_present_defaults([run])
    assert waiting.defaults["policy_kwargs"]["n_atoms"] == 11
    assert read_plan(files / "b")[0].defaults == waiting.defaults  # which the next call compares with
    write_plan(files / "b", suite, [run])
    with FileLock(run.folder / "lock"), pytest.raises(ValueError, match="n_atoms must be 51, as when the run was"):
        with_present_defaults([run])
    (run.folder / "result.json").write_text("{}")
    write_plan(files / "b", suite, [dataclasses.replace(run, defaults={})])
    assert read_plan(files / "b")[0].defaults == run.defaults  # a finished run keeps what it was started with


def test_missing_ray_prints_an_error(files, call, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "sb3_eqr.benchmark.cluster", raising=False)
    shown = call(f"{RUN} --ray", code=2).err
    assert "ray" in shown and 'Run pip install ".[cluster]" in a clone of the repository' in shown


def test_the_command_without_its_extra(call, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["sb3-eqr", "benchmark", "status", "b"])
    monkeypatch.delitem(sys.modules, "sb3_eqr.benchmark.commands", raising=False)
    monkeypatch.setitem(sys.modules, "rich.console", None)
    with pytest.raises(SystemExit, match=r'sb3-eqr benchmark: .*rich.*pip install "\.\[benchmark\]" in a clone of the repo'):
        cli.main()
    call("run --help")


@pytest.mark.parametrize(
    "change, message",
    [
        ({"step": 1}, "unknown key 'step'. Did you mean 'steps'"),
        ({"steps": ..., "step": 1}, "unknown key 'step'. Did you mean 'steps'"),  # without steps
        ({"env_id": {"CartPole": "CartPole-v1"}}, "env_id must have every game, got none for Acrobot"),
        ({"steps": {"CartPole": 10}}, "steps must have every game, got none for Acrobot"),
        ({"steps": 0}, "steps: CartPole: input should be greater than 0, got 0"),
        ({"evaluation": {"episodes": 1, "n_envs": 1}}, "evaluation: curve must be set, got nothing"),
        ({"evaluation": {**SUITE["evaluation"], "epsilom": 0}}, "unknown key 'evaluation: epsilom'. Did you mean 'epsilon'"),
        ({"normalisation": {"unit": "x"}}, "normalisation: source must be set, got nothing"),
        ({"games": "CartPole"}, "games: input should be a valid list, got 'CartPole'"),
        ({"env_id": "CartPole-v1"}, "env_id must contain {game} and no other braces, got 'CartPole-v1'"),
        ({"env_id": "{game}-{v}"}, "env_id must contain {game} and no other braces, got '{game}-{v}'"),
        ({"evaluation": None}, "evaluation: input should be a valid dictionary or i.*, got None"),
        ({"evaluation": {**SUITE["evaluation"], "n_envs": 0}}, "evaluation: n_envs: input should be greater than 0, got 0"),
        ({"evaluation": {**SUITE["evaluation"], "epsilon": 7}}, "epsilon: input should be less than or equal to 1, got 7"),
        ({"normalisation": {**SUITE["normalisation"], "scores": {}}}, "got none for CartPole, Acrobot"),
        ({"games": ["a/b", "a-b"], "steps": 4}, "games must have names that differ as names of folders, got a/b, a-b"),
        (
            {"env_kwargs": {"cartpole": {"render_mode": None}}},
            "env_kwargs: there is no game 'cartpole'. Did you mean 'CartPole'",
        ),
        ({"env_id": "{game}-v9"}, "'CartPole-v9' is not registered with gymnasium. Did you mean"),
    ],
)
def test_invalid_suites_raise(files, change, message):
    entry = {key: value for key, value in (SUITE | change).items() if value is not ...}
    (files / "own.yml").write_text(yaml.safe_dump({"tiny": entry}))
    with pytest.raises(ValueError, match=message):
        choose(load_suite("tiny", files / "own.yml"), None, None)


@pytest.mark.parametrize(
    "preprocessing, message",
    [
        ({}, "evaluation must be on full episodes with raw scores, got no preprocessing"),
        ({"env_wrapper": "gymnasium.wrappers.Nope"}, "PongNoFrameskip-v4: .*Nope"),
        ({"env_wrapper": "sb3_eqr.envs.atari.Atari100kWrapper"}, "raw scores, got ClipRewardEnv, EpisodicLifeEnv"),
        ({"env_wrapper": [{"sb3_eqr.envs.atari.Atari100kWrapper": {"training": False}}]}, "got its own frame_stack"),
    ],
)
def test_atari_suites_with_the_wrong_evaluation_environment_raise(files, preprocessing, message):
    entry = SUITE | {"env_id": "{game}NoFrameskip-v4", "games": ["Pong"], "normalisation": "human"}
    entry["preprocessing"] = preprocessing
    (files / "own.yml").write_text(yaml.safe_dump({"tiny": entry}))
    suite = choose(load_suite("tiny", files / "own.yml"), None, None)
    with pytest.raises(ValueError, match=message):
        plan_runs(files / "b", suite, ["qrdqn:stock"], [0])


def test_a_replay_buffer_is_no_larger_than_the_run(files):
    """The default of QRDQN is 1,000,000, which is 56 GB of Atari frames."""
    suite = choose(load_suite("smoke"), None, None)
    runs = plan_runs(files / "b", suite, ["qrdqn", "eqr_qrdqn", "dqn:fast.yml", "ppo"], [0])
    assert [run.entry.get("buffer_size") for run in runs] == [3_000, 3_000, 99, None]


def test_a_crash_on_a_full_disk_does_not_stop_the_others(files, suite, capsys, monkeypatch):
    """Its message may look like markup."""
    runs = plan_runs(files / "b", suite, ["dqn:fast.yml"], [0])

    def full(*_):
        raise OSError(28, "No space left on device")

    class Crashing(InThisProcess):
        def outcome(self, handle):
            raise dispatch.Crash("the [last] line")

    monkeypatch.setattr(dispatch, "atomic_write", full)
    assert dispatch.finish(Crashing(), runs, runs, Settings(), Console()) == runs
    assert capsys.readouterr().out.count("dqn:fast, CartPole, seed 0: crashed (the [last] line)") == 2


def test_nothing_starts_after_the_time_to_stop(files, suite):
    runs, pool = plan_runs(files / "b", suite, ["dqn:fast.yml"], [0, 3]), InThisProcess()
    assert dispatch.finish(pool, runs, runs, Settings(stop_at=time.time() - 1), Console()) == []
    assert pool.started == []


@pytest.mark.parametrize(
    "text, first, seeds",
    [("2", 0, [0, 1]), ("2", 3, [3, 4]), ("1,3", 0, [1, 3]), ("0,", 0, None), ("1,1", 0, None), ("1,2", 1, None)],
)
def test_seeds(text, first, seeds):
    if seeds is None:
        with pytest.raises(ValueError, match="seed"):
            read_seeds(text, first)
    else:
        assert read_seeds(text, first) == seeds


def test_our_suites(tmp_path):
    atari = load_suite("atari100k")
    reference = benchmark.load_reference()
    assert {game.lower() for game in atari.games} == set(reference["game"]) and set(atari.steps.values()) == {100_000}
    assert atari.normalisation.scores["Pong"] == [-20.7, 14.6]  # the paper's Table 2
    assert load_suite("atari100k-5").games == ["Assault", "BattleZone", "Boxing", "ChopperCommand", "Qbert"]
    for name in ("atari100k", "atari100k-5", "minatar", "classic", "worlds", "smoke", "smoke-atari"):
        suite = choose(load_suite(name), None, None)
        assert suite.normalisation.scores.keys() == set(suite.games), name
        assert all(high > low for low, high in suite.normalisation.scores.values())
        write_suite(suite, tmp_path / "suite.yml")
        assert read_suite(tmp_path / "suite.yml") == suite
    evaluation = atari.evaluation
    assert (evaluation.episodes, evaluation.epsilon, evaluation.max_steps) == (100, 0.001, 27_000)


def test_agents_and_their_files():
    assert find_agent("qrdqn").file.name == "qrdqn.yml" and "rl_zoo3" in str(find_agent("qrdqn").file)
    assert find_agent("qrdqn:stock").file.parent.name == "stock"
    assert find_agent("eqr_rainbow").file.parent.name == "zoo_hyperparams"
    assert find_agent("eqr_rainbow:se2+aet").file.name == "se2+aet.yml"  # and not se2+aet+r


def test_files_of_agents_build_on_each_other(tmp_path):
    several = tmp_path / "several.yml"
    several.write_text("one: {base: off, changes: {gamma: 0.9}}\ntwo: {base: several.yml:one, changes: {tau: 0.5}}\n")
    (tmp_path / "other.yml").write_text("base: several.yml:two\nchanges:\n")
    found = find_agent(f"eqr_rainbow:{tmp_path}/other.yml")  # from another folder
    assert (found.name, found.file.name) == ("eqr_rainbow:other", "eqr_rainbow.yml")
    assert found.changes == {"prediction_depth": 0, "policy_kwargs": {"group": None}, "gamma": 0.9, "tau": 0.5}


@pytest.mark.parametrize(
    "text, name, message",
    [
        ("[", None, r"own.yml must be valid YAML"),
        ("", "slow", r"own.yml must be a mapping, got None"),
        ("slow: {learning_rate: 0.5}", "slow", r"'slow' must be a mapping with base and changes, got \{'learning_rate': 0.5"),
        ("base: own.yml", None, "base must be another agent, got this one"),
        ("slow: {base: own.yml:slow}", "slow", "base must be another agent, got this one"),
        ("{base: stock, changes: 3}", None, "changes must be a mapping, got 3"),
        ("a/b: {base: stock}", "a/b", r"must have no slashes, as it names a folder, got 'a/b'"),
    ],
)
def test_invalid_files_of_agents_raise(tmp_path, text, name, message):
    (tmp_path / "own.yml").write_text(text)
    with pytest.raises(ValueError, match=message):
        find_agent(f"dqn:{tmp_path}/own.yml" + ("" if name is None else f":{name}"))


def test_suites_of_two_files_are_merged_game_by_game():
    raw = {key: value for key, value in SUITE.items() if key != "normalisation"}
    hill = {**raw, "games": ["Hill"], "steps": 9, "env_id": {"Hill": "MountainCar-v0"}}
    kwargs = {"CartPole": {"sutton_barto_reward": True}}
    second = make_suite("tiny", "b", hill)
    with pytest.raises(ValueError, match=r"unit must be 'unit', as that of the runs that are there, got 'raw"):
        merge(make_suite("tiny", "a", SUITE), second)
    both = merge(make_suite("tiny", "a", {**raw, "env_kwargs": kwargs}), second)
    assert both.games == ["CartPole", "Acrobot", "Hill"] and both.protocol("Hill")["env_id"] == "MountainCar-v0"
    assert both.protocol("CartPole")["env_id"] == "CartPole-v1" and both.steps["Hill"] == 9
    assert both.protocol("CartPole")["preprocessing"] == {"env_kwargs": kwargs["CartPole"]}


def test_several_agents_in_one_file(files):
    suite = choose(load_suite("tiny", files / "own.yml"), ["CartPole"], None, episodes=3)
    runs = plan_runs(files / "b", suite, ["dqn:named.yml:two", "dqn:named.yml:three", "dqn:fast.yml"], [5])
    found = [(run.agent.name, run.entry.get("gamma")) for run in runs]
    assert found == [("dqn:two", 0.2), ("dqn:three", 0.3), ("dqn:fast", None)]
    assert runs[0].entry["batch_size"] == 4 and runs[0].protocol["evaluation"]["episodes"] == 3


def test_our_environments_are_a_suite(files):
    """With the arguments of each, in training and evaluation."""
    suite = choose(load_suite("worlds"), None, 100)
    runs = {run.game: run for run in plan_runs(files / "b", suite, ["eqr_rainbow"], [0])}
    assert {runs[game].protocol["env_id"] for game in runs} >= {"SlidingBallTorus-v0", "PixelPendulum-v0", "BlindCliffwalk-v0"}
    assert runs["torus_of_8"].entry["env_kwargs"]["n_distractors"] == 8
    env = make_game(runs["torus_of_4"].protocol)
    assert env.unwrapped.n_distractors == 4 and env.unwrapped.n_steps == 16


@pytest.mark.parametrize("off, same", [("eqr_qrdqn:off", "eqr_qrdqn:qrdqn"), ("eqr_rainbow:off", "eqr_rainbow:rainbow")])
def test_agents_without_eqr_have_the_rest_of_their_entry(off, same):
    """On MinAtar, these are the agents of two files of ablations, which are written by hand."""
    suite = load_suite("minatar")
    for game in suite.games:
        first, second = (hyperparameters(find_agent(name), suite.protocol(game), spaces.Discrete(6)) for name in (off, same))
        assert first == {**first, **second}
        assert first.keys() - second.keys() <= {"aet_coef", "symmetry_coef", "reward_coef", "aux_gradient_share"}


@pytest.mark.parametrize("algo", ["eqr_qrdqn", "eqr_rainbow"])
def test_an_entry_without_eqr_builds_its_agent(algo):
    """CartPole's have a Q head on the group elements and a projection by the Q head."""
    protocol = load_suite("smoke").protocol("CartPole-v1")
    entry = hyperparameters(find_agent(f"{algo}:off"), protocol, spaces.Discrete(2))
    arguments = with_schedule({key: value for key, value in entry.items() if key not in ZOO_KEYS})
    model = ALGOS[algo](entry["policy"], "CartPole-v1", **arguments)
    assert model.depth == 0 and model.policy.options.group is None and model.gamma == entry["gamma"]


def test_scores_without_runs(tmp_path):
    with pytest.raises(ValueError, match=r"got one without suite\.yml"):
        benchmark.load_scores(tmp_path)
