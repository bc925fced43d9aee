"""
Install a fresh clone into an empty environment of each Python, run the commands of README and quickstart there, and write how
long each takes: docs/results/installation.md.

    python -m experiments.installation python3.11 python3.12 python3.13 --write docs/results/installation.md

Exits with 1 if a command fails. Long commands are shortened; the table shows by what.
"""

import argparse
import pathlib
import re
import shlex
import subprocess
import tempfile
import time
from typing import NamedTuple

ROOT = pathlib.Path(__file__).parents[1]
PAGES = ("README.md", "docs/quickstart.md", "docs/own_environment.md")


class Command(NamedTuple):
    """
    :param line: as a page has it
    :param shorter: arguments added to it; of an argument given twice the last one counts
    """

    line: str
    shorter: str = ""


COMMANDS = (
    Command("sb3-eqr train --algo eqr_qrdqn --env CartPole-v1 --eval-freq 5000", "-n 3000 --eval-freq 1500 --eval-episodes 2"),
    Command("sb3-eqr enjoy --algo eqr_qrdqn --env CartPole-v1 -f logs --no-render", "-n 200"),
    Command("sb3-eqr train --algo eqr_qrdqn --env FrozenLake-v1 -n 20000", "-n 2000 --eval-freq -1"),
    Command("sb3-eqr visualize cartpole.zip --env CartPole-v1 --video"),
    Command(
        "sb3-eqr benchmark run results/first --suite smoke --agents eqr_qrdqn:off eqr_qrdqn qrdqn:stock --seeds 2",
        "--steps 500",
    ),
    Command("sb3-eqr benchmark report results/first"),
    Command(
        "sb3-eqr benchmark run results/mine --suite minatar --agents eqr_rainbow eqr_rainbow:off qrdqn:stock --seeds 5",
        "--games Breakout --steps 300 --seeds 1",
    ),
    Command("sb3-eqr benchmark report results/mine", "--force"),
)
SHORTER = {"learn(20_000": "learn(2_000", "learn(100_000": "learn(400"}  # of Python blocks, run as one script per page


class Result(NamedTuple):
    """What a command took; ``size``: MB of installed packages after it."""

    command: str
    seconds: float
    size: int | None = None


def scripts(clone: pathlib.Path) -> dict[str, str]:
    """:return: name of a page -> its Python blocks as one script, shortened"""
    found = {}
    for page in PAGES:
        blocks = re.findall(r"^```python\n(.*?)^```", (clone / page).read_text(encoding="utf-8"), re.M | re.S)
        text = "\n".join(blocks)
        for long, short in SHORTER.items():
            text = text.replace(long, short)
        found[page] = text
    return found


def run(command: list[str], folder: pathlib.Path, name: str) -> Result:
    """
    :param name: as the table has it
    :raises SystemExit: if the command fails, with the end of what it printed
    """
    start = time.monotonic()
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    seconds = time.monotonic() - start
    print(f"{seconds:7.1f} s  {name}", flush=True)
    if done.returncode:
        raise SystemExit(f"{shlex.join(command)}: exit {done.returncode}\n{done.stdout[-3000:]}")
    return Result(name, seconds)


def size_of(folder: pathlib.Path) -> int:
    """:return: MB of all files below a folder"""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink()) // 1_000_000


def install_and_run(python: str, folder: pathlib.Path) -> tuple[str, list[Result]]:
    """
    :param python: an interpreter
    :param folder: empty
    :return: its version, what each command took
    """
    code = "import platform; print(platform.python_version())"
    version = subprocess.run([python, "-c", code], capture_output=True, text=True).stdout.strip()
    print(f"Python {version}", flush=True)
    clone, venv = folder / "sb3_eqr", folder / "venv"
    subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
    results = [run([python, "-m", "venv", str(venv)], folder, "python -m venv .venv")]
    for extras in ("[atari]", "[atari,benchmark,visualize]"):
        pip = [str(venv / "bin" / "python"), "-m", "pip", "install", "-c", "constraints.txt", f".{extras}"]
        installed = run(pip, clone, f'pip install -c constraints.txt ".{extras}"')
        results.append(installed._replace(size=size_of(venv / "lib")))
    for page, text in scripts(clone).items():
        (folder / "script.py").write_text(text, encoding="utf-8")
        results.append(run([str(venv / "bin" / "python"), "script.py"], folder, f"the Python code of {page}, shortened"))
    for command in COMMANDS:
        program, *arguments = shlex.split(f"{command.line} {command.shorter}")
        results.append(run([str(venv / "bin" / program), *arguments], folder, f"{command.line} {command.shorter}".strip()))
    return version, results


def table(found: dict[str, list[Result]]) -> str:
    """:return: Markdown: a row per command, a column per Python"""
    lines = [f"| command | {' | '.join(f'Python {version}' for version in found)} |", f"|---|{'---|' * len(found)}"]
    for rows in zip(*found.values(), strict=True):
        cells = [f"{row.seconds:.0f} s" + (f", {row.size:,} MB" if row.size else "") for row in rows]
        lines.append(f"| `{rows[0].command}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Install, run, write the table into the page."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n\n")[0])
    parser.add_argument("pythons", nargs="+", help="interpreters, such as python3.12")
    parser.add_argument("--write", type=pathlib.Path, help="page whose table is replaced")
    args = parser.parse_args()
    found = {}
    for python in args.pythons:
        with tempfile.TemporaryDirectory() as folder:
            version, results = install_and_run(python, pathlib.Path(folder))
            found[version] = results
    print(table(found))
    if args.write:
        text = args.write.read_text(encoding="utf-8")
        text = re.sub(r"\| command \|.*?(?=\n\n|\Z)", lambda _: table(found), text, flags=re.S)
        args.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
