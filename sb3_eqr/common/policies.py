"""The base class of all EqR policies, which extends SB3's Q-learning policies."""

import inspect
from collections.abc import Callable
from dataclasses import fields
from itertools import chain
from typing import Any, ClassVar, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn
from torch.nn import functional as F

from sb3_eqr.common.checks.arguments import POLICY, check_arguments, with_fields_of
from sb3_eqr.common.checks.validation import check_policy_kwargs
from sb3_eqr.common.groups import GroupLayer, NoGroup
from sb3_eqr.common.latent.conv_latent_model import ConvLatentModel
from sb3_eqr.common.latent.latent_model import LatentModel, frozen_copy
from sb3_eqr.common.latent.options import LatentOptions
from sb3_eqr.common.networks.encoders import (
    ConvTrunk,
    GroupFeaturesExtractor,
    ImageExtractor,
    MlpExtractor,
    find_trunk,
    make_trunk,
    trunk_of,
)
from sb3_eqr.common.networks.inputs import keys_of
from sb3_eqr.common.networks.layers import Centering, DistributionalHead
from sb3_eqr.common.networks.optimizers import decay_matrices_only, find_optimizer
from sb3_eqr.common.networks.q_networks import EqRNetwork
from sb3_eqr.common.networks.target_copy import TargetCopy
from sb3_eqr.common.type_aliases import PyTorchObs

Network = TypeVar("Network", bound="EqRNetwork")


class EqRPolicy(BasePolicy):
    """
    Mixin, listed before an SB3 policy whose ``_build`` creates an online network, a target network and the optimiser.
    It adds the group encoder on top of the policy's features extractor, the latent model and its target copy, and includes
    them in the optimiser and the train mode.

    Subclasses define ``network_name``. The parameters up to ``optimizer_kwargs`` are those of SB3's policies.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: hidden sizes of the Q head; ``None``: [256] (appendix B.4)
    :param activation_fn: Activation function of the Q head
    :param features_extractor_class: the trunk, which the group encoder is put on top of. A class or a name: "nature" (the
        paper's three convolutions), "impala" (the residual network of IMPALA, with ``width_scale``), "mlp" (one layer of 256),
        "two_layer", "flatten" (SB3's). ``None``: "mlp" (MlpPolicy), "nature" (CnnPolicy), ``DictExtractor`` (MultiInputPolicy)
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
    :param layer_norm: whether to apply layer norm to the trunk's features, with or without a group
    :param center: whether to subtract the features' running mean before the layer norm; unused without layer norm
    :param head_input: input of the Q head: "state", the group elements (the paper), or "trunk", the trunk's features; only the
        latent model then uses group elements, and with a group the AET loss needs ``projection="own"`` or "none"
    :param dueling: whether to use value and advantage streams
    :param noisy: whether to use factorised noisy layers in the head
    :param sigma_init: their initial noise σ₀: 0.1 as in DER (https://arxiv.org/abs/1906.05243); Table 5 uses 0.5
    :param act_with_target: whether to choose actions with the target network, which changes more slowly if ``tau`` < 1 (as in
        SR-SPR, https://openreview.net/forum?id=OpC-9aBBVJe, and BBF), instead of the online network
    :param bfloat16_targets: whether encoders compute in bfloat16 where no gradient flows, for targets. Saves a fifth of an
        Atari update's time on a CPU with avx512_bf16; the features have a relative error of 0.5%. The agent warns if PyTorch
        finds no such instructions
    :param kwargs: the options of the latent model, :class:`~sb3_eqr.common.latent.options.LatentOptions`, and additional
        arguments of the SB3 policy
    :raises ValueError: if an argument is out of range
    """

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = MlpExtractor
    network_name: ClassVar[str]  # of the online network; that of its target copy ends in _target
    action_space: spaces.Discrete
    net_arch: list[int]
    activation_fn: type[nn.Module]
    latent_model: LatentModel
    latent_target: LatentModel  # its target copy
    latent_encoder: BaseFeaturesExtractor | None  # the target copy of the encoder for the latent model, if it has its own

    @with_fields_of(LatentOptions)
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
        layer_norm: bool = True,
        center: bool = True,
        head_input: str = "trunk",
        dueling: bool = True,
        noisy: bool = True,
        sigma_init: float = 0.1,
        act_with_target: bool = False,
        bfloat16_targets: bool = False,
        **kwargs: Any,
    ):
        check_arguments({**kwargs, **locals()}, POLICY)
        options = {found.name: kwargs.pop(found.name) for found in fields(LatentOptions) if found.name in kwargs}
        check_policy_kwargs(self, EqRPolicy, kwargs)
        self.options = LatentOptions(**options)
        if self.options.transition == "convolutional" and layer_norm:
            raise ValueError(
                'layer_norm must be False if transition="convolutional", which predicts values in [0, 1], got True. Pass '
                'policy_kwargs={"layer_norm": False, "features_extractor_kwargs": {"rescale": True}}.'
            )
        self.layer_norm = layer_norm
        self.center = center
        self.head_input = head_input
        self.dueling = dueling
        self.noisy = noisy
        self.sigma_init = sigma_init
        self.act_with_target = act_with_target
        self.bfloat16_targets = bfloat16_targets
        self._frozen: list[nn.Module] = []
        super().__init__(  # builds
            observation_space,
            action_space,
            lr_schedule,  # type: ignore[arg-type]
            net_arch=[256] if net_arch is None else net_arch,  # appendix B.4
            activation_fn=activation_fn,
            features_extractor_class=find_trunk(features_extractor_class or self.default_trunk_class),
            features_extractor_kwargs=dict(features_extractor_kwargs or {}),  # a copy, because SB3 changes it
            normalize_images=normalize_images,
            optimizer_class=find_optimizer(optimizer_class),
            optimizer_kwargs=optimizer_kwargs,
            **kwargs,
        )

    @property
    def online(self) -> EqRNetwork:
        """The network that is trained, and that acts unless ``act_with_target``."""
        return getattr(self, self.network_name)

    @property
    def target(self) -> EqRNetwork:
        """The target copy of the online network."""
        return getattr(self, f"{self.network_name}_target")

    @property
    def encoder(self) -> BaseFeaturesExtractor:
        """The encoder that is trained: features for the latent model."""
        return self.online.features_extractor

    @property
    def typical_actions(self) -> th.Tensor:
        """All actions, (A,), int64: those that diagnostics show."""
        return th.arange(int(self.action_space.n), device=self.device)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Create the trunk, with the group encoder on top of it if the Q head takes group elements."""
        kind, space, has_group = self.features_extractor_class, self.observation_space, self.options.group is not None
        is_encoder = issubclass(kind, GroupFeaturesExtractor)
        if is_encoder and has_group and self.head_input == "trunk":
            raise ValueError(
                'features_extractor_class must be a trunk if head_input="trunk", got a group encoder. Pass head_input="state".'
            )
        kwargs = self.features_extractor_kwargs
        if not has_group or self.head_input == "trunk":
            return make_trunk(kind, space, kwargs, self.layer_norm, self.center, self.normalize_images)
        group_kwargs = {**self._group_kwargs, "layer_norm": self.layer_norm, "center": self.center}
        group_kwargs["normalized_image"] = not self.normalize_images
        if is_encoder:
            return kind(space, **{**group_kwargs, **kwargs})
        return GroupFeaturesExtractor(space, **group_kwargs, trunk_class=kind, trunk_kwargs=kwargs)

    @property
    def _group_kwargs(self) -> dict[str, Any]:
        return {name: getattr(self.options, name) for name in ("group", "n_blocks", "parameterization", "whiten")}

    @property
    def group_layer(self) -> GroupLayer | None:
        """The layer that maps features to group elements, in the encoder or the latent model; ``None`` without a group."""
        found = getattr(self.encoder, "group_layer", self.latent_model.embedding)
        return found if isinstance(found, GroupLayer) else None

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
        self.latent_model = self._make_latent_model().to(self.device)
        self.latent_target = frozen_copy(self.latent_model)
        for module in self.modules():
            if isinstance(module, ConvTrunk):
                module.to_channels_last()
        self._centerings = [module for module in self.online.modules() if isinstance(module, Centering)]
        encoder, tau = self.online.features_extractor, self.options.latent_tau
        # Without a copy of its own, the latent model's target has the encoder of the Q head's target (latent_tau=None), or the
        # online one, which a copy after each update would equal.
        self.latent_encoder = None if tau is None or (tau == 1 and ignores_mode(encoder)) else frozen_copy(encoder)
        latents: list[tuple[nn.Module, nn.Module]] = [(self.latent_model, self.latent_target)]
        if self.latent_encoder is not None:
            latents.append((encoder, self.latent_encoder))
        self.target_copy = TargetCopy([(self.online, self.target), *(latents if tau is None else [])])
        self.latent_target_copy = TargetCopy(latents) if tau is not None else self.target_copy
        # One optimiser, so that SB3's learning-rate schedule and saving work unchanged; one group is one kernel.
        group = self.optimizer.param_groups[0]
        group["params"] = list(dict.fromkeys([*group["params"], *self.latent_model.parameters()]))
        decay_matrices_only(self, self.optimizer)

    @property
    def description(self) -> dict[str, str]:
        """Properties that the parameters' shapes do not determine, by name; saved in the model's file."""
        group = "no group" if self.group_layer is None else self.group_layer.description
        return {"group": group, "observation keys": keys_of(self.observation_space)}

    def _make_latent_model(self) -> LatentModel:
        encoder, head, options = self.online.features_extractor, self.online.head, self.options
        sizes = int(self.action_space.n), options, head.first if options.projection == "head" else None
        if options.transition == "convolutional":
            return ConvLatentModel(map_shape(encoder), *sizes)
        if options.group is None:
            return LatentModel(nn.Identity(), NoGroup(encoder.features_dim), 1, *sizes)
        if isinstance(encoder, GroupFeaturesExtractor):
            return LatentModel(nn.Identity(), encoder.group_layer.group, encoder.group_layer.n_blocks, *sizes)
        if options.projection == "head":
            raise ValueError(
                'projection must be "own" or "none" if head_input="trunk", because the Q head then takes no group elements, '
                'got "head". Pass policy_kwargs={"projection": "own"}.'
            )
        layer = GroupLayer(encoder.features_dim, **self._group_kwargs)
        return LatentModel(layer, layer.group, layer.n_blocks, *sizes)

    def embed_actions(self, actions: th.Tensor) -> th.Tensor:
        """Action embeddings for the latent model: one-hot vectors, (..., A), of actions, int64, (...)."""
        return F.one_hot(actions, int(self.action_space.n)).to(next(self.latent_model.parameters()).dtype)

    def _predict(self, observation: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        return (self.target if self.act_with_target else self.online)._predict(observation, deterministic)

    def check_losses(self, aet: bool, symmetry: bool) -> None:
        """Raise ValueError if this policy does not support the requested AET or GET (``symmetry``) loss."""
        if symmetry and not self.latent_model.has_symmetry_loss:
            others = (
                ", another group, or prediction_depth=0 for an agent without EqR" if self.options.transition == "group" else ""
            )
            raise ValueError(
                f"group must have inverses for the GET loss, got {self.options.group!r}. Pass symmetry_coef=0{others}."
            )
        if aet and self.options.projection == "head" and not self.net_arch:
            raise ValueError(
                "net_arch must have at least one hidden layer, because the AET loss projects with the first one, got []. "
                'Pass policy_kwargs={"net_arch": [256]} or {"projection": "own"}, or aet_coef=0.'
            )

    def update_target(self, tau: float) -> None:
        """Update the targets of encoder and Q head, and of the latent model if ``latent_tau`` is ``None``; 1 copies."""
        self.target_copy.update(tau)

    def after_gradient_step(self) -> None:
        """Update running means and the latent model's target."""
        for module in self._centerings:
            module.update()
        if self.options.latent_tau is not None:
            self.latent_target_copy.update(self.options.latent_tau)

    def reset_parameters(self, fresh: "EqRPolicy", shrink_factor: float) -> None:
        """
        Reset parameters to counter the loss of plasticity: reinitialise the Q head and the AET loss's projection and
        predictor (Nikishin et al. 2022, https://arxiv.org/abs/2205.07802), and set encoder and latent model to α old +
        (1 - α) fresh (shrink and perturb, Ash and Adams 2020, https://arxiv.org/abs/1910.08475; used for the encoder in
        SR-SPR and BBF). Batch statistics and frozen parameters are kept; statistics of features are counted from 0 again, so
        that the next batches replace them. The optimiser's state is cleared, and the target copies the new parameters.

        :param fresh: a newly initialised policy of the same kind
        :param shrink_factor: α in [0, 1]
        """
        renewed = (self.online.head, self.latent_model.projection, self.latent_model.predictor)
        fresh_only = {parameter for module in renewed for parameter in module.parameters()}
        pairs = [(self.online, fresh.online), (self.latent_model, fresh.latent_model)]
        with th.no_grad():
            for old, drawn in chain(*(zip(a.parameters(), b.parameters(), strict=True) for a, b in pairs)):
                alpha = 0.0 if old in fresh_only else shrink_factor
                if old.requires_grad:
                    old.copy_(alpha * old + (1 - alpha) * drawn if alpha > 0 else drawn)
            for module in self.modules():
                if module.training and hasattr(module, "running_count"):
                    module.running_count.zero_()  # type: ignore[operator] # not if it is frozen
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

    def train(self, mode: bool = True) -> "EqRPolicy":
        """As PyTorch's, but target copies and frozen modules stay in eval mode."""
        super().train(mode)
        for module in (self.target, self.latent_target, self.latent_encoder, *self._frozen):
            if module is not None:
                module.eval()
        return self

    def freeze(self, modules: list[nn.Module]) -> None:
        """Freeze the parameters and batch statistics of these modules, and unfreeze all others."""
        for module in self._frozen:
            module.requires_grad_(True).train(self.training)
        for module in modules:
            module.requires_grad_(False).eval()
        self._frozen = modules

    def _get_constructor_parameters(self) -> dict[str, Any]:
        taken = [inspect.signature(kind.__init__).parameters for kind in (EqRPolicy, type(self))]  # type: ignore[misc]
        own = [name for parameters in taken for name in parameters if name in vars(self)]
        return {**super()._get_constructor_parameters(), **{name: getattr(self, name) for name in own}, **vars(self.options)}


def map_shape(encoder: BaseFeaturesExtractor) -> tuple[int, int, int]:
    """Shape (C, H, W) of the feature map for a convolutional transition; raises ValueError if features are not a map."""
    trunk = trunk_of(encoder)
    if not isinstance(trunk, ImageExtractor) or trunk.linear is not None:
        raise ValueError(
            'features_extractor_class must be an image trunk without a linear layer if transition="convolutional", '
            f'got {type(trunk).__name__}. Pass features_extractor_class="nature" or "impala" without features_dim.'
        )
    if not trunk.rescale:
        raise ValueError(
            'features_extractor_kwargs must have rescale=True if transition="convolutional", which predicts values in [0, 1], '
            "got rescale=False."
        )
    return trunk.map_shape


def ignores_mode(module: nn.Module) -> bool:
    """Whether a module computes the same in train and in eval mode; one with buffers of its own may keep statistics."""
    depend = (nn.modules.dropout._DropoutNd, nn.RReLU)

    def keeps(part: Any) -> bool:  # dropout: a number in a GRU, or in attention
        return isinstance(part, Centering) or not (isinstance(part, depend) or part._buffers or getattr(part, "dropout", 0))

    return all(map(keeps, module.modules()))
