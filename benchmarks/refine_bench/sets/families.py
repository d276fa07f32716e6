"""The objects of SyntheticShift as the other families of networks would predict them: see `families`."""

from __future__ import annotations

from functools import partial

from ..cases import Case, Scene, mesh_of
from ..families import FAMILIES, predict
from ..shapes import ASYMMETRIC, make_shape
from .synthetic import MADE_PLANE, Instance, full_view, objects


def family_cases() -> list[Case]:
    """60 cases: 20 objects, each as three families predict it; the family is the level."""
    return [
        Case(
            instance.name,
            instance.category,
            partial(make_scene, instance),
            family,
            instance.generator in ASYMMETRIC,
            MADE_PLANE,
        )
        for entry in objects()
        for family in FAMILIES
        for instance in [Instance(*entry, family)]
    ]


def make_scene(instance: Instance) -> Scene:
    """The object and its view in SyntheticShift, and the prediction of the family."""
    shape = make_shape(instance.generator, instance.seed)
    truth = mesh_of(shape)
    coarse = predict(instance.level, shape, instance.seed)
    return Scene(mesh_of(coarse), full_view(truth, instance.seed), truth)
