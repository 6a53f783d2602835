"""Many copies of one tissue: independent, each with its own stiffness and faults."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from thorough import mostly_thorough
from tissue_scene import EYE, TIP, curved_sheet, steps

from endo_sim_ros.core.gaussians import save_ply
from endo_sim_ros.physics import PhysicsConfig, TissueBatch, TissueSimulation, build_control_nodes


@pytest.mark.slow
def test_environments_are_independent_copies_on_any_number_of_threads(monkeypatch):
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=400))
    config = PhysicsConfig(device="cpu", node_count=400)

    def run(threads: int):
        monkeypatch.setenv("ENDO_SIM_THREADS", str(threads))
        batch = TissueBatch(nodes, config, environments=5, tools=2, stiffness=[1.0, 1.0, 2.0, 1.0, 1.0])
        batch.tools.grasp_points[:, 0] = torch.from_numpy(TIP)
        batch.tools.forces[:, 0, 2] = torch.tensor([0.1, 0.2, 0.2, 0.0, 1e7])
        for _ in range(5):
            batch.step()
        return batch

    batch, other = run(1), run(3)
    assert torch.equal(batch.displacements, other.displacements) and torch.equal(batch.F, other.F)
    depths = batch.displacements.norm(dim=2).max(1).values
    assert depths[1] > 1.8 * depths[0] and depths[2] < 0.6 * depths[1]
    assert not batch.displacements[3].any() and torch.equal(batch.positions()[3], torch.from_numpy(nodes.rest))
    assert batch.tools.faults.tolist() == [0, 0, 0, 0, 5] and batch.displacements.isfinite().all()
    np.testing.assert_allclose(batch.tools.reaction_forces[:4, 0, 2], [-0.1, -0.2, -0.2, 0.0], atol=1e-12)
    single = TissueSimulation.from_nodes(nodes, config)  # with fewer substeps, as nothing in it is stiffer
    single.set_wrench("probe", TIP, [0.0, 0.0, 0.1])
    steps(single, 5)
    np.testing.assert_allclose(batch.positions()[0], single.state().positions, atol=0.03 * depths[0])
    assert not batch.tools.reaction_forces[4].any()  # its steps were undone, and what the wrench did
    batch.reset(torch.tensor([1, 4]))
    assert not batch.displacements[1].any() and batch.displacements[0].any() and batch.tools.faults[4] == 0


def test_copies_feel_their_own_stiffness_whatever_that_of_the_others():
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=400))
    felt = []
    for other in (1.0, 4.0):
        config = PhysicsConfig(device="cpu", node_count=400, substeps=80)
        batch = TissueBatch(nodes, config, environments=2, stiffness=[1.0, other])
        batch.tools.present[:], batch.tools.closed[:] = 1, 1
        batch.tools.rotations[:] = torch.eye(3)
        for lift in (0.0, 0.001, 0.002, 0.002):
            batch.tools.tips[:, 0] = torch.from_numpy(TIP - [0, 0, lift])
            batch.step()
        felt.append(batch.tools.reaction_forces[:, 0, 2].clone())
    assert felt[0][0] == felt[1][0] == felt[0][1] > 0.01
    assert felt[1][1] > 3 * felt[1][0]


@pytest.mark.parametrize("name", ["forces", "torques", "tips", "rotations"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_commands_that_are_not_finite_are_faults_of_their_copy(name, value):
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=300))
    batch = TissueBatch(nodes, PhysicsConfig(device="cpu", node_count=300, contact_radius=0.005), environments=2)
    batch.tools.grasp_points[:, 0] = torch.from_numpy(TIP)
    batch.tools.forces[:, 0, 2] = 0.1
    batch.tools.present[:] = 1
    batch.tools.rotations[:] = torch.eye(3)
    batch.step()
    before = batch.displacements[1].clone()
    getattr(batch.tools, name)[1] = value
    batch.step()
    assert batch.tools.faults.tolist() == [0, 1]
    assert torch.equal(batch.displacements[1], before) and not batch.tools.reaction_forces[1].any()
    assert batch.displacements[0].norm(dim=1).max() > before.norm(dim=1).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, printed", mostly_thorough([("TissueBatch(", r"0\.2000"), ("set_instrument", r"\] [1-9]")])
)  # nodes held; a reaction
def test_the_documented_code_runs(name, printed, tmp_path, monkeypatch, capsys):
    text = (Path(__file__).parents[2] / "docs" / "physics.md").read_text()
    (code,) = (block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if name in block)
    save_ply(curved_sheet(), tmp_path / "model.ply")
    monkeypatch.chdir(tmp_path)
    exec(code, {"__name__": "__main__"})
    told = capsys.readouterr().out
    assert re.search(printed, told), told
