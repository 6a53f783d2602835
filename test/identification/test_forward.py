"""Copies of an experiment: they do what the simulation does, and differ by what is unknown."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from slab import FINER, HEAVY, NODES, PHYSICS, pressed

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.identification import Tracks, forward
from endo_sim_ros.identification.forward import Copy, ForwardModel
from endo_sim_ros.physics import Skinning, TissueBatch

ONES = np.ones(len(NODES))
CAMERA = Camera(intrinsic_matrix(300.0, 300.0, 128.0, 102.0), 256, 204, np.eye(4))


@pytest.fixture(scope="module")
def model() -> ForwardModel:
    return ForwardModel(NODES, PHYSICS, "cpu")


def test_forces_are_proportional_to_the_modulus(model):
    soft, stiff = model.replay(pressed(), [Copy(ONES, ONES), Copy(2 * ONES, ONES)]).forces
    assert np.linalg.norm(soft, axis=1).max() > 0.2
    assert np.abs(stiff - 2 * soft).max() < 0.03 * np.abs(stiff).max()  # pressed so slowly, inertia is nothing


def test_copies_with_other_options_and_shifts_differ(model):
    nearer = Copy(ONES, ONES, (), np.array([0, 0, 0.001]))
    wet = Copy(ONES, ONES, (("poisson_ratio", 0.45),))
    plain, deeper, stiffer = np.abs(model.replay(pressed(), [Copy(ONES, ONES), nearer, wet]).forces).max((1, 2))
    assert deeper > 1.1 * plain and stiffer > 1.1 * plain


def test_tissue_that_is_held_less_gives_way_more(model):
    loose = np.where(NODES.pinned, 1e-3, 1.0)
    held, moved = np.abs(model.replay(pressed(), [Copy(ONES, ONES), Copy(ONES, loose)]).forces).max((1, 2))
    assert moved < 0.9 * held


def test_tracked_points_move_as_gaussians_do(model):
    rest = np.array([[0.001, 0.002, 0.1], [0.011, -0.004, 0.1]])
    experiment = replace(pressed(), tracks=[Tracks(rest, np.array([12]), np.zeros((1, 2, 2)), [CAMERA])])
    model.replan()  # others needed more substeps
    pixels = model.replay(experiment, [Copy(ONES, ONES)]).pixels[0][0, 0]
    batch = TissueBatch(NODES, PHYSICS, 1)
    batch.tools.present[:] = 1
    batch.tools.rotations[:] = torch.eye(3, dtype=torch.float64)
    for tip in experiment.tips[:13]:
        batch.tools.tips[:] = torch.from_numpy(tip)
        batch.step()
    gaussians = GaussianModel(
        torch.from_numpy(rest).float(), torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), -6.0), torch.zeros(2), torch.zeros(2, 1, 3)
    )
    means, _ = Skinning(gaussians, NODES.rest, device="cpu").deform(batch.positions()[0], batch.F[0])
    assert np.abs(pixels - CAMERA.project(means.numpy().astype(float))[0]).max() < 0.1  # whose steps have other substeps
    assert np.abs(pixels - CAMERA.project(rest)[0]).max() > 1.0


def test_a_press_that_begins_in_the_tissue_is_felt_as_one_that_comes_from_the_air(model):
    whole, begin = pressed(steps=40), 8
    parts = {name: getattr(whole, name)[begin:] for name in ("tips", "rotations", "present", "closed", "forces")}
    expected, felt = (np.linalg.norm(model.replay(each, [Copy(ONES, ONES)]).forces[0], axis=1) for each in (whole, replace(whole, **parts)))
    assert expected[begin] > 0.1 * expected.max()
    assert np.abs(felt - expected[begin:]).max() < 0.05 * expected.max()


@pytest.mark.parametrize("room", [1 << 20, 0])
def test_what_a_copy_did_is_not_simulated_again_while_there_is_room(room, monkeypatch):
    monkeypatch.setattr(forward, "_REMEMBERED", room)
    press = replace(pressed(steps=8), displacements=np.zeros((8, 1, 3)), nodes=np.array([40]))
    model, plain, deeper = ForwardModel(NODES, HEAVY, "cpu", FINER), Copy(ONES, ONES), Copy(ONES, ONES, (), np.array([0, 0, 0.001]))
    first = model.replay(press, [plain, deeper], 1)
    steps = model.steps
    again = model.replay(press, [plain, deeper, plain], 1)
    assert model.steps == (steps if room else 2 * steps)
    for name in ("forces", "displacements"):
        found = getattr(again, name)
        np.testing.assert_array_equal(found[:2], getattr(first, name))
        np.testing.assert_array_equal(found[2], found[0])
        assert not np.array_equal(found[0], found[1])
    steps = model.steps
    model.replay(replace(press, tips=press.tips + [0, 0, 0.001]), [plain], 1)
    assert model.steps > steps
