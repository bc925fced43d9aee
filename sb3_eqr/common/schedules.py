"""How the n-step return and the discount move after a reset (BBF, https://arxiv.org/abs/2305.19452)."""


def anneal_n_steps(initial: int | None, final: int, progress: float) -> int:
    """
    Geometric, rounded: 10 to 3 passes 5 half-way.

    :param initial: n at the start; ``None``: it does not move
    :param final: n at the end
    :param progress: in [0, 1]
    """
    return final if initial is None else round(initial * (final / initial) ** progress)


def anneal_gamma(initial: float | None, final: float, progress: float) -> float:
    """
    Geometric in 1 - γ: the horizon 1 / (1 - γ) grows by the same factor in the same time.

    :param initial: γ at the start, < 1; ``None``: it does not move
    :param final: γ at the end, < 1
    :param progress: in [0, 1]
    """
    if initial is None or progress >= 1:
        return final
    return 1 - (1 - initial) * ((1 - final) / (1 - initial)) ** progress
