"""The named configurations: RL Zoo's YAML files of this package as keyword arguments."""

import pathlib
from typing import Any

ZOO_KEYS = ("policy", "n_timesteps", "frame_stack", "n_envs", "normalize", "env_wrapper")  # read by RL Zoo itself


def configuration_files() -> dict[str, pathlib.Path]:
    """
    :return: name -> file, of every file in ``zoo_hyperparams``: "eqr_rainbow", "eqr_bbf", "gl2+aet+r", ...
    """
    package = pathlib.Path(__file__).parent
    folders = (package / "zoo_hyperparams", package.parent / "zoo_hyperparams")  # in a wheel, in a checkout
    folder = next(folder for folder in folders if folder.is_dir())
    return {path.stem: path for path in sorted(folder.rglob("*.yml"))}


def load_configuration(name: str, env_id: str = "atari") -> dict[str, Any]:
    """
    Keyword arguments of a named configuration, for the constructor of its agent::

        EqRRainbow("CnnPolicy", env, **load_configuration("eqr_bbf"))

    :param name: one of :func:`configuration_files`; docs/configurations.md says what each is
    :param env_id: the entry in that file: "atari", or the name of an environment
    :raises ValueError: if there is no such file or entry
    """
    try:
        import yaml
    except ImportError as error:
        raise ImportError("load_configuration needs PyYAML: pip install pyyaml") from error
    files = configuration_files()
    if name not in files:
        raise ValueError(f"configuration: expected one of {list(files)}, found {name!r}")
    entries = yaml.safe_load(files[name].read_text(encoding="utf-8"))
    if env_id not in entries:
        raise ValueError(f"configuration {name!r}: expected an entry of {list(entries)}, found {env_id!r}")
    return {key: value for key, value in entries[env_id].items() if key not in ZOO_KEYS}
