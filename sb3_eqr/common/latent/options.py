"""The options of the latent model: defaults, legal values and sources, each declared once."""

from dataclasses import dataclass

from sb3_eqr.common.checks.arguments import FLAG, NONE, SHARE, TEXT, check_fields, integer, one_of, option
from sb3_eqr.common.groups import Group
from sb3_eqr.common.groups.layer import DEFAULT_GROUP


@dataclass(frozen=True)
class LatentOptions:
    """
    What the latent model is, and how it is trained. As ``policy_kwargs`` of an agent, they stand beside the others:
    ``policy_kwargs=dict(group="SO(2)", net_arch=[64])``.

    :param group: group of the blocks of the latent state, see :func:`~sb3_eqr.common.groups.make_group`; "none" for
        unconstrained vectors, ``None`` to use the trunk's features directly (no encoder); both need ``symmetry_coef=0``
    :param n_blocks: K ≥ 1; ``None``: as in :class:`~sb3_eqr.common.groups.layer.GroupLayer`, 12 for SE(2) (Table 5)
    :param parameterization: parameterization of rotations, "euler", "exp" or "gram-schmidt"
    :param whiten: whether to whiten the encoder's algebra parameters over the batch: states cannot collapse to a point, and
        blocks are decorrelated; needs a group
    :param transition: how actions move latent states: "group", or "convolutional", SPR's network on the trunk's feature map
        (:class:`~sb3_eqr.common.latent.conv_latent_model.ConvLatentModel`), which needs ``group=None``, ``layer_norm=False``
        and an image trunk with ``rescale=True`` and without ``features_dim``, since it predicts values in [0, 1]
    :param latent_hidden_dim: width ≥ 1 of the hidden layers of κ, r_ψ and ρ, of b, and of ``projection="own"``; 256 in
        appendix B.4
    :param latent_norm: norm of the hidden layers of κ(x, a), r_ψ and ρ: "layer", or "batch" (appendix B.4), with which an
        unusual state in a batch changes the predictions for all others (docs/gradients.md)
    :param projection: p of the AET loss: "head", the first layer of the Q head (appendix B.4), "own", a separate layer, or
        "none", the state itself (§5)
    :param predictor: whether to add a linear layer after p on the online side only, as in SPR
        (https://arxiv.org/abs/2007.05929), without which the AET loss makes latent states alike (docs/gradients.md). It starts
        as the identity, except with SPR's own transition
    :param latent_tau: update coefficient of the latent model's target after each gradient step, in [0, 1]; 1 copies, as in
        the paper. ``None``: it is updated together with the target of the Q head
    :param state_dependent_actions: ``True``: κ(s, a). ``False``: κ(a), independent of the state, as in Example 2
    :param reward_loss: "mse" (Eq. 17), or "categorical": cross-entropy over the sign of the reward, as in the released code
    :param aet_loss: "distance" (Eq. 18), or "contrastive": InfoNCE among the batch's targets
        (:func:`~sb3_eqr.common.losses.contrastive_loss`), which cannot collapse
    :raises ValueError: if an option is out of range
    """

    group: str | Group | None = DEFAULT_GROUP
    n_blocks: int | None = option(None, integer(1) | NONE)
    parameterization: str = option("euler", TEXT)
    whiten: bool = option(False, FLAG)
    transition: str = option("group", one_of(["group", "convolutional"]))
    latent_hidden_dim: int = option(256, integer(1))
    latent_norm: str = option("layer", one_of(["layer", "batch"]))
    projection: str = option("own", one_of(["head", "own", "none"]))
    predictor: bool = option(True, FLAG)
    latent_tau: float | None = option(1.0, SHARE | NONE)
    state_dependent_actions: bool = option(True, FLAG)
    reward_loss: str = option("mse", one_of(["mse", "categorical"]))
    aet_loss: str = option("distance", one_of(["distance", "contrastive"]))

    def __post_init__(self) -> None:
        check_fields(self)
        if self.whiten and self.group is None:
            raise ValueError("group must not be None if whiten=True, got None. Pass a group, or whiten=False.")
        if self.transition == "convolutional" and self.group is not None:
            raise ValueError(f'group must be None if transition="convolutional", got {self.group!r}. Pass group=None.')
