"""Wrong command lines: each must end with a message and without a traceback, and none may take long."""

import importlib
import os
import pathlib
import sys
import time
from collections.abc import Iterator

from benchmarks.attacks import Finding
from benchmarks.attacks.kills import FORK
from sb3_eqr import EqRRainbow

LONGEST = 5.0  # seconds to an answer
MODULES = {"benchmark": "sb3_eqr.benchmark.__main__", "visualize": "sb3_eqr.visualize.__main__"}
# Files of hyperparameters with something wrong. The entry's own values: what is put after them wins.
ENTRIES = ["[]", "3", "text", "CartPole-v1: [1, 2]", "CartPole-v1: 3", "CartPole-v1: text", "{", "a: b: c", "\x00"]
ENTRIES += ["CartPole-v1: {policy: MlpPolicy}", "CartPole-v1: {n_timesteps: 10}", "CartPole-v1: {policy: NoPolicy, n_timesteps: 10}"]
KEYS = ["n_timesteps: many", "n_timesteps: -1", "n_timesteps: .nan", "n_envs: 0", "n_envs: two", "frame_stack: -1"]
KEYS += ["normalize: [1]", "policy_kwargs: text", "policy_kwargs: [1]", "policy_kwargs: {group: SU(2)}", "policy_kwargs: {n_blocks: 0}"]
KEYS += ["learning_rate: fast", "learning_rate: lin_x", "learning_rate: -1", "buffer_size: 1", "batch_size: 0", "gamma: 2", "tau: -1"]
KEYS += ["max_grad_norm: -1", "n_steps: 0", "train_freq: 0", "train_freq: [1, hour]", "env_wrapper: no.such.Wrapper"]
KEYS += ["callback: no.such.Callback", "env_wrapper: 3", "resets: {intervall: 3}", "prediction_depth: -1", "aet_coef: text"]
KEYS += ["replay_buffer_kwargs: {alpha: -1}", "seed: 3", "device: cpu", "unknown: 1", "policy_kwargs: {noisy: 3}", "shift_pixels: 1.5"]
SUITES = ["[]", "3", "own: 3", "own: {}", "own: {env_id: '{game}', games: CartPole-v1, steps: 10, evaluation: {}}", "{"]
SUITES += ["own: {env_id: '{game}', games: [CartPole-v1], steps: -10, evaluation: {}}"]
GOOD = "episodes: 2, n_envs: 1, curve: {points: 2, episodes: 1}"
for scores in ("[1, 1]", "[2, 1]", "[.nan, 1]", "[1]", "text", "[0, .inf]", "null"):
    rest = f"evaluation: {{{GOOD}}}, normalisation: {{unit: u, source: s, scores: {{CartPole-v1: {scores}}}}}"
    SUITES.append(f"own: {{env_id: '{{game}}', games: [CartPole-v1], steps: 10, {rest}}}")


def lines(folder: pathlib.Path) -> Iterator[str]:
    """
    :param folder: for the files that they name
    """
    model, text, folder_of_nothing = folder / "model.zip", folder / "text.zip", folder / "empty"
    EqRRainbow("MlpPolicy", "CartPole-v1", buffer_size=100, policy_kwargs={"n_blocks": 1, "net_arch": [4]}).save(model)
    text.write_text("no zip file")
    (folder / "half.zip").write_bytes(model.read_bytes()[: model.stat().st_size // 2])
    folder_of_nothing.mkdir()
    run = f"train --algo eqr_qrdqn --env CartPole-v1 -n 20 --eval-freq -1 -f {folder}/logs"
    yield from ("trian", "--nothing", "train --algo", "train --algo eqr", "train --algo eqr_qrdqn --env", "enjoy --algo eqr")
    for env in ("CartPol-v1", "Pendulum-v1", "NoSuch-v0", "ALE/Pog-v5", "MinAtar/Pong-v1", "/"):
        yield f"train --algo eqr_qrdqn --env {env} -n 20"
    for number, entry in enumerate(ENTRIES + [f"CartPole-v1: {{policy: MlpPolicy, n_timesteps: 10, {key}}}" for key in KEYS]):
        path = folder / f"entry_{number}.yml"
        path.write_text(entry)
        yield f"{run.replace(' -n 20', '')} --conf-file {path}"
    for flag in ("-n many", "--seed x", "--device nodevice", "--device cuda", "--vec-env none", "--num-threads x", "--eval-freq x"):
        yield f"{run} {flag}"
    for flag in ("-params n_stepz:3", "-params gamma:x", "-params gamma", "-params gamma:2", "--conf-file no.yml", "--conf-file nofile"):
        yield f"{run} {flag}"
    for found in (text, folder / "half.zip", folder / "none.zip", model, folder_of_nothing, folder):
        yield f"{run} -i {found}"
    for found in ("nowhere", str(text), str(folder_of_nothing)):
        yield f"{run} --resume {found}"
    for flag in ("--checkpoint-every 0", "--checkpoint-every x", "--resume", "--checkpoint-every -3"):
        yield f"{run} {flag}"
    yield f"train --algo ppo --env CartPole-v1 -n 20 -f {folder}/logs --resume nowhere"
    for command in ("enjoy", "record_video", "push_to_hub"):
        for rest in ("-f nowhere", "--env NoSuch-v0", f"-f {folder} --exp-id 7", f"-f {folder} --load-best", "--algo eqr_qrdnq"):
            yield f"{command} --algo eqr_qrdqn --env CartPole-v1 {rest}"
    for command in ("plot_train", "all_plots", "plot_from_file"):
        yield from (f"{command} -a eqr_qrdqn -e NoSuch-v0 -f {folder_of_nothing}", f"{command} --nothing")
    for found in (text, folder / "half.zip", folder / "none.zip", folder_of_nothing, folder):
        yield f"visualize {found} --env CartPole-v1 --out {folder}/out"
    for flag in ("--env NoSuch-v0", "--env Acrobot-v1", "--env CartPole-v1 --steps 0", "--env CartPole-v1 --depth -1", "", "--steps x"):
        yield f"visualize {model} --out {folder}/out {flag}"
    for flag in ("--n-envs 0", "--seed -1", "--device nodevice", "--env-kwargs x", "--env-kwargs nothing:3", "--algo ppo"):
        yield f"visualize {model} --env CartPole-v1 --out {folder}/out {flag}"
    benchmark = f"benchmark run {folder}/benchmark"
    for number, suite in enumerate(SUITES):
        path = folder / f"suite_{number}.yml"
        path.write_text(suite)
        yield f"{benchmark} --suite own --suite-file {path} --agents eqr_qrdqn"
    for flag in ("--suite nosuite", "--suite-file none.yml", "--agents nobody", "--agents eqr_qrdqn:nothing", "--games Pong"):
        yield f"{benchmark} --suite smoke {flag}"
    for flag in ("--seeds 0", "--seeds x", "--steps 0", "--steps -5", "--device nodevice", "--cpus-per-run 0", "--gpus-per-run 9"):
        yield f"{benchmark} --suite smoke --agents eqr_qrdqn {flag}"
    for flag in ("--address nowhere:1", "--checkpoint-every -1", "--checkpoint-every x", "--agents qrdqn:stock qrdqn:stock"):
        yield f"{benchmark} --suite smoke --agents eqr_qrdqn {flag}"
    for command in ("report", "status"):
        for found in ("nowhere", str(text), str(folder_of_nothing), ""):
            yield f"benchmark {command} {found}"
    yield from ("benchmark", "benchmark rum", f"benchmark report {folder_of_nothing} --reference x", "benchmark status --nothing")


def answer(line: str, log: pathlib.Path) -> None:
    """Do what ``sb3-eqr`` does with a line, in a process of its own."""
    with open(log, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    words = line.split()
    module = MODULES.get(words[0] if words else "")
    sys.argv = ["sb3-eqr", *(words[1:] if module else words)]
    importlib.import_module(module or "sb3_eqr.zoo.__main__").main()


def wrong_command_lines(folder: pathlib.Path) -> Finding:
    """Every line; a message without a traceback, a status other than 0."""
    folder.mkdir(parents=True)
    for module in (*MODULES.values(), "sb3_eqr.zoo.__main__", "rl_zoo3.train", "rl_zoo3.enjoy", "ray"):
        importlib.import_module(module)  # once, not in each process
    wrong, count, log = [], 0, folder / "log"
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    for line in lines(folder):
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
    must = "a message, no traceback, a status other than 0, none over 5 s"
    return Finding(f"{count} wrong command lines", must, f"{count - len(wrong)} answered", not wrong, tuple(wrong))
