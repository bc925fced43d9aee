"""Wrong command lines: each must exit with a message and no traceback, within a few seconds."""

import importlib
import os
import pathlib
import sys
import time

from experiments.attacks import Finding
from experiments.attacks.kills import FORK
from sb3_eqr import EqRRainbow

LONGEST = 5.0  # seconds until it must exit
MODULES = {"benchmark": "sb3_eqr.benchmark.__main__", "visualize": "sb3_eqr.visualize.__main__"}
# Invalid files of hyperparameters. In KEYS, the value that follows the entry's own overrides it.
ENTRIES = ["[]", "3", "text", "CartPole-v1: [1, 2]", "CartPole-v1: 3", "CartPole-v1: text", "{", "a: b: c", "\x00"]
ENTRIES += [f"CartPole-v1: {{{e}}}" for e in ("policy: MlpPolicy", "n_timesteps: 10", "policy: NoPolicy, n_timesteps: 10")]
KEYS = """
n_timesteps: many | n_timesteps: -1 | n_timesteps: .nan | n_envs: 0 | n_envs: two | frame_stack: -1 | normalize: [1]
policy_kwargs: text | policy_kwargs: [1] | policy_kwargs: {group: SU(2)} | policy_kwargs: {n_blocks: 0}
policy_kwargs: {noisy: 3} | learning_rate: fast | learning_rate: lin_x | learning_rate: -1 | buffer_size: 1
batch_size: 0 | gamma: 2 | tau: -1 | max_grad_norm: -1 | n_steps: 0 | train_freq: 0 | train_freq: [1, hour]
env_wrapper: no.such.Wrapper | env_wrapper: 3 | callback: no.such.Callback | resets: {intervall: 3}
prediction_depth: -1 | aet_coef: text | replay_buffer_kwargs: {alpha: -1} | seed: 3 | device: cpu | unknown: 1
shift_pixels: 1.5
"""
SUITES = ["[]", "3", "own: 3", "own: {}", "own: {env_id: '{game}', games: CartPole-v1, steps: 10, evaluation: {}}", "{"]
SUITES += ["own: {env_id: '{game}', games: [CartPole-v1], steps: -10, evaluation: {}}"]
GOOD = "episodes: 2, n_envs: 1, curve: {points: 2, episodes: 1}"
for scores in ("[1, 1]", "[2, 1]", "[.nan, 1]", "[1]", "text", "[0, .inf]", "null"):
    rest = f"evaluation: {{{GOOD}}}, normalisation: {{unit: u, source: s, scores: {{CartPole-v1: {scores}}}}}"
    SUITES.append(f"own: {{env_id: '{{game}}', games: [CartPole-v1], steps: 10, {rest}}}")
# The beginning of a command line > what follows it. Words in capitals are replaced by others, see ``command_lines``.
LINES = """
> trian | --nothing | train --algo | train --algo eqr | train --algo eqr_qrdqn --env | enjoy --algo eqr
train --algo eqr_qrdqn -n 20 --env > CartPol-v1 | Pendulum-v1 | NoSuch-v0 | ALE/Pog-v5 | MinAtar/Pong-v1 | /
TRAIN --conf-file > ENTRIES | no.yml | nofile
TRAIN -n 20 > -n many | --seed x | --device nodevice | --device cuda | --vec-env none | --num-threads x
TRAIN -n 20 > --eval-freq x | -params n_stepz:3 | -params gamma:x | -params gamma | -params gamma:2
TRAIN -n 20 -i > ZIPS | FOLDER/ | FOLDER/model.zip
TRAIN -n 20 --resume > nowhere | ZIPS | NOTHING
TRAIN -n 20 --checkpoint-every > 0 | x | -3 | NOTHING
train --algo ppo --env CartPole-v1 -n 20 -f FOLDER/logs > --resume nowhere | --checkpoint-every 5
enjoy AGENT > -f nowhere | --env NoSuch-v0 | -f FOLDER --exp-id 7 | -f FOLDER --load-best | --algo eqr_qrdnq
record_video AGENT > -f nowhere | --env NoSuch-v0 | -f FOLDER --exp-id 7 | -f FOLDER --load-best | --algo eqr_qrdnq
push_to_hub AGENT > -f nowhere | --env NoSuch-v0 | -f FOLDER --exp-id 7 | -f FOLDER --load-best | --algo eqr_qrdnq
plot_train > -a eqr_qrdqn -e NoSuch-v0 -f FOLDER/empty | --nothing
all_plots > -a eqr_qrdqn -e NoSuch-v0 -f FOLDER/empty | --nothing
plot_from_file > -a eqr_qrdqn -e NoSuch-v0 -f FOLDER/empty | --nothing
visualize --env CartPole-v1 --out FOLDER/out > ZIPS | FOLDER/
SHOW > --env NoSuch-v0 | --env Acrobot-v1 | NOTHING | --steps x | --algo ppo
SHOW --env CartPole-v1 > --steps 0 | --depth -1 | --n-envs 0 | --seed -1 | --device nodevice | --env-kwargs x
SHOW --env CartPole-v1 > --env-kwargs nothing:3
RUN own --suite-file > SUITES | none.yml
RUN > nosuite | smoke --agents nobody | smoke --agents eqr_qrdqn:nothing | smoke --games Pong | smoke --seeds 0
RUN smoke > --seeds x | --steps 0 | --steps -5 | --device nodevice | --cpus-per-run 0 | --gpus-per-run 9
RUN smoke > --address nowhere:1 | --checkpoint-every -1 | --checkpoint-every x | --agents qrdqn:stock qrdqn:stock
benchmark report > nowhere | ZIPS | NOTHING
benchmark status > nowhere | ZIPS | NOTHING
benchmark > NOTHING | rum | report FOLDER/empty --reference x | status --nothing
"""


def write_files(folder: pathlib.Path) -> None:
    """Write the files that the command lines name."""
    model = folder / "model.zip"
    EqRRainbow("MlpPolicy", "CartPole-v1", buffer_size=100, policy_kwargs={"n_blocks": 1, "net_arch": [4]}).save(model)
    (folder / "text.zip").write_text("no zip file")
    (folder / "half.zip").write_bytes(model.read_bytes()[: model.stat().st_size // 2])
    (folder / "empty").mkdir()
    keys = [key for line in KEYS.strip().splitlines() for key in line.split(" | ")]
    entries = ENTRIES + [f"CartPole-v1: {{policy: MlpPolicy, n_timesteps: 10, {key}}}" for key in keys]
    for name, contents in (("entry", entries), ("suite", SUITES)):
        for number, content in enumerate(contents):
            (folder / f"{name}_{number}.yml").write_text(content)


def command_lines(folder: pathlib.Path) -> list[str]:
    """
    :param folder: the folder of :func:`write_files`
    :return: the command lines of ``LINES``
    """
    words = {
        "TRAIN": "train AGENT --eval-freq -1 -f FOLDER/logs",
        "AGENT": "--algo eqr_qrdqn --env CartPole-v1",
        "SHOW": "visualize FOLDER/model.zip --out FOLDER/out",
        "RUN": "benchmark run FOLDER/benchmark --agents eqr_qrdqn --suite",
        "ZIPS": " | ".join(f"FOLDER/{name}" for name in ("text.zip", "half.zip", "none.zip", "empty")),
        "ENTRIES": " | ".join(map(str, sorted(folder.glob("entry_*.yml")))),
        "SUITES": " | ".join(map(str, sorted(folder.glob("suite_*.yml")))),
        "NOTHING": "",
        "FOLDER": str(folder),
    }
    table = LINES.strip()
    for word, text in words.items():
        table = table.replace(word, text)
    rows = [line.split(">") for line in table.splitlines()]
    return [f"{start.strip()} {end.strip()}".strip() for start, ends in rows for end in ends.split("|")]


def answer(line: str, log: pathlib.Path) -> None:
    """Run a command line as ``sb3-eqr`` does, in a separate process."""
    with open(log, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    words = line.split()
    module = MODULES.get(words[0] if words else "")
    sys.argv = ["sb3-eqr", *(words[1:] if module else words)]
    importlib.import_module(module or "sb3_eqr.zoo.__main__").main()


def mistake(line: str, log: pathlib.Path) -> str | None:
    """:return: what is wrong with the answer to a command line; ``None`` if nothing is"""
    began = time.monotonic()
    process = FORK.Process(target=answer, args=(line, log))
    process.start()
    process.join(60)
    seconds = time.monotonic() - began
    process.kill()
    process.join()
    said = log.read_text(errors="replace")
    last = (said.strip().splitlines() or [""])[-1][:120]
    found = {"traceback": "Traceback" in said, "status 0": process.exitcode == 0, "no message": not last}
    found[f"{seconds:.0f} s"] = seconds > LONGEST
    return next((f"{line}: {what}: {last}" for what, is_so in found.items() if is_so), None)


def wrong_command_lines(folder: pathlib.Path) -> Finding:
    """Try every command line: it must print a message without a traceback and exit with a status other than 0."""
    folder.mkdir(parents=True)
    for module in (*MODULES.values(), "sb3_eqr.zoo.__main__", "rl_zoo3.train", "rl_zoo3.enjoy", "ray"):
        importlib.import_module(module)  # once, not in each process
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    write_files(folder)
    lines = command_lines(folder)
    wrong = [found for found in (mistake(line, folder / "log") for line in lines) if found is not None]
    must = "an error message, no traceback, a status other than 0, none over 5 s"
    return Finding(f"{len(lines)} wrong command lines", must, f"{len(lines) - len(wrong)} rejected", wrong)
