import warnings
from itertools import accumulate
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.dqn import DQN

from sb3_eqr.common.eqr_algorithm import EqRAlgorithm
from sb3_eqr.eqr_rainbow.policies import CnnPolicy, EqRCategoricalNetwork, EqRRainbowPolicy, MlpPolicy, MultiInputPolicy

WATCHED_STEPS = 10_000


class EqRRainbow(EqRAlgorithm, DQN):
    """
    Equivariant representations for RL (EqR) on a Rainbow-style categorical agent, as in the paper.
    Paper: Mondal et al., EqR: Equivariant Representations for Data-Efficient Reinforcement Learning (ICML 2022);
    the categorical head (C51) is from https://arxiv.org/abs/1707.06887, its combination with double Q, dueling, noisy
    layers, prioritised replay and n-step returns from https://arxiv.org/abs/1710.02298.

    The parameters are those of :class:`~sb3_eqr.common.eqr_algorithm.EqRAlgorithm` (``help(EqRRainbow.__init__)``). The
    defaults are the paper's values for Atari 100K (Table 5), except for those of docs/differences.md.

    ``policy_kwargs`` sets the support of the return distribution (``n_atoms``, ``v_min``, ``v_max``), the group, the number
    of blocks, dueling and noisy layers, see :class:`~sb3_eqr.eqr_rainbow.policies.EqRRainbowPolicy`. The default support
    is for rewards clipped to [-1, 1]; the agent warns if a return lies outside the support.
    """

    policy_aliases = {"MlpPolicy": MlpPolicy, "CnnPolicy": CnnPolicy, "MultiInputPolicy": MultiInputPolicy}
    policy: EqRRainbowPolicy  # type: ignore[assignment]
    q_net: EqRCategoricalNetwork
    q_net_target: EqRCategoricalNetwork
    target_update_interval: int | None  # type: ignore[assignment]
    max_grad_norm: float | None  # type: ignore[assignment]
    _warned_of_returns = False

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        self._episode_rewards: list[list[float]] = [[] for _ in range(self.n_envs)]  # of the current episodes
        return super()._setup_learn(*args, **kwargs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        settled = self._vec_normalize_env is None or self.num_timesteps > self.learning_starts  # its scale varies at first
        if settled and self.td_coef > 0 and not self._warned_of_returns:
            self._watch_returns(reward, dones)

    def _watch_returns(self, reward: np.ndarray, dones: np.ndarray) -> None:
        """
        Warn, once, about a reward or a discounted return to the end of an episode that lies outside the support. Episodes
        longer than ``WATCHED_STEPS`` are watched in parts, so that the memory for them is bounded.

        :param reward: the rewards that the agent learns from, (n_envs,)
        :param dones: (n_envs,)
        """
        returns = list(reward)
        for rewards, now, done in zip(self._episode_rewards, reward, dones, strict=True):
            rewards.append(float(now))
            if done or len(rewards) == WATCHED_STEPS:
                returns += accumulate(reversed(rewards), lambda later, r: r + self.gamma * later)
                rewards.clear()
        v_min, v_max = self.policy.v_min, self.policy.v_max
        worst = max(returns, key=lambda value: max(v_min - value, value - v_max))
        if not v_min <= worst <= v_max:
            self._warned_of_returns = True
            warnings.warn(
                f"step {self.num_timesteps}: a discounted return of {worst:.4g} lies outside the support of the return "
                f"distribution, [v_min, v_max] = [{v_min}, {v_max}], and is clipped to it. "
                "Pass policy_kwargs=dict(v_min=..., v_max=...), for example the smallest and largest of 0 and a step's "
                "rewards divided by 1 - gamma, or scale the rewards (VecNormalize)."
            )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_episode_rewards", "_warned_of_returns"]
