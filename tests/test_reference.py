"""The bundled figures give the last rows that the paper prints."""

import pytest

from sb3_eqr.benchmark.reference import human_normalized, load_reference

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
# What the scores in the tables give where the line under them says something else by one in the last digit.
OWN = {("SPR [EqR Tab2]", 0): 0.703, ("MLP [EqR Tab3]", 1): 0.399}


@pytest.fixture(scope="module")
def scores():
    return load_reference()


@pytest.mark.parametrize("method", PRINTED)
def test_last_rows(scores, method):
    values = human_normalized(scores)[method]
    found = (round(values.mean(), 3), round(values.median(), 3), int((values > 1).sum()))
    expected = tuple(OWN.get((method, place), printed) for place, printed in enumerate(PRINTED[method]))
    assert found == expected


def test_what_is_bundled(scores):
    assert scores.columns.tolist() == ["method", "game", "runs", "mean", "sd", "source"]
    assert scores.groupby("method")["game"].nunique().eq(26).all() and not scores.duplicated(["method", "game"]).any()
    assert scores["source"].str.len().gt(5).all() and scores["runs"].ge(1).all()
    normalized = human_normalized(scores)
    assert normalized["Random"].eq(0).all() and normalized["Human"].eq(1).all()


def test_unknown_games_are_named(scores):
    with pytest.raises(ValueError, match="found tetris"):
        human_normalized(scores.head(1).assign(game="tetris"))
