"""Physics and skinning on a GPU as on the CPU. Skipped where there is none."""

import numpy as np
import pytest
import torch
from dense_sheet import sheet
from instrument_scene import Instrument

from endo_sim_ros.physics import PhysicsConfig, Skinning, TissueBatch, TissueSimulation, ToolLinks, build_control_nodes
from endo_sim_ros.physics.backends import cuda
from endo_sim_ros.physics.materials import MATERIALS

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]
TIP = np.array([0.0, 0.0, 0.12])


def test_prepared_tissue_has_nothing_left_to_make_ready_when_it_is_first_touched(monkeypatch):
    simulation = TissueSimulation(sheet(), np.zeros(3), PhysicsConfig(device="cuda", node_count=500))
    simulation.prepare()
    monkeypatch.setattr(cuda.wp, "load_module", lambda *_, **__: pytest.fail("kernels are loaded only now"))
    monkeypatch.setattr(cuda.wp, "ScopedCapture", lambda *_, **__: pytest.fail("the step is captured only now"))
    assert simulation.set_wrench("pull", TIP, [0.0, 0.0, -0.3])
    simulation.step()
    assert np.abs(simulation.state().positions - simulation.nodes.rest).max() > 1e-6


def touch(device: str, **overrides) -> tuple[TissueSimulation, dict[str, np.ndarray]]:
    """Pull with a wrench, lift with a jaw, press with a rod and cut, all at once; the end, and all that was felt."""
    config = PhysicsConfig(**{"device": device, "node_count": 2000, "contact_radius": 0.006, "blade_length": 0.03, **overrides})
    simulation, felt = TissueSimulation(sheet(), np.zeros(3), config), []
    pose = np.eye(4)
    assert simulation.set_wrench("pull", TIP - [0.04, 0, 0], [0.1, 0.0, -0.3])
    for step in range(10):
        pose[:3, 3] = TIP + [0.04, 0, -0.0008 * step]
        assert simulation.set_grasp("grip", pose, True)
        pose[:3, 3] = TIP + [0, 0, -0.006 + 0.0005 * step]
        simulation.set_grasp("press", pose, False)
        pose[:3, 3] = 0.02, -0.03 + 0.005 * step, 0.15
        if config.kinematics == "rest":
            simulation.set_cut("knife", pose, True)
        simulation.step()
        felt.append(np.concatenate([simulation.reaction(tool) for tool in ("pull", "grip", "press")]))
    assert simulation.faults == 0 and (len(simulation.cuts) > 0) == (config.kinematics == "rest")
    state = simulation.state()
    return simulation, {"positions": state.positions, "F": state.F, "felt": np.array(felt)}


@pytest.mark.parametrize("kinematics", ["rest", "current"])
@pytest.mark.parametrize("material", MATERIALS)
def test_physics_agrees_step_for_step(kinematics, material):
    options = {"kinematics": kinematics, "material": material, "relaxation": 0.5}
    (simulation, cpu), (_, cuda) = touch("cpu", **options), touch("cuda", **options)
    moved = np.abs(cpu["positions"] - simulation.nodes.rest).max()
    assert moved > 2e-3
    np.testing.assert_allclose(cuda["positions"], cpu["positions"], atol=2e-3 * moved)
    np.testing.assert_allclose(cuda["F"], cpu["F"], atol=5e-3)
    np.testing.assert_allclose(cuda["felt"], cpu["felt"], atol=0.01 * np.abs(cpu["felt"]).max())


def test_copies_are_cut_each_on_its_own_and_what_is_whole_has_the_bits_of_whole_tissue():
    nodes = build_control_nodes(sheet(), np.zeros(3), PhysicsConfig(node_count=1000))

    def play(device: str, cutters: list[float | None]) -> tuple[TissueBatch, np.ndarray]:
        config = PhysicsConfig(device=device, node_count=1000, blade_length=0.03)
        batch, seen = TissueBatch(nodes, config, len(cutters), 2, own_cuts=True), []
        batch.tools.rotations[:] = torch.eye(3, device=batch.solver.device)
        batch.tools.present[:, 0] = batch.tools.closed[:, 0] = 1
        for step in range(10):
            poses = np.tile(np.eye(4), (len(cutters), 2, 1, 1))
            poses[:, 0, :3, 3] = TIP - [0.015 + 0.0005 * step, 0, 0]
            poses[:, 1, :3, 3] = [[0.0, (at or 0.0) + 0.003 * step, 0.14] for at in cutters]
            batch.move_edges(poses, np.array([[False, at is not None] for at in cutters]))
            batch.tools.tips[:] = torch.from_numpy(poses[..., :3, 3]).to(batch.tools.tips)
            batch.step()
            seen.append(batch.displacements.cpu().numpy().copy())
        return batch, np.array(seen)

    cutters = [None, -0.015, None, 0.0]
    (batch, cuda), (_, cpu), (_, whole) = play("cuda", cutters), play("cpu", cutters), play("cuda", [None] * 4)
    moved = np.abs(cpu).max()
    assert moved > 2e-3 and [len(batch.cuts(b)) > 0 for b in range(4)] == [False, True, False, True]
    np.testing.assert_allclose(cuda, cpu, atol=5e-3 * moved)
    np.testing.assert_array_equal(cuda[:, [0, 2]], whole[:, [0, 2]])
    assert np.abs(cuda[:, 1] - whole[:, 1]).max() > 0.05 * moved
    batch.reset(torch.tensor([1], device="cuda"))
    assert not len(batch.cuts(1)) and len(batch.cuts(3)) and not batch.displacements[1].any()


@pytest.mark.parametrize("count", [700, 2000, 4000])
def test_blocks_that_share_the_tissue_agree_with_launches_for_each_substep(count, monkeypatch):
    one, few = touch("cuda", node_count=count, relaxation=0.5)
    monkeypatch.setattr(cuda.cluster, "divide", lambda *arguments: None)
    many = touch("cuda", node_count=count, relaxation=0.5)[1]
    np.testing.assert_allclose(few["positions"], many["positions"], atol=2e-3 * np.abs(many["positions"] - one.nodes.rest).max())
    np.testing.assert_allclose(few["felt"], many["felt"], atol=2e-2 * np.abs(many["felt"]).max())


def press_and_pull(device: str, **overrides) -> tuple[TissueSimulation, dict[str, np.ndarray]]:
    """Press with an instrument, close its jaws, pull until tissue slips, while the shaft of another lies on the tissue."""
    config = PhysicsConfig(**{"device": device, "node_count": 2000, "grip_force": 1.0, **overrides})
    simulation, instrument, felt = TissueSimulation(sheet(), np.zeros(3), config), Instrument("PROGRASP_FORCEPS"), []
    for tool in ("grip", "lie"):
        simulation.set_instrument(tool, instrument.capsules)
    for step in range(16):
        deep = min(step, 5) - 2.0 * max(step - 6, 0)
        pose, links = instrument.at(TIP + [0, 0, -0.02 + 0.001 * deep], 0.0, 0.6 if step < 6 else 0.0)
        simulation.set_grasp("grip", pose, step == 6 or step > 6 and simulation.in_reach("grip"), links)
        pose, links = instrument.at(TIP + [0.0, 0.03, -0.004 + 0.0004 * step], np.pi / 2)
        simulation.set_grasp("lie", pose, False, links)
        simulation.step()
        felt.append(np.concatenate([*simulation.reaction("grip"), *simulation.reaction("lie"), [len(simulation.held_nodes("grip"))]]))
    assert simulation.faults == 0
    state = simulation.state()
    return simulation, {"positions": state.positions, "F": state.F, "felt": np.array(felt)}


@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_instruments_agree_step_for_step(kinematics):
    (simulation, cpu), (_, cuda) = press_and_pull("cpu", kinematics=kinematics), press_and_pull("cuda", kinematics=kinematics)
    moved = np.abs(cpu["positions"] - simulation.nodes.rest).max()
    assert moved > 2e-3 and simulation.slips + cpu["felt"][6, -1] > 0
    np.testing.assert_allclose(cuda["positions"], cpu["positions"], atol=5e-3 * moved)
    np.testing.assert_allclose(cuda["felt"][:, :12], cpu["felt"][:, :12], atol=0.02 * np.abs(cpu["felt"][:, :12]).max())
    np.testing.assert_allclose(cuda["felt"][:, -1], cpu["felt"][:, -1], atol=1)


def test_instruments_give_the_same_bits_twice_and_in_blocks_what_they_give_in_launches(monkeypatch):
    (one, first), (_, second) = press_and_pull("cuda"), press_and_pull("cuda")
    for name, values in first.items():
        np.testing.assert_array_equal(second[name], values, err_msg=name)
    monkeypatch.setattr(cuda.cluster, "divide", lambda *arguments: None)
    many = press_and_pull("cuda")[1]
    np.testing.assert_allclose(first["positions"], many["positions"], atol=5e-3 * np.abs(many["positions"] - one.nodes.rest).max())
    np.testing.assert_allclose(first["felt"][:, :12], many["felt"][:, :12], atol=2e-2 * np.abs(many["felt"][:, :12]).max())


def test_a_batch_takes_the_links_of_all_its_copies_without_waiting():
    config, instrument, count = PhysicsConfig(device="cuda", node_count=1000), Instrument(), 16
    nodes, links = build_control_nodes(sheet(), np.zeros(3), config), ToolLinks(instrument.capsules)
    batch = TissueBatch(nodes, config, environments=count, capsules=len(links))
    for step in range(6):
        at = [instrument.at(TIP + [0, 0, -0.014 + 0.001 * step + 0.0002 * b]) for b in range(count)]
        poses = torch.from_numpy(np.stack([[each[name] for name in links.links] for _, each in at])).cuda()
        tips = torch.from_numpy(np.stack([pose for pose, _ in at])).cuda()
        batch.tools.set_links(0, links, poses)
        batch.tools.tips[:, 0], batch.tools.rotations[:, 0] = tips[:, :3, 3], tips[:, :3, :3]
        batch.tools.present[:] = 1
        batch.step()
    pushes = -batch.tools.reaction_forces[:, 0, 2]
    assert not batch.tools.faults.any() and bool((pushes[1:] > pushes[:-1]).all()) and float(pushes[-1]) > 0.05


def test_the_same_touches_give_the_same_bits_twice():
    (_, first), (_, second) = touch("cuda"), touch("cuda")
    for name, values in first.items():
        np.testing.assert_array_equal(second[name], values, err_msg=name)


def test_many_environments_agree_with_one_and_faults_stay_in_theirs():
    config, count = PhysicsConfig(device="cuda", node_count=1000), 64
    nodes = build_control_nodes(sheet(), np.zeros(3), config)
    batch = TissueBatch(nodes, config, environments=count, tools=2)
    skinning = Skinning(sheet(), nodes.rest, device="cuda")
    means, covars = batch.append_skinning(skinning)
    batch.tools.grasp_points[:, 0] = torch.from_numpy(TIP)
    batch.tools.forces[:, 0, 2] = torch.linspace(0.0, 0.3, count, dtype=torch.float64)
    batch.tools.forces[7, 0, 2] = 1e7
    for _ in range(5):
        batch.step()
    assert batch.tools.faults.tolist() == [5 * (b == 7) for b in range(count)]
    assert batch.displacements.isfinite().all() and not batch.displacements[0].any()
    depths = batch.displacements.norm(dim=2).amax(1)
    assert bool((depths[8:] > depths[7:-1]).all())
    single = TissueBatch(nodes, config, environments=1, tools=2)
    single.tools.grasp_points[:, 0] = torch.from_numpy(TIP)
    single.tools.forces[:, 0, 2] = 0.3
    for _ in range(5):
        single.step()
    # One is shared by more blocks than each of many, which add up in another order.
    torch.testing.assert_close(single.displacements[0], batch.displacements[-1], atol=1e-7, rtol=0)
    pinned = torch.from_numpy(nodes.pinned).cuda()[:, None, None]
    expected = skinning.deform(batch.positions()[-1], torch.where(pinned, torch.eye(3, device="cuda"), batch.F[-1]))
    torch.testing.assert_close(means[-1], expected[0], atol=1e-7, rtol=0)
    torch.testing.assert_close(covars[-1], expected[1], atol=1e-10, rtol=1e-4)
    batch.reset(torch.arange(0, count, 2, device="cuda"))
    assert not batch.displacements[::2].any() and bool(batch.displacements[9].any())


def test_commands_written_on_a_side_stream_reach_the_next_step():
    config = PhysicsConfig(device="cuda", node_count=400)
    batch = TissueBatch(build_control_nodes(sheet(), np.zeros(3), config), config, environments=4)
    with torch.cuda.stream(torch.cuda.Stream()):
        for step in range(20):
            batch.tools.grasp_points[:, 0] = torch.from_numpy(TIP)
            batch.tools.forces[:, 0, 2] = 0.01 * (step + 1)
            batch.step()
            reactions = batch.tools.reaction_forces[:, 0, 2].clone()
            torch.testing.assert_close(reactions, torch.full_like(reactions, -0.01 * (step + 1)), atol=1e-9, rtol=0)


def test_skinning_agrees():
    model, rng = sheet(), np.random.default_rng(0)
    rest = model.means[::10].numpy()
    positions = (rest + rng.normal(0, 1e-3, rest.shape)).astype(np.float32)
    F = (np.eye(3) + rng.normal(0, 0.1, (len(rest), 3, 3))).astype(np.float32)
    for weighting in ("compact", "softmax"):
        (m1, c1), (m2, c2) = (Skinning(model, rest, weighting=weighting, device=d).deform(positions, F) for d in ("cpu", "cuda"))
        torch.testing.assert_close(m2.cpu(), m1, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(c2.cpu(), c1, atol=1e-9, rtol=1e-3)
