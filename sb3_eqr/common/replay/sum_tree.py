"""A sum tree, which samples batches in proportion to priorities."""

import numpy as np


class SumTree:
    """
    A tree with two levels: leaves, in blocks of about √capacity / 4, and the sum of each block. It is wide and flat, because
    each level costs a few NumPy calls per batch, and a cumulative sum over a block hardly more than one such call. Sums are
    recomputed instead of incremented, so rounding errors do not accumulate.

    :param capacity: number of leaves, at least 1
    """

    def __init__(self, capacity: int):
        self.capacity = capacity = int(capacity)  # it may be of NumPy
        self._block = 1 << max(capacity.bit_length() // 2 - 2, 4)
        self._leaves = np.zeros((-(-capacity // self._block), self._block))
        self._sums = np.zeros(len(self._leaves))

    @property
    def nbytes(self) -> int:
        """Memory usage, in bytes."""
        return self._leaves.nbytes + self._sums.nbytes

    def set(self, leaves: np.ndarray, priorities: np.ndarray | float) -> None:
        """
        :param leaves: indices in [0, capacity), (B,); of duplicates, the last one counts
        :param priorities: non-negative, (B,) or one for all leaves
        """
        self._leaves.ravel()[leaves] = priorities
        blocks = leaves // self._block
        self._sums[blocks] = self._leaves[blocks].sum(axis=1)

    def get(self, leaves: np.ndarray) -> np.ndarray:
        """
        :param leaves: indices in [0, capacity), (B,)
        :return: their priorities, (B,)
        """
        return self._leaves.ravel()[leaves]

    def sample(self, batch_size: int, uniforms: np.ndarray) -> np.ndarray:
        """
        Stratified sampling (Schaul et al. 2016, appendix B.2.1, https://arxiv.org/abs/1511.05952):
        divides the total into ``batch_size`` equal ranges and samples one leaf from each.

        :param uniforms: random numbers in [0, 1), (B,)
        :return: leaves, (B,), int64
        """
        starts = np.zeros(len(self._sums) + 1)
        self._sums.cumsum(out=starts[1:])
        masses = (np.arange(batch_size) + uniforms) * (starts[-1] / batch_size)
        # Rounding may push a mass just above the total: never select a leaf after the last priority above 0.
        masses = np.minimum(masses, np.nextafter(starts[-1], 0))
        blocks = starts.searchsorted(masses, side="right") - 1  # (B,)
        inside = self._leaves[blocks].cumsum(axis=1)  # (B, block)
        rest = np.minimum(masses - starts[blocks], np.nextafter(inside[:, -1], 0))
        return blocks * self._block + (inside > rest[:, None]).argmax(axis=1)  # argmax returns the first True
