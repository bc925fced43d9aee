"""
The last rows of the EqR paper's tables, computed from the scores in the package: docs/results/published.md.

    python -m experiments.published_rows
"""

import pandas as pd

from sb3_eqr.benchmark.reference import HUMAN, RANDOM, load_reference

# mean, median, games above human, as printed under Tables 2, 3 and 4 of the EqR paper
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


def human_normalized(scores: pd.DataFrame) -> pd.DataFrame:
    """
    (score - random) / (human - random), with the random and human scores of the paper's Table 2.

    :param scores: columns method, game, mean
    :return: rows games, columns methods
    :raises ValueError: for a game without a human score, with the names of those that have one
    """
    reference = load_reference().pivot(index="game", columns="method", values="mean")
    unknown = set(scores["game"]) - set(reference.index)
    if unknown:
        raise ValueError(f"game must be one of {', '.join(reference.index)}, got {', '.join(sorted(unknown))}.")
    table = scores.pivot(index="game", columns="method", values="mean")
    low, high = reference.loc[table.index, RANDOM], reference.loc[table.index, HUMAN]
    return table.sub(low, axis=0).div(high - low, axis=0)


def last_rows() -> pd.DataFrame:
    """
    The last rows of Tables 2, 3 and 4 of the EqR paper, computed from the scores in the tables.

    :return: columns table (2, 3, 4), method, mean, median, superhuman (games above human), and the printed values of the
        last three: printed_mean, printed_median, printed_superhuman; means and medians have three decimals, as printed
    """
    normalized = human_normalized(load_reference())
    rows = []
    for method, (mean, median, superhuman) in PRINTED.items():
        values = normalized[method]
        rows.append(
            {
                "table": int(method[-2]),
                "method": method.partition(" [")[0].replace("$", ""),
                "mean": round(float(values.mean()), 3),
                "median": round(float(values.median()), 3),
                "superhuman": int((values > 1).sum()),
                "printed_mean": mean,
                "printed_median": median,
                "printed_superhuman": superhuman,
            }
        )
    return pd.DataFrame(rows)


def disagreements(rows: pd.DataFrame) -> list[str]:
    """
    :param rows: see :func:`last_rows`
    :return: a sentence for each number in the paper that its scores do not give
    """
    return [
        f"{row['method']} in Table {row['table']}: the paper prints a {what} of {row[f'printed_{what}']:.3f}, "
        f"the scores in its table give {row[what]:.3f}."
        for row in rows.to_dict("records")
        for what in ("mean", "median", "superhuman")
        if row[what] != row[f"printed_{what}"]
    ]


def published_table() -> str:
    """
    :return: :func:`last_rows` as a Markdown page
    """
    rows = last_rows()
    lines = [
        "# The last rows of the EqR paper's tables",
        "",
        "Human-normalised scores on the 26 games of Atari 100K, computed from the game scores that the paper prints",
        "(`python -m experiments.published_rows`). Superhuman games are those with a mean above 1.",
        "",
        "| table | method | mean | median | superhuman games |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['table']} | {row['method']} | {row['mean']:.3f} | {row['median']:.3f} | {row['superhuman']} |"
        for row in rows.to_dict("records")
    ]
    lines += ["", "All agree with the paper except these:", "", *(f"- {text}" for text in disagreements(rows))]
    return "\n".join(lines)


if __name__ == "__main__":
    print(published_table())
