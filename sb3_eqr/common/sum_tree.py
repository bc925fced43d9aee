"""A sum tree: draws in proportion to priorities in O(log N), for whole batches at once."""

import numpy as np


class SumTree:
    """
    A complete binary tree in one array: node 1 is the root, node i has children 2i and 2i + 1, and the leaves are
    the last ``capacity`` nodes, rounded up to a power of two. Inner nodes are recomputed from their children, never
    incremented, so rounding errors do not pile up.

    :param capacity: number of leaves, at least 1
    """

    def __init__(self, capacity: int):
        self.capacity = capacity
        self._depth = max(capacity - 1, 0).bit_length()
        self._first_leaf = 1 << self._depth
        self._nodes = np.zeros(2 * self._first_leaf)

    @property
    def total(self) -> float:
        """The sum of all priorities."""
        return float(self._nodes[1])

    @property
    def nbytes(self) -> int:
        """Memory, in bytes."""
        return self._nodes.nbytes

    def set(self, leaves: np.ndarray, priorities: np.ndarray | float) -> None:
        """
        :param leaves: indices in [0, capacity), (B,); where one is named twice, the last one counts
        :param priorities: non-negative, (B,) or one for all
        """
        nodes = leaves + self._first_leaf
        self._nodes[nodes] = priorities
        for _ in range(self._depth):
            nodes = nodes >> 1
            self._nodes[nodes] = self._nodes[2 * nodes] + self._nodes[2 * nodes + 1]

    def get(self, leaves: np.ndarray) -> np.ndarray:
        """
        :param leaves: indices in [0, capacity), (B,)
        :return: their priorities, (B,)
        """
        return self._nodes[leaves + self._first_leaf]

    def find(self, masses: np.ndarray) -> np.ndarray:
        """
        The leaf at which the running sum of priorities first exceeds each mass. A leaf of priority 0 is never found.

        :param masses: numbers in [0, total), (B,)
        :return: leaves, (B,), int64
        """
        nodes = np.ones(len(masses), dtype=np.int64)
        masses = masses.copy()
        for _ in range(self._depth):
            left = self._nodes[2 * nodes]
            # Rounding may leave a mass just above what is there: never walk into an empty subtree.
            right = (masses >= left) & (self._nodes[2 * nodes + 1] > 0)
            masses -= left * right
            nodes = 2 * nodes + right
        return nodes - self._first_leaf

    def sample(self, batch_size: int, uniforms: np.ndarray) -> np.ndarray:
        """
        Stratified draws (Schaul et al. 2016, appendix B.2.1, https://arxiv.org/abs/1511.05952):
        the total is cut into ``batch_size`` equal ranges and one leaf is drawn from each.

        :param uniforms: random numbers in [0, 1), (B,)
        :return: leaves, (B,), int64
        """
        return self.find((np.arange(batch_size) + uniforms) * (self.total / batch_size))
