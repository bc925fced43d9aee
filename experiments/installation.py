"""
Install a fresh clone into an empty environment of each Python, run the commands of README and quickstart there, and write how
long each takes: experiments/notes/installation.md.

    python -m experiments.installation python3.11 python3.12 python3.13 --write experiments/notes/installation.md

Exits with 1 if a command fails. Long commands are shortened; of an argument that is given twice the last one counts.
"""

import argparse
import pathlib
import re
import shlex
import subprocess
import tempfile
import time

from experiments import markdown

ROOT = pathlib.Path(__file__).parents[1]
PAGES = ("README.md", "docs/quickstart.md", "docs/own_environment.md")
TRAIN, RUN = "sb3-eqr train --algo eqr_qrdqn --env", "sb3-eqr benchmark run"
COMMANDS = (
    f"{TRAIN} CartPole-v1 --eval-freq 5000 -n 3000 --eval-freq 1500 --eval-episodes 2",
    "sb3-eqr enjoy --algo eqr_qrdqn --env CartPole-v1 -f logs --no-render -n 200",
    "sb3-eqr visualize ball.zip --env SlidingBallDistractors-v0",
    f"{RUN} results/first --suite smoke --agents eqr_qrdqn:off eqr_qrdqn qrdqn:stock --seeds 2 --steps 500",
    "sb3-eqr benchmark report results/first",
)
SHORTER = {
    "learning_starts=2_000": "learning_starts=200",
    "learn(8_000": "learn(900",
    "learn(12_000": "learn(400",
    "learn(20_000": "learn(200",
    "learn(100_000": "learn(400",
}  # of Python blocks, run as one script per page


def script(page: pathlib.Path) -> str:
    """:return: the Python blocks of a page as one script, shortened"""
    text = "\n".join(re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S))
    for long, short in SHORTER.items():
        text = text.replace(long, short)
    return text


def run(command: list[str], folder: pathlib.Path, name: str) -> str:
    """
    :param name: as the table has it
    :return: how long it took
    :raises SystemExit: if the command fails, with the end of what it printed
    """
    start = time.monotonic()
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    seconds = time.monotonic() - start
    print(f"{seconds:7.1f} s  {name}", flush=True)
    if done.returncode:
        raise SystemExit(f"{shlex.join(command)}: exit {done.returncode}\n{done.stdout[-3000:]}")
    return f"{seconds:.0f} s"


def install_and_run(python: str, folder: pathlib.Path) -> dict[str, str]:
    """
    :param python: an interpreter
    :param folder: empty
    :return: command -> how long it took, of an installation also the size of all packages after it
    """
    clone, binaries, packages = folder / "sb3_eqr", folder / "venv" / "bin", folder / "venv" / "lib"
    own_python = str(binaries / "python")
    subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
    found = {"python -m venv .venv": run([python, "-m", "venv", str(folder / "venv")], folder, "venv")}
    for extras in (".[atari]", ".[atari,mujoco,benchmark,visualize]"):
        name = f'pip install -c constraints.txt "{extras}"'
        taken = run([own_python, "-m", *shlex.split(name)], clone, name)
        files = [path for path in packages.rglob("*") if path.is_file() and not path.is_symlink()]
        found[name] = f"{taken}, {sum(path.stat().st_size for path in files) // 1_000_000:,} MB"
    for page in PAGES:
        name = f"the Python code of {page}, shortened"
        found[name] = run([own_python, "-c", script(clone / page)], folder, name)
    for command in COMMANDS:
        program, *arguments = shlex.split(command)
        found[command] = run([str(binaries / program), *arguments], folder, command)
    return found


def main() -> None:
    """Install, run, write the table into the page."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n\n")[0])
    parser.add_argument("pythons", nargs="+", help="interpreters, such as python3.12")
    parser.add_argument("--write", type=pathlib.Path, help="page whose table is replaced")
    args = parser.parse_args()
    found = {}
    for python in args.pythons:
        version = subprocess.run([python, "--version"], capture_output=True, text=True, check=True).stdout.strip()
        print(version, flush=True)
        with tempfile.TemporaryDirectory() as folder:
            found[version] = install_and_run(python, pathlib.Path(folder))
    rows = [[f"`{name}`", *(taken[name] for taken in found.values())] for name in next(iter(found.values()))]
    table = markdown(["command", *found], rows)
    print(table)
    if args.write:
        text = args.write.read_text(encoding="utf-8")
        args.write.write_text(re.sub(r"\| command \|.*?(?=\n\n|\Z)", lambda _: table, text, flags=re.S), encoding="utf-8")


if __name__ == "__main__":
    main()
