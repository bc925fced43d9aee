"""Policies of actor-critic agents: SB3's, whose actor and critics also read a latent state."""

import inspect
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim, get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.type_aliases import Schedule

from sb3_eqr.common.checks.arguments import (
    ALGORITHM,
    FLAG,
    NONE,
    POLICY,
    TEXT,
    Rule,
    a,
    a_list,
    check_arguments,
    integer,
    number,
    one_of,
    option,
    with_fields_of,
)
from sb3_eqr.common.checks.validation import check_policy_kwargs
from sb3_eqr.common.groups import Group
from sb3_eqr.common.groups.layer import GroupLayer
from sb3_eqr.common.latent.latent_model import LatentModel, frozen_copy
from sb3_eqr.common.latent.options import LatentOptions
from sb3_eqr.common.networks.encoders import (
    ConvExtractor,
    DictExtractor,
    ImageExtractor,
    TwoLayerExtractor,
    find_trunk,
    is_flat,
    make_trunk,
)
from sb3_eqr.common.networks.inputs import Augmentation, keys_of
from sb3_eqr.common.networks.optimizers import can_fuse, find_optimizer
from sb3_eqr.common.networks.target_copy import TargetCopy
from sb3_eqr.common.type_aliases import PyTorchObs

DEFAULT_SHIFT = 4  # pixels, as in DrQ
GROUP = TEXT | a(Group, "a group")
WIDTHS = a_list(integer(1))
NET_ARCH = Rule(
    'a dictionary with the lists "pi" and "qf"',
    lambda value: isinstance(value, dict) and {*value} == {"pi", "qf"} and all(map(WIDTHS.holds, value.values())),
)
RULES = {
    **POLICY,
    "net_arch": POLICY["net_arch"] | NET_ARCH,
    "n_critics": integer(1),
    "log_std_init": number(),
    "clip_mean": number(0, above=True),
    "head_input": one_of(["latent", "observation"]),
    "reads_features": FLAG | NONE,
    "shift_pixels": ALGORITHM["shift_pixels"],
}


@dataclass(frozen=True)
class ActorCriticOptions(LatentOptions):
    """
    As :class:`LatentOptions`; the target is a moving average, which actor and critics read, too. There is no Q head. By
    default, the latent state is 72 numbers, as many as SE(2) has in 12 blocks, and κ(x, a) is added to them:
    docs/results/continuous.md.
    """

    group: str | Group = option("T(72)^1", GROUP)  # type: ignore[assignment]  # noqa: RUF009
    transition: str = option("group", one_of(["group"]))
    latent_tau: float | None = option(0.005, number(0, 1, above=True))
    projection: str = option("own", one_of(["own", "none"]))

    def __post_init__(self) -> None:
        if self.group is None:
            raise ValueError(
                'group must be a string or a group, got None. Omit it for the default, pass "none(72)" so that κ(x, a) is the '
                'next state itself, or, for SAC itself, prediction_depth=0 and policy_kwargs=dict(head_input="observation").'
            )
        super().__post_init__()
        is_whole = isinstance(self.group, str) and ("^" in self.group or self.group.startswith("none"))
        if is_whole and self.n_blocks not in (None, 1):
            raise ValueError(
                f"n_blocks must be None or 1 with group={self.group!r}, which is the whole latent state, got {self.n_blocks}. "
                'Pass a group such as group="SE(2)", too, or omit n_blocks.'
            )


class LatentReader(BaseFeaturesExtractor):
    """
    What actor and critics read of observations: [s, x], but h(s) in place of images, or as ``reads_features`` says. h and
    x = τ(s) are those of the moving average, without gradient: only the auxiliary losses train them. In a round of updates,
    observations are augmented, and those of one batch are encoded only once, for actor and critics alike.

    :param observation_space: of the observations
    :param encoder: the moving average of the encoder, h
    :param latent_model: the moving average of the latent model
    :param augment: in a round of updates; otherwise observations are only preprocessed
    :param reads_features: whether h(s) is among what they read; ``None``: only if s has images
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        encoder: BaseFeaturesExtractor,
        latent_model: LatentModel,
        augment: Augmentation,
        reads_features: bool | None = None,
    ):
        n_observed = sum(get_flattened_obs_dim(space) for space in augment.plain_spaces.values())
        self.reads_features = bool(augment.image_keys) if reads_features is None else reads_features
        n_features = encoder.features_dim if self.reads_features else 0
        super().__init__(observation_space, n_observed + n_features + latent_model.state_dim)
        self._parts = encoder, latent_model  # in a tuple: they belong to the policy
        self._augment = augment
        self._plain = Augmentation(observation_space, augment._normalize_images, 0, 0.0)
        self._is_updating = False
        self._known: list[tuple[PyTorchObs, th.Tensor]] = []

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """Map observations as they come from the environment, (B, *obs_shape) or a dict of these, to (B, features_dim)."""
        if not (self._is_updating and self.training):
            return self._read(self._plain(observations))
        for seen, found in self._known:
            if seen is observations:
                return found
        found = self._read(self._augment(observations))
        self._known = [*self._known[-1:], (observations, found)]  # an update has two batches
        return found

    @th.no_grad()
    def _read(self, observations: PyTorchObs) -> th.Tensor:
        encoder, latent_model = self._parts
        features = encoder(observations)
        given = observations if isinstance(observations, dict) else {"": observations}
        parts = [given[key].flatten(1) for key in self._augment.plain_spaces]
        parts += [features] if self.reads_features else []
        return th.cat([*parts, latent_model.embedding(features)], dim=1)

    @contextmanager
    def updating(self) -> Iterator[None]:
        """A context for a round of updates."""
        self._is_updating = True
        try:
            yield
        finally:
            self._is_updating = False
            self.forget()

    def forget(self) -> None:
        """Forget what was encoded, because the moving average has changed."""
        self._known.clear()

    def moved(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """κ(x, a) · x, (B, D), with the gradient for the actions, (B, A)."""
        _, latent_model = self._parts
        state = self(observations)[:, -latent_model.state_dim :]
        return latent_model.act(latent_model.action_element(state, actions), state)


class ReadsLatent(BaseModel):
    """Mixin, listed before a network of SB3, that reads observations through a :class:`LatentReader`."""

    def extract_features(self, obs: PyTorchObs, features_extractor: Any) -> th.Tensor:  # type: ignore[override]
        return features_extractor(obs)  # which preprocesses


class PredictsState(ReadsLatent):
    """Mixin, listed before a critic of SB3, that reads κ(x, a) · x beside the action."""

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> Any:
        """
        As that of the critic: values of observations, (B, *obs_shape), and actions, (B, A). Where the actions have a gradient,
        the critics get none: SAC would discard it.
        """
        reader: Any = self.features_extractor
        inputs = th.cat([actions, reader.moved(obs, actions)], dim=1)
        trained = [parameter for parameter in self.parameters() if parameter.requires_grad] if actions.requires_grad else []
        for parameter in trained:
            parameter.requires_grad_(False)
        try:
            return super().forward(obs, inputs)  # type: ignore[misc]
        finally:
            for parameter in trained:
                parameter.requires_grad_(True)


class ForImages:
    """Mixin, listed before an actor-critic policy for vectors: the encoder is the paper's three convolutions."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = ConvExtractor
    stock_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = NatureCNN


class ForDicts:
    """Mixin, listed before an actor-critic policy for vectors: observations are dicts."""

    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = DictExtractor
    stock_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = CombinedExtractor


class EqRActorCriticPolicy(BasePolicy):
    """
    Mixin, listed before a policy of SB3 with an actor and critics. It adds the encoder, the latent model, their moving
    averages and the optimiser of both; actor and critics read them through a :class:`LatentReader`, and the critics
    κ(x, a) · x, too, which is κ(x, a) without a group.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant), also of the latent model
    :param features_extractor_class: the encoder h, a class or a name as in :class:`~sb3_eqr.common.policies.EqRPolicy`, or
        "two_layer". ``None``: "two_layer" (MlpPolicy), "nature" (CnnPolicy), ``DictExtractor`` (MultiInputPolicy); SB3's with
        ``head_input="observation"``
    :param features_extractor_kwargs: its keyword arguments
    :param layer_norm: whether layer norm follows the encoder
    :param reads_features: whether actor and critics read h(s) beside x and what of s is not an image; ``None``: only if s
        has images
    :param head_input: what actor and critics read: "latent", or "observation", as in SB3, without a latent model
    :param shift_pixels: largest random shift of images in updates, in pixels, ≥ 0, at most one for each 16 of the smaller
        side, as in DrQ (https://arxiv.org/abs/2004.13649)
    :param kwargs: the options of the latent model, :class:`ActorCriticOptions`, and the other arguments of the SB3 policy
    :raises ValueError: if an argument is out of range
    """

    actor_class: ClassVar[type[ReadsLatent]]
    critic_class: ClassVar[type[PredictsState]]
    default_trunk_class: ClassVar[type[BaseFeaturesExtractor]] = TwoLayerExtractor
    stock_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor
    actor_kwargs: dict[str, Any]
    critic_kwargs: dict[str, Any]
    encoder: BaseFeaturesExtractor
    latent_encoder: BaseFeaturesExtractor  # its moving average
    latent_model: LatentModel
    latent_target: LatentModel  # its moving average
    latent_optimizer: th.optim.Optimizer
    reader: LatentReader

    @with_fields_of(ActorCriticOptions)
    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        features_extractor_class: str | type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        layer_norm: bool = True,
        head_input: str = "latent",
        reads_features: bool | None = None,
        shift_pixels: int = DEFAULT_SHIFT,
        **kwargs: Any,
    ):
        check_arguments({**kwargs, **locals()}, RULES)
        options = {found.name: kwargs.pop(found.name) for found in fields(ActorCriticOptions) if found.name in kwargs}
        check_policy_kwargs(self, EqRActorCriticPolicy, kwargs)
        self.options = ActorCriticOptions(**options)
        self.layer_norm = layer_norm
        self.head_input = head_input
        self.reads_features = reads_features
        self.shift_pixels = shift_pixels
        if not self.has_latent:
            unused = [found.name for found in fields(self.options) if getattr(self.options, found.name) != found.default]
            unused += [] if shift_pixels in (0, DEFAULT_SHIFT) else ["shift_pixels"]
            if unused:
                warnings.warn(f"{', '.join(unused)}: no effect with head_input='observation', without a latent model.")
        kind = kwargs["optimizer_class"] = find_optimizer(kwargs.get("optimizer_class", th.optim.Adam))
        if self.has_latent and kind in (th.optim.Adam, th.optim.AdamW):
            given = kwargs.get("optimizer_kwargs") or {}
            kwargs["optimizer_kwargs"] = {"fused": can_fuse(given), **given}
        if features_extractor_class is None:
            features_extractor_class = self.default_trunk_class if self.has_latent else self.stock_extractor_class
        extractor_class, extractor_kwargs = find_trunk(features_extractor_class), dict(features_extractor_kwargs or {})
        if not kwargs.get("normalize_images", True) and issubclass(extractor_class, (ImageExtractor, DictExtractor)):
            extractor_kwargs["normalized_image"] = True  # as SB3 does for its own
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,  # type: ignore[arg-type]
            features_extractor_class=extractor_class,
            features_extractor_kwargs=extractor_kwargs,
            **kwargs,
        )

    @property
    def has_latent(self) -> bool:
        """Whether there is a latent model, which actor and critics read."""
        return self.head_input == "latent"

    def check_losses(self, depth: int, symmetry_coef: float) -> None:
        """
        Raise ValueError if a loss needs what this policy does not have; warn if nothing trains its latent model.

        :param depth: M; 0 if all losses are disabled
        :param symmetry_coef: weight of the GET loss
        """
        if depth > 0 and not self.has_latent:
            raise ValueError(f"prediction_depth must be 0 with head_input='observation', without a latent model, got {depth}.")
        if depth == 0 and self.has_latent:
            warnings.warn(
                "prediction_depth=0, or no weight above 0: actor and critics read an encoder that no loss trains. "
                'Pass policy_kwargs=dict(head_input="observation"), too, for an agent without a latent model.'
            )
        if depth > 0 and symmetry_coef > 0 and not self.latent_model.has_symmetry_loss:
            raise ValueError(f"group must have inverses for the GET loss, got {self.options.group!r}. Pass symmetry_coef=0.")

    def _build(self, lr_schedule: Schedule) -> None:
        if self.has_latent:
            self._make_latent_model()
        super()._build(lr_schedule)  # type: ignore[misc]
        if self.has_latent:
            parameters = [*self.encoder.parameters(), *self.latent_model.parameters()]
            self.latent_optimizer = self.optimizer_class(parameters, lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _make_latent_model(self) -> None:
        options = self.options
        kind, kwargs = self.features_extractor_class, self.features_extractor_kwargs
        self.encoder = make_trunk(kind, self.observation_space, kwargs, self.layer_norm, False, self.normalize_images)
        names = ("group", "n_blocks", "parameterization", "whiten")
        layer = GroupLayer(self.encoder.features_dim, **{name: getattr(options, name) for name in names})
        self.latent_model = LatentModel(layer, layer.group, layer.n_blocks, get_action_dim(self.action_space), options)
        self.latent_encoder, self.latent_target = frozen_copy(self.encoder), frozen_copy(self.latent_model)
        self.target_copy = TargetCopy([(self.encoder, self.latent_encoder), (self.latent_model, self.latent_target)])
        shift_pixels = 0 if is_flat(self.encoder) else self.shift_pixels
        self.augment = Augmentation(self.observation_space, self.normalize_images, shift_pixels, 0.0)
        self.reader = LatentReader(
            self.observation_space, self.latent_encoder, self.latent_target, self.augment, self.reads_features
        )

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """As SB3's; with a latent model, the actor reads it."""
        if not self.has_latent:
            return super().make_actor(features_extractor)  # type: ignore[misc]
        return self.actor_class(**self._update_features_extractor(self.actor_kwargs, self.reader)).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """As SB3's; with a latent model, the critics read it."""
        if not self.has_latent:
            return super().make_critic(features_extractor)  # type: ignore[misc]
        kwargs = self._update_features_extractor(self.critic_kwargs, self.reader)
        kwargs["features_dim"] += self.latent_model.state_dim
        return self.critic_class(**kwargs).to(self.device)

    @property
    def typical_actions(self) -> th.Tensor:
        """The largest action in each direction of each axis, (2 A, A): those that diagnostics show."""
        ones = th.eye(get_action_dim(self.action_space), device=self.device)
        return th.stack([ones, -ones], dim=1).flatten(0, 1)

    def embed_actions(self, actions: th.Tensor) -> th.Tensor:
        """Action embeddings for the latent model: the actions themselves, (..., A), in [-1, 1] as SB3 scales them."""
        return actions

    def set_training_mode(self, mode: bool) -> None:
        """As SB3's, for the latent model, too; its moving average is always in eval mode."""
        super().set_training_mode(mode)
        if self.has_latent:
            self.encoder.train(mode)
            self.latent_model.train(mode)

    def train(self, mode: bool = True) -> "EqRActorCriticPolicy":
        """As PyTorch's, but the moving average stays in eval mode."""
        super().train(mode)
        if self.has_latent:
            self.latent_encoder.eval()
            self.latent_target.eval()
        return self

    @property
    def description(self) -> dict[str, str]:
        """Properties that the parameters' shapes do not determine, by name; saved in the model's file."""
        group: Any = self.latent_model.embedding.description if self.has_latent else "no latent model"
        return {"group": group, "observation keys": keys_of(self.observation_space)}

    def _apply(self, fn: Callable[[th.Tensor], th.Tensor], recurse: bool = True) -> "EqRActorCriticPolicy":
        if self.has_latent:
            self.target_copy.forget_tensors()
        return super()._apply(fn, recurse)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = [name for name in inspect.signature(EqRActorCriticPolicy.__init__).parameters if name in vars(self)]
        return {**super()._get_constructor_parameters(), **{name: getattr(self, name) for name in own}, **vars(self.options)}
