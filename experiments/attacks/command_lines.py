"""Wrong command lines: each must exit with a message and no traceback, within a few seconds."""

import importlib
import os
import pathlib
import sys
import time
from collections.abc import Iterator

from experiments.attacks import Finding
from experiments.attacks.kills import FORK
from sb3_eqr import EqRRainbow

LONGEST = 5.0  # seconds until it must exit
MODULES = {"benchmark": "sb3_eqr.benchmark.__main__", "visualize": "sb3_eqr.visualize.__main__"}
# Invalid files of hyperparameters. In KEYS, the value that follows the entry's own overrides it.
ENTRIES = ["[]", "3", "text", "CartPole-v1: [1, 2]", "CartPole-v1: 3", "CartPole-v1: text", "{", "a: b: c", "\x00"]
ENTRIES += [
    "CartPole-v1: {policy: MlpPolicy}",
    "CartPole-v1: {n_timesteps: 10}",
    "CartPole-v1: {policy: NoPolicy, n_timesteps: 10}",
]
KEYS = ["n_timesteps: many", "n_timesteps: -1", "n_timesteps: .nan", "n_envs: 0", "n_envs: two", "frame_stack: -1"]
KEYS += [
    "normalize: [1]",
    "policy_kwargs: text",
    "policy_kwargs: [1]",
    "policy_kwargs: {group: SU(2)}",
    "policy_kwargs: {n_blocks: 0}",
]
KEYS += [
    "learning_rate: fast",
    "learning_rate: lin_x",
    "learning_rate: -1",
    "buffer_size: 1",
    "batch_size: 0",
    "gamma: 2",
    "tau: -1",
]
KEYS += ["max_grad_norm: -1", "n_steps: 0", "train_freq: 0", "train_freq: [1, hour]", "env_wrapper: no.such.Wrapper"]
KEYS += ["callback: no.such.Callback", "env_wrapper: 3", "resets: {intervall: 3}", "prediction_depth: -1", "aet_coef: text"]
KEYS += [
    "replay_buffer_kwargs: {alpha: -1}",
    "seed: 3",
    "device: cpu",
    "unknown: 1",
    "policy_kwargs: {noisy: 3}",
    "shift_pixels: 1.5",
]
SUITES = ["[]", "3", "own: 3", "own: {}", "own: {env_id: '{game}', games: CartPole-v1, steps: 10, evaluation: {}}", "{"]
SUITES += ["own: {env_id: '{game}', games: [CartPole-v1], steps: -10, evaluation: {}}"]
GOOD = "episodes: 2, n_envs: 1, curve: {points: 2, episodes: 1}"
for scores in ("[1, 1]", "[2, 1]", "[.nan, 1]", "[1]", "text", "[0, .inf]", "null"):
    rest = f"evaluation: {{{GOOD}}}, normalisation: {{unit: u, source: s, scores: {{CartPole-v1: {scores}}}}}"
    SUITES.append(f"own: {{env_id: '{{game}}', games: [CartPole-v1], steps: 10, {rest}}}")


def write_files(folder: pathlib.Path) -> None:
    """Write the files that the command lines name."""
    model = folder / "model.zip"
    EqRRainbow("MlpPolicy", "CartPole-v1", buffer_size=100, policy_kwargs={"n_blocks": 1, "net_arch": [4]}).save(model)
    (folder / "text.zip").write_text("no zip file")
    (folder / "half.zip").write_bytes(model.read_bytes()[: model.stat().st_size // 2])
    (folder / "empty").mkdir()
    entries = ENTRIES + [f"CartPole-v1: {{policy: MlpPolicy, n_timesteps: 10, {key}}}" for key in KEYS]
    for name, contents in (("entry", entries), ("suite", SUITES)):
        for number, content in enumerate(contents):
            (folder / f"{name}_{number}.yml").write_text(content)


def cases(folder: pathlib.Path) -> Iterator[tuple[str, list[str]]]:
    """
    :param folder: the folder of :func:`write_files`
    :return: beginnings of command lines, each with the endings to try
    """
    entries, suites = ([str(path) for path in sorted(folder.glob(f"{name}_*.yml"))] for name in ("entry", "suite"))
    zips = [f"{folder}/{name}" for name in ("text.zip", "half.zip", "none.zip", "empty", "")]
    train = f"train --algo eqr_qrdqn --env CartPole-v1 --eval-freq -1 -f {folder}/logs"
    yield "", ["trian", "--nothing", "train --algo", "train --algo eqr", "train --algo eqr_qrdqn --env", "enjoy --algo eqr"]
    envs = ["CartPol-v1", "Pendulum-v1", "NoSuch-v0", "ALE/Pog-v5", "MinAtar/Pong-v1", "/"]
    yield "train --algo eqr_qrdqn -n 20 --env", envs
    yield f"{train} --conf-file", [*entries, "no.yml", "nofile"]
    yield f"{train} -n 20", ["-n many", "--seed x", "--device nodevice", "--device cuda", "--vec-env none", "--num-threads x"]
    yield f"{train} -n 20", ["--eval-freq x", "-params n_stepz:3", "-params gamma:x", "-params gamma", "-params gamma:2"]
    yield f"{train} -n 20 -i", [*zips, f"{folder}/model.zip"]
    yield f"{train} -n 20 --resume", ["nowhere", *zips[:4], ""]
    yield f"{train} -n 20 --checkpoint-every", ["0", "x", "-3", ""]
    yield f"train --algo ppo --env CartPole-v1 -n 20 -f {folder}/logs", ["--resume nowhere", "--checkpoint-every 5"]
    for command in ("enjoy", "record_video", "push_to_hub"):
        wrong = ["-f nowhere", "--env NoSuch-v0", f"-f {folder} --exp-id 7", f"-f {folder} --load-best", "--algo eqr_qrdnq"]
        yield f"{command} --algo eqr_qrdqn --env CartPole-v1", wrong
    for command in ("plot_train", "all_plots", "plot_from_file"):
        yield command, [f"-a eqr_qrdqn -e NoSuch-v0 -f {folder}/empty", "--nothing"]
    yield f"visualize --env CartPole-v1 --out {folder}/out", zips
    wrong = [
        "--env NoSuch-v0",
        "--env Acrobot-v1",
        "--env CartPole-v1 --steps 0",
        "--env CartPole-v1 --depth -1",
        "",
        "--steps x",
    ]
    wrong += [f"--env CartPole-v1 {flag}" for flag in ("--n-envs 0", "--seed -1", "--device nodevice", "--env-kwargs x")]
    yield (
        f"visualize {folder}/model.zip --out {folder}/out",
        [*wrong, "--env CartPole-v1 --env-kwargs nothing:3", "--algo ppo"],
    )
    run = f"benchmark run {folder}/benchmark --agents eqr_qrdqn --suite"
    yield f"{run} own --suite-file", [*suites, "none.yml"]
    wrong = ["nosuite", "smoke --agents nobody", "smoke --agents eqr_qrdqn:nothing", "smoke --games Pong", "smoke --seeds 0"]
    wrong += ["smoke --seeds x", "smoke --steps 0", "smoke --steps -5", "smoke --device nodevice", "smoke --cpus-per-run 0"]
    wrong += [
        "smoke --gpus-per-run 9",
        "smoke --address nowhere:1",
        "smoke --checkpoint-every -1",
        "smoke --checkpoint-every x",
    ]
    yield run, [*wrong, "smoke --agents qrdqn:stock qrdqn:stock"]
    for command in ("report", "status"):
        yield f"benchmark {command}", ["nowhere", *zips[:4], ""]
    yield "benchmark", ["", "rum", f"report {folder}/empty --reference x", "status --nothing"]


def answer(line: str, log: pathlib.Path) -> None:
    """Run a command line as ``sb3-eqr`` does, in a separate process."""
    with open(log, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    words = line.split()
    module = MODULES.get(words[0] if words else "")
    sys.argv = ["sb3-eqr", *(words[1:] if module else words)]
    importlib.import_module(module or "sb3_eqr.zoo.__main__").main()


def wrong_command_lines(folder: pathlib.Path) -> Finding:
    """Try every command line: it must print a message without a traceback and exit with a status other than 0."""
    folder.mkdir(parents=True)
    for module in (*MODULES.values(), "sb3_eqr.zoo.__main__", "rl_zoo3.train", "rl_zoo3.enjoy", "ray"):
        importlib.import_module(module)  # once, not in each process
    wrong, count, log = [], 0, folder / "log"
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    write_files(folder)
    for line in [f"{start} {end}".strip() for start, ends in cases(folder) for end in ends]:
        count += 1
        began = time.monotonic()
        process = FORK.Process(target=answer, args=(line, log))
        process.start()
        process.join(60)
        seconds = time.monotonic() - began
        if process.is_alive():
            process.kill()
            process.join()
        said = log.read_text(errors="replace")
        last = (said.strip().splitlines() or [""])[-1][:120]
        if "Traceback" in said:
            wrong.append(f"{line}: traceback: {last}")
        elif process.exitcode == 0:
            wrong.append(f"{line}: status 0: {last}")
        elif seconds > LONGEST:
            wrong.append(f"{line}: {seconds:.0f} s: {last}")
        elif not last:
            wrong.append(f"{line}: no message")
    must = "an error message, no traceback, a status other than 0, none over 5 s"
    return Finding(f"{count} wrong command lines", must, f"{count - len(wrong)} rejected", not wrong, tuple(wrong))
