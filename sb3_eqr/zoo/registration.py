"""The agents in RL Zoo's tables."""

from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_eqr import EqRQRDQN, EqRRainbow, envs
from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.zoo.search import convert_eqr_params, make_sampler

AGENTS: dict[str, type[EqRAlgorithm]] = {"eqr_qrdqn": EqRQRDQN, "eqr_rainbow": EqRRainbow}


def register() -> None:
    """Put the agents into RL Zoo's tables, with their search spaces, and the package's environments into gymnasium's."""
    ALGOS.update(AGENTS)  # type: ignore[arg-type]
    for name in AGENTS:
        HYPERPARAMS_SAMPLER[name] = make_sampler(categorical=name == "eqr_rainbow")
        HYPERPARAMS_CONVERTER[name] = convert_eqr_params  # type: ignore[assignment]
    envs.register()
