"""The console script ``sb3-eqr``."""

import importlib
import sys

from sb3_eqr import __version__

# Commands of this package rather than RL Zoo; each has the name of the extra that it needs.
COMMANDS = ("benchmark", "visualize")


def main() -> None:
    """Run the command, or print what to install for it."""
    if sys.argv[1:] == ["--version"]:
        print(f"sb3_eqr {__version__}")
        return
    extra = sys.argv[1] if sys.argv[1:2] and sys.argv[1] in COMMANDS else "zoo"
    try:
        if extra in COMMANDS:
            del sys.argv[1]
        run = importlib.import_module(f"sb3_eqr.{extra}.__main__").main
    except ImportError as error:
        advice = "" if "pip install" in str(error) else f'. Run pip install ".[{extra}]" in a clone of the repository'
        others = "" if extra in COMMANDS else ". " + " ".join(f'sb3-eqr {name} needs ".[{name}]".' for name in COMMANDS)
        sys.exit(f"sb3-eqr: {error}{advice}{others}")
    run()


if __name__ == "__main__":
    main()
