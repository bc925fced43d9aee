"""The bundled scores give the last rows that the paper prints."""

import json

import pytest

from experiments.tables import in_words, published
from sb3_eqr.benchmark.reference import load_reference
from sb3_eqr.benchmark.scores import read_runs
from tests.tools.test_package import ROOT

# mean, median, games above human, as printed under Tables 2, 3 and 4
PRINTED = {
    "SimPLe [EqR Tab2]": (0.443, 0.144, 2),
    "DER [EqR Tab2]": (0.285, 0.161, 2),
    "CURL [EqR Tab2]": (0.381, 0.175, 2),
    "DrQ [EqR Tab2]": (0.357, 0.268, 2),
    "SPR [EqR Tab2]": (0.704, 0.415, 7),
    "EqR, L_R [EqR Tab2]": (0.859, 0.418, 8),
    "EqR, L_R + L_{GET} [EqR Tab2]": (0.886, 0.398, 7),
    "MLP [EqR Tab3]": (0.681, 0.398, 6),
    "EqR, T_2 [EqR Tab3]": (0.829, 0.361, 6),
    "EqR, SE_2 [EqR Tab3]": (0.859, 0.418, 8),
    "EqR, GL_2 [EqR Tab3]": (0.833, 0.380, 7),
    "EqR [EqR Tab4]": (0.682, 0.337, 6),
    "EqR, L_R [EqR Tab4]": (0.859, 0.418, 8),
    "EqR, L_{GET} [EqR Tab4]": (0.749, 0.377, 6),
    "EqR, $L_R + L_{GET}$ [EqR Tab4]": (0.886, 0.398, 7),
}
# Means and medians of the tables' scores that differ from the printed ones by one in the last digit.
OWN = {("SPR [EqR Tab2]", 0): 0.703, ("MLP [EqR Tab3]", 1): 0.399}


def test_last_rows():
    """As printed, but for two; the page has the same. An agent of several tables has one row, named as in the first."""
    rows = [line.strip("| ").split(" | ") for line in published().splitlines()[2:]]
    found = {}
    for method, printed in PRINTED.items():
        mean, median, superhuman = (OWN.get((method, place), value) for place, value in enumerate(printed))
        numbers = [f"{mean:.3f}", f"{median:.3f}", str(superhuman)]
        (row,) = [row for row in rows if row[2:] == numbers and method[-2] in row[1].split(", ")]
        found.setdefault(row[0], []).append(method[-2])
        assert row[0] == in_words(method) or method == "EqR, SE_2 [EqR Tab3]"
    assert {name: ", ".join(tables) for name, tables in found.items()} == {row[0]: row[1] for row in rows}
    assert published() in (ROOT / "docs" / "results" / "published.md").read_text(encoding="utf-8")


def test_the_bundled_scores():
    scores = load_reference()
    assert scores.columns.tolist() == ["method", "game", "runs", "mean", "sd", "source"]
    assert scores.groupby("method")["game"].nunique().eq(26).all() and not scores.duplicated(["method", "game"]).any()
    assert scores["source"].str.len().gt(5).all() and scores["runs"].ge(1).all()


def test_reading_runs(tmp_path):
    file = tmp_path / "runs.json"
    file.write_text(json.dumps({"pong": [1, 2.5, 3], "bank heist": [4, 5], "Hero": [6]}))
    found = read_runs(file, "X", ["BankHeist", "Pong"])
    assert found.attrs["note"] == "X: the first 2 runs of every game only, as many as all of them have."
    rows = [["X", "BankHeist", 0, 4.0], ["X", "BankHeist", 1, 5.0], ["X", "Pong", 0, 1.0], ["X", "Pong", 1, 2.5]]
    assert found.to_numpy().tolist() == rows


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "--reference X: .*x.json must contain .*, got Invalid JSON"),
        ("[1]", "with a raw score per run, got Input should be an object. Write its runs as lists of finite numbers"),
        ('{"Pong": 3}', "got Pong: Input should be a valid (list|array)"),
        ('{"Pong": [1, NaN]}', "got Pong: 1: Input should be a finite number"),
        ('{"Pong": [true]}', "got Pong: 0: Input should be a valid number"),
        ('{"Pong": []}', "got Pong: List should have at least 1 item"),
        ('{"Pong": [1]}', "must contain scores for Pong, BankHeist, got none for BankHeist, only for Pong. Add them"),
        ('{"Pong": [1], "BankHeis": [1]}', "got none for BankHeist, only for Pong, BankHeis. Add them, correct their names"),
    ],
)
def test_invalid_files_of_runs(tmp_path, content, message):
    file = tmp_path / "x.json"
    file.write_text(content)
    with pytest.raises(ValueError, match=message):
        read_runs(file, "X", ["Pong", "BankHeist"])
    with pytest.raises(ValueError, match=r"must contain .*, got no readable file: No such file"):
        read_runs(tmp_path / "nowhere", "X", ["Pong"])
