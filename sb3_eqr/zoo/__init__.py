"""
RL Zoo with the EqR agents: registration, search spaces, and the command line ``sb3-eqr`` (or ``python -m sb3_eqr.zoo``).

    sb3-eqr train --algo eqr_rainbow --env CartPole-v1 --conf-file FILE_OR_NAME ...

Every command is RL Zoo's, with all of its flags. The package adds ``eqr_qrdqn``, ``eqr_rainbow``,
``eqr_sac`` and ``eqr_tqc``, their hyperparameter files, and error messages instead of tracebacks.
"""

try:
    import rl_zoo3.import_envs  # noqa: F401
except ImportError as error:
    raise ImportError(f'sb3_eqr.zoo needs RL Zoo: {error}. Run pip install ".[zoo]" in a clone of the repository') from None

from sb3_eqr import AGENTS
from sb3_eqr.zoo.registration import register

__all__ = ["AGENTS", "register"]
