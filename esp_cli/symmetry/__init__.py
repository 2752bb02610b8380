"""The mathematics of symmetry: groups, and their representations on a task's spaces."""

from esp_cli.symmetry.admission import admit, admit_declared, carried_groups, default_transforms
from esp_cli.symmetry.elements import Element, Geometry
from esp_cli.symmetry.groups import FiniteGroup, Group, agent_permutations, direct_product, item_orders
from esp_cli.symmetry.parse import parse_elements, parse_group
from esp_cli.symmetry.plane import PlaneElement, cyclic, dihedral, mirror, rotation
from esp_cli.symmetry.transforms import Transform, TransformSet, build_transform, transform_set

__all__ = [
    "Element",
    "FiniteGroup",
    "Geometry",
    "Group",
    "PlaneElement",
    "Transform",
    "TransformSet",
    "admit",
    "admit_declared",
    "agent_permutations",
    "build_transform",
    "carried_groups",
    "cyclic",
    "default_transforms",
    "dihedral",
    "direct_product",
    "item_orders",
    "mirror",
    "parse_elements",
    "parse_group",
    "rotation",
    "transform_set",
]
