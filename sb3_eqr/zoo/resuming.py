"""Resumable runs of ``sb3-eqr train``: ``--checkpoint-every`` and ``--resume`` for RL Zoo's experiments."""

import argparse
import math
import os
import pathlib
import shutil
import signal
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from types import SimpleNamespace
from typing import Any

import yaml
from optuna import TrialPruned
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback, EventCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_eqr import AGENTS
from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.common.saving.checkpoints import ExactCheckpointCallback
from sb3_eqr.common.saving.random_state import preserved_rng_state
from sb3_eqr.trust import check_zoo_folder, read_plain, read_trusted
from sb3_eqr.zoo.checks import fail
from sb3_eqr.zoo.entries import find_entry

FOLDER, BEST = "checkpoints", "best_model.zip"  # in the folder of a run; the latter by RL Zoo


class RngPreserving(EventCallback):
    """A callback that does not change the random generators."""

    def _on_step(self) -> bool:
        with preserved_rng_state(self.model.action_space):
            return self._on_event()


class ResumableExperiment(ExperimentManager):
    """
    RL Zoo's experiment, which also writes checkpoints, or resumes from one into a new folder as with ``-i``.

    :param given: the arguments of ``sb3-eqr train``: ``checkpoint_every``, ``resume`` and ``trust``, which RL Zoo does not
        have, and ``conf_file``, which args.yml keeps as the user named it; a temporary file may be used in its place
    """

    def __init__(self, *args: Any, given: argparse.Namespace, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.args.conf_file = given.conf_file
        self.checkpoint_every, self.resume, self.trust = given.checkpoint_every, given.resume, given.trust
        self.best: tuple[float, dict[str, Any]] = (-math.inf, {})  # value and parameters of a search's best trial
        self.continue_training = self.continue_training or self.resume is not None
        # Beside this file, RL Zoo looks for statistics of VecNormalize; beside "", it would find those of the current folder.
        self.trained_agent = self.trained_agent or os.path.join(self.save_path, "none")

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """
        As RL Zoo's; exits with a message instead of a traceback if the experiment cannot be built. A signal to end counts as
        Ctrl-C, after which RL Zoo saves the agent.
        """
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        self.is_new = not os.path.exists(self.save_path)
        try:
            found = super().setup_experiment()
        except (ValueError, TypeError, IndexError, ImportError) as error:
            self._remove_folder()
            fail(f"{self.algo} on {self.env_name.gym_id}, by {self.config}: {error}")
        except BaseException:
            self._remove_folder()
            raise
        if found is not None and isinstance(found[0], EqROffPolicy):
            given = ", ".join(sorted(self._hyperparams.keys() - {"policy"}))
            print(f"{in_one_line(found[0])}. Set by the hyperparameters: {given or 'nothing'}; the rest are defaults.")
        return found

    def _remove_folder(self) -> None:
        """Remove the folder made for this run, where enjoy would look for a model, unless it was there before."""
        if self.is_new:
            shutil.rmtree(self.save_path, ignore_errors=True)

    def objective(self, trial: Any) -> float:
        """As RL Zoo's; keeps the best trial, and prunes those that diverge."""
        try:
            value = super().objective(trial)
        except FloatingPointError as error:  # RL Zoo expects ValueError
            print(f"Trial {trial.number}: {error}")
            raise TrialPruned from error
        self.best = max(self.best, (value, trial.params), key=lambda found: found[0])
        return value

    def hyperparameters_optimization(self) -> None:
        """As RL Zoo's, which prints the numbers that it drew; adds the arguments that they stand for."""
        try:
            super().hyperparameters_optimization()
        finally:
            self._remove_folder()
        best = self.best[1]
        if self.storage and self.study_name:
            with suppress(ValueError):  # no trial has finished
                best = self.load_trial(self.storage, self.study_name, convert=False)  # also of earlier commands
        if self.algo in AGENTS and best:
            env_id = self.env_name.gym_id
            entry = find_entry(str(self.config), env_id, self.custom_hyperparams or {})
            found = {**entry, **HYPERPARAMS_CONVERTER[self.algo](best)}
            print(f"As a file for --conf-file:\n{yaml.dump({env_id: found})}")

    def create_callbacks(self) -> None:
        """RL Zoo's callbacks, and one for the checkpoints."""
        # RL Zoo evaluates, films and uploads with those of the command line only, not with those of the hyperparameters.
        self.eval_env_kwargs = self.eval_env_kwargs or self.env_kwargs
        self.args.env_kwargs = self.env_kwargs or None
        super().create_callbacks()
        if self.checkpoint_every is not None or self.resume is not None:
            # RL Zoo evaluates Atari's agents with random actions, in environments whose state is not in a checkpoint.
            self.callbacks = [RngPreserving(c) if isinstance(c, EvalCallback) else c for c in self.callbacks]
        if self.checkpoint_every is not None:
            folder = pathlib.Path(self.save_path) / FOLDER
            self.callbacks.append(ExactCheckpointCallback(self.checkpoint_every, folder, verbose=self.verbose))

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self.resume is None:
            return super()._load_pretrained_agent(hyperparams, env)
        checkpoints = checkpoints_of(self.resume)
        model = ALGOS[self.algo].resume(checkpoints, env, self.device, self.trust)  # type: ignore[attr-defined]
        if self.n_timesteps <= model.num_timesteps:
            fail(f"--resume: {self.resume} is already at step {model.num_timesteps}. Pass -n above {model.num_timesteps}.")
        run = run_of(self.resume)
        if run is not None and (run / BEST).is_file():  # which a worse one will not replace
            shutil.copy2(run / BEST, self.save_path)
        print(f"Resuming at step {model.num_timesteps}")
        self.n_timesteps -= model.num_timesteps
        model.verbose, model.tensorboard_log = self.verbose, self.tensorboard_log or model.tensorboard_log
        return model

    def learn(self, model: BaseAlgorithm) -> None:
        """As RL Zoo's, which counts steps from 0, but a resumed run keeps its count."""
        if self.resume is None:
            super().learn(model)
        else:
            counting_on = partial(model.learn, reset_num_timesteps=False)
            super().learn(SimpleNamespace(learn=counting_on, env=model.env))  # type: ignore[arg-type]


def in_one_line(model: EqROffPolicy) -> str:
    """The agent's class, group and losses."""
    weights = {"AET": model.aet_coef, "GET": model.symmetry_coef, "reward": model.reward_coef} if model.depth else {}
    losses = ", ".join(f"{name} {weight:g}" for name, weight in weights.items() if weight)
    return f"{type(model).__name__}: {model.policy.description['group']}; auxiliary losses: {losses or 'none'}"


def checkpoints_of(path: pathlib.Path) -> pathlib.Path:
    """The folder of checkpoints in a run's folder; any other path is returned unchanged."""
    return path / FOLDER if (path / FOLDER).is_dir() else path


def run_of(path: pathlib.Path) -> pathlib.Path | None:
    """The folder of the run that wrote these checkpoints, or this one; ``None`` if they are not in such a folder."""
    checkpoints = checkpoints_of(path).resolve()
    return next((folder.parent for folder in (checkpoints, checkpoints.parent) if folder.name == FOLDER), None)


def config_of(path: pathlib.Path, trust: bool, packages: Sequence[str] = ()) -> dict[str, Any] | None:
    """
    :param path: a run's folder, a folder of checkpoints, or one checkpoint
    :param trust: whether the settings may name code of any package
    :param packages: packages whose code they may name in any case
    :return: the entry of the run that wrote it, from RL Zoo's config.yml and args.yml; ``None`` if they are not there
    :raises ValueError: if they name code of other packages
    """
    run = run_of(path)
    config = None if run is None else next(iter(sorted(run.glob("*/config.yml"))), None)
    if config is None:
        return None
    if not trust:
        check_zoo_folder(config.parent, packages)
    if not (config.parent / "args.yml").is_file():
        raise ValueError(f"{config.parent} must have args.yml beside config.yml, as RL Zoo writes it, got none.")
    read = read_trusted if trust else read_plain
    entry, arguments = read(config), read(config.parent / "args.yml")
    given = {name: arguments.get(name) for name in ("env_kwargs", "n_timesteps")}
    return {**entry, **{name: value for name, value in given.items() if value not in (None, {}, -1)}}
