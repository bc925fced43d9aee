"""The base class of all EqR policies, which extends SB3's Q-learning policies."""

import inspect
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_eqr.common.checks.arguments import ALGORITHM, POLICY, check_arguments
from sb3_eqr.common.checks.validation import check_names
from sb3_eqr.common.groups import Group, NoGroup
from sb3_eqr.common.latent.conv_latent_model import ConvLatentModel
from sb3_eqr.common.latent.latent_model import GroupLatentModel, LatentModel, Projection, frozen_copy
from sb3_eqr.common.networks.encoders import (
    DEFAULT_GROUP,
    ConvTrunk,
    DictExtractor,
    GroupFeaturesExtractor,
    GroupLayer,
    ImageExtractor,
    MlpExtractor,
    NormalizedExtractor,
    find_trunk,
    make_trunk,
)
from sb3_eqr.common.networks.layers import Centering, DistributionalHead, Whitening
from sb3_eqr.common.networks.optimizers import decay_matrices_only, find_optimizer
from sb3_eqr.common.networks.q_networks import EqRNetwork
from sb3_eqr.common.networks.target_copy import TargetCopy
from sb3_eqr.common.type_aliases import PyTorchObs

Network = TypeVar("Network", bound="EqRNetwork")

DEFAULT_NET_ARCH = (256,)  # appendix B.4
OWN_ARGUMENTS = ["group", "n_blocks", "parameterization", "whiten", "layer_norm", "center", "head_input", "dueling"]
OWN_ARGUMENTS += ["noisy", "sigma_init", "transition", "latent_hidden_dim", "latent_norm", "projection", "predictor"]
OWN_ARGUMENTS += ["latent_tau", "state_dependent_actions", "act_with_target", "reward_loss", "aet_loss"]


class EqRPolicy(BasePolicy):
    """
    Mixin, listed before an SB3 policy whose ``_build`` creates an online network, a target network and the optimiser.
    It adds the group encoder on top of the policy's features extractor, the latent model and its target copy, and includes
    them in the optimiser and the train mode.

    Subclasses define ``online`` and ``target``. The parameters up to ``optimizer_kwargs`` are those of SB3's policies.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: hidden sizes of the Q head; ``None``: [256] (appendix B.4)
    :param activation_fn: Activation function of the Q head
    :param features_extractor_class: the trunk, which the group encoder is put on top of. A class or a name: "nature" (the
        paper's three convolutions), "impala" (the residual network of IMPALA, with ``width_scale``), "mlp" (one layer of 256),
        "flatten" (SB3's). ``None``: "mlp" (MlpPolicy), "nature" (CnnPolicy), ``DictExtractor`` (MultiInputPolicy)
    :param features_extractor_kwargs: keyword arguments of the trunk: those of
        :class:`~sb3_eqr.common.networks.encoders.ConvExtractor` for "nature", those of
        :class:`~sb3_eqr.common.networks.encoders.ImpalaExtractor` for "impala", those of
        :class:`~sb3_eqr.common.networks.encoders.DictExtractor` for dicts
    :param normalize_images: Whether to divide images by 255 (True by default)
    :param optimizer_class: The optimizer to use, or its name in ``torch.optim``; Adam by default
    :param optimizer_kwargs: its keyword arguments, excluding the learning rate. For Adam and AdamW, the agent's constructor
        adds the defaults ``eps=1.5e-4`` (Table 5) and ``fused=True`` (one kernel for all parameters).
        ``weight_decay`` (0.1 in BBF, https://arxiv.org/abs/2305.19452; AdamW's own default is 0.01) applies only to matrices,
        not to biases, batch-norm parameters and the noise of noisy layers
    :param group: group of the blocks of the latent state, see :func:`~sb3_eqr.common.groups.make_group`; "none" for
        unconstrained vectors, ``None`` to use the trunk's features directly (no encoder); both need ``symmetry_coef=0``
    :param n_blocks: K; ``None``: 12, or 32 for T(n) (Table 5), or 1 if the group's name contains the number of blocks
    :param parameterization: parameterization of rotations, "euler", "exp" or "gram-schmidt"
    :param whiten: whether to whiten the encoder's algebra parameters over the batch: states cannot collapse to a point, and
        blocks are decorrelated; needs a group
    :param layer_norm: whether to apply layer norm to the trunk's features, with or without a group
    :param center: whether to subtract the features' running mean before the layer norm; unused without layer norm
    :param head_input: input of the Q head: "state", the group elements (the paper), or "trunk", the trunk's features; only the
        latent model then uses group elements, and with a group the AET loss needs ``projection="own"`` or "none"
    :param dueling: whether to use value and advantage streams
    :param noisy: whether to use factorised noisy layers in the head
    :param sigma_init: their initial noise σ₀: 0.1 as in DER (https://arxiv.org/abs/1906.05243); Table 5 uses 0.5
    :param transition: how actions move latent states: "group", or "convolutional", SPR's network on the trunk's feature map
        (:class:`~sb3_eqr.common.latent.conv_latent_model.ConvLatentModel`), which needs ``group=None``, an image trunk,
        and ``layer_norm=False``, since it predicts values in [0, 1]
    :param latent_hidden_dim: width of the hidden layers of κ, r_ψ and ρ, and of ``projection="own"``
    :param latent_norm: norm of these layers: "layer", or "batch" (appendix B.4), with which an unusual state in a batch
        changes the predictions for all others (docs/gradients.md)
    :param projection: p of the AET loss: "head", the first layer of the Q head (appendix B.4), "own", a separate layer, or
        "none", the state itself (§5)
    :param predictor: whether to add a linear layer after p on the online side only, as in SPR
        (https://arxiv.org/abs/2007.05929), without which the AET loss makes latent states alike (docs/gradients.md). It starts
        as the identity, except with SPR's own transition
    :param latent_tau: update coefficient of the latent model's target (encoder, p̄, κ̄, b̄) after each gradient step, in
        [0, 1]; 1 copies, as in the paper. ``None``: it is updated together with the target of the Q head
    :param state_dependent_actions: ``True``: κ(s, a). ``False``: κ(a), independent of the state, as in Example 2
    :param act_with_target: whether to choose actions with the target network, which changes more slowly if ``tau`` < 1 (as in
        SR-SPR, https://openreview.net/forum?id=OpC-9aBBVJe, and BBF), instead of the online network
    :param reward_loss: "mse" (Eq. 17), or "categorical": cross-entropy over the sign of the reward
    :param aet_loss: "distance" (Eq. 18), or "contrastive": InfoNCE among the batch's targets
        (:func:`~sb3_eqr.common.losses.contrastive_loss`), which cannot collapse
    :param stock_kwargs: additional arguments of the SB3 policy
    :raises ValueError: if an argument is out of range
    """

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = MlpExtractor
    action_space: spaces.Discrete
    net_arch: list[int]
    activation_fn: type[nn.Module]
    latent_model: LatentModel
    latent_model_target: LatentModel
    own_projection: nn.Linear | None
    own_projection_target: nn.Linear | None
    latent_network_target: EqRNetwork | None
    state_dim: int  # D: size of the latent state
    shares_passes = True  # whether networks that are equal encode a batch once

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        lr_schedule: Schedule,
        net_arch: list[int] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: str | type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: str | type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        group: str | Group | None = DEFAULT_GROUP,
        n_blocks: int | None = None,
        parameterization: str = "euler",
        whiten: bool = False,
        layer_norm: bool = True,
        center: bool = True,
        head_input: str = "trunk",
        dueling: bool = True,
        noisy: bool = True,
        sigma_init: float = 0.1,
        transition: str = "group",
        latent_hidden_dim: int = 256,
        latent_norm: str = "layer",
        projection: str = "own",
        predictor: bool = True,
        latent_tau: float | None = 1.0,
        state_dependent_actions: bool = True,
        act_with_target: bool = False,
        reward_loss: str = "mse",
        aet_loss: str = "distance",
        **stock_kwargs: Any,
    ):
        given = {**locals(), **stock_kwargs}
        stock = inspect.signature(super().__init__).parameters
        if misplaced := sorted(stock_kwargs.keys() & ALGORITHM.keys()):
            name = misplaced[0]
            raise TypeError(f"policy_kwargs: {name!r} is an argument of the agent. Pass {name}=... beside policy_kwargs.")
        if any(name not in stock for name in stock_kwargs):
            own = [inspect.signature(kind.__init__).parameters for kind in (type(self), EqRPolicy)]  # type: ignore[misc]
            names = {name for parameters in own for name in list(parameters)[4:]} - {"kwargs", "stock_kwargs"}
            check_names(f"policy_kwargs: {type(self).__name__}", stock_kwargs, sorted(names))
        check_arguments(given, POLICY)
        if whiten and group is None:
            raise ValueError("group must not be None if whiten=True, got None. Pass a group, or whiten=False.")
        if transition == "convolutional" and group is not None:
            raise ValueError(f'group must be None if transition="convolutional", got {group!r}. Pass group=None.')
        if transition == "convolutional" and layer_norm:
            raise ValueError(
                'layer_norm must be False if transition="convolutional", which predicts values in [0, 1], got True. Pass '
                'policy_kwargs={"layer_norm": False, "features_extractor_kwargs": {"rescale": True}}.'
            )
        self.group = group
        self.n_blocks = n_blocks
        self.parameterization = parameterization
        self.whiten = whiten
        self.layer_norm = layer_norm
        self.center = center
        self.head_input = head_input
        self.predictor = predictor
        self.latent_tau = latent_tau
        self.transition = transition
        self._frozen: list[nn.Module] = []
        self.latent_hidden_dim = latent_hidden_dim
        self.latent_norm = latent_norm
        self.dueling = dueling
        self.noisy = noisy
        self.sigma_init = sigma_init
        self.projection = projection
        self.state_dependent_actions = state_dependent_actions
        self.act_with_target = act_with_target
        self.reward_loss = reward_loss
        self.aet_loss = aet_loss
        super().__init__(  # builds
            observation_space,
            action_space,
            lr_schedule,  # type: ignore[arg-type]
            net_arch=list(DEFAULT_NET_ARCH) if net_arch is None else net_arch,
            activation_fn=activation_fn,
            features_extractor_class=find_trunk(features_extractor_class or self.default_trunk_class),
            features_extractor_kwargs=features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=find_optimizer(optimizer_class),
            optimizer_kwargs=optimizer_kwargs,
            **stock_kwargs,
        )

    @property
    def online(self) -> EqRNetwork:
        """The network that is trained, and that acts unless ``act_with_target``."""
        raise AttributeError(f"{type(self).__name__} must define `online`")

    @property
    def target(self) -> EqRNetwork:
        """The target copy of the online network."""
        raise AttributeError(f"{type(self).__name__} must define `target`")

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Create the trunk, with the group encoder on top of it if the Q head takes group elements."""
        trunk_kwargs = dict(self.features_extractor_kwargs)
        if not self.normalize_images and issubclass(self.features_extractor_class, (ImageExtractor, DictExtractor)):
            trunk_kwargs["normalized_image"] = True  # SB3 does this for its own extractors
        is_encoder = issubclass(self.features_extractor_class, GroupFeaturesExtractor)
        if is_encoder and self.group is not None and self.head_input == "trunk":
            raise ValueError(
                'features_extractor_class must be a trunk if head_input="trunk", got a group encoder. Pass head_input="state".'
            )
        if self.group is None or self.head_input == "trunk":
            return make_trunk(
                self.features_extractor_class, self.observation_space, trunk_kwargs, self.layer_norm, self.center
            )
        group_kwargs = {name: getattr(self, name) for name in ("layer_norm", "center")} | self._group_kwargs
        group_kwargs["normalized_image"] = not self.normalize_images
        if is_encoder:
            return self.features_extractor_class(self.observation_space, **{**group_kwargs, **trunk_kwargs})
        return GroupFeaturesExtractor(
            self.observation_space,
            **group_kwargs,  # type: ignore[arg-type]
            trunk_class=self.features_extractor_class,
            trunk_kwargs=trunk_kwargs,
        )

    @property
    def _group_kwargs(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("group", "n_blocks", "parameterization", "whiten")}

    @property
    def group_layer(self) -> GroupLayer | None:
        """The layer that maps features to group elements, in the encoder or the latent model; ``None`` without a group."""
        for owner, name in ((self.online.features_extractor, "group_layer"), (self.latent_model, "embedding")):
            if isinstance(found := getattr(owner, name, None), GroupLayer):
                return found
        return None

    def _make_network(self, network_class: type[Network], n_atoms: int, **kwargs: Any) -> Network:
        encoder, n_actions = self.make_features_extractor(), int(self.action_space.n)
        sigma_init = self.sigma_init if self.noisy else None
        head = DistributionalHead(
            encoder.features_dim, n_actions, n_atoms, self.net_arch, self.activation_fn, self.dueling, sigma_init
        )
        network = network_class(self.observation_space, self.action_space, encoder, head, self.normalize_images, **kwargs)
        return network.to(self.device)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)  # type: ignore[misc]
        encoder = self.online.features_extractor
        self.latent_model = self._make_latent_model(encoder).to(self.device)
        self.latent_model_target = frozen_copy(self.latent_model)
        parameters = list(self.latent_model.parameters())
        self.own_projection = self.own_projection_target = None
        if self.projection == "own":
            self.own_projection = nn.Linear(self.state_dim, self.latent_hidden_dim).to(self.device)
            self.own_projection_target = frozen_copy(self.own_projection)
            parameters += self.own_projection.parameters()
        self.predictor_net = None
        if self.predictor:
            width = {"own": self.latent_hidden_dim, "head": self.online.head.projection_dim, "none": self.state_dim}
            self.predictor_net = nn.Linear(width[self.projection], width[self.projection]).to(self.device)
            if self.transition == "group":  # like κ and ρ around the identity, or the latent model has to undo it first
                nn.init.eye_(self.predictor_net.weight)
                nn.init.zeros_(self.predictor_net.bias)
            parameters += self.predictor_net.parameters()
        for module in self.modules():
            if isinstance(module, ConvTrunk):
                module.to_channels_last()
        self._centerings = [module for module in self.online.modules() if isinstance(module, Centering)]
        depend_on_mode = (nn.modules.batchnorm._NormBase, nn.modules.dropout._DropoutNd, nn.RReLU, Whitening)
        self._encoder_ignores_mode, self._states_ignore_mode = (
            not any(isinstance(module, depend_on_mode) for part in parts for module in part.modules())
            for parts in ([encoder], [encoder, self.latent_model.embedding])
        )
        is_online = self.latent_tau == 1 and self._states_ignore_mode  # a copy would be identical
        self.latent_network_target = None if self.latent_tau is None or is_online else frozen_copy(self.online)
        self._make_target_copies()
        # One optimiser, so that SB3's learning-rate schedule and saving work unchanged.
        self.optimizer.param_groups[0]["params"] += parameters  # one group is one kernel
        decay_matrices_only(self, self.optimizer)

    @property
    def description(self) -> dict[str, str]:
        """Properties that the parameters' shapes do not determine, by name; saved in the model's file."""
        keys = list(self.observation_space.spaces) if isinstance(self.observation_space, spaces.Dict) else []
        group = "no group" if self.group_layer is None else self.group_layer.description
        return {"group": group, "observation keys": ", ".join(keys)}  # in the order in which they are concatenated

    def _make_latent_model(self, encoder: BaseFeaturesExtractor) -> LatentModel:
        sizes, losses = (int(self.action_space.n), self.latent_hidden_dim), (self.reward_loss, self.aet_loss)
        if self.transition == "convolutional":
            self.state_dim = encoder.features_dim
            return ConvLatentModel(map_shape(encoder), *sizes, *losses, norm=self.latent_norm)
        if self.group is None:
            self.state_dim = encoder.features_dim
            blocks: tuple[Group, int] = NoGroup(encoder.features_dim), 1
            return GroupLatentModel(*blocks, *sizes, *losses, self.state_dependent_actions, norm=self.latent_norm)
        layer = encoder.group_layer if isinstance(encoder, GroupFeaturesExtractor) else None
        made = layer or GroupLayer(encoder.features_dim, **self._group_kwargs)
        self.state_dim = made.state_dim
        embedding = made if layer is None else None
        given = made.group, made.n_blocks
        return GroupLatentModel(*given, *sizes, *losses, self.state_dependent_actions, embedding, self.latent_norm)

    def _make_target_copies(self) -> None:
        latents: list[tuple[nn.Module | None, nn.Module | None]] = [
            (self.latent_network_target and self.online, self.latent_network_target),
            (self.own_projection, self.own_projection_target),
            (self.latent_model.embedding, self.latent_model_target.embedding),
            (self.latent_model.transition, self.latent_model_target.transition),
            (self.latent_model.projection, self.latent_model_target.projection),
        ]
        pairs = [(online, target) for online, target in latents if online and target and [*online.parameters()]]
        if self.latent_tau is None:
            self.target_copy = self.latent_target_copy = TargetCopy([(self.online, self.target), *pairs])
        else:
            self.target_copy, self.latent_target_copy = TargetCopy([(self.online, self.target)]), TargetCopy(pairs)

    @property
    def latent_target(self) -> EqRNetwork:
        """The network whose encoder computes the latent model's targets."""
        if self.latent_tau is None:
            return self.target
        return self.latent_network_target or self.online

    @property
    def target_encodes_as_online(self) -> bool:
        """Whether the target encoder of the Q head gives the same features as the online one, so that one pass suffices."""
        return self.shares_passes and self.target_copy.is_exact and self._encoder_ignores_mode

    @property
    def latent_target_encodes_as_online(self) -> bool:
        """The same for the latent model's target."""
        shares_passes = self.shares_passes or self.latent_target_copy is not self.target_copy
        return shares_passes and self.latent_target_copy.is_exact and self._states_ignore_mode

    def load_state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """As PyTorch's ``load_state_dict``, with the same parameters."""
        result = super().load_state_dict(*args, **kwargs)
        for copy in (self.target_copy, self.latent_target_copy):
            copy.compare()
        return result

    def _predict(self, observation: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        return (self.target if self.act_with_target else self.online)._predict(observation, deterministic)

    def check_losses(self, aet: bool, symmetry: bool) -> None:
        """Raise ValueError if this policy does not support the requested AET or GET (``symmetry``) loss."""
        if symmetry and not self.latent_model.has_symmetry_loss:
            others = ", another group, or prediction_depth=0 for an agent without EqR" if self.transition == "group" else ""
            raise ValueError(f"group must have inverses for the GET loss, got {self.group!r}. Pass symmetry_coef=0{others}.")
        if aet and self.projection == "head" and isinstance(self.latent_model.embedding, GroupLayer):
            raise ValueError(
                'projection must be "own" or "none" if head_input="trunk", because the Q head then takes no group elements, '
                'got "head". Pass policy_kwargs={"projection": "own"}, or aet_coef=0.'
            )
        if aet and self.projection == "head" and not self.net_arch:
            raise ValueError(
                "net_arch must have at least one hidden layer, because the AET loss projects with the first one, got []. "
                'Pass policy_kwargs={"net_arch": [256]} or {"projection": "own"}, or aet_coef=0.'
            )

    @property
    def project(self) -> Projection:
        """p of the AET loss, followed by the predictor if there is one."""
        project = self._projections(self.online, self.own_projection)
        predict = self.predictor_net
        return project if predict is None else lambda rows: predict(project(rows))

    @property
    def target_project(self) -> Projection:
        """p̄, the target copy of p."""
        return self._projections(self.latent_target, self.own_projection_target)

    def _projections(self, network: EqRNetwork, own: nn.Linear | None) -> Projection:
        if own is not None:
            return own
        return network.head.project if self.projection == "head" else nn.Identity()

    def update_target(self, tau: float) -> None:
        """Update the targets of encoder and Q head, and of the latent model if ``latent_tau`` is ``None``; 1 copies."""
        self.target_copy.update(tau)

    def after_gradient_step(self) -> None:
        """Note that the targets are no longer exact copies; update running means and the latent model's target."""
        self.target_copy.is_exact = self.latent_target_copy.is_exact = False
        for module in self._centerings:
            module.update()
        if self.latent_tau is not None:
            self.latent_target_copy.update(self.latent_tau)

    def reset_parameters(self, fresh: "EqRPolicy", shrink_factor: float) -> None:
        """
        Reset parameters to counter the loss of plasticity: reinitialise the Q head and the AET loss's own projection and
        predictor (Nikishin et al. 2022, https://arxiv.org/abs/2205.07802), and set encoder and latent model to α old +
        (1 - α) fresh (shrink and perturb, Ash and Adams 2020, https://arxiv.org/abs/1910.08475; used for the encoder in
        SR-SPR and BBF). Batch statistics and frozen parameters are kept; statistics of features are counted from 0 again, so
        that the next batches replace them. The optimiser's state is cleared, and the target copies the new parameters.

        :param fresh: a newly initialised policy of the same kind
        :param shrink_factor: α in [0, 1]
        """
        parts: list[tuple[nn.Module | None, nn.Module | None, float]] = [
            (self.online.features_extractor, fresh.online.features_extractor, shrink_factor),
            (self.latent_model, fresh.latent_model, shrink_factor),
            (self.online.head, fresh.online.head, 0.0),
            (self.own_projection, fresh.own_projection, 0.0),
            (self.predictor_net, fresh.predictor_net, 0.0),
        ]
        with th.no_grad():
            for old, new, alpha in parts:
                pairs = () if old is None or new is None else zip(old.parameters(), new.parameters(), strict=True)
                for parameter, drawn in pairs:
                    if parameter.requires_grad:
                        parameter.copy_(alpha * parameter + (1 - alpha) * drawn if alpha > 0 else drawn)
            for module in self.modules():
                if module.training and hasattr(module, "running_count"):
                    module.running_count.zero_()  # not if it is frozen
        self.optimizer.state.clear()
        for copy in (self.target_copy, self.latent_target_copy):
            copy.update(1.0)

    def _apply(self, fn: Callable[[th.Tensor], th.Tensor], recurse: bool = True) -> "EqRPolicy":
        for copy in (self.target_copy, self.latent_target_copy):
            copy.forget_tensors()
        return super()._apply(fn, recurse)

    def set_training_mode(self, mode: bool) -> None:
        """Put all trained modules into train or eval mode; the target copies stay in eval mode."""
        if mode == self.training:
            return  # SB3 calls this at every environment step, and visiting all modules is slow
        super().set_training_mode(mode)
        self.latent_model.train(mode)
        for module in self._frozen:
            module.eval()

    def freeze(self, modules: list[nn.Module]) -> None:
        """Freeze the parameters and batch statistics of these modules, and unfreeze all others."""
        for module in self._frozen:
            module.requires_grad_(True).train(self.training)
        for module in modules:
            module.requires_grad_(False).eval()
        self._frozen = modules

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **{name: getattr(self, name) for name in OWN_ARGUMENTS}}


def map_shape(encoder: BaseFeaturesExtractor) -> tuple[int, int, int]:
    """Shape (C, H, W) of the feature map for a convolutional transition; raises ValueError if features are not a map."""
    trunk = encoder.trunk if isinstance(encoder, NormalizedExtractor) else encoder
    if not isinstance(trunk, ImageExtractor) or trunk.linear is not None:
        raise ValueError(
            'features_extractor_class must be an image trunk without a linear layer if transition="convolutional", '
            f'got {type(trunk).__name__}. Pass features_extractor_class="nature" or "impala" without features_dim.'
        )
    return trunk.map_shape
