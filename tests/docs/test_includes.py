"""
Each ``literalinclude`` of the pages shows the code that the text before it describes.

The code is read with Sphinx's reader. For each include, ``PROMISES`` has the phrases that the code must contain and the names
that the text before it must mention.
"""

import ast
import pathlib
import re
from types import SimpleNamespace
from typing import NamedTuple

import pytest
from sphinx.directives.code import LiteralIncludeReader

ROOT = pathlib.Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(page for page in DOCS.rglob("*.md") if "_build" not in page.parts)
LEGAL_OPTIONS = {"pyobject", "start-at", "end-before", "dedent"}  # line numbers go stale

INCLUDE = re.compile(r"^```\{literalinclude\} (\S+)\n(.*?)^```$", re.M | re.S)


class Include(NamedTuple):
    """A ``literalinclude`` of a page."""

    target: str  # its key in PROMISES: the file within the repository, and the object or the first line
    lead: str  # the text since the previous heading or block
    code: str


class Promise(NamedTuple):
    """What an include and the text before it must contain."""

    code: tuple[str, ...]  # phrases of the code; no other include of the page contains all of them
    text: tuple[str, ...]  # phrases of the text before it


# page -> include -> promise, in the order of the page
PROMISES: dict[str, dict[str, Promise]] = {
    "configurations.md": {
        "sb3_eqr/common/checks/arguments.py, ALGORITHM: dict": Promise(
            code=('"max_grad_norm": number(0, above=True) | NONE', '"seed": integer(0, 2**32 - 1) | NONE'),
            text=("`ALGORITHM`", "`WEIGHT`", "`SHARE`", "`FLAG`"),
        ),
        "sb3_eqr/common/checks/arguments.py, POLICY: dict": Promise(
            code=('"projection": one_of(["head", "own", "none"])', '"n_quantiles": integer(1)'), text=("`POLICY`",)
        ),
    },
    "gradients.md": {
        "sb3_eqr/common/networks/layers.py, Centering.update": Promise(
            code=("(1 - self.BY_CHANCE * self.batch_error / distance)", "self.running_mean.lerp_("),
            text=("`Centering.update`", "1 − 3 e / d"),
        ),
    },
    "losses.md": {
        "sb3_eqr/common/objective.py, Objective.__call__": Promise(
            code=(
                "self.policy.online.features_extractor(observations)",
                "loss = (samples.weights * sum(",
                ").mean()",
                "return LossTerms(",
            ),
            text=("`Objective.__call__`", "`reward_coef`", "`aet_coef`", "`symmetry_coef`", "`td_coef`", "$w_i$"),
        ),
        "sb3_eqr/common/latent/gradients.py, _Branch.backward": Promise(
            code=("th.mm(both, both.mT, out=ctx.gram)", "ctx.share * ", "th.addcmul(of_td, of_auxiliary, scale)"),
            text=("`branch`", "`aux_gradient_share=1.0`", "`train/td_state_gradient`"),
        ),
        "sb3_eqr/common/latent/rollout.py, _Rollout.forward": Promise(
            code=("th.addmm(offset, states[-1], transposed)", "group.act_vjp(params.view(", "th.stack(states[1:], dim=1)"),
            text=(
                "`rollout` in `sb3_eqr/common/latent/rollout.py`",
                r"= \kappa_\phi(\hat x_{m-1}, a_{t+m-1}) \cdot \hat x_{m-1}",
            ),
        ),
        "sb3_eqr/common/losses.py, _NormalizedDistance.forward": Promise(
            code=("difference = directions[0] - directions[1]", "difference.square().sum(dim=-1)"),
            text=("`normalized_distance`", r"\rVert_2^2 = 2 - 2 \cos(y, \bar y)"),
        ),
        "sb3_eqr/common/latent/latent_model.py, if project is not None and": Promise(
            code=("target_project(target_rollout.flatten(", "AET_LOSSES[self.aet_loss](projected, target_projected, mask)"),
            text=("`LatentModel.forward`", "`AET_LOSSES`", r"L_{\mathrm{AET}}"),
        ),
        "sb3_eqr/common/networks/layers.py, DistributionalHead.project": Promise(
            code=("def project(self", "return self.first(features)"),
            text=("`DistributionalHead.project`", "first layer of the Q head"),
        ),
        "sb3_eqr/common/losses.py, contrastive_loss": Promise(
            code=("cosines / TEMPERATURE", "F.cross_entropy(logits"),
            text=("`contrastive_loss`", '`policy_kwargs=dict(aet_loss="contrastive")`', r"\sum_{j=1}^{B} \exp"),
        ),
        "sb3_eqr/common/latent/latent_model.py, GroupLatentModel.symmetry_loss": Promise(
            code=("self.group.compose(self.blocks(partner), self.group.inverse(", "self.action_symmetry(", "th.no_grad()"),
            text=("`GroupLatentModel.symmetry_loss`", "`symmetry_coef`", r"\tau_g = \bar x^{(j)}_0 \, x_0^{-1}"),
        ),
        "sb3_eqr/common/losses.py, reward_mse": Promise(
            code=("F.mse_loss(prediction.squeeze(-1), reward",),
            text=("`reward_mse`", r"\left(r_\psi(\hat x_m) - r_{t+m}\right)^2"),
        ),
        "sb3_eqr/common/losses.py, reward_cross_entropy": Promise(
            code=("reward.sign().long() + 1", "F.cross_entropy("),
            text=("`reward_cross_entropy`", '`policy_kwargs=dict(reward_loss="categorical")`'),
        ),
        "sb3_eqr/common/objective.py, Objective._td_terms": Promise(
            code=(
                "values[n_samples:] if self.double_q else target.expectation(next_outputs)",
                "of_actions(next_outputs, next_values.argmax(dim=1",
                "online.td_loss(current, next_best, samples.rewards, discounts)",
            ),
            text=("`Objective._td_terms`", "`double_q`", "`td_loss`"),
        ),
        "sb3_eqr/eqr_qrdqn/policies.py, EqRQuantileNetwork.td_loss": Promise(
            code=("quantile_huber_loss(current, rewards + discounts * next_outputs)", "return loss, loss.detach()"),
            text=("`EqRQuantileNetwork.td_loss`", "The priority of a sample is its loss", "`next_outputs`"),
        ),
        "sb3_eqr/common/losses.py, quantile_huber_loss": Promise(
            code=("th.where(wanted < predicted, 1 - midpoints, midpoints)", 'reduction="none")).sum(dim=1).mean(dim=1)'),
            text=("`quantile_huber_loss`", r"\mathcal{H}(y_j - \theta_i)"),
        ),
        "sb3_eqr/eqr_rainbow/policies.py, EqRCategoricalNetwork.td_loss": Promise(
            code=("values = th.addcmul(rewards, discounts, self.support)", "return categorical_loss(current, target)"),
            text=("`EqRCategoricalNetwork.td_loss`", "`v_min`", "`v_max`"),
        ),
        "sb3_eqr/common/losses.py, categorical_projection": Promise(
            code=(".clamp(0, n_atoms - 1)", "shares.mul_(probabilities[:, :, None]).sum(dim=1)"),
            text=("`categorical_projection`", r"\Delta z = (v_{\max} - v_{\min}) / (N - 1)"),
        ),
        "sb3_eqr/common/losses.py, categorical_loss": Promise(
            code=('F.cross_entropy(logits, target, reduction="none")', "th.xlogy(target, target)"),
            text=("`categorical_loss`", "cross-entropy", "KL divergence"),
        ),
        "sb3_eqr/common/eqr_algorithm.py, EqRAlgorithm.train": Promise(
            code=(
                "buffer.sample(batch_size",
                "assign_gradients(terms.loss, self._trained)",
                "clip_grad_norm(self._trained, self.max_grad_norm)",
                "optimizer.step()",
                "policy.update_target(self.tau)",
                "buffer.update_priorities(samples.indices, terms.priorities)",
            ),
            text=("`EqRAlgorithm.train`", "Algorithm 1", "`gradient_steps`"),
        ),
    },
}


def name_of(page):
    return str(page.relative_to(DOCS))


def includes_of(text, page):
    """
    :param text: content of the page
    :param page: path of the page, to resolve relative paths
    :raises ValueError: if Sphinx does not find the object or the line in the file
    """
    found = []
    for match in INCLUDE.finditer(text):
        options = dict(re.findall(r"^:([\w-]+): *(.*)$", match[2], re.M))
        assert options.keys() <= LEGAL_OPTIONS, options
        if "dedent" in options:
            options["dedent"] = int(options["dedent"])
        path = (page.parent / match[1]).resolve()
        code, _ = LiteralIncludeReader(str(path), options, SimpleNamespace(source_encoding="utf-8")).read()
        assert len(ast.parse(code).body) == 1, f"{match[0]} must include exactly one complete function or statement"
        what = options.get("pyobject") or options.get("start-at", "")
        lead = re.split(r"^(?:#+ .*|```)$", text[: match.start()], flags=re.M)[-1]
        found.append(Include(f"{path.relative_to(ROOT)}, {what}", lead, code))
    return found


def check(text, page, promises):
    """Fail unless the page has exactly the includes of the table, and they keep its promises."""
    includes = includes_of(text, page)
    assert [include.target for include in includes] == list(promises)
    assert text.count("{literalinclude}") == len(includes)  # none is missed by the pattern
    for include in includes:
        promise = promises[include.target]
        for phrase in promise.code:
            assert phrase in include.code, f"{include.target} does not show {phrase!r}"
        lead = " ".join(include.lead.split())
        for phrase in promise.text:
            assert phrase in lead, f"the text before {include.target} does not mention {phrase!r}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_includes_show_what_the_text_describes(page):
    check(page.read_text(encoding="utf-8"), page, PROMISES.get(name_of(page), {}))


def test_each_promise_matches_one_include_only():
    """Otherwise an include could show a different function unnoticed."""
    for name, promises in PROMISES.items():
        page = DOCS / name
        code_of = {include.target: include.code for include in includes_of(page.read_text(encoding="utf-8"), page)}
        for target, promise in promises.items():
            assert [other for other, code in code_of.items() if all(phrase in code for phrase in promise.code)] == [target]


TAMPERED = {  # error in a page -> the replacement that makes it, what it raises
    "another function": ("pyobject: reward_mse", "pyobject: normalized_distance", AssertionError),
    "a function that is gone": ("pyobject: _Rollout.forward", "pyobject: LatentModel.unroll", ValueError),
    "a line that is gone": ("start-at: if project is not None and", "start-at: if project is not nothing:", ValueError),
    "more than one statement": ("end-before: if target is not None:", "end-before: return LatentLosses", AssertionError),
    "half a statement": ("end-before: if target is not None:", "end-before: target_projected =", SyntaxError),
    "line numbers": (":pyobject: reward_mse", ":lines: 3-9", AssertionError),
    "a file that is gone": ("../sb3_eqr/common/objective.py", "../sb3_eqr/objective.py", OSError),
    "an include without a promise": ("## Reward", "```{literalinclude} ../sb3_eqr/cli.py\n```\n\n## Reward", AssertionError),
    "text about something else": ("by `reward_mse`", "by another loss", AssertionError),
}


@pytest.mark.parametrize("old, new, error", TAMPERED.values(), ids=TAMPERED)
def test_errors_in_pages_are_found(old, new, error):
    page = DOCS / "losses.md"
    text = page.read_text(encoding="utf-8")
    assert old in text
    with pytest.raises(error):
        check(text.replace(old, new, 1), page, PROMISES["losses.md"])
