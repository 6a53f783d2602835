"""Tissue that breathes: what is held follows the waveform, the rest follows what is held."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from tissue_scene import EYE, TIP, curved_sheet, pose_at, simulate, specimen, steps

from endo_sim_ros.core.motion import beat_share, breath_share
from endo_sim_ros.physics import MotionConfig, PhysicsConfig, Skinning, TissueBatch, TissueSimulation, build_control_nodes
from endo_sim_ros.sequences.phantom.config import PhantomConfig
from endo_sim_ros.sequences.phantom.displacement import displacement_at

BREATH = MotionConfig(breathing=0.004)
BOTH = MotionConfig(breathing=0.004, breathing_period=2.0, heartbeat=0.002, direction_x=0.0, direction_y=3.0 / 5, direction_z=-4.0 / 5)
WAY = np.array([0.0, 0.6, -0.8])


def moved(simulation: TissueSimulation) -> np.ndarray:
    """Displacement of what is held [3], m; all of it alike."""
    state = simulation.state()
    held = (state.positions - state.rest)[simulation.nodes.pinned]
    assert np.ptp(held, axis=0).max() < 2e-8  # what float32 rounds off positions
    return simulation.solver.motion.held.numpy()[0, 0].astype(np.float64)


def slab(**options) -> TissueSimulation:
    """A slab of 4 × 4 × 1.5 cm, held below."""
    nodes = specimen((9, 9, 4), 0.005, lambda x: x[:, 2] < 0.002, lambda x: x[:, 2] > 0.014)
    return TissueSimulation.from_nodes(nodes, PhysicsConfig(**{"device": "cpu", "damping": 0.0, **options}))


def test_the_waveforms_are_those_of_the_synthetic_patient():
    for options in ({"breathing": 0.008, "breathing_period": 5.0}, {"heartbeat": 0.002, "heartbeat_period": 0.7}):
        config = PhantomConfig(**options)
        sizes = [float(np.linalg.norm(displacement_at(config, t).amplitudes)) for t in (0.1, 0.9, 2.0)]
        wave = breath_share if "breathing" in options else beat_share
        most, period = options.values()
        assert sizes == pytest.approx([most * wave(t, period) for t in (0.1, 0.9, 2.0)], abs=1e-12)
    assert (breath_share(0.0, 4.0), breath_share(2.0, 4.0), beat_share(0.225, 0.9)) == (0.0, 1.0, 1.0)


def test_held_nodes_are_where_the_waveform_has_them_at_the_end_of_each_step():
    simulation = simulate(node_count=300, motion=BOTH)
    for step in range(1, 101):
        simulation.step()
        t = 0.04 * step
        breath, beat = 0.004 * breath_share(t, 2.0), 0.002 * beat_share(t, 0.9)
        np.testing.assert_allclose(moved(simulation), (breath + beat) * WAY, rtol=3e-7, atol=1e-10)
        np.testing.assert_allclose(simulation.motion.displacements, [breath, beat], rtol=1e-9, atol=1e-12)
        apart = simulation.motion.phases - [t / 2.0, t / 0.9]
        np.testing.assert_allclose(apart, np.round(apart), atol=1e-9)
        springs = simulation.solver.displacements()[simulation.nodes.pinned] - moved(simulation)
        assert np.abs(springs).max() < 3e-5
    assert simulation.faults == 0 and simulation.motion.rates == pytest.approx([0.5, 1 / 0.9])


def test_the_heart_may_go_its_own_way():
    apart = dataclasses.replace(BOTH, heartbeat_direction_x=-0.5)
    simulation = simulate(node_count=300, motion=apart)
    for step in range(1, 13):
        simulation.step()
        breath, beat = 0.004 * breath_share(0.04 * step, 2.0), 0.002 * beat_share(0.04 * step, 0.9)
        np.testing.assert_allclose(moved(simulation), breath * WAY + beat * np.array([-1.0, 0.0, 0.0]), rtol=3e-7, atol=1e-9)
        np.testing.assert_allclose(simulation.motion.displacements, [breath, beat], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(dataclasses.replace(BOTH, heartbeat_direction_z=1e-9).ways, BOTH.ways)


def test_a_slab_that_is_held_below_moves_as_one():
    simulation = slab(motion=BREATH)
    mass = float(simulation.solver.nodes.mass.numpy().sum())
    for _ in range(25):  # to the middle of the way there, where it is fastest
        simulation.step()
        free = (simulation.state().positions - simulation.state().rest)[~simulation.nodes.pinned]
        assert np.linalg.norm(free - moved(simulation), axis=1).max() < 2e-5  # it lags behind, or swings past, by 20 µm of 4 mm
    speed = math.pi * 0.004 / 4.0 * math.sin(2 * math.pi * 0.98 / 4.0)  # mean over the last step
    momentum = np.array(simulation.solver.momentum()[0]) / mass
    assert np.linalg.norm(momentum) == pytest.approx(speed, rel=0.1)
    assert momentum @ [1, 0, -0.5] / math.hypot(1, 0.5) == pytest.approx(np.linalg.norm(momentum), rel=1e-3)
    assert np.abs(simulation.state().F - np.eye(3)).max() < 3e-3


def test_a_tool_feels_tissue_only_while_it_comes():
    simulation = slab(motion=MotionConfig(breathing=0.01, direction_x=0.0, direction_z=1.0), contact_radius=0.006, damping=50.0)
    felt = []
    for _ in range(100):
        simulation.set_grasp("probe", pose_at([0.02, 0.02, 0.015 + 0.008 + simulation.contact_radius]), False)
        simulation.step()
        felt.append(simulation.reaction("probe")[0][2])
    raised = 0.01 * np.array([breath_share(0.04 * step, 4.0) for step in range(1, 101)])
    assert not np.any(np.array(felt)[raised < 0.0075])
    assert min(felt[48:52]) > 0.02 and simulation.faults == 0


def test_other_amplitudes_and_periods_come_without_a_jump():
    simulation = simulate(node_count=300, motion=BOTH)
    steps(simulation, 37)
    phases, before = simulation.motion.phases, moved(simulation)
    simulation.set_motion(MotionConfig(breathing=0.006, breathing_period=8.0, heartbeat=0.0, direction_x=1.0, direction_z=0.0))
    np.testing.assert_array_equal(simulation.motion.phases, phases)
    fastest = 0.0
    for _ in range(60):
        simulation.step()
        fastest, before = max(fastest, float(np.linalg.norm(moved(simulation) - before))), moved(simulation)
    # Breath moves by π A/T, a fade by 1.5 A/s, a heartbeat by 0.61 A/(0.08 T).
    assert fastest < 0.04 * (math.pi * 0.006 / 2.0 + 1.5 * (0.004 + 0.006 + 0.002) + 0.61 * 0.002 / (0.08 * 0.9))
    assert simulation.motion.phases[0] == pytest.approx((phases[0] + 60 * 0.04 / 8.0) % 1)
    np.testing.assert_allclose(moved(simulation), [0.006 * breath_share(simulation.motion.phases[0], 1.0), 0, 0], rtol=1e-6, atol=1e-12)
    simulation.set_motion(MotionConfig())
    steps(simulation, 30)
    assert not moved(simulation).any() and not simulation.solver.motion.moving
    steps(simulation, 60)
    assert simulation.resting and np.abs(simulation.state().positions - simulation.state().rest).max() < 1e-5


def test_motion_that_begins_later_grows_from_nothing():
    simulation = simulate(node_count=300)
    steps(simulation, 10)
    simulation.set_motion(BREATH)
    simulation.step()
    assert np.linalg.norm(moved(simulation)) < 1e-6
    steps(simulation, 49)
    assert np.linalg.norm(moved(simulation)) == pytest.approx(0.004, rel=1e-5)


def test_a_step_that_is_undone_leaves_the_phase_right():
    simulation, other = (simulate(node_count=300, motion=BOTH) for _ in range(2))
    for step in range(30):
        undone = step in (10, 11, 12)
        before = moved(simulation)
        simulation.set_wrench("probe", TIP, [0, 0, 1e7 * undone])
        simulation.step()
        other.step()
        np.testing.assert_array_equal(moved(simulation), before if undone else moved(other))
    assert simulation.faults == 3 and simulation.time == other.time
    steps(simulation, 30), steps(other, 30)
    np.testing.assert_allclose(simulation.state().positions, other.state().positions, atol=3e-5)


def test_a_reset_begins_with_the_phases_of_the_config_and_tissue_at_rest_there():
    config = dataclasses.replace(BOTH, breathing_phase=0.3, heartbeat_phase=0.2)
    simulation = simulate(node_count=300, motion=config)

    def look():
        state = simulation.state()
        return state.positions.tobytes(), state.F.tobytes(), simulation.motion.phases.tobytes()

    first = look()
    offset = (0.004 * breath_share(0.3, 1.0) + 0.002 * beat_share(0.2, 1.0)) * WAY
    np.testing.assert_allclose(
        simulation.state().positions - simulation.state().rest, np.tile(offset, (len(simulation.nodes), 1)), atol=2e-8
    )
    steps(simulation, 20)
    later = look()
    simulation.reset()
    assert look() == first
    steps(simulation, 20)
    assert look() == later


def test_tissue_of_another_material_goes_on_in_the_phase():
    simulation = simulate(node_count=300, motion=BOTH)
    steps(simulation, 30)
    stiffer = simulate(node_count=300, motion=BOTH, young_modulus=2e4)
    assert stiffer.continue_from(simulation)
    np.testing.assert_array_equal(moved(stiffer), moved(simulation))
    simulation.step(), stiffer.step()
    np.testing.assert_array_equal(moved(stiffer), moved(simulation))


def test_copies_are_the_same_as_one_alone_each_in_its_phase():
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=300))
    config = PhysicsConfig(device="cpu", node_count=300, motion=BOTH)
    phases = np.random.default_rng(0).uniform(size=(3, 2))

    def run(chosen: slice) -> tuple[torch.Tensor, ...]:
        batch = TissueBatch(nodes, config, len(phases[chosen]))
        means, covars = batch.append_skinning(Skinning(curved_sheet(), nodes.rest, device="cpu"))
        batch.reset(slice(None), phases[chosen])
        batch.tools.grasp_points[:, 0] = torch.from_numpy(TIP)
        batch.tools.forces[:, 0, 2] = 0.1
        for _ in range(12):
            batch.step()
        return batch.displacements, batch.F, batch.positions(), means, covars

    together = run(slice(None))
    for b in range(3):
        alone = run(slice(b, b + 1))
        assert all(torch.equal(all_of[b], own[0]) for all_of, own in zip(together, alone))
    assert not torch.equal(together[2][0], together[2][1])


def test_a_copy_that_begins_anew_while_the_motion_fades_fades_with_the_others():
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=300))
    config = PhysicsConfig(device="cpu", node_count=300, motion=MotionConfig(breathing=0.02, breathing_phase=0.45))
    batch = TissueBatch(nodes, config, 3)
    batch.step()
    batch.solver.motion.change(MotionConfig(breathing_phase=0.45))
    batch.step()
    batch.reset(torch.tensor([1]))
    batch.step()
    held = batch.positions()[:, torch.from_numpy(nodes.pinned)] - torch.from_numpy(nodes.rest[nodes.pinned]).float()
    moved = held.norm(dim=-1).mean(1)
    assert (moved / moved[0] - 1).abs().max() < 0.1 and moved[0] > 0.01


def test_skinning_within_the_step_is_that_of_the_state():
    model = curved_sheet()
    nodes = build_control_nodes(model, EYE, PhysicsConfig(node_count=300))
    batch = TissueBatch(nodes, PhysicsConfig(device="cpu", node_count=300, motion=BOTH), 1)
    skinning = Skinning(model, nodes.rest, device="cpu")
    means, covars = batch.append_skinning(skinning)
    for _ in range(20):
        batch.step()
    F = torch.where(torch.from_numpy(nodes.pinned)[:, None, None], torch.eye(3), batch.F[0])
    assert all(torch.equal(a, b[0]) for a, b in zip(skinning.deform(batch.positions()[0], F), (means, covars)))
    assert (means[0] - model.means).norm(dim=1).min() > 0.001  # all of it moves, also beside what is held


@pytest.mark.parametrize(
    "motion, sentence",
    [
        ({"breathing": float("nan")}, "must be finite"),
        ({"breathing_period": -4.0}, "must lie in"),
        ({"direction_x": 0.0, "direction_z": 0.0}, "points somewhere"),
        ({"direction_x": 1e-200, "direction_z": 0.0}, "points somewhere"),
        ({"breathing": 0.02, "heartbeat": 0.01}, "more travel"),
    ],
)
def test_motion_that_cannot_be_is_refused_and_changes_nothing(motion, sentence):
    simulation = simulate(node_count=300, motion=BREATH)
    with pytest.raises(ValueError, match=sentence):
        simulation.set_motion(dataclasses.replace(BREATH, **motion))
    assert simulation.solver.motion.config == BREATH


def test_the_fastest_motion_that_can_be_asked_for_is_no_fault():
    fastest = MotionConfig(breathing=0.03, breathing_period=0.5, heartbeat=0.01, heartbeat_period=0.2)
    simulation = simulate(node_count=300, motion=fastest, travel=0.08)
    steps(simulation, 50)
    assert simulation.faults == 0
