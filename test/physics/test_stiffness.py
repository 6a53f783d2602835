"""Stiffness of each node, and tissue that relaxes."""

import dataclasses

import numpy as np
import pytest
from tissue_scene import TIP, depth_of_dent, pose_at, simulate, specimen, steps

from endo_sim_ros.core.config import ConfigError, unused_options
from endo_sim_ros.physics import PhysicsConfig, StabilityError, TissueProperties, TissueSimulation, plan_substeps
from endo_sim_ros.physics.materials import MATERIALS


@pytest.mark.slow
@pytest.mark.parametrize("material", ["fixed_corotated", "fung"])
def test_tissue_that_relaxes_holds_back_less_and_less_as_a_standard_linear_solid(material):
    ratio, time, forces = 1.5, 0.4, []
    simulation = simulate(material=material, relaxation=ratio, relaxation_time=time)
    simulation.set_grasp("PSM1", pose_at(TIP), True)
    simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.002]), True)
    for _ in range(60):
        simulation.step()
        forces.append(simulation.reaction("PSM1")[0][2])
    lasting = simulate(material=material)
    lasting.set_grasp("PSM1", pose_at(TIP), True)
    lasting.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.002]), True)
    steps(lasting, 60)
    final = lasting.reaction("PSM1")[0][2]
    elapsed = simulation.step_duration * np.arange(1, 61) - simulation.step_duration
    expected = final * (1 + ratio * np.exp(-elapsed / time))
    np.testing.assert_allclose(forces[5:], expected[5:], rtol=0.08)
    assert forces[5] > 1.7 * forces[-1] > 0


@pytest.mark.slow
def test_slowly_relaxing_tissue_is_not_left_as_it_is_before_it_has_relaxed():
    held, lasting = [], []
    for relaxation, results in ((1.0, held), (0.0, lasting)):
        simulation = simulate(node_count=300, relaxation=relaxation, relaxation_time=4.0)
        simulation.set_grasp("PSM1", pose_at(TIP), True)
        simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.002]), True)
        for _ in range(7):
            results.append(simulation.reaction("PSM1")[0][2])
            steps(simulation, 100)  # 4 s
    assert held[1] > 1.25 * lasting[-1] and held[-1] == pytest.approx(lasting[-1], rel=0.02)
    steps(simulation, 1)
    assert simulation.resting


def test_stiffening_tissue_has_the_substeps_of_the_stiffest_that_it_becomes():
    config = PhysicsConfig(material="fung", young_modulus=2600.0, poisson_ratio=0.3, stiffening_limit=4.0)  # μ 1000, λ 1500
    at_rest = plan_substeps(dataclasses.replace(config, material="neo_hookean"), 0.002).count
    assert plan_substeps(dataclasses.replace(config, stiffening_limit=1.0), 0.002).count == at_rest
    ratio = np.sqrt((1500 + 2000 * 4 * (1 + 2 * np.log(4))) / 3500)
    assert plan_substeps(config, 0.002).count == pytest.approx(ratio * at_rest, rel=0.03)
    with pytest.raises(StabilityError, match=r"poisson_ratio 0\.3, stiffening_limit 4 and density"):
        plan_substeps(dataclasses.replace(config, substeps=at_rest), 0.002)
    said = unused_options(PhysicsConfig(stiffening=3.0))
    assert said == ["stiffening has no effect while material is fixed_corotated; set material to fung"]


@pytest.mark.slow
def test_tissue_that_has_stiffened_snaps_back_without_a_fault(monkeypatch):
    """Not so with the substeps for tissue at rest."""
    faults, lift = [], TIP - [0, 0, 0.02]
    for tangent in (MATERIALS["fung"].tangent, lambda stiffening: 1.0):
        monkeypatch.setitem(MATERIALS, "fung", MATERIALS["fung"]._replace(tangent=tangent))
        simulation = simulate(node_count=800, material="fung", stiffening=9.0, damping=5.0)
        simulation.set_grasp("grip", pose_at(TIP), True)
        for share in np.linspace(0.1, 1, 10):
            simulation.set_grasp("grip", pose_at(TIP + share * (lift - TIP)), True)
            simulation.step()
        steps(simulation, 20)
        simulation.set_grasp("grip", pose_at(lift), False)
        steps(simulation, 30)
        faults.append(simulation.faults)
    assert faults[0] == 0 < faults[1]


def test_relaxing_tissue_needs_the_substeps_of_its_fast_stiffness():
    plain, relaxing = PhysicsConfig(step_duration=0.015, substeps=30), PhysicsConfig(relaxation=3.0)
    assert plan_substeps(relaxing, 0.01).count == pytest.approx(2 * plan_substeps(PhysicsConfig(), 0.01).count, abs=1)
    with pytest.raises(StabilityError, match=r"young_modulus 2e\+06 Pa.*relaxation 3 and density"):
        plan_substeps(dataclasses.replace(plain, relaxation=3.0, young_modulus=2e6), 0.01)


@pytest.mark.slow
def test_a_stiff_region_gives_way_less_and_the_tissue_beside_it_as_before():
    region = "sphere 0.025 0 0.12 0.012 young_modulus=100000"
    left, right = TIP - [0.025, 0, 0], TIP + [0.025, 0, 0]
    dents = []
    for regions in ((), (region,)):
        simulation = simulate(node_count=2000, regions=regions)
        for name, tip in (("left", left), ("right", right)):
            simulation.set_wrench(name, tip, [0.0, 0.0, 0.2])
        steps(simulation, 10)
        state = simulation.state()
        moved, x = state.positions[:, 2] - state.rest[:, 2], state.rest[:, 0]
        dents.append((moved[x < 0].max(), moved[x > 0].max()))
    assert dents[1][0] == pytest.approx(dents[0][0], rel=0.05)
    assert dents[1][1] < 0.5 * dents[0][1]
    with pytest.raises(ConfigError, match="sphere 5 5 5"):
        simulate(regions=("sphere 5 5 5 0.01 young_modulus=1e5",))


@pytest.mark.slow
def test_each_node_obeys_its_own_material():
    """A column of two halves in series, each shortening as its own modulus says."""
    height, spacing = 0.02, 0.0025
    nodes = specimen((9, 9, 9), spacing, lambda x: x[:, 2] > height - 1e-6, lambda x: x[:, 2] < 1e-6)
    stiff = nodes.rest[:, 2] < height / 2 - 1e-6
    properties = TissueProperties.uniform(len(nodes), 5e3, 0.0, 1000.0).painted(stiff, young_modulus=20e3)
    config = PhysicsConfig(device="cpu", poisson_ratio=0.0, force_radius=0.05)
    simulation = TissueSimulation.from_nodes(nodes, config, properties)
    force, area = 0.05, (8 * spacing) ** 2
    simulation.set_wrench("load", [0.01, 0.01, 0.0], [0.0, 0.0, force])
    steps(simulation, 40)
    moved = (simulation.state().positions - nodes.rest)[:, 2]
    middle = nodes.is_skin & (np.linalg.norm(nodes.rest[:, :2] - 0.01, axis=1) < 0.008)
    half = np.abs(nodes.rest[:, 2] - height / 2) < 1e-6
    expected_half = force / area / 5e3 * height / 2
    assert moved[half].mean() == pytest.approx(expected_half, rel=0.12)
    assert moved[middle].mean() == pytest.approx(expected_half * 1.25, rel=0.12)


@pytest.mark.slow
@pytest.mark.parametrize("force", [0.4, 1.2, -0.4])
def test_a_column_that_stiffens_gives_way_as_the_equation_says(force):
    """Poisson's ratio 0: it stays as wide as it is, and F/A = μ exp(a W) (s − 1/s) of its stretch s."""
    height, spacing, young, rate = 0.02, 0.0025, 5e3, 2.0
    nodes = specimen((9, 9, 9), spacing, lambda x: x[:, 2] > height - 1e-6, lambda x: x[:, 2] < 1e-6)
    config = PhysicsConfig(
        device="cpu", material="fung", young_modulus=young, poisson_ratio=0.0, stiffening=rate, stiffening_limit=5.0, force_radius=0.05
    )
    simulation = TissueSimulation.from_nodes(nodes, config)
    simulation.set_wrench("load", [0.01, 0.01, 0.0], [0.0, 0.0, -force])
    steps(simulation, 60)
    stretch = np.linspace(0.5, 2.0, 10_000)
    exponent = np.minimum(rate * (stretch**2 - 1 - 2 * np.log(stretch)), np.log(5.0))
    expected = np.interp(force / (8 * spacing) ** 2, young / 2 * np.exp(exponent) * (stretch - 1 / stretch), stretch)
    middle = nodes.is_skin & (np.linalg.norm(nodes.rest[:, :2] - 0.01, axis=1) < 0.008)
    moved = (nodes.rest - simulation.state().positions)[middle, 2].mean()
    assert moved == pytest.approx((expected - 1) * height, rel=0.12) and simulation.faults == 0


@pytest.mark.slow
def test_tissue_whose_material_changes_goes_on_from_where_it_is():
    soft, stiff = simulate(blade_length=0.03), simulate(blade_length=0.03, young_modulus=20e3)
    for y in np.linspace(-0.045, 0.0, 10):
        soft.set_cut("knife", pose_at([0.02, y, 0.145]), True)
    soft.set_wrench("probe", TIP, [0.0, 0.0, 0.2])
    soft.set_grasp("grip", pose_at(TIP + [0.03, 0, 0]), True)
    steps(soft, 20)
    assert stiff.continue_from(soft)
    np.testing.assert_array_equal(stiff.state().positions, soft.state().positions)
    assert len(stiff.cuts) == len(soft.cuts) > 0 and stiff.in_reach("grip") and stiff.time == soft.time
    before = depth_of_dent(stiff)
    steps(stiff, 20)
    assert depth_of_dent(stiff) == pytest.approx(before / 2, rel=0.2)  # the same force, twice the stiffness
    np.testing.assert_allclose(stiff.reaction("probe")[0], [0, 0, -0.2], atol=1e-9)
    assert not simulate(node_count=400).continue_from(soft)
