"""Metrics of what an agent's latent model has learned."""

from typing import NamedTuple

import numpy as np
import torch as th
from torch.nn import functional as F

from sb3_eqr.common.off_policy import EqROffPolicy
from sb3_eqr.visualize import findings, measures
from sb3_eqr.visualize.latents import Play, action_elements, check_agent, each_block, eval_mode, latents
from sb3_eqr.visualize.measures import Rewards, Transition, mean_of_known

MAX_STATES = 256  # in which κ is computed for every action: enough for a table of means
PREDICTS = 0.25  # minimum skill and minimum gain
SENTENCES = {
    "predicts": "The latent model predicts: {errors}{unless}. Only a comparison with runs without EqR shows whether this "
    "raises returns.",
    "does not predict": "The latent model does not predict: {errors}. It predicts if its error is at least {limit:.0%} lower "
    "than both. Train longer, or, with discrete actions, raise aet_coef. Where a step moves the state little, no motion is "
    "hard to beat. The verdict does not say whether returns improve; transition.csv shows at which step the prediction fails.",
    "not trained": "The latent model was not trained, so there is no prediction to judge: prediction_depth is 0, or aet_coef, "
    "symmetry_coef and reward_coef all are.",
    "collapsed": "The latent states have collapsed to nearly a single one: {errors}. Keep reward_coef above 0, lower "
    'aet_coef and symmetry_coef, or pass policy_kwargs=dict(aet_loss="contrastive", predictor=False).',
}
UNLESS = (
    ". The losses compare projections, so only these are predicted well. To use the latent states themselves, train with "
    'policy_kwargs=dict(projection="none")'
)
COLLAPSED = 1e-3  # squared distance on the unit sphere: directions within two degrees of each other


class Diagnostics(NamedTuple):
    """The result of :func:`diagnose`. M steps ahead, A actions, K blocks, F factors."""

    blocks: list[str]  # (K,): "SE(2) 0", ...
    transition: Transition  # in the latent space
    loss: Transition  # the same between p(x̂_m), past the predictor, and p(x_m) on the unit sphere, as in training (Eq. 18)
    motion: findings.Motion
    generators: list[findings.Generators]  # one per group
    disentanglement: findings.Disentanglement
    action_symmetry: findings.ActionSymmetry | None  # None if the group has no inverse
    collapse: findings.Collapse
    rewards: Rewards
    verdict: str  # "predicts", "does not predict", "collapsed" or "not trained"
    rewards_trained: bool = True  # whether the agent's settings train its reward predictor
    symmetry_trained: bool = True  # the same for ρ

    @property
    def has_group(self) -> bool:
        """Whether κ(x, a) is what an action does; without a group, it is the next state."""
        return not all(part.group.startswith("none") for part in self.generators)

    @property
    def compares_blocks(self) -> bool:
        """Whether there are several blocks, or true factors to compare one with."""
        return len(self.blocks) > 1 or self.disentanglement.information is not None

    @property
    def summary(self) -> str:
        """The verdict in one sentence, and what to do in a second one."""
        (skill, gain), (latent_skill, latent_gain) = skill_and_gain(self.loss), skill_and_gain(self.transition)
        steps = "one step" if len(self.loss.error) == 1 else f"{len(self.loss.error)} steps"
        errors = (
            f"over {steps}, its error is {_lower(skill)} than with shuffled targets and {_lower(gain)} "
            f"than with no motion ({_lower(latent_skill)} and {_lower(latent_gain)} between latent states, before the "
            "projection)"
        )
        unless = UNLESS if latent_gain < PREDICTS else ""
        return SENTENCES[self.verdict].format(errors=errors, unless=unless, limit=PREDICTS)

    @property
    def scalars(self) -> dict[str, float]:
        """The metrics that are one number each; NaN for undefined ones."""
        skill, gain = skill_and_gain(self.loss)
        blocks, collapse = self.disentanglement, self.collapse
        return {
            "skill": skill,
            "gain": gain,
            "effective_rank": collapse.effective_rank,
            "dimensions": collapse.dimensions,
            "spread": collapse.spread,
            "dead_units": collapse.dead_units,
            "specificity": mean_of_known(blocks.specificity),
            "redundancy": mean_of_known(blocks.redundancy[~np.eye(len(blocks.redundancy), dtype=bool)]),
            "gap": np.nan if blocks.gap is None else mean_of_known(blocks.gap),
            "reward_explained": mean_of_known(self.rewards.explained),
        }


def diagnose(model: EqROffPolicy, play: Play, seed: int = 0) -> Diagnostics:
    """
    Compute all metrics. No global random generator is used.

    :param model: any EqR agent
    :param play: see :func:`~sb3_eqr.visualize.latents.play` and :func:`~sb3_eqr.visualize.latents.replayed`
    :param seed: seed for the pairs of ``action_symmetry``
    :raises ValueError: if the agent is not an EqR agent
    """
    check_agent("diagnose", model)
    data = latents(model, play.samples)
    latent_model = model.policy.latent_model
    with th.no_grad(), eval_mode(model):
        start, following = (F.normalize(latent_model.projection(x), dim=-1) for x in (data.states, data.next_states))
        predicted = F.normalize(latent_model.project(data.predicted), dim=-1)  # which includes the predictor, if there is one
    chosen = th.linspace(0, len(data.states) - 1, min(len(data.states), MAX_STATES)).long().to(data.states.device)
    elements = action_elements(model, data.states[chosen])  # (n, A, D)
    motion = findings.find_motion(model, data, data.states[chosen], elements)
    generators = findings.find_generators(model, elements)
    loss = measures.transition_error(start, following, predicted, data.mask)
    signed = model.policy.options.reward_loss == "categorical"
    return Diagnostics(
        blocks=[name for name, *_ in each_block(model, data.states)],
        transition=measures.transition_error(data.states, data.next_states, data.predicted, data.mask),
        loss=loss,
        motion=motion,
        generators=generators,
        disentanglement=findings.find_disentanglement(model, data.states, play.factors, motion, generators),
        action_symmetry=findings.find_action_symmetry(model, data, np.random.default_rng(seed)),
        collapse=findings.find_collapse(model, data.states, play.samples.observations),
        rewards=measures.reward_error(data.predicted_rewards, data.rewards.sign() if signed else data.rewards, data.mask),
        verdict=find_verdict(loss, is_trained=model.depth > 0),
        rewards_trained=model.depth > 0 and model.reward_coef > 0,
        symmetry_trained=model.depth > 0 and model.symmetry_coef > 0,
    )


def find_verdict(loss: Transition, is_trained: bool = True) -> str:
    """
    - "predicts": the rollout removes at least a quarter of the error of shuffled targets, and of that of no motion.
      An untrained agent whose states differ may achieve the first, since its κ moves them little, but not the second.
    - "not trained": otherwise, if no loss trains the latent model.
    - "collapsed": otherwise, if the shuffled error, Var[ẑ] + Var[z] + ‖mean ẑ − mean z‖², is below 10⁻³: all states are
      equal, and κ does not move them. In an untrained agent the states may be nearly equal, but κ moves them.
    - "does not predict": otherwise.

    :param loss: errors on the unit sphere
    :param is_trained: whether the agent's settings train its latent model
    """
    skill, gain = skill_and_gain(loss)
    if skill >= PREDICTS and gain >= PREDICTS:
        return "predicts"
    if not is_trained:
        return "not trained"
    return "collapsed" if _mean(loss.shuffled, loss.n_windows) < COLLAPSED else "does not predict"


def skill_and_gain(errors: Transition) -> tuple[float, float]:
    """Skill and gain over all steps, so that one in which nothing moves has no weight; NaN if undefined at every step."""
    error, shuffled, still = (_mean(x, errors.n_windows) for x in (errors.error, errors.shuffled, errors.still))
    known = [~np.isnan(x).all() for x in (errors.skill, errors.gain)]
    return (1 - error / shuffled if known[0] else np.nan), (1 - error / still if known[1] else np.nan)


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    known = weights > 0
    return float(np.average(values[known], weights=weights[known])) if known.any() else np.nan


def _lower(share: float) -> str:
    if np.isnan(share):
        return "no lower"
    if share < -1:
        return f"{1 - share:.3g} times higher"
    return f"{share:.0%} lower" if share >= 0 else f"{-share:.0%} higher"
