"""Checks of the command line before RL Zoo starts, with messages that say what to do."""

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

import torch as th

from sb3_eqr.envs import check_registered, import_packages

# Prefix of an environment's name -> package that it needs, and how to install it.
EXTRAS = {"ALE/": ("ale_py", '".[atari]" in a clone of the repository'), "MinAtar/": ("minatar", "minatar")}


def fail(message: str) -> NoReturn:
    """Print an error without a traceback, and exit with status 2 as argparse does."""
    print(f"sb3-eqr: {message.replace('pass trust=True', 'pass --trust')}", file=sys.stderr)
    raise SystemExit(2)


@contextmanager
def failing(start: str = "", errors: tuple[type[Exception], ...] = (ValueError,)) -> Iterator[None]:
    """Exit with ``start`` and the message of an error instead of raising it."""
    try:
        yield
    except errors as error:
        fail(f"{start}{error}")


def check_environment(env_id: str, packages: list[str]) -> None:
    """Exit with a message if the environment is not registered after these packages are imported."""
    for start, (package, requirement) in EXTRAS.items():
        is_meant = env_id.startswith(start) or (start == "ALE/" and "NoFrameskip" in env_id)
        if is_meant and importlib.util.find_spec(package) is None:
            fail(f"--env: {env_id} needs {package}. Run pip install {requirement}.")
    with failing():
        import_packages(packages)
        check_registered(env_id, "--env")


def check_device(device: str) -> None:
    """Exit with a message if the device is not one of PyTorch, or a GPU that is not there."""
    try:
        th.device("cpu" if device == "auto" else device)
    except RuntimeError:
        fail(f"--device must be auto, cpu, cuda or another PyTorch device, got {device!r}.")
    if device.startswith("cuda") and not th.cuda.is_available():
        fail(f"--device is {device}, but PyTorch finds no GPU. Pass --device cpu, or leave it out.")
