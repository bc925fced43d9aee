"""The interface of all groups, used by the encoder and the latent model (EqR, §3.1 and §4)."""

from abc import ABC, abstractmethod

import torch as th


class Group(ABC):
    """
    A group whose elements are arrays of one shape.

    ``num_params``: number of parameters that the network predicts per element.
    ``element_shape``: shape of one element.
    ``has_inverse``: ``False`` only for :class:`NoGroup`, which is not a group.
    """

    num_params: int
    element_shape: tuple[int, ...]
    has_inverse: bool = True

    def __init__(self, name: str, num_params: int, element_shape: tuple[int, ...]):
        self.name = name
        self.num_params = num_params
        self.element_shape = element_shape

    def __repr__(self) -> str:
        return self.name

    @abstractmethod
    def element(self, params: th.Tensor) -> th.Tensor:
        """
        Compute group elements from their parameters.

        :param params: real numbers, (..., num_params), floating point
        :return: group elements, (..., \\*element_shape), same dtype and device
        """

    @abstractmethod
    def compose(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        """
        The group operation; the left factor acts on the right one (Eq. 10).

        :param left: (..., \\*element_shape)
        :param right: (..., \\*element_shape), broadcast against ``left``
        :return: (..., \\*element_shape)
        """

    @abstractmethod
    def inverse(self, element: th.Tensor) -> th.Tensor:
        """
        Invert group elements.

        :param element: (..., \\*element_shape)
        :return: (..., \\*element_shape); finite even if a GL element is singular
        """

    @abstractmethod
    def identity(self, *batch: int, dtype: th.dtype | None = None, device: th.device | str | None = None) -> th.Tensor:
        """The identity, (\\*batch, \\*element_shape)."""

    @property
    def for_actions(self) -> "Group":
        """
        The same group in the parameterization used for actions, in which small parameters are small moves. Latent states
        have to cover the entire group, which "gram-schmidt" does without a discontinuity; actions only have to cover a
        neighbourhood of the identity.
        """
        return self

    def identity_params(self) -> th.Tensor:
        """Parameters of the identity, (num_params,)."""
        return th.zeros(self.num_params)
