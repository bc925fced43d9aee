"""The table of docs/files.md: which commands run code that files from others name. Each line is executed, the first
by ``test_loading_executes_no_code``."""

import pathlib
import pickle
import re

import pytest
import torch as th
import yaml
from stable_baselines3 import DQN

from sb3_eqr import EqRQRDQN, ExactCheckpointCallback
from sb3_eqr.eqr_sac import EqRSACPolicy
from sb3_eqr.trust import check_zoo_folder, is_plain

DOCS = pathlib.Path(__file__).parents[2] / "docs" / "files.md"
SMALL = {"buffer_size": 500, "learning_starts": 10, "device": "cpu"}


class Runs:
    def __reduce__(self):
        return pathlib.Path.touch, (pathlib.Path("ran"),)


def ran(call, *args):
    """Whether a call, which may fail, ran the code."""
    try:
        call(*args)
    except (Exception, SystemExit) as error:
        print(error)
    found = pathlib.Path("ran").exists()
    pathlib.Path("ran").unlink(missing_ok=True)
    return found


@pytest.fixture
def hostile(tmp_path, monkeypatch):
    """The folder of a run, whose settings can be changed: returns a function that writes them."""
    monkeypatch.chdir(tmp_path)
    for algo, kind in (("eqr_qrdqn", EqRQRDQN), ("dqn", DQN)):
        folder = pathlib.Path("logs", algo, "CartPole-v1_1")
        (folder / "CartPole-v1").mkdir(parents=True)
        kind("MlpPolicy", "CartPole-v1", **SMALL).save(folder / "CartPole-v1")

    def write(algo="eqr_qrdqn", statistics=False, **settings):
        beside = pathlib.Path("logs", algo, "CartPole-v1_1", "CartPole-v1")
        config = {"policy": "MlpPolicy", "n_timesteps": 50, "normalize": statistics, **settings}
        (beside / "config.yml").write_text(yaml.safe_dump(config))
        (beside / "args.yml").write_text(yaml.safe_dump({"env": "CartPole-v1", "gym_packages": [], "env_kwargs": None}))
        (beside / "vecnormalize.pkl").unlink(missing_ok=True)
        if statistics:
            (beside / "vecnormalize.pkl").write_bytes(pickle.dumps(Runs()))
        return beside.parent

    return write


TOUCH = "__import__('pathlib').Path('ran').touch()"
SETTINGS = [
    {"policy_kwargs": f"dict(net_arch=[{TOUCH} or 8])"},
    {"replay_buffer_kwargs": f"[{TOUCH}]"},
    {"monitor_kwargs": f"dict(x={TOUCH})"},
    {"normalize": f"dict(x={TOUCH})"},
    {"statistics": True},
]


def test_the_table_is_the_one_that_is_tested():
    rows = re.findall(
        r"^\| (?!what|-)(.*) \| (yes|no)(?:; yes with [^|]*)? \|$", DOCS.read_text(encoding="utf-8"), re.MULTILINE
    )
    assert [answer for _, answer in rows] == "no no no yes yes yes yes".split()


def test_sb3s_load_of_a_policy_runs_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    th.save(Runs(), "policy.pth")
    assert ran(EqRSACPolicy.load, "policy.pth")


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_commands_that_run_no_code(hostile, sb3_eqr, settings, tmp_path):
    folder = hostile(**settings)
    model = folder / "CartPole-v1.zip"
    place = f"--algo eqr_qrdqn --env CartPole-v1 -f {tmp_path}/logs"
    EqRQRDQN("MlpPolicy", "CartPole-v1", **SMALL).learn(30, ExactCheckpointCallback(20, folder / "checkpoints"))
    lines = [f"train --algo eqr_qrdqn --env CartPole-v1 --resume {folder} -n 60 -f new", f"enjoy {place} -n 5 --no-render"]
    lines += [f"record_video {place} -n 5", f"push_to_hub {place} -orga none --dry-run"]
    if "statistics" in settings:
        lines += [f"train --algo eqr_qrdqn --env CartPole-v1 -i {model} -n 20 -f new -params normalize:True"]
    for line in lines:
        assert not ran(sb3_eqr, line), line


def test_commands_that_run_code(hostile, sb3_eqr, tmp_path):
    folder = hostile(**SETTINGS[0])
    hostile("dqn", **SETTINGS[3])
    settings = folder / "CartPole-v1" / "config.yml"
    pathlib.Path("file.yml").write_text(yaml.safe_dump({"CartPole-v1": yaml.safe_load(settings.read_text())}))
    place = f"--env CartPole-v1 -f {tmp_path}/logs -n 5 --no-render"
    assert ran(sb3_eqr, "train --algo eqr_qrdqn --env CartPole-v1 --conf-file file.yml -n 20 -f new")
    assert ran(sb3_eqr, f"enjoy --algo dqn {place}")
    hostile(**SETTINGS[3])
    assert ran(sb3_eqr, f"enjoy --algo eqr_qrdqn {place} --trust")


@pytest.mark.parametrize("text", ["dict(a=[1, -2.5], b=dict(c='x'))", "{'a': (1, None)}", "True"])
def test_plain_expressions(text):
    assert is_plain(text)


@pytest.mark.parametrize("text", [TOUCH, "dict(a=dict)", "dict.__class__", "[x for x in dict()]", "print(1)", "(", "nn.ReLU"])
def test_other_expressions(text):
    assert not is_plain(text)


@pytest.mark.parametrize("missing", ["args.yml", "config.yml"])
def test_one_file_alone_is_checked(hostile, sb3_eqr, missing, tmp_path):
    """RL Zoo reads each of them without the other."""
    beside = hostile(**SETTINGS[3]) / "CartPole-v1"
    (beside / missing).unlink()
    if missing == "config.yml":
        (beside / "args.yml").write_text("!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path [ran]]")
    assert not ran(sb3_eqr, f"enjoy --algo eqr_qrdqn --env CartPole-v1 -f {tmp_path}/logs -n 5 --no-render")


WRAPPERS = ["sb3_eqr.envs.atari.Atari100kWrapper", "stable_baselines3.common.atari_wrappers.WarpFrame"]
WRAPPERS += ["sb3_contrib.common.wrappers.TimeFeatureWrapper", "gymnasium.wrappers.FlattenObservation"]
WRAPPERS += [
    "gymnasium.wrappers.TimeLimit",
    "rl_zoo3.wrappers.MaskVelocityWrapper",
    "stable_baselines3.common.vec_env.VecFrameStack",
]


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_wrappers_of_kept_libraries_are_allowed(wrapper, tmp_path):
    (tmp_path / "config.yml").write_text(yaml.safe_dump({"env_wrapper": [{wrapper: {}}, "mine.Wrapper"]}))
    with pytest.raises(ValueError, match=r"that write no files, got mine\.Wrapper\. "):  # the other one alone
        check_zoo_folder(tmp_path)


@pytest.mark.parametrize("key", ["replay_buffer_class", "env_wrapper"])
def test_expressions_that_begin_with_a_package_of_the_user_are_not_its_names(key, tmp_path):
    """RL Zoo evaluates the first."""
    (tmp_path / "config.yml").write_text(yaml.safe_dump({key: "mine.Buffer"}))
    check_zoo_folder(tmp_path, ["mine"])
    (tmp_path / "config.yml").write_text(yaml.safe_dump({key: "mine.B if False else [print('ran')]"}))
    with pytest.raises(ValueError, match=r"got .*mine\.B if False"):
        check_zoo_folder(tmp_path, ["mine"])


@pytest.mark.parametrize("wrapper", ["rl_zoo3.wrappers.np", "gymnasium.wrappers.RecordVideo", "rl_zoo3.wrappersx.Mine"])
def test_other_names_in_their_place_are_not(wrapper, tmp_path):
    (tmp_path / "config.yml").write_text(yaml.safe_dump({"env_wrapper": wrapper}))
    with pytest.raises(ValueError, match=f"that write no files, got {wrapper}"):
        check_zoo_folder(tmp_path)
