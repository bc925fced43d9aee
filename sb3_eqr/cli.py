"""The console script ``sb3-eqr``."""

import sys


def main() -> None:
    """Run the command line, or tell what to install for it."""
    extra = "benchmark" if sys.argv[1:2] == ["benchmark"] else "zoo"
    try:
        if extra == "benchmark":
            del sys.argv[1]
            from sb3_eqr.benchmark.__main__ import main as run
        else:
            from sb3_eqr.zoo.__main__ import main as run
    except ImportError as error:
        advice = "" if "pip install" in str(error) else f'. pip install "sb3-eqr[{extra}]" brings it'
        sys.exit(f"sb3-eqr: {error}{advice}")
    run()
