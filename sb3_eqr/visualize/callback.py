"""Log the diagnostics of a latent model to TensorBoard during training."""

import warnings

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure, TensorBoardOutputFormat

from sb3_eqr.common.checks.arguments import check, integer
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.visualize.diagnostics import diagnose
from sb3_eqr.visualize.latents import check_agent, encode, group_model, replayed
from sb3_eqr.visualize.pictures import latent_figure

EXCLUDED = ("csv", "stdout", "log", "json")  # their names; "log": HumanOutputFormat writing to a file


class LatentCallback(BaseCallback):
    """
    Callback for diagnosing the latent model of an EqR agent during training, on windows from its replay buffer.

    It logs, under ``latent/``: ``skill`` and ``gain``, the fractions by which the rollout's error is below that of shuffled
    targets and of no motion (with the trained distance, over all steps ahead); ``effective_rank``, ``spread`` and
    ``dead_units`` of the encoder; mean ``specificity`` and ``redundancy`` of the blocks; ``symmetry_distance``, the
    distance of the GET loss; ``reward_explained``; and ``blocks``, a figure of the blocks, coloured by age. See
    :func:`~sb3_eqr.visualize.diagnostics.diagnose`. Metrics that are undefined for an agent are not logged.

    Training is bit-identical with and without the callback: it has its own random generator, seeded with the agent's
    seed and the step, and evaluates the networks in eval mode.

    :param log_freq: Log every ``log_freq`` steps, counted over all environments. This also dumps the logger, as SB3's
        ``EvalCallback`` does
    :param n_windows: Number of windows, drawn with replacement
    :param pictures: Whether to log the figure, if the logger writes for TensorBoard
    :param verbose: Verbosity level: 0 for no output, 1 for a line each time it logs
    :raises ValueError: for an argument out of range, or, when training starts, if the agent is not an EqR agent, or has
        SPR's convolutional transition
    """

    model: EqROffPolicy

    def __init__(self, log_freq: int = 5000, n_windows: int = 256, pictures: bool = True, verbose: int = 0):
        super().__init__(verbose)
        check("log_freq", log_freq, integer(1))
        check("n_windows", n_windows, integer(8))
        self.log_freq = log_freq
        self.n_windows = n_windows
        self.pictures = pictures
        self._looks = 0  # completed intervals

    def _init_callback(self) -> None:
        check_agent("LatentCallback", self.model)
        if self.model.depth > 0:
            group_model(self.model)
        else:
            warnings.warn(
                "LatentCallback logs nothing: the agent does not train its latent model, because prediction_depth is 0, "
                "or aet_coef, symmetry_coef and reward_coef all are. Leave the callback out."
            )

    def _on_training_start(self) -> None:
        self._looks = self.num_timesteps // self.log_freq

    def _on_step(self) -> bool:
        looks = self.num_timesteps // self.log_freq
        if looks > self._looks:
            self._looks = looks
            self._look()
        return True

    def _look(self) -> None:
        buffer = self.model.replay_buffer
        assert buffer is not None
        if 0 in (self.model.depth, buffer.prediction_depth) or buffer.n_starts < 1:
            return  # the buffer has no windows, or none is complete yet
        play = replayed(self.model, self.n_windows, np.random.default_rng([self.model.seed or 0, self.num_timesteps]))
        found = diagnose(self.model, play)
        symmetry = np.nan if found.action_symmetry is None else found.action_symmetry.distance
        for name, value in {**found.scalars, "symmetry_distance": symmetry}.items():
            if np.isfinite(value) and name != "dimensions":
                self.logger.record(f"latent/{name}", value)
        if self.pictures and any(isinstance(kind, TensorBoardOutputFormat) for kind in self.logger.output_formats):
            ages = (buffer.pos - 1 - play.samples.indices // buffer.n_envs) % buffer.buffer_size
            figure = latent_figure(self.model, encode(self.model, play.samples.observations), ages, "steps ago")
            self.logger.record("latent/blocks", Figure(figure, close=False), exclude=EXCLUDED)
        if self.verbose >= 1:
            print(f"{self.num_timesteps} steps: {found.summary}")
        self.logger.dump(self.num_timesteps)
