"""
Matrix Lie groups: what states and actions are made of (EqR, §3.1, §4 and appendix A).

A network predicts ``num_params`` numbers per block; :meth:`Group.element` turns them into a group element.
Every method is stateless, differentiable and batched over all leading dimensions.

``base`` says what a group is, ``matrix`` has the formulas, ``product`` makes groups from names.
"""

from sb3_eqr.common.groups.base import Group
from sb3_eqr.common.groups.matrix import GL, SE, SO, MatrixGroup, MatrixLieGroup, NoGroup, T, guarded_inverse
from sb3_eqr.common.groups.product import ProductGroup, make_group

__all__ = [
    "GL",
    "SE",
    "SO",
    "Group",
    "MatrixGroup",
    "MatrixLieGroup",
    "NoGroup",
    "ProductGroup",
    "T",
    "guarded_inverse",
    "make_group",
]
