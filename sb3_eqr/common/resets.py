"""Resets against lost plasticity, and how the n-step return and the discount move after each (SR-SPR, BBF)."""

from dataclasses import dataclass, fields
from typing import Any

from sb3_eqr.common.arguments import RESETS, check_arguments
from sb3_eqr.common.validation import check_names


@dataclass(frozen=True)
class ResetSchedule:
    """
    When an agent is reset, and from where n and γ are annealed; by default nothing of either.

    At a reset the Q head is drawn afresh (Nikishin et al. 2022, https://arxiv.org/abs/2205.07802), encoder and latent model
    are shrunk and perturbed, and the optimiser forgets (SR-SPR, D'Oro et al. 2023, https://openreview.net/forum?id=OpC-9aBBVJe;
    BBF, Schwarzer et al. 2023, https://arxiv.org/abs/2305.19452).

    :param interval: gradient steps between two resets, ≥ 1; 40,000 in BBF. ``None``: no resets
    :param shrink_factor: α in [0, 1]: encoder and latent model become α old + (1 - α) fresh; 0.5 in BBF
    :param end: fraction of training, as SB3 counts it for each call of ``learn``, after which there are no resets any more,
        so that the final agent has had time to recover; in [0, 1]
    :param initial_n_steps: n at the start of training and after each reset, from where it moves to ``n_steps``
        geometrically, ≥ 1; 10 in BBF. ``None``: n does not move
    :param initial_gamma: the same for γ, geometrically in 1 - γ, in [0, 1); 0.97 in BBF. ``None``: γ does not move
    :param annealing_steps: in how many gradient steps they get there, ≥ 1; 10,000 in BBF
    :raises ValueError: for a value out of its range
    """

    interval: int | None = None
    shrink_factor: float = 0.5
    end: float = 0.9
    initial_n_steps: int | None = None
    initial_gamma: float | None = None
    annealing_steps: int = 10_000

    def __post_init__(self) -> None:
        check_arguments(vars(self), RESETS, "resets: ")

    @classmethod
    def of(cls, given: "ResetSchedule | dict[str, Any] | None") -> "ResetSchedule":
        """
        :param given: a schedule, its fields as a dictionary (as in a YAML file), or ``None`` for no resets
        :raises TypeError: for a field that there is not
        """
        if isinstance(given, cls):
            return given
        if given is not None and not isinstance(given, dict):
            raise TypeError(f"resets must be a ResetSchedule, a dict of its fields or None, got {given!r}.")
        check_names("resets", given or {}, [field.name for field in fields(cls)])
        return cls(**(given or {}))


class Resets:
    """The resets of one agent so far, and what follows from them and the schedule."""

    def __init__(self, schedule: ResetSchedule):
        self.schedule = schedule
        self.done: list[int] = []  # the number of updates before each

    def updates_since(self, n_updates: int) -> int:
        """Of so many updates, those since the last reset, or since the start."""
        return n_updates - (self.done[-1] if self.done else 0)

    def is_due(self, n_updates: int, progress_remaining: float) -> bool:
        """After so many updates, with so much of training remaining, from 1 to 0."""
        interval, over = self.schedule.interval, 1.0 - progress_remaining >= self.schedule.end
        return interval is not None and self.updates_since(n_updates) >= interval and not over

    def roll_back(self, n_updates: int) -> None:
        """Forget the resets that came after so many updates."""
        self.done = [reset for reset in self.done if reset < n_updates]

    def annealed(self, n_updates: int, n_steps: int, gamma: float) -> tuple[int, float]:
        """
        n and γ after so many updates, ``n_steps`` and ``gamma`` at the end of annealing. Geometric: n passes 5 half-way from
        10 to 3, and the horizon 1 / (1 - γ) grows by the same factor in the same time.
        """
        first_n, first_gamma = self.schedule.initial_n_steps, self.schedule.initial_gamma
        progress = min(self.updates_since(n_updates) / self.schedule.annealing_steps, 1.0)
        if first_n is not None:
            n_steps = round(first_n * (n_steps / first_n) ** progress)
        if first_gamma is not None and progress < 1:
            gamma = 1 - (1 - first_gamma) * ((1 - gamma) / (1 - first_gamma)) ** progress
        return n_steps, gamma
