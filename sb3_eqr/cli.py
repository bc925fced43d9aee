"""The console script ``sb3-eqr``. Its help needs no extra."""

import importlib
import sys

from sb3_eqr import __version__
from sb3_eqr.common.checks.arguments import nearest

# What each command does, by the extra that it needs.
COMMANDS = {
    "zoo": {
        "train": "train an agent with tuned hyperparameters",
        "enjoy": "show a trained agent",
        "plot_train": "plot the returns of training",
        "plot_from_file": "plot evaluations that all_plots has saved",
        "all_plots": "plot the evaluations of several runs",
        "record_video": "write a video of a trained agent",
        "push_to_hub": "upload a trained agent to Hugging Face; --dry-run writes the folder hub/ only",
        "load_from_hub": "download an agent",
    },
    "benchmark": {"benchmark": "compare agents over environments and seeds: run, status, report, pack"},
    "visualize": {"visualize": "metrics, plots and a video of what a saved agent has learned"},
}
EXTRAS = {command: extra for extra, commands in COMMANDS.items() for command in commands}
LINES = "\n".join(f"  {command:<16}{does}" for commands in COMMANDS.values() for command, does in commands.items())
USAGE = f"""usage: sb3-eqr COMMAND ...

{LINES}

The first eight are RL Zoo's commands, with its arguments and the agents eqr_qrdqn, eqr_rainbow, eqr_sac, eqr_tqc.
sb3-eqr COMMAND --help lists the arguments of a command, sb3-eqr --version prints the version.

examples:
  sb3-eqr train --algo eqr_qrdqn --env CartPole-v1 --eval-freq 5000
  sb3-eqr benchmark run results/first --suite smoke --agents eqr_qrdqn eqr_qrdqn:off --seeds 2"""


def main() -> None:
    """Run the command, or print what to install for it."""
    command = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if command == "--version":
        print(f"sb3_eqr {__version__}")
    elif command in ("-h", "--help"):
        print(USAGE)
    elif command not in EXTRAS:
        legal = f"one of {', '.join(EXTRAS)}, got {command!r}.{nearest(command, EXTRAS)}"
        print(f"sb3-eqr: The command must be {legal} sb3-eqr --help lists them.", file=sys.stderr)
        sys.exit(2)
    else:
        run(command, EXTRAS[command])


def run(command: str, extra: str) -> None:
    """Run a command of the package that belongs to an extra."""
    if command == extra:
        del sys.argv[1]
    try:
        start = importlib.import_module(f"sb3_eqr.{extra}.__main__").main
    except ImportError as error:
        advice = "" if "pip install" in str(error) else f'. Run pip install ".[{extra}]" in a clone of the repository'
        sys.exit(f"sb3-eqr: {error}{advice}")
    start()


if __name__ == "__main__":
    main()
