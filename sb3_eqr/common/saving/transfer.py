"""Transfer of representations: tasks that differ only in rewards share the symmetries of their transitions (paper, §4)."""

import io
import re
from typing import Any

import torch as th
from stable_baselines3.common.save_util import load_from_zip_file
from torch import nn

from sb3_eqr.common.checks.validation import check_same_parameters
from sb3_eqr.common.policies import EqRPolicy
from sb3_eqr.common.saving.models import FileOrPath, data_of, read_model

ENCODER = "features_extractor"
LATENT_PARTS = ("embedding", "transition", "action_symmetry", "symmetry_projection")  # κ, ρ and b; r_ψ belongs to the task


def load_representation(policy: EqRPolicy, path: FileOrPath) -> None:
    """
    Load encoder, κ, ρ and b of a saved agent into a policy and its target copy. On any mismatch, nothing is changed.

    :param policy: policy of either agent
    :param path: file of either agent
    :raises ValueError: if the file is not an EqR agent, or its group, trunk, number of actions or order of keys differs
    """
    content = read_model(path)
    found = _saved_parts(content, path, policy.device)
    described = {name: policy.description[name] for name in ("group", "observation keys")}
    check_same_parameters(described, data_of(content).get("policy_description", {}))
    modules = representation(policy)
    for name, module in modules.items():
        expected = {key: f"of shape {tuple(value.shape)}" for key, value in module.state_dict().items()}
        given = {key: f"of shape {tuple(value.shape)}" for key, value in found[name].items()}
        for key in sorted(expected.keys() | given.keys()):
            if expected.get(key) != given.get(key):
                raise ValueError(
                    f"load_representation: {name}.{key} must be the same in both agents, got {expected.get(key, 'missing')} "
                    f"here and {given.get(key, 'missing')} in the file. Build this agent with the policy_kwargs of the saved "
                    "agent (head_input, group, n_blocks, parameterization, whiten, layer_norm, center, trunk, transition, "
                    "latent_hidden_dim, latent_norm, state_dependent_actions), for the same observations and actions."
                )
    for name, module in modules.items():
        module.load_state_dict(found[name])
        for parameter in module.parameters():
            policy.optimizer.state.pop(parameter, None)
    for copy in (policy.target_copy, policy.latent_target_copy):
        copy.update(1.0)


def representation(policy: EqRPolicy) -> dict[str, nn.Module]:
    """The encoder and the components of the latent model that do not depend on rewards, by name."""
    parts = {name: getattr(policy.latent_model, name, None) for name in LATENT_PARTS}  # SPR's transition has no ρ
    return {ENCODER: policy.online.features_extractor} | {name: part for name, part in parts.items() if part is not None}


def _saved_parts(content: bytes, path: Any, device: th.device) -> dict[str, dict[str, th.Tensor]]:
    """The parameters of each component of the representation in a file."""
    _, saved, _ = load_from_zip_file(io.BytesIO(content), load_data=False, device=device)  # type: ignore[arg-type]
    parameters: Any = (saved or {}).get("policy", {})
    if not any(name.startswith("latent_model.") for name in parameters):
        raise ValueError(f"load_representation: {path} must be a file of EqRQRDQN or EqRRainbow, got another one.")
    found: dict[str, dict[str, th.Tensor]] = {name: {} for name in (ENCODER, *LATENT_PARTS)}
    for name, value in parameters.items():
        match = re.fullmatch(rf"(?:(?!\w+_target\.)\w+\.{ENCODER}|latent_model\.(\w+))\.(.+)", name)
        if match and (match[1] or ENCODER) in found:
            found[match[1] or ENCODER][match[2]] = value
    return found
