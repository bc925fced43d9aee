"""
Matrix Lie groups, which represent latent states and actions (EqR, §3.1, §4 and appendix A).

A network predicts ``num_params`` numbers per block, and :meth:`Group.element` turns them into a group element.
All methods are stateless, differentiable and batched over all leading dimensions.

``base`` defines the interface, ``matrix`` the groups, ``product`` creates groups from their names, and ``layer`` maps features
to group elements.
"""

from sb3_eqr.common.groups.base import Group
from sb3_eqr.common.groups.layer import DEFAULT_GROUP, GroupLayer, Whitening
from sb3_eqr.common.groups.matrix import GL, SE, SO, MatrixGroup, MatrixLieGroup, NoGroup, T, guarded_inverse
from sb3_eqr.common.groups.product import ProductGroup, make_group

__all__ = [
    "DEFAULT_GROUP",
    "GL",
    "SE",
    "SO",
    "Group",
    "GroupLayer",
    "MatrixGroup",
    "MatrixLieGroup",
    "NoGroup",
    "ProductGroup",
    "T",
    "Whitening",
    "guarded_inverse",
    "make_group",
]
