"""The console script ``sb3-eqr``, up to where PyTorch is imported."""

import os


def main() -> None:
    """
    Let OpenMP's threads sleep while they wait, unless the user has chosen otherwise, then run the command line. By default
    they spin: beside another busy process, two threads then take many times as long as one. OpenMP
    reads this once, when PyTorch is loaded.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from sb3_eqr import cli

    cli.main()


if __name__ == "__main__":
    main()
