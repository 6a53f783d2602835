"""The solver: the same bits again, both implementations alike, recovery, rest."""

import contextlib
import threading

import numpy as np
import pytest
import warp as wp
from tissue_scene import EYE, TIP, curved_sheet, depth_of_dent, pose_at, simulate, steps

from endo_sim_ros.core.device import init_warp
from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation, sample_farthest
from endo_sim_ros.physics.backends import cluster_division as cluster
from endo_sim_ros.physics.backends.cluster_kernels import make_step_kernel
from endo_sim_ros.physics.backends.plain_kernels import make_advance_kernel
from endo_sim_ros.physics.materials import MATERIALS
from endo_sim_ros.physics.stencils import Stencils

BACKENDS = {"vectorised": contextlib.nullcontext, "plain": compare_plain}


@pytest.mark.parametrize("kinematics", ["rest", "current"])
@pytest.mark.parametrize("material", MATERIALS)
def test_rest_state_stays_bit_identical_without_force(kinematics, material):
    simulation = simulate(kinematics=kinematics, material=material)
    steps(simulation, 3)
    state = simulation.state()
    np.testing.assert_array_equal(state.positions, state.rest)
    np.testing.assert_array_equal(state.F, np.tile(np.eye(3, dtype=np.float32), (len(state.F), 1, 1)))
    assert state.time == pytest.approx(0.12) and state.positions.dtype == np.float32


@pytest.mark.slow
@pytest.mark.parametrize(
    "material", [name if name == "neo_hookean" else pytest.param(name, marks=pytest.mark.thorough) for name in MATERIALS]
)
def test_kernels_for_gpus_compile_without_one(material, tmp_path):
    init_warp()
    for kernel, arch in ((make_advance_kernel(material, "rest"), 75), (make_step_kernel(material, 4, 16), 90)):  # clusters are of sm_90
        wp.compile_aot_module(kernel.module, arch=arch, module_dir=tmp_path / str(arch), use_ptx=True)
        assert list((tmp_path / str(arch)).glob("*.ptx"))


@pytest.mark.slow
@pytest.mark.parametrize("count, blocks", [(20, 1), (20, 16), (700, 4), (2000, 8), (2000, 16), (4000, 16)])
def test_blocks_of_a_cluster_add_up_what_all_nodes_give_to_a_grid_node(count, blocks):
    solver = simulate(node_count=count).solver
    corners = Stencils(solver.rest_cells, solver.grid_shape).corners()
    division = cluster.divide(solver.rest_cells, corners, blocks)
    given = np.random.default_rng(0).normal(size=corners.shape)
    expected = np.zeros(corners.max() + 1)
    np.add.at(expected, corners, given)
    assert sorted(division.nodes[division.nodes >= 0]) == list(range(len(corners)))
    patch = division.addends.shape[2]
    inboxes = np.zeros((blocks, division.inbox))
    for nodes, slots, sums, inbox in zip(division.nodes, division.slot_of, division.sums.reshape(blocks, -1, 4), inboxes):
        memory = np.zeros(division.slots)
        memory[slots[nodes >= 0]] = given[nodes[nodes >= 0]]
        assert not memory[-1] and len(np.unique(slots[nodes >= 0])) == 27 * (nodes >= 0).sum()
        for thread, (_, _, sharing, g) in enumerate(sums):
            if g >= 0:
                threads = sums[thread : thread + cluster.BANKS * sharing : cluster.BANKS]
                inbox[g] = sum(memory[begin : end : cluster.WARP].sum() for begin, end, _, _ in threads)
    totals = inboxes[:, :patch].copy()
    for block, outgoing in enumerate(division.outgoing.reshape(blocks, -1, 3)):
        for g, other, place in outgoing[outgoing[:, 0] >= 0]:
            assert other != block and not inboxes[other, place]
            inboxes[other, place] = totals[block, g]
    np.testing.assert_array_equal((inboxes[:, patch:] != 0).sum(1), division.received)
    for nodes, corners_of, addends, inbox in zip(division.nodes, division.corners, division.addends, inboxes):
        totals = inbox[addends].sum(0)
        np.testing.assert_allclose(totals[corners_of[nodes >= 0]], expected[corners[nodes[nodes >= 0]]], atol=1e-12)


def test_more_nodes_than_a_cluster_holds_are_not_divided():
    solver = simulate(curved_sheet(20_000), node_count=8000).solver
    corners = Stencils(solver.rest_cells, solver.grid_shape).corners()
    assert all(cluster.divide(solver.rest_cells, corners, blocks) is None for blocks in cluster.CLUSTERS)


def test_few_environments_are_shared_by_many_blocks_and_many_by_few():
    assert [cluster.by_preference(environments, 132)[0] for environments in (1, 4, 8, 16, 64)] == [16, 16, 8, 4, 1]
    for environments in (1, 8, 1024):
        assert sorted(cluster.by_preference(environments, 132)) == sorted(cluster.CLUSTERS)


@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_same_inputs_give_the_same_bits_twice(kinematics):
    def run():
        simulation = simulate(kinematics=kinematics)
        simulation.set_wrench("probe", TIP, [0.1, 0.0, 0.2], [0.0, 0.0, 1e-4])
        steps(simulation, 4)
        return simulation

    first, second = run(), run()
    np.testing.assert_array_equal(first.state().positions, second.state().positions)
    np.testing.assert_array_equal(first.state().F, second.state().F)
    first.reset()
    first.set_wrench("probe", TIP, [0.1, 0.0, 0.2], [0.0, 0.0, 1e-4])
    steps(first, 4)
    np.testing.assert_array_equal(first.state().positions, second.state().positions)


@pytest.mark.slow
@pytest.mark.parametrize("kinematics", ["rest", "current"])
@pytest.mark.parametrize("material", MATERIALS)
def test_backends_agree_on_everything_that_acts_at_once(kinematics, material):
    """The kernels that a GPU runs, here on the CPU, and those for a CPU: what is in both is the update of control nodes."""
    states, kinds = [], set()
    for backend in BACKENDS.values():
        with backend():
            simulation = simulate(
                kinematics=kinematics, material=material, contact_radius=0.006, relaxation=0.5, gravity_z=0.5,
                regions=("sphere 0 0 0.12 0.02 young_modulus=20000",),
            )  # fmt: skip
        kinds.add(type(simulation.solver.backend))
        assert simulation.set_wrench("pull", TIP - [0.03, 0, 0], [0.1, 0.0, -0.3])
        assert simulation.set_grasp("grip", pose_at(TIP + [0.03, 0, 0]), True)
        for step in range(6):
            simulation.set_grasp("grip", pose_at(TIP + [0.03, 0, -0.001 * step]), True)
            simulation.set_grasp("probe", pose_at(TIP + [0, 0, -0.006 + 0.0005 * step]), False)
            simulation.step()
        state = simulation.state()
        reactions = [np.concatenate(simulation.reaction(tool)) for tool in ("pull", "grip", "probe")]
        states.append((state.positions - state.rest, state.F, np.array(reactions)))
    assert len(kinds) == len(BACKENDS)
    assert np.abs(states[0][0]).max() > 3e-3 and states[0][2][2, 2] < -0.01
    np.testing.assert_allclose(states[1][0], states[0][0], atol=1e-6)
    np.testing.assert_allclose(states[1][1], states[0][1], atol=2e-4)
    np.testing.assert_allclose(states[1][2], states[0][2], atol=1e-3)


def test_inverted_tissue_recovers_with_every_backend():
    """Near-singular and inverted F take the decomposition instead of the iteration."""
    ends, chosen = [], np.random.default_rng(6).permutation(300)[:20]
    for backend in BACKENDS.values():
        with backend():
            simulation = simulate(node_count=300, damping=200.0)
        F = simulation.solver.deformation_gradients()
        F[chosen] = np.float32(np.diag([1.0, 1.0, -0.3]))
        F[chosen[:4]] = 0.0
        simulation.solver.state.F.assign(F)
        simulation.disturbed = True
        steps(simulation, 3)
        assert simulation.faults == 0
        ends.append(simulation.state().positions)
    np.testing.assert_allclose(ends[1], ends[0], atol=2e-5)


def test_moving_the_scene_by_metres_changes_nothing():
    dents = []
    for offset in ((0.0, 0.0, 0.0), (2.0, -4.0, 3.0)):
        simulation = simulate(curved_sheet(offset=offset), np.array(offset))
        simulation.set_wrench("probe", TIP + offset, [0.0, 0.0, 0.2])
        steps(simulation, 5)
        state = simulation.state()
        dents.append(state.positions.astype(np.float64) - state.rest)
    np.testing.assert_allclose(dents[1], dents[0], atol=2e-6)
    assert np.abs(dents[0]).max() > 5e-4


@pytest.mark.slow
def test_printed_skin_only_method_and_dense_baseline_run():
    printed = simulate(layers=0, kinematics="current")
    dense = TissueSimulation(curved_sheet(), EYE, PhysicsConfig.baseline(device="cpu"))
    assert len(printed.nodes) == 1000 and len(dense.nodes) == 3000
    for simulation in (printed, dense):
        assert simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.002])
        steps(simulation, 3)
        assert 1e-5 < depth_of_dent(simulation) < 0.02
        assert simulation.faults == 0


def test_tissue_that_came_to_rest_is_not_stepped_until_a_tool_acts():
    simulation = simulate()
    calls, step = [], simulation.solver.step
    simulation.solver.step = lambda: calls.append(1) or step()
    steps(simulation, 3)
    assert not calls and simulation.time == pytest.approx(3 * simulation.step_duration)
    simulation.set_wrench("PSM1", TIP, [0, 0, 0.1])
    simulation.step()
    simulation.set_wrench("PSM1", TIP, [0, 0, 0])
    steps(simulation, 200)
    assert 4 < len(calls) < 100
    assert depth_of_dent(simulation) < 2e-5


@pytest.mark.slow
def test_tissue_can_be_built_in_one_thread_while_other_tissue_begins_to_move_in_another():
    points = np.random.default_rng(0).normal(size=(2000, 3))
    expected, wrong, done = sample_farthest(points, 40), [], threading.Event()

    def sample():
        while not done.is_set():
            try:
                np.testing.assert_array_equal(sample_farthest(points, 40), expected)
            except BaseException as error:
                wrong.append(error)
                return

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        for _ in range(20):
            simulation = simulate(node_count=60, layers=1)
            simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.01])
            simulation.step()  # the first one prepares the launches
    finally:
        done.set()
        thread.join()
    assert not wrong
