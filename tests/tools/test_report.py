"""From result.json files to the numbers, sentences and files of a report."""

import base64
import json
import re

import numpy as np
import pandas as pd
import pytest
from rliable import library, metrics
from scipy.stats import t

from sb3_eqr.benchmark import figures
from sb3_eqr.benchmark import report as report_module
from sb3_eqr.benchmark.analysis import analyse, conclusion, difference_in_words
from sb3_eqr.benchmark.comparison import compare
from sb3_eqr.benchmark.figures import all_figures, normalized_curves
from sb3_eqr.benchmark.packed import pack
from sb3_eqr.benchmark.reference import SHOWN, published_means
from sb3_eqr.benchmark.report import write_report
from sb3_eqr.benchmark.scores import load_scores
from sb3_eqr.benchmark.suites import make_suite, write_suite
from sb3_eqr.benchmark.tables import difference_table, make_table, number, to_html, to_markdown
from sb3_eqr.plot_style import looks

PONG, BOXING, KRULL = [-20.7, 14.6], [0.1, 12.1], [1598.0, 2665.5]  # Table 2: random, human
ENTRY = {
    "games": ["Pong", "Boxing", "Krull"],
    "env_id": "{game}NoFrameskip-v4",
    "steps": 100_000,
    "preprocessing": {"frame_stack": 4},
    "evaluation": {"episodes": 2, "n_envs": 2, "epsilon": 0.001, "max_steps": 27_000, "curve": {"points": 2, "episodes": 2}},
    "normalisation": "human",
}


def a_suite(**changes):
    return make_suite("small", "test", {**ENTRY, **changes})


def normalised(unit="human-normalised score", **scores):
    given = {"Pong": PONG, "Boxing": BOXING, "Krull": KRULL} | scores
    return a_suite(normalisation={"unit": unit, "source": "EqR paper, Table 2", "scores": given})


SUITE = a_suite()
FULL, BASE = "eqr_rainbow:se2+aet+r", "eqr_rainbow:se2+aet"
SCORES = {  # agent -> game -> final score of each seed; the mean of two episodes
    "dqn": {"Pong": [-20.7, -18.7, -19.7], "Boxing": [0.1, 2.1, 1.1], "Krull": [1598.0, 1798.0, 1998.0]},
    BASE: {"Pong": [-10.0, -12.0, -14.0], "Boxing": [10.0, 12.0, 14.0], "Krull": [3000.0, 3200.0, 2800.0]},
    FULL: {"Pong": [-9.0, -11.0, -13.0], "Boxing": [9.0, 12.0, 15.0], "Krull": [3100.0, 3300.0, 2700.0]},
}


def a_result(agent, game, seed, score, suite):
    losses = [{"step": step, "td_loss": 1.0, "aet_loss": 0.5, "symmetry_loss": 0.25} for step in (4_000, 8_000)]
    protocol = suite.protocol(game)
    steps = protocol["steps"]
    return {
        "agent": agent,
        "game": game,
        "seed": seed,
        "suite": suite.name,
        "protocol": protocol,
        "entry": {"algo": agent, "file": "a", "name": "atari", "hyperparameters": {"batch_size": 32}},
        "versions": {"torch": "2.9"},
        "machine": {"device": "cpu", "threads": 1, "platform": "Linux"},
        "command": f"sb3-eqr benchmark run small --agents {agent}",
        "started": "2026-11-21T15:00:00+00:00",
        "wall_clock_s": 1_800.0,
        "steps_per_second": 55.5,
        "attempts": 1,
        "resumed_at": [],
        "evaluations": [
            {"step": steps // 2, "kind": "curve", "scores": [score / 2, score / 2], "lengths": [7, 7]},
            {"step": steps, "kind": "curve", "scores": [999.0], "lengths": [7]},  # the final evaluation is used instead
            {"step": steps, "kind": "final", "scores": [score - 1, score + 1], "lengths": [8, 8]},
        ],
        "training": {"step": [10], "score": [3.0], "length": [10]},
        "losses": losses if agent.startswith("eqr") else [],
    }


def a_benchmark(folder, scores=SCORES, suite=SUITE, change=lambda result: None):
    """:param change: changes the result of a run; if it returns False, the run is not finished"""
    folder.mkdir(parents=True)
    write_suite(suite, folder / "suite.yml")
    for agent, games in scores.items():
        for game, values in games.items():
            for seed, value in enumerate(values):
                path = folder / "runs" / agent / game / str(seed) / "result.json"
                result = a_result(agent, game, seed, value, suite)
                if change(result) is not False:
                    path.parent.mkdir(parents=True)
                    path.write_text(json.dumps(result))
    return folder


def matrix(agent, scores=SCORES):
    """(runs, games), human-normalised, computed without the package."""
    bounds = {"Pong": PONG, "Boxing": BOXING, "Krull": KRULL}
    rows = [[(v - bounds[g][0]) / (bounds[g][1] - bounds[g][0]) for v in values] for g, values in scores[agent].items()]
    return np.array(rows).T


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Every agent, game and seed. The figures, which take most of the time, are in :func:`drawn`."""
    folder = tmp_path_factory.mktemp("report")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_module, "all_figures", lambda analysis: [])
        return write_report([a_benchmark(folder / "runs")], {}, False, folder / "report", reps=50)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Every figure, for two agents, one game and two seeds, without the constrained layout, which takes half the time."""
    folder = tmp_path_factory.mktemp("drawn")
    scores = {agent: {"Pong": SCORES[agent]["Pong"][:2]} for agent in (BASE, FULL)}

    def to_png(shown):
        shown.figure.set_layout_engine("none")
        return figures.to_png(shown)

    benchmark = a_benchmark(folder / "runs", scores, a_suite(games=["Pong"]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "DPI", 40)
        patch.setattr(report_module, "to_png", to_png)
        return write_report([benchmark], {}, False, folder / "report", reps=10)


@pytest.fixture
def report_of(tmp_path, monkeypatch):
    """Writes the report of one benchmark, without figures, and returns its page."""
    monkeypatch.setattr(report_module, "all_figures", lambda analysis: [])

    def write(*results, force=False, reps=5, references=(), **changes):
        folder = a_benchmark(tmp_path / "a", *results, **changes)
        return write_report([folder], dict(references), force, tmp_path / "report", reps=reps)

    return write


def text_of(page):
    return re.sub(r"\s+", " ", page.read_text(encoding="utf-8"))


def test_the_numbers_match_rliable(report):
    """aggregates.csv equals the results of rliable on scores normalised in this file."""
    found = pd.read_csv(report.with_name("aggregates.csv"), keep_default_na=False, na_values=[""])
    for agent in SCORES:
        rows = found[found["agent"] == agent].set_index("metric")
        for name in ("IQM", "median", "mean", "optimality gap"):
            function = getattr(metrics, f"aggregate_{name.lower().replace(' ', '_')}")
            assert rows.at[name, "value"] == pytest.approx(function(matrix(agent)))
        np.random.seed(0)
        ordered = matrix(agent)[:, [1, 2, 0]]  # the bootstrap samples the games in alphabetical order
        _, ends = library.get_interval_estimates({"": ordered}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=50)
        assert rows.loc["IQM", ["low", "high"]].tolist() == pytest.approx(ends[""][:, 0].tolist())
        assert rows.at["superhuman games", "value"] == (matrix(agent).mean(axis=0) > 1).sum()
        assert (rows["runs"] == 3).all() and (rows["games"] == 3).all() and (rows["from"] == "runs").all()


def test_published_methods_are_means_over_the_games_present(report):
    found = pd.read_csv(report.with_name("aggregates.csv")).query("agent == 'EqR, R + GET (paper)'").set_index("metric")
    values = [(-6.1 + 20.7) / 35.3, (39.2 - 0.1) / 12.0, (5467.7 - 1598) / 1067.5]  # Table 2
    assert found.at["mean", "value"] == pytest.approx(np.mean(values))
    assert found.at["median", "value"] == pytest.approx(sorted(values)[1])
    assert found.at["superhuman games", "value"] == 2 and (found["from"] == "game means only").all()
    assert found[["low", "high"]].isna().all(axis=None)
    page = text_of(report)
    assert "† EqR, R + GET (paper): 100K steps, game means only (10 runs), no interval. EqR paper (ICML 2022), T" in page
    assert "† SPR: 100K steps, game means only (100 runs), no interval." in page and "CURL" not in page


def test_the_table_of_games(report):
    page = text_of(report)
    assert "<td>Boxing</td>" in page
    assert "<td>3,033<br><small>± 306</small></td>" in page  # Krull: 3100, 3300, 2700; sd with n - 1
    for cell in ("3,000<br><small>± 200", "−11.0<br><small>± 2.0", "−12.0<br><small>± 2.0"):
        assert f"<td>{cell}</small></td>" in page
    lines = [re.sub(" +", " ", line) for line in report.with_name("table.md").read_text().splitlines()]
    rows = {line[2:].partition(" |")[0]: line for line in reversed(lines)}  # without the second table, of differences
    assert rows["Krull"].startswith("| Krull | 1,598 | 2,666 | 1,798 ± 200 | 3,000 ± 200 | 3,033 ± 306 |")
    assert "| 12.0 ± 2.0 | 12.0 ± 3.0 |" in rows["Boxing"]
    assert rows["minutes per run"].startswith("| minutes per run | | | 30.0 | 30.0 | 30.0 | – |")


def test_the_best_agent_is_bold_if_the_runs_distinguish_it(report_of):
    """Four runs with means 10 and 20 and a spread of 1; if the means differ by less than the spread, nothing is bold."""
    apart, alike = [9.0, 10.0, 11.0, 10.0], [9.1, 10.1, 11.1, 10.1]
    scores = {"dqn": {"Pong": apart, "Boxing": apart}, FULL: {"Pong": [2 * score for score in apart], "Boxing": alike}}
    page = report_of(scores, force=True, reps=100)
    assert re.findall("<b>(.*?)</b>", page.read_text()) == ["20.0", "1.000"]
    assert "**20.0** ± 1.6" in page.with_name("table.md").read_text()
    assert f"{FULL} is better than dqn: its IQM is" in text_of(page).partition("Scores</h2>")[0]


def test_a_report_has_its_figures_and_its_page_is_self_contained(drawn):
    figures = {f"{name}.png" for name in ("profiles", "aggregates", "sample_efficiency", "learning_curves")}
    assert {path.name for path in drawn.parent.iterdir()} == figures | {"report.html", "table.md", "aggregates.csv"}
    page = drawn.read_text(encoding="utf-8")
    assert page.startswith("<!DOCTYPE html>") and page.endswith("</html>\n")
    assert not re.search(r"<script|<link|@import|url\(|https?:", page)
    assert all(target.startswith(("data:image/png;base64,", "#")) for target in re.findall(r'(?:src|href)="(.{22})', page))
    for path in drawn.parent.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG") and path.read_bytes().endswith(b"IEND\xaeB`\x82")
        assert base64.b64encode(path.read_bytes()).decode() in page
    assert set(re.findall(r'href="#(\w+)"', page)) | {"conclusion"} == set(re.findall(r'id="(\w+)"', page))


def test_the_page_has_the_commands_that_made_it(report):
    page = text_of(report)
    assert page.count("sb3-eqr benchmark run small --agents dqn") == 1
    assert "Linux" in page and "55.5" in page and "<td>30.0</td>" in page and "batch_size" in page
    assert "0.058 with 1 seed, 0.026 with 5 seeds, 0.018 with 10 seeds" in page


def test_differences_in_words(tmp_path):
    analysis = analyse(compare([a_benchmark(tmp_path / "a")], {}, False), reps=50)
    rows = analysis.differences.to_dict("records")
    pairs = {(row["agent"], row["baseline"]) for row in rows}
    assert analysis.comparison.agents[0] == "dqn" and pairs >= {(BASE, "dqn"), (FULL, "dqn")} and len(pairs) == 3
    words = [difference_in_words(row, analysis.comparison) for row in rows]
    far = metrics.aggregate_iqm(matrix(BASE)) - metrics.aggregate_iqm(matrix("dqn"))
    assert words[0].startswith(f"{BASE} is better than dqn: its IQM is {far:.2f} higher; 3 runs on 3 games can detect ")
    near = metrics.aggregate_iqm(matrix(BASE)) - metrics.aggregate_iqm(matrix(FULL))
    way = f"{abs(near):.2f} {'lower' if near > 0 else 'higher'}"
    assert "cannot be distinguished with these runs: the IQM of the first is" in words[-1]
    assert f"{way}, and 3 runs on 3 games can only detect differences above " in words[-1]
    assert conclusion(analysis) == [
        "No agent is the best: the one with the highest IQM is not distinguished from all others.",
        *words,
        "Four times as many seeds would detect differences half as large.",
    ]


def test_a_different_protocol_raises_or_is_marked(tmp_path, report_of):
    def change(result):
        if result["agent"] == BASE:
            result["protocol"]["steps"] = 50_000

    text = f"got {BASE}: steps is 50000, not 100000 (Pong, Boxing, Krull). Select agents with --agents, or pass --force"
    with pytest.raises(ValueError, match=re.escape(text)):
        report_of(change=change)
    assert not (tmp_path / "report").exists()
    page = write_report([tmp_path / "a"], {}, True, tmp_path / "report", reps=5)
    text = text_of(page)
    assert f"‡ {BASE} was run under another protocol: steps is 50000, not 100000" in text
    assert text.count(f">{BASE} ‡</t") >= 3 and f"{FULL} ‡" not in text  # games, runs, settings
    assert "se2+aet ‡ |" in page.with_name("table.md").read_text()
    rows = pd.read_csv(page.with_name("aggregates.csv")).dropna(subset="protocol_differs")
    assert set(rows["agent"]) == {BASE} and rows["protocol_differs"].str.startswith("steps is 50000").all()


def test_an_agent_without_a_finished_run_is_named(tmp_path, report_of):
    scores = {agent: {"Pong": SCORES[agent]["Pong"]} for agent in (BASE, FULL)}
    folder = a_benchmark(tmp_path / "b", scores, a_suite(games=["Pong"]))
    plan = a_result("sac", "Pong", 4, 0, SUITE)
    (folder / "runs/sac/Pong/4").mkdir(parents=True)
    (folder / "runs/sac/Pong/4/run.json").write_text(json.dumps(plan))
    page = write_report([folder], {}, False, tmp_path / "report", reps=5)
    assert "Left out, because they have not finished: sac, Pong, seed 4." in text_of(page)
    page = write_report([folder], {}, False, tmp_path / "report", agents=[BASE, FULL], reps=5)
    assert "have not finished" not in text_of(page)


def test_missing_runs_are_omitted_and_reported(tmp_path, report_of):
    def change(result):
        run = (result["agent"], result["game"], result["seed"])
        return run[:2] != ("dqn", "Krull") and run != (FULL, "Pong", 1)

    with pytest.raises(ValueError, match=r"got some missing. No finished run of any agent: Hero. dqn has no finished run"):
        report_of(suite=a_suite(games=[*SUITE.games, "Hero"]), change=change)
    page = write_report([tmp_path / "a"], {}, True, tmp_path / "report", reps=5)
    text = text_of(page)
    assert "No finished run of any agent: Hero." in text and "dqn has no finished run on Krull." in text
    assert "Only the 2 of 4 games that every agent has are compared: Pong, Boxing." in text
    assert f"{FULL} lacks seeds on some games: Pong lacks 1. Only seeds that it has on every game are compared: 0, 2." in text
    rows = pd.read_csv(page.with_name("aggregates.csv")).set_index(["agent", "metric"])
    kept = matrix(FULL)[[0, 2], :2]
    assert rows.at[(FULL, "mean"), "value"] == pytest.approx(kept.mean()) and rows.at[(FULL, "mean"), "runs"] == 2
    assert rows.at[("dqn", "mean"), "value"] == pytest.approx(matrix("dqn")[:, :2].mean())


def test_nothing_to_compare(tmp_path):
    apart = {"dqn": {"Pong": [1.0]}, "qrdqn": {"Krull": [1.0]}}
    with pytest.raises(ValueError, match=r"got none: dqn has Pong; qrdqn has Krull. Select agents with --agents"):
        compare([a_benchmark(tmp_path / "a", apart)], {}, False)

    def change(result):
        return (result["game"] == "Pong") == (result["seed"] == 0)

    with pytest.raises(ValueError, match="dqn must have a seed finished on every game, got none: Pong: 0; Boxing: 1, 2"):
        compare([a_benchmark(tmp_path / "b", {"dqn": SCORES["dqn"]}, change=change)], {}, False)
    with pytest.raises(ValueError, match=r"c must contain finished runs, got none. Run sb3-eqr benchmark run, again if"):
        compare([a_benchmark(tmp_path / "c", {})], {}, False)
    with pytest.raises(ValueError, match=r"nowhere must be a folder of sb3-eqr benchmark run, got no folder. Run"):
        compare([tmp_path / "nowhere"], {}, False)
    with pytest.raises(ValueError, match="folders must be at least one benchmark folder, got none"):
        compare([], {}, False)


def test_games_without_bounds_and_runs_in_two_folders(tmp_path):
    with pytest.raises(ValueError, match=r"Boxng has no bounds for normalisation .* Pong, Boxing, Krull\. Correct the name"):
        compare([a_benchmark(tmp_path / "a", {"dqn": {"Pong": [1.0]}}, change=lambda r: r.update(game="Boxng"))], {}, False)

    one = {"dqn": {"Pong": [1.0]}}
    folders = [a_benchmark(tmp_path / "b", one), a_benchmark(tmp_path / "c", one)]
    with pytest.raises(ValueError, match=r"dqn, Pong, seed 0 must be in one folder, got it in .*b and .*c"):
        compare(folders, {}, False)
    other = normalised(Pong=[0.0, 1.0])
    later = a_benchmark(tmp_path / "d", {"qrdqn": {"Pong": [1.0]}}, suite=other)
    with pytest.raises(ValueError, match=r"The bounds of Pong must be the same in all folders, got 0.0 and 1"):
        compare([folders[0], later], {}, False)


def test_selecting_agents_and_baseline(tmp_path):
    folder = a_benchmark(tmp_path / "a")
    assert compare([folder], {}, False, baseline=FULL).agents == [FULL, "dqn", BASE]
    assert compare([folder], {}, False, [BASE], FULL).agents == [FULL, BASE]
    with pytest.raises(ValueError, match=r"--agents: 'ppo' has no finished run.* Choose from dqn, eqr_rainbow:se2"):
        compare([folder], {}, False, ["ppo"])
    with pytest.raises(ValueError, match=r"--baseline must be one of dqn, eqr.*, got 'ppo'"):
        compare([folder], {}, False, baseline="ppo")


def test_published_scores_are_only_shown_with_runs_of_the_same_steps(report_of):
    text = text_of(report_of(change=lambda result: result["protocol"].update(steps=10_000)))
    assert "Published scores are omitted, because they are for 100,000 steps" in text
    assert "†" not in text and "superhuman games" in text


def of_another_batch_size(result):
    if (result["agent"], result["seed"]) == (BASE, 2):
        result["entry"]["hyperparameters"]["batch_size"] = 64


def of_other_defaults(result):
    if result["agent"] == BASE and result["seed"] != 1:  # seed 1 is of a version that did not record them
        result["defaults"] = {"gamma": 0.99, "policy_kwargs": {"noisy": result["seed"] == 2}}


def that_start_late(result):
    result["entry"]["hyperparameters"]["learning_starts"] = 100_000 if result["agent"] == "dqn" else 99_999


def with_long_rollouts(result):
    if result["agent"] == "dqn":
        result["entry"] |= {"algo": "ppo", "hyperparameters": {"n_envs": 16}}
        result["defaults"] = {"n_steps": 8_192}


UNTRAINED = "dqn makes no update on Pong ({} of 100,000 steps): it stays untrained."


@pytest.mark.parametrize(
    "runs, note",
    [
        (of_another_batch_size, f"{BASE}: its runs differ in batch_size."),
        (of_other_defaults, f"{BASE}: its runs differ in policy_kwargs.noisy."),
        (that_start_late, UNTRAINED.format("learning_starts 100,000")),
        (with_long_rollouts, UNTRAINED.format("a rollout has 131,072")),
    ],
)
def test_agents_with_different_runs_and_untrained_ones_are_reported(tmp_path, runs, note):
    scores = {agent: {"Pong": SCORES[agent]["Pong"]} for agent in ("dqn", BASE)}
    assert compare([a_benchmark(tmp_path / "a", scores, a_suite(games=["Pong"]), runs)], {}, False).notes == [note]


def test_equal_scores_are_not_bold(report_of):
    text = text_of(report_of({"dqn": {"Pong": [1.0, 2.0]}, "qrdqn": {"Pong": [2.0, 1.0]}}, force=True))
    assert "<b>" not in text and "qrdqn and dqn have the same IQM." in text


def test_two_folders_make_one_benchmark_in_which_each_run_is_once(tmp_path):
    """Runs that are left out may be in both."""
    folders = [a_benchmark(tmp_path / name, {key: SCORES[key] for key in ("dqn", name)}) for name in (FULL, BASE)]
    found = compare(folders, {}, False, [BASE, FULL])
    assert sorted(found.agents) == [BASE, FULL] and found.games == SUITE.games and found.notes == []
    with pytest.raises(ValueError, match="must be in one folder"):
        compare(folders, {}, False)


def test_one_agent_one_game_one_seed(tmp_path, report_of):
    page = report_of({FULL: {"Pong": [0.0]}}, force=True)
    text = text_of(page)
    assert f"{FULL} has a single run per game: no intervals" in text and "Conclusion" not in text
    rows = pd.read_csv(page.with_name("aggregates.csv")).query(f"agent == '{FULL}'").set_index("metric")
    assert rows.at["IQM", "value"] == pytest.approx(20.7 / 35.3) and rows[["low", "high"]].isna().all(axis=None)
    assert "<b>" not in text
    found = all_figures(analyse(compare([tmp_path / "a"], {}, True), 5))
    assert [p.name for p in found] == ["profiles", "aggregates", "sample_efficiency", "learning_curves"]
    assert "95%" not in "".join(p.caption for p in found)
    assert found[-1].caption.endswith("A single run each.")


def test_an_agent_without_a_curve_changes_no_other_line(tmp_path):
    folder = a_benchmark(tmp_path / "a", {FULL: {"Pong": [1.0], "Boxing": [1.0]}, BASE: {"Pong": [2.0], "Boxing": [2.0]}})
    found = compare([folder], {}, True)
    for run in found.results:
        if (run["agent"], run["game"]) == (BASE, "Pong"):
            run["evaluations"] = run["evaluations"][-1:]
    axes = {ax.get_title(): ax for ax in all_figures(analyse(found, 5))[-1].figure.axes}
    pong, boxing = axes["Pong"], axes["Boxing"]
    (alone,), (first, second) = ([line.get_linestyle() for line in ax.get_lines()] for ax in (pong, boxing))
    assert alone in (first, second) and first != second
    assert alone == {line.get_color(): line.get_linestyle() for line in boxing.get_lines()}[pong.get_lines()[0].get_color()]


def test_other_units_have_no_published_scores(report_of):
    text = text_of(report_of(suite=normalised("random play 0, solved 1")))
    assert "games above 1" in text and "superhuman" not in text and "SPR" not in text and "†" not in text


def test_a_reference_with_runs_has_intervals(tmp_path, report_of):
    file = tmp_path / "theirs.json"
    theirs = {"pong": [0.0, 1.0, 0.5], "BOXING": [5.0, 6.0, 5.5], "kr_ull": [2000, 2100, 2050], "Hero": [1.0] * 3}
    file.write_text(json.dumps(theirs))
    page = report_of(references={"THEIRS": file}, reps=20)
    rows = pd.read_csv(page.with_name("aggregates.csv")).query("agent == 'THEIRS'").set_index("metric")
    scores = matrix("T", {"T": dict(zip(("Pong", "Boxing", "Krull"), theirs.values(), strict=False))})
    assert rows.at["IQM", "value"] == pytest.approx(metrics.aggregate_iqm(scores)) and rows.at["IQM", "runs"] == 3
    assert rows.at["IQM", "low"] < rows.at["IQM", "value"] < rows.at["IQM", "high"]
    assert "THEIRS is better than dqn" in text_of(page) and "; 3 runs on 3 games" in text_of(page)
    assert "**0.50** ± 0.50" in page.with_name("table.md").read_text()  # the best on Pong
    with pytest.raises(ValueError, match="--reference must have a name that no agent has, got 'dqn'"):
        compare([tmp_path / "a"], {"dqn": file}, False)


def test_curves_are_over_fractions_of_the_steps_and_end_with_the_final_evaluation(tmp_path):
    def change(result):
        if result["game"] == "Krull":  # twice as long as the others
            result["protocol"]["steps"] = 200_000
            for evaluation in result["evaluations"]:
                evaluation["step"] *= 2

    comparison = compare([a_benchmark(tmp_path / "a", {FULL: SCORES[FULL]}, change=change)], {}, False)
    fractions, curves = normalized_curves(comparison)[FULL]
    assert fractions.tolist() == [0.5, 1.0] and curves.shape == (3, 3, 2)
    assert curves[..., -1] == pytest.approx(matrix(FULL))
    assert curves[0, 0, 0] == pytest.approx((-4.5 + 20.7) / 35.3)  # Pong, seed 0, half way


def test_curves_of_many_points_and_of_points_that_coincide(tmp_path):
    """201 points are half a percent apart; an evaluation that waited for a reset may be near the next one."""

    def change(result):
        scores = result["evaluations"][-1]["scores"]
        steps = [*range(500, 100_000, 500), *([99_999] if result["game"] == "Krull" else []), 100_000]
        curve = [{"step": step, "kind": "curve", "scores": scores, "lengths": [1] * len(scores)} for step in steps]
        result["evaluations"] = [*curve[:-1], curve[-1] | {"kind": "final"}]

    comparison = compare([a_benchmark(tmp_path / "a", {FULL: SCORES[FULL]}, change=change)], {}, False)
    fractions, curves = normalized_curves(comparison)[FULL]
    assert fractions.tolist() == pytest.approx([number / 200 for number in range(1, 201)])
    assert curves.shape == (3, 3, 200) and curves[..., -1] == pytest.approx(matrix(FULL))


def test_empty_figures_are_omitted(tmp_path):
    def change(result):
        result.update(losses=[], evaluations=result["evaluations"][-1:])

    found = all_figures(analyse(compare([a_benchmark(tmp_path / "a", {"dqn": SCORES["dqn"]}, change=change)], {}, False), 5))
    assert [shown.name for shown in found] == ["profiles", "aggregates"]


def test_agents_can_be_told_apart_without_colours():
    style = looks([str(i) for i in range(66)])
    assert len({(look.line, look.marker) for look in style.values()}) == 66


def test_cells_are_escaped():
    table = make_table(["a_b", "50% & more"], [["x|y", "1\n± 2"], ["<z>", "3"]], [[False, True], [False, False]])
    lines = [re.sub(" +", " ", line) for line in to_markdown(table).splitlines()]
    assert lines[0] == "| a_b | 50% & more |" and lines[2] == r"| x\|y | **1** ± 2 |"
    assert "&lt;z&gt;" in to_html(table) and "<z>" not in to_html(table) and "<b>1</b><br><small>± 2</small>" in to_html(table)


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [(52118.4, None, "52,118"), (-20.7, None, "−20.7"), (0.123, None, "0.12"), (-0.0001, 2, "0.00"), (np.nan, None, "–")],
)
def test_numbers(value, decimals, text):
    assert number(value, decimals) == text


def test_published_means_use_the_names_of_the_suite():
    means = published_means(SHOWN, ["Bank_Heist", "Tetris", "Pong"])
    assert means.index.tolist() == ["Bank_Heist", "Pong"] and means.at["Pong", "EqR, R (paper)"] == -6.0


def test_two_runs_have_no_verdict(report_of):
    """However far apart they are."""
    text = text_of(report_of({"dqn": {"Pong": [-20.0, -19.9]}, FULL: {"Pong": [20.0, 19.9]}}, force=True, reps=20))
    assert "2 runs per game do not show how much of that is chance" in text and "is better than dqn" not in text
    assert "<b>" not in text


def test_raw_scores_have_no_gap_and_no_bounds(tmp_path, report_of):
    suite = make_suite("own", "test", {key: value for key, value in ENTRY.items() if key != "normalisation"})
    page = report_of(suite=suite)
    for text in (text_of(page), page.with_name("table.md").read_text(), page.with_name("aggregates.csv").read_text()):
        assert not re.search("optimality gap|score 0|score 1|games above|normalised scores", text), text


def test_raw_scores_of_several_games_are_not_averaged(tmp_path, report_of):
    """A quarter trimmed at each end of all raw scores would be whole games: here that on which the agents differ."""
    suite = make_suite("own", "test", {key: value for key, value in ENTRY.items() if key != "normalisation"})
    scores = {game: [1.0, 2.0, 3.0] for game in SUITE.games}
    page = report_of({"dqn": scores, FULL: {**scores, "Krull": [1001.0, 1002.0, 1003.0]}}, suite)
    found = text_of(page)
    assert f"Compared with dqn, {FULL} is better on Krull, worse on no game, with no clear difference on 2 games" in found
    assert "IQM" not in found and not page.with_name("aggregates.png").exists() and page.with_name("table.md").exists()
    one = a_benchmark(tmp_path / "one", {"dqn": {"Pong": [1.0, 2.0, 3.0]}, FULL: {"Pong": [7.0, 8.0, 9.0]}}, suite)
    assert f"{FULL} is better than dqn: its IQM is 6.00 higher" in conclusion(analyse(compare([one], {}, True), 20))[0]


def test_the_baseline_is_the_same_agent_without_eqr_where_no_stock_agent_ran(tmp_path):
    def change(result):
        depth = 5 if result["agent"] == BASE else 0
        result["entry"] |= {"algo": "eqr_rainbow", "hyperparameters": {"prediction_depth": depth}}

    scores = {BASE: SCORES[BASE], "eqr_rainbow:zero": SCORES[FULL]}
    assert compare([a_benchmark(tmp_path / "a", scores, change=change)], {}, False).agents == ["eqr_rainbow:zero", BASE]


def test_differences_per_game_have_welch_intervals(tmp_path):
    """Means 4 and 1, variances 4 and 1, three seeds each: s² = 5/3, (5/3)² / ((4/3)² / 2 + (1/3)² / 2) degrees of freedom."""
    scores = {"dqn": {"Pong": [0.0, 1.0, 2.0]}, FULL: {"Pong": [2.0, 4.0, 6.0]}}
    half = t.ppf(0.975, (25 / 9) / (16 / 18 + 1 / 18)) * (5 / 3) ** 0.5
    found = difference_table(compare([a_benchmark(tmp_path / "a", scores)], {}, True)).cells
    assert found.to_numpy().tolist() == [["Pong", f"3.00\n[{number(3 - half)}, {number(3 + half)}]"]]
    assert half == pytest.approx(4.15, abs=0.1)  # t is 3.18 for 3 degrees of freedom


def test_a_file_of_packed_runs_is_reported_like_its_folder(tmp_path):
    """In two parts, of which the second replaces a run, without what was stopped and the machine's folders."""
    file = tmp_path / "all.jsonl.xz"

    def change(result):
        command = "run TOP/runs/here --agents dqn:TOP/settings/a.yml dqn:settings/b.yml 'dqn:/a é/b 1/c.yml:two'"
        command = command.replace("TOP", "/a/b-1")
        result.update({"command": command} | ({"stopped_at": 7} if result["seed"] == 2 else {}))

    first = a_benchmark(tmp_path / "a", {"dqn": SCORES["dqn"]}, change=change)
    assert pack(first, file) == 9
    both = a_benchmark(tmp_path / "b", {"dqn": {"Pong": [7.0, 8.0]}, FULL: SCORES[FULL]}, change=change)
    assert pack(both, file) == 18
    found = compare([file], {}, False)
    assert found.games == SUITE.games and found.agents == ["dqn", FULL] and found.bounds["Pong"] == tuple(PONG)
    assert found.notes[0] == "6 runs stopped before the end: left out."
    raw = {key: rows["raw"].tolist() for key, rows in found.scores.groupby(["agent", "game"])}
    assert raw["dqn", "Pong"] == [7.0, 8.0] and raw["dqn", "Krull"] == [1598.0, 1798.0]
    assert found.results[0]["command"] == "run here --agents dqn:a.yml dqn:settings/b.yml dqn:c.yml:two"
    assert len(load_scores(file)) == 12 * 6
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ValueError, match="must be a file of sb3-eqr benchmark pack, got another or a damaged one"):
        compare([file], {}, False)
    for damaged in ("{", "[]", "[1]", "{}", "3"):
        next(both.glob("runs/*/*/*/result.json")).write_text(damaged)
        with pytest.raises(ValueError, match=r"result.json must be the result of a run, got a damaged file"):
            compare([both], {}, False)


def test_a_damaged_result_is_named(tmp_path, report_of):
    """Each value of a row in turn is replaced by values of other types."""
    report_of({"dqn": {"Pong": [1.0]}}, a_suite(games=["Pong"]))
    (path,) = tmp_path.glob("a/runs/*/*/*/result.json")
    row = json.loads(path.read_text())
    wrong = []
    for key in row:
        parts = [{k: v for k, v in row[key].items() if k != part} for part in row[key]] if isinstance(row[key], dict) else []
        for value in (None, "text", -1.5, [], [None], {}, {"step": "x"}, *parts):
            path.write_text(json.dumps({**row, key: value}))
            try:
                write_report([tmp_path / "a"], {}, False, tmp_path / "report", reps=2)
            except ValueError as error:
                assert str(error).endswith(".") and len(str(error)) > 40, error
            except Exception as error:
                wrong.append(f"{key} = {value!r}: {error!r}")
    assert wrong == []
