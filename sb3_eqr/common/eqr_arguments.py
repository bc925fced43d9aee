"""The arguments of every EqR agent: their one signature, their defaults, their legal ranges."""

from typing import Any

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import get_device

from sb3_eqr.common.buffers import SequenceReplayBuffer
from sb3_eqr.common.checks import check_number
from sb3_eqr.common.policies import EqRPolicy, find_optimizer
from sb3_eqr.common.safe_files import SafeFiles

FAST = ("auto", "off", "graph", "overlap")


class EqRArguments(SafeFiles):
    """
    Mixin, to stand before an SB3 Q-learning algorithm: its arguments.
    :class:`~sb3_eqr.common.eqr_setup.EqRSetup` builds what they ask for.
    """

    policy: EqRPolicy
    replay_buffer: SequenceReplayBuffer | None
    replay_buffer_class: type[SequenceReplayBuffer] | None
    target_update_interval: int | None
    max_grad_norm: float | None
    exploration_schedule: Schedule
    exploration_rate: float
    exploration_final_eps: float
    _n_calls: int

    def __init__(
        self,
        policy: str | type[EqRPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-4,
        buffer_size: int = 100_000,
        learning_starts: int = 2_000,
        batch_size: int = 32,
        tau: float = 1.0,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 2,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 10,
        target_update_interval: int | None = None,
        exploration_fraction: float = 0.02,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.0,
        max_grad_norm: float | None = 10.0,
        prediction_depth: int = 5,
        aet_coef: float = 1.0,
        get_coef: float = 1.0,
        reward_coef: float = 1.0,
        reward_loss: str = "mse",
        aet_loss: str = "distance",
        td_coef: float = 1.0,
        double_q: bool = True,
        prioritized_replay: bool = True,
        priority_alpha: float = 0.5,
        priority_beta: float = 0.4,
        priority_final_beta: float = 1.0,
        shift_pixels: int = 4,
        intensity_scale: float = 0.05,
        initial_n_steps: int | None = None,
        initial_gamma: float | None = None,
        annealing_steps: int = 10_000,
        reset_interval: int | None = None,
        reset_shrink_factor: float = 0.5,
        reset_fraction: float = 0.9,
        fast: str = "off",
        bf16: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        """
        Default hyperparameters are those of the paper for Atari 100K (Table 5).

        :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
        :param env: The environment to learn from (if registered in Gym, can be str); actions must be Discrete
        :param learning_rate: The learning rate, it can be a function of the current progress remaining (from 1 to 0)
        :param buffer_size: size of the replay buffer, over all environments; per environment at least n + M + 1
        :param learning_starts: how many steps of the model to collect transitions for before learning starts
        :param batch_size: Minibatch size for each gradient update
        :param tau: how far the target moves at each target update, in [0, 1]; 1 copies the online networks
        :param gamma: the discount factor
        :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
            like ``(5, "step")`` or ``(2, "episode")``.
        :param gradient_steps: How many gradient steps to do after each rollout; -1: as many as steps done in the environment
        :param replay_buffer_class: a class derived from ``SequenceReplayBuffer``; ``None``: chosen by ``prioritized_replay``
        :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation; ``frame_stack`` tells how many
            frames an image observation stacks (found by itself where ``VecFrameStack`` is used)
        :param optimize_memory_usage: has no effect: memory is always saved
        :param n_steps: n of the n-step return
        :param target_update_interval: update the target every so many environment steps, as QRDQN and DQN do;
            ``None``: after every gradient step, as the paper asks
        :param exploration_fraction: fraction of entire training period over which the exploration rate is reduced;
            2,000 of 100,000 steps, after which the noisy layers explore
        :param exploration_initial_eps: initial value of random action probability; above 1 the actions are random until the
            line has come down to 1
        :param exploration_final_eps: final value of random action probability
        :param max_grad_norm: The maximum value for the gradient clipping (if None, no clipping), over all that is trained
        :param prediction_depth: M, how many steps ahead the latent model predicts; 0 switches the auxiliary losses off
        :param aet_coef: λ₂ ≥ 0, weight of the action-equivariant transition loss; 0 switches it off
        :param get_coef: λ₃ ≥ 0, weight of the group-equivariant transition loss; 0 switches it off
        :param reward_coef: λ₁ ≥ 0, weight of the reward loss; 0 switches it off
        :param reward_loss: "mse" (Eq. 17), or "categorical": cross-entropy over the sign of the reward
        :param aet_loss: "distance" (Eq. 18), or "contrastive": InfoNCE among the batch's targets
            (:func:`~sb3_eqr.common.losses.contrastive_loss`), which cannot collapse
        :param td_coef: weight of the TD loss; 0: no Q-learning, the representation alone is trained
            (:func:`~sb3_eqr.representation.train_representation`), and replay priorities stay as they are
        :param double_q: choose the next action by the online network (van Hasselt et al. 2016)
        :param prioritized_replay: draw by priority and weight every loss (Schaul et al. 2016); else uniformly
        :param priority_alpha: α, the priority exponent
        :param priority_beta: β at the start of training
        :param priority_final_beta: β at the end of training, reached linearly; with ``priority_beta=0.5`` and
            ``priority_alpha=0.5``, 0.5 gives the weights 1/√P of BBF
        :param shift_pixels: random shift of images, in pixels; 0 switches it off
        :param intensity_scale: random intensity of images; 0 switches it off
        :param initial_n_steps: n at the start of training and after each reset, from where it moves to ``n_steps``
            geometrically; 10 in BBF (Schwarzer et al. 2023, https://arxiv.org/abs/2305.19452). ``None``: n does not move
        :param initial_gamma: the same for γ, geometrically in 1 - γ; 0.97 in BBF. ``None``: γ does not move
        :param annealing_steps: in how many gradient steps they get there; 10,000 in BBF
        :param reset_interval: every so many gradient steps the Q head is drawn afresh, encoder and latent model are shrunk
            and perturbed, and the optimiser forgets (Nikishin et al. 2022, https://arxiv.org/abs/2205.07802, and SR-SPR,
            D'Oro et al. 2023, https://openreview.net/forum?id=OpC-9aBBVJe); 40,000 in BBF. ``None``: never
        :param reset_shrink_factor: α in [0, 1]: at a reset, encoder and latent model become α old + (1 - α) fresh; 0.5 in BBF
        :param reset_fraction: fraction of the entire training period (as SB3 counts it for each call of ``learn``) after
            which there are no resets any more, so that the final agent has had time to recover
        :param fast: how updates run. "off": as they are; "auto": on a GPU captured as one CUDA graph, elsewhere as they are;
            "graph": captured, with a warning that says why where that cannot be; "overlap": captured, and the environments
            step while the GPU computes: an action is chosen by the networks of one round of updates before, and priorities are
            written one update late. The first three give the same numbers to rounding. "off" is the default until captured
            updates have been measured on a GPU
        :param bf16: in updates, the convolutions (or what else stands in front of the group encoder's linear layer) compute in
            bfloat16, by autocast; for GPUs
        :param stats_window_size: Window size for the rollout logging
        :param tensorboard_log: the log location for tensorboard (if None, no logging)
        :param policy_kwargs: additional arguments to be passed to the policy on creation, see
            :class:`~sb3_eqr.common.policies.EqRPolicy`
        :param verbose: the verbosity level: 0 no output, 1 info, 2 debug
        :param seed: Seed for the pseudo random generators
        :param device: Device (cpu, cuda, ...) on which the code should be run.
            Setting it to auto, the code will be run on the GPU if possible.
        :param _init_setup_model: Whether or not to build the network at the creation of the instance
        :raises ValueError: for an argument out of its range
        :raises AssertionError: if the action space is not Discrete (as SB3)
        """
        del optimize_memory_usage  # kept so that SB3's arguments fit
        # SB3 fills in the dictionaries that it is given: the caller's are left as they are.
        policy_kwargs = dict(policy_kwargs or {})
        policy_kwargs.setdefault("optimizer_class", th.optim.Adam)
        if find_optimizer(policy_kwargs["optimizer_class"]) in (th.optim.Adam, th.optim.AdamW):
            # Epsilon of Table 5; one kernel for all parameters, on CPU and GPU, where PyTorch's default has six for each.
            given = policy_kwargs.get("optimizer_kwargs") or {}
            fused = get_device(device).type in ("cpu", "cuda") and not (given.get("foreach") or given.get("differentiable"))
            policy_kwargs["optimizer_kwargs"] = {"eps": 1.5e-4, "fused": fused, **given}
        super().__init__(  # type: ignore[call-arg]
            policy,
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=dict(replay_buffer_kwargs or {}),
            n_steps=n_steps,
            target_update_interval=target_update_interval,
            exploration_fraction=exploration_fraction,
            exploration_initial_eps=exploration_initial_eps,
            exploration_final_eps=exploration_final_eps,
            max_grad_norm=max_grad_norm,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.prediction_depth = prediction_depth
        self.aet_coef = aet_coef
        self.get_coef = get_coef
        self.reward_coef = reward_coef
        self.reward_loss = reward_loss
        self.aet_loss = aet_loss
        self.td_coef = td_coef
        self.double_q = double_q
        self.prioritized_replay = prioritized_replay
        self.priority_alpha = priority_alpha
        self.priority_beta = priority_beta
        self.shift_pixels = shift_pixels
        self.intensity_scale = intensity_scale
        self.priority_final_beta = priority_final_beta
        self.initial_n_steps = initial_n_steps
        self.initial_gamma = initial_gamma
        self.annealing_steps = annealing_steps
        self.reset_interval = reset_interval
        self.reset_shrink_factor = reset_shrink_factor
        self.reset_fraction = reset_fraction
        self.fast = fast
        self.bf16 = bf16
        self._waiting_round: tuple[int, int] | None = None  # of updates, with fast="overlap"; survives saving
        self.representation_frozen = False  # by load_representation; survives saving
        self._resets: list[int] = []  # the number of updates before each reset so far
        if _init_setup_model:
            self._setup_model()

    def _check_numbers(self) -> None:
        if self.target_update_interval is not None:
            check_number("target_update_interval", self.target_update_interval, 1, whole=True)
        for name in ("prediction_depth", "shift_pixels"):
            check_number(name, getattr(self, name), 0, whole=True)
        for name in ("td_coef", "aet_coef", "get_coef", "reward_coef", "intensity_scale"):
            check_number(name, getattr(self, name), 0)
        for name in ("tau", "priority_final_beta", "reset_shrink_factor", "reset_fraction"):
            check_number(name, getattr(self, name), 0, 1)
        check_number("annealing_steps", self.annealing_steps, 1, whole=True)
        if self.reset_interval is not None:
            check_number("reset_interval", self.reset_interval, 1, whole=True)
        if self.initial_n_steps is not None:
            check_number("initial_n_steps", self.initial_n_steps, 1, whole=True)
        check_number("batch_size", self.batch_size, 1, whole=True)
        if self.fast not in FAST:
            raise ValueError(f"fast: expected one of {list(FAST)}, found {self.fast!r}")
        self._check_combinations()

    def _check_combinations(self) -> None:
        if self.initial_gamma is not None:
            check_number("initial_gamma", self.initial_gamma, 0, 1)
            if max(self.initial_gamma, self.gamma) == 1:
                raise ValueError(
                    f"initial_gamma: expected it and gamma below 1, since 1 - γ is annealed by a factor, found "
                    f"{self.initial_gamma} and {self.gamma}. Pass initial_gamma=None for a constant γ."
                )
        if self.td_coef == 0 and self.depth == 0:
            raise ValueError(
                "td_coef: expected a weight above 0 where no auxiliary loss is on, found 0. "
                "Pass prediction_depth >= 1 and one of aet_coef, get_coef, reward_coef above 0."
            )
        if self.depth > 0 and self.batch_size < 2:
            raise ValueError(
                f"batch_size: the latent model's batch norm needs at least 2 samples, found {self.batch_size}. "
                "Pass a larger batch_size or prediction_depth=0."
            )

    @property
    def depth(self) -> int:
        """M as it is used: 0 where no auxiliary loss is on."""
        return self.prediction_depth if self.aet_coef or self.get_coef or self.reward_coef else 0

    @property
    def _uses_aet(self) -> bool:
        return self.depth > 0 and self.aet_coef > 0
