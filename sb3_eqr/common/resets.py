"""Resets against the loss of plasticity, and annealing of n and γ after each reset (SR-SPR, BBF)."""

from dataclasses import dataclass, field, fields
from typing import Any

from sb3_eqr.common.checks.arguments import NONE, SHARE, check_fields, integer, option
from sb3_eqr.common.checks.validation import check_names


@dataclass(frozen=True)
class ResetSchedule:
    """
    When an agent is reset, and how n and γ are annealed; by default neither. As in BBF, there is no reset if less than a full
    interval of this call of ``learn`` would be left after it.

    A reset reinitialises the Q head and the AET loss's own projection and predictor (Nikishin et al. 2022,
    https://arxiv.org/abs/2205.07802), shrinks and perturbs encoder and latent model, and clears the optimiser's state
    (SR-SPR, D'Oro et al. 2023, https://openreview.net/forum?id=OpC-9aBBVJe; BBF, Schwarzer et al. 2023,
    https://arxiv.org/abs/2305.19452).

    :param interval: gradient steps between two resets, ≥ 1; 40,000 in BBF. ``None``: no resets
    :param shrink_factor: α in [0, 1]: encoder and latent model become α old + (1 - α) fresh; 0.5 in BBF
    :param initial_n_steps: n at the start of training and after each reset, annealed geometrically to ``n_steps``, ≥ 1; 10 in
        BBF. ``None``: n is constant
    :param initial_gamma: the same for γ, annealed geometrically in 1 - γ, in [0, 1); 0.97 in BBF. ``None``: γ is constant
    :param annealing_steps: number of gradient steps of the annealing, ≥ 1; 10,000 in BBF
    :raises ValueError: if a value is out of range
    """

    interval: int | None = option(None, integer(1) | NONE)
    shrink_factor: float = option(0.5, SHARE)
    initial_n_steps: int | None = option(None, integer(1) | NONE)
    initial_gamma: float | None = option(None, SHARE | NONE)
    annealing_steps: int = option(10_000, integer(1))

    def __post_init__(self) -> None:
        check_fields(self, "resets: ")

    @classmethod
    def of(cls, given: "ResetSchedule | dict[str, Any] | None") -> "ResetSchedule":
        """
        Create a schedule from an argument.

        :param given: a schedule, its fields as a dictionary (as in a YAML file), or ``None`` for no resets
        :return: the schedule
        :raises TypeError: if a field is unknown
        """
        if isinstance(given, cls):
            return given
        if given is not None and not isinstance(given, dict):
            raise TypeError(f"resets must be a ResetSchedule, a dict of its fields or None, got {given!r}.")
        check_names("resets", given or {}, [found.name for found in fields(cls)])
        return cls(**(given or {}))


@dataclass
class Resets:
    """The resets of one agent so far, and the current n and γ."""

    schedule: ResetSchedule
    done: list[int] = field(default_factory=list)  # number of updates before each reset

    def updates_since(self, n_updates: int) -> int:
        """Number of updates since the last reset, or since the start."""
        return n_updates - (self.done[-1] if self.done else 0)

    def is_due(self, n_updates: int, n_left: float) -> bool:
        """Whether a reset is due after ``n_updates`` updates, when ``n_left`` are still to come in this call of ``learn``."""
        interval = self.schedule.interval
        return interval is not None and self.updates_since(n_updates) >= interval and n_left >= interval

    def annealed(self, n_updates: int, n_steps: int, gamma: float) -> tuple[int, float]:
        """
        n and γ after ``n_updates`` updates; ``n_steps`` and ``gamma`` are the values at the end of annealing. Annealing is
        geometric: from 10 to 3, n is 5 half-way, and the horizon 1 / (1 - γ) grows by a constant factor per step.
        """
        first_n, first_gamma = self.schedule.initial_n_steps, self.schedule.initial_gamma
        progress = min(self.updates_since(n_updates) / self.schedule.annealing_steps, 1.0)
        if first_n is not None:
            n_steps = round(first_n * (n_steps / first_n) ** progress)
        if first_gamma is not None and progress < 1:
            gamma = 1 - (1 - first_gamma) * ((1 - gamma) / (1 - first_gamma)) ** progress
        return n_steps, gamma
