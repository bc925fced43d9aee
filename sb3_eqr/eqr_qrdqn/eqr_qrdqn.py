from sb3_contrib.qrdqn import QRDQN

from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.eqr_qrdqn.policies import CnnPolicy, EqRQRDQNPolicy, EqRQuantileNetwork, MlpPolicy, MultiInputPolicy


class EqRQRDQN(EqRAlgorithm, QRDQN):
    """
    Equivariant representations for RL (EqR) on Quantile Regression DQN.
    Paper: Mondal et al., EqR: Equivariant Representations for Data-Efficient Reinforcement Learning (ICML 2022);
    the quantile head is from https://arxiv.org/abs/1710.10044.

    The parameters are those of :class:`~sb3_eqr.common.eqr_algorithm.EqRAlgorithm` (``help(EqRQRDQN.__init__)``). The
    defaults are the paper's values for Atari 100K (Table 5), except for those of docs/differences.md, and
    where QR-DQN differs: 51 quantiles replace the 51 atoms on [-10, 10], and the priority is the quantile loss.

    ``policy_kwargs`` sets the group, the number of blocks, dueling and noisy layers, see
    :class:`~sb3_eqr.eqr_qrdqn.policies.EqRQRDQNPolicy`.
    """

    policy_aliases = {"MlpPolicy": MlpPolicy, "CnnPolicy": CnnPolicy, "MultiInputPolicy": MultiInputPolicy}
    policy: EqRQRDQNPolicy  # type: ignore[assignment]
    quantile_net: EqRQuantileNetwork
    quantile_net_target: EqRQuantileNetwork
    target_update_interval: int | None  # type: ignore[assignment]
