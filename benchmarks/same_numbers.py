"""
Do updates compute what they computed before elements left out their constant entries (commit d23ef57)?

    git worktree add /tmp/before d23ef57
    python -m benchmarks.same_numbers --before /tmp/before

An agent of each version starts from the same parameters and is trained on the same samples with the same noise. What has
changed on purpose is changed in the old one, too: weights of constant entries are 0 and stay so, both streams of the head
share the noise of their inputs, one draw of noise serves both uses of the online head, and states are not held past an
episode's end.

The control is the new version beside itself with starting parameters that differ in their last bit: how far rounding takes it.
"""

import argparse
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import configure

from benchmarks import workload
from sb3_eqr.common.type_aliases import SequenceReplayBufferSamples

GROUPS = ["SE(2)", "SE(3)", "SO(2)", "SO(3)", "GL(2)", "T(2)", "SE(2)^2 x SO(3)", "none(12)", None]
N_SAMPLES, HIDDEN, N_BLOCKS = 16, 32, 3
ON_STATES: tuple[str, ...] = ("head.first.0.weight", "head.first.0.weight_sigma", "transition.0.weight", "reward_net.0.weight")
ON_STATES += ("action_symmetry.0.weight", "projection.weight")


class World(gym.Env):
    """Six numbers and three actions; nothing is ever played."""

    observation_space, action_space = spaces.Box(-1, 1, (6,)), spaces.Discrete(3)


def make(algorithm: Any, group: str | None) -> Any:
    """An agent with every loss that its group allows, and nothing that draws random numbers but noisy layers and partners."""
    has_inverse = group is not None and not group.startswith("none")
    network = {"group": group, "n_blocks": N_BLOCKS if has_inverse and "^" not in str(group) else None, "net_arch": [HIDDEN]}
    options = {"symmetry_coef": float(has_inverse), "policy_kwargs": network, "learning_starts": 0, "buffer_size": 100}
    model = algorithm("MlpPolicy", World(), batch_size=N_SAMPLES, seed=0, device="cpu", **options)
    model.set_logger(configure(None, []))
    return model


def moving(policy: Any) -> np.ndarray:
    """Which entries of the old version's state move, (D,), bool: not those that are the same for any parameters."""
    encoder = policy.online.features_extractor
    if not hasattr(encoder, "group"):
        return np.ones(encoder.features_dim, dtype=bool)
    params = th.randn(50, encoder.n_blocks, encoder.group.num_params)
    return (encoder.group.element(params).flatten(1).std(dim=0) > 0).numpy()


def as_new(name: str, tensor: th.Tensor, state: dict[str, th.Tensor], keep: np.ndarray) -> tuple[str, th.Tensor] | None:
    """A tensor of the old version's state dict, by the name and in the shape that it has in the new one; None: part of one."""
    if name.endswith("num_batches_tracked") or ".head.value.0." in name:
        return None
    if ".head.advantage.0." in name:
        tensor = th.cat([tensor, state[name.replace("advantage", "value")]])
        name = name.replace("advantage", "first")
    name = name.replace("advantage.2", "advantage.0").replace("value.2", "value.0")
    if name.endswith(ON_STATES):
        n_state = len(keep)
        tensor = th.cat([tensor[:, :n_state][:, th.as_tensor(keep)], tensor[:, n_state:]], dim=1)
    return name, tensor


def new_state(old: Any, keep: np.ndarray) -> dict[str, th.Tensor]:
    """The old version's parameters and statistics as the new one has them."""
    state = old.policy.state_dict()
    return dict(found for name, tensor in state.items() if (found := as_new(name, tensor, state, keep)))


def silence_constants(old: Any, keep: np.ndarray) -> None:
    """Weights of entries that never move become 0 and stay 0."""
    masks = {}
    for name, parameter in old.policy.named_parameters():
        if name.replace(".value.0.", ".first.0.").replace(".advantage.0.", ".first.0.").endswith(ON_STATES):
            mask = th.ones_like(parameter)
            mask[:, : len(keep)] = th.as_tensor(keep).to(parameter.dtype)
            parameter.data *= mask
            masks[name] = mask
            if parameter.requires_grad:
                parameter.register_hook(lambda gradient, mask=mask: gradient * mask)


def share_noise(old: Any, new: Any, control: Any, keep: np.ndarray, rng: np.random.Generator) -> Callable[[], None]:
    """The noisy layers of all take their noise from one table; what is returned draws a new table."""
    tables: dict[Any, Any] = {}

    def draw() -> None:
        for nets in zip((old.policy.online, old.policy.target), (new.policy.online, new.policy.target), strict=True):
            before, after = (net.head for net in nets)
            for layer, parts in (
                (after.first[0], (before.advantage[0], before.value[0])),
                (after.advantage[0], (before.advantage[2],)),
                (after.value[0], (before.value[2],)),
            ):
                n_out, n_in = layer.weight.shape
                noise_out, noise_in = (th.as_tensor(rng.standard_normal(n)).to(layer.weight.dtype) for n in (n_out, n_in))
                tables[layer] = noise_out, noise_in
                for part, share in zip(parts, noise_out.chunk(len(parts)), strict=True):
                    whole = noise_in
                    if len(parts) == 2:
                        whole = th.zeros(len(keep), dtype=noise_in.dtype)
                        whole[th.as_tensor(keep)] = noise_in
                    tables[part] = share, whole
        for one, other in zip(new.policy.modules(), control.policy.modules(), strict=True):
            if one in tables:
                tables[other] = tables[one]

    def forward(self: Any, inputs: th.Tensor, noisy: bool = False) -> th.Tensor:
        noise_out, noise_in = tables[self]
        weight = self.weight + self.weight_sigma * th.outer(noise_out, noise_in) if noisy else self.weight
        return th.nn.functional.linear(inputs, weight, self.bias + self.bias_sigma * noise_out if noisy else self.bias)

    type(old.policy.online.head.advantage[0]).forward = forward
    type(new.policy.online.head).forward.__globals__["draw_noise"] = lambda layers: [tables[layer] for layer in layers]
    return draw


def samples_of(depth: int, rng: np.random.Generator, dtype: th.dtype) -> SequenceReplayBufferSamples:
    """Windows as a replay buffer gives them, of random numbers, some of them cut by the end of an episode."""
    real = lambda *shape: th.as_tensor(rng.standard_normal((N_SAMPLES, *shape))).to(dtype)  # noqa: E731
    actions = th.as_tensor(rng.integers(3, size=(N_SAMPLES, depth)))
    ends = rng.integers(1, 2 * depth, size=N_SAMPLES)
    mask = th.as_tensor(np.arange(depth) < ends[:, None]).to(dtype)
    dones, discounts = (real(1) > 1).to(dtype), th.full((N_SAMPLES, 1), 0.9, dtype=dtype)
    first = real(6), actions[:, :1], real(6), dones, real(1), discounts, np.arange(N_SAMPLES), real().abs()
    return SequenceReplayBufferSamples(*first, real(depth, 6), actions, real(depth), mask)


def difference(found: dict[str, th.Tensor], expected: dict[str, th.Tensor]) -> float:
    """The largest one of a parameter or statistic, over its largest entry or 1."""
    return max(float((found[name] - e).abs().max() / e.abs().max().clamp(min=1)) for name, e in expected.items())


def compare(classes: tuple[Any, Any], group: str | None, n_updates: int, dtype: th.dtype) -> tuple[float, float]:
    """After so many updates: how far the new version is from the old one, and from the control."""
    th.set_default_dtype(dtype)
    old, new, control = (make(algorithm, group) for algorithm in (*classes, classes[1]))
    latent = type(old.policy.latent_model)
    latent.rollout_of_old = getattr(latent, "rollout_of_old", latent.rollout)
    latent.rollout = lambda self, state, one_hot, mask: self.rollout_of_old(state, one_hot, th.ones_like(mask))
    keep = moving(old.policy)
    silence_constants(old, keep)
    new.policy.load_state_dict({**new.policy.state_dict(), **new_state(old, keep)})
    control.policy.load_state_dict(new.policy.state_dict())
    for parameter in control.policy.parameters():
        parameter.data *= 1 + th.finfo(dtype).eps
    rng = np.random.default_rng(0)
    draw = share_noise(old, new, control, keep, rng)
    models = old, new, control
    for model in models:
        type(model.objective.augment)._part.__globals__["preprocess_obs"] = lambda obs, *_: obs
        model.replay_buffer.can_sample = lambda: True
        model.replay_buffer.update_priorities = lambda *_: None
    for update in range(n_updates):
        draw()
        samples = samples_of(new.depth, rng, dtype)
        for model in models:
            model.replay_buffer.sample = lambda *_, samples=samples, **__: samples
            th.manual_seed(update)
            model.train(1, N_SAMPLES)
    th.set_default_dtype(th.float32)
    found = new.policy.state_dict()
    return difference(found, new_state(old, keep)), difference(control.policy.state_dict(), found)


def main() -> None:
    """Parse the command line, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n")[0])
    parser.add_argument("--before", required=True, metavar="DIR", help="a checkout of commit d23ef57")
    parser.add_argument("--updates", type=int, default=200)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    th.set_num_threads(1)
    workload.add_before(args.before)
    print(
        f"{'agent':12}{'group':18}{'float32':>10}{'control':>10}{'float64':>10}{'control':>10}  after {args.updates} updates"
    )
    for name in ("EqRQRDQN", "EqRRainbow"):
        classes = tuple(workload.AGENTS[key][0] for key in (name + workload.BEFORE, name))
        for group in GROUPS:
            found = [
                x for dtype in (th.float32, th.float64) for x in compare((classes[0], classes[1]), group, args.updates, dtype)
            ]
            print(f"{name:12}{group or 'no group':18}" + "".join(f"{one:10.1e}" for one in found), flush=True)


if __name__ == "__main__":
    main()
