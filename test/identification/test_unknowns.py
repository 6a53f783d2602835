"""Priors: what is known of tissue before any data."""

from dataclasses import replace

import numpy as np
import pytest
from slab import NODES, PHYSICS

from endo_sim_ros.identification import IdentificationConfig
from endo_sim_ros.identification.maps import paint_as_regions
from endo_sim_ros.identification.unknowns import PRIORS, Unknowns, gaussian_process, transform, untransform
from endo_sim_ros.physics import tissue
from endo_sim_ros.physics.control_nodes import held_sets
from endo_sim_ros.physics.regions import TissueProperties, paint_regions

NONE = np.zeros((0, 3))


def test_a_field_has_the_variance_that_was_asked_for():
    centres, weights, left, factor = gaussian_process(NODES.rest, 0.8, 0.012)
    assert np.allclose((weights**2).sum(1) + left, 0.64, atol=1e-4)
    at_centres = [int(np.abs(NODES.rest - each).sum(1).argmin()) for each in centres]
    assert left[at_centres].max() < 1e-4 and np.allclose(weights[at_centres], factor, atol=1e-3)
    correlation = weights[at_centres] @ weights[at_centres].T / 0.64
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    assert np.allclose(correlation, np.exp(-0.5 * (distance / 0.012) ** 2), atol=1e-3)


def test_directions_give_back_derivatives_by_the_unknowns():
    unknowns = Unknowns(NODES, PHYSICS, IdentificationConfig(stiffness="field"), NONE)
    ways, back = unknowns.directions(NONE)
    assert np.allclose(back.T @ ways, np.eye(unknowns.count), atol=1e-6) or np.allclose(ways.T @ back, np.eye(unknowns.count), atol=1e-6)
    few, _ = unknowns.directions(np.array([[0.02, 0.02, 0.1]]))
    assert len(few) < len(ways)


def test_transforms_are_inverse_and_keep_their_bounds():
    for value, high in ((0.3, 0.495), (5e3, 0.0)):
        assert untransform(transform(value, high), high) == pytest.approx(value)
    assert untransform(100.0, 0.495) <= 0.495


def test_values_of_physics_are_the_medians_of_the_priors():
    lung = tissue("lung", device="cpu")
    unknowns = Unknowns(NODES, lung, IdentificationConfig(unknowns=tuple(PRIORS)), NONE)
    copy = unknowns.copy(np.zeros(unknowns.count))
    assert dict(copy.options) == pytest.approx({name: getattr(lung, name) for name in PRIORS})
    assert (copy.factors == 1).all()


@pytest.mark.parametrize("name", ["liver", "lung", "fat", "gall_bladder"])
def test_published_numbers_of_tissues_are_likely(name):
    physics = tissue(name)
    for other, prior in PRIORS.items():
        values = [getattr(tissue(each), other) for each in ("liver", "lung")]
        if getattr(physics, other) > 0 and min(values) > 0:
            apart = transform(getattr(physics, other), prior.high) - np.mean([transform(value, prior.high) for value in values])
            assert abs(apart) < 2.5 * prior.sd, (name, other)


def test_what_is_held_is_divided_into_back_and_rim():
    back, rim = held_sets(NODES)
    assert not (back & rim).any() and ((back | rim) == NODES.pinned).all()
    assert rim[NODES.is_skin & NODES.pinned].all() and back.sum() >= 25


def test_regions_paint_what_they_were_made_of():
    rng = np.random.default_rng(0)
    modulus = 4e3 * np.exp(0.8 * np.sin(NODES.rest @ rng.standard_normal(3) * 200))
    texts = paint_as_regions(NODES, modulus, step=0.2)
    painted = paint_regions(TissueProperties.uniform(len(NODES), 1.0, 0.3, 1000.0), NODES.rest, texts)
    assert np.abs(np.log(painted.young_modulus / modulus)).max() < 0.2
    assert paint_as_regions(NODES, np.full(len(NODES), 5e3))[0].endswith("young_modulus=5000") and len(texts) > 5
    assert len(paint_as_regions(NODES, modulus, most=10)) <= 10


def test_one_modulus_of_each_region():
    physics = replace(PHYSICS, regions=("sphere 0 0 0.105 0.01 young_modulus=9000",))
    unknowns = Unknowns(NODES, physics, IdentificationConfig(stiffness="regions"), NONE)
    assert unknowns.labels == ["young_modulus of the rest", "young_modulus of sphere 0 0 0.105 0.01"]
    inside = unknowns.matrix[:, 1] > 0
    factors = unknowns.copy(np.array([0.0, 1.0])).factors
    assert np.allclose(factors[inside], np.e) and (factors[~inside] == 1).all()
    assert [np.exp(each.mean) for each in unknowns.reported()] == pytest.approx([4e3, 9e3])
