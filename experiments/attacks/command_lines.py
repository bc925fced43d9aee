"""Wrong command lines: each must exit with a message and no traceback, within a few seconds."""

import importlib
import os
import pathlib
import sys
import time

import yaml

from experiments.attacks import Finding
from experiments.attacks.kills import FORK
from sb3_eqr import EqRRainbow

LONGEST = 5.0  # seconds until it must exit
MODULES = {"benchmark": "sb3_eqr.benchmark.__main__", "visualize": "sb3_eqr.visualize.__main__"}
TABLE = yaml.safe_load((pathlib.Path(__file__).parents[1] / "settings" / "command_lines.yml").read_text(encoding="utf-8"))
ENTRY = "CartPole-v1: {policy: MlpPolicy, n_timesteps: 10, %s}"
SUITE = """own: {env_id: "{game}", games: [CartPole-v1], steps: 10,
  evaluation: {episodes: 2, n_envs: 1, curve: {points: 2, episodes: 1}},
  normalisation: {unit: u, source: s, scores: {CartPole-v1: %s}}}"""


def cells(text: str) -> list[str]:
    """:return: what a text has between bars and ends of lines"""
    return [cell.strip() for line in text.strip().splitlines() for cell in line.split("|")]


def write_files(folder: pathlib.Path) -> None:
    """Write the files that the command lines name."""
    model = folder / "model.zip"
    EqRRainbow("MlpPolicy", "CartPole-v1", buffer_size=100, policy_kwargs={"n_blocks": 1, "net_arch": [4]}).save(model)
    (folder / "text.zip").write_text("no zip file")
    (folder / "half.zip").write_bytes(model.read_bytes()[: model.stat().st_size // 2])
    (folder / "empty").mkdir()
    entries = TABLE["entries"] + [ENTRY % key for key in cells(TABLE["keys"])]
    suites = TABLE["suites"] + [SUITE % scores for scores in cells(TABLE["scores"])]
    for name, contents in (("entry", entries), ("suite", suites)):
        for number, content in enumerate(contents):
            (folder / f"{name}_{number}.yml").write_text(content)


def command_lines(folder: pathlib.Path) -> list[str]:
    """:return: the command lines of the table, for the folder of :func:`write_files`"""
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
    table = TABLE["lines"]
    for word, text in words.items():
        table = table.replace(word, text)
    rows = [line.split(">") for line in table.splitlines()]
    return [f"{start.strip()} {end}".strip() for start, ends in rows for end in cells(ends)]


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
