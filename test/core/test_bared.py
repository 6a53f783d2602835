"""What others hide has another colour once tissue is strained."""

import dataclasses

import numpy as np
import pytest
import torch
from plyfile import PlyData
from test_rendering import CAMERA, CPU, IDENTITY, NODES, sheet

from endo_sim_ros.core.cameras import make_pose
from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel, ModelError, load_ply, save_ply
from endo_sim_ros.physics import Skinning
from endo_sim_ros.rendering import DeformableRenderer

STRETCH = np.diag([1.0, 1.25, 1.0]).astype(np.float32)  # strains by 0.28


def bared(degree: int = 0) -> GaussianModel:
    """A colourful sheet that grows grey, whatever it was."""
    model = sheet(degree)
    return dataclasses.replace(model, bared=-model.sh[:, 0])


def drawn(model: GaussianModel, F: np.ndarray, spots: list[DyedSpot] | None = None) -> np.ndarray:
    """The picture of a sheet all of which is deformed alike."""
    renderer = DeformableRenderer(model, NODES, CPU)
    renderer.dye(spots or [])
    return renderer.render(CAMERA, NODES @ F.T, np.tile(F, (len(NODES), 1, 1)))[0]


@pytest.mark.parametrize("degree", [0, 2])
def test_at_rest_nothing_of_it_is_seen_and_in_strained_tissue_all(degree):
    model = bared(degree)
    plain = dataclasses.replace(model, bared=None)
    renderers = [DeformableRenderer(each, NODES, CPU) for each in (model, plain)]
    for state in ((), (NODES, IDENTITY)):
        np.testing.assert_array_equal(*(renderer.render(CAMERA, *state)[0] for renderer in renderers))
    sh = plain.sh.clone()
    sh[:, 0] = 0
    np.testing.assert_array_equal(drawn(model, STRETCH), drawn(dataclasses.replace(plain, sh=sh), STRETCH))
    assert np.abs(drawn(model, STRETCH).astype(int) - drawn(plain, STRETCH)).mean() > 5


def test_little_strain_shows_little_of_it_and_a_turn_nothing():
    model = bared()
    plain = dataclasses.replace(model, bared=None)
    breath = np.diag([1.0, 1.05, 1.0]).astype(np.float32)
    turn = make_pose([0, 0, 0], [1, 0.03, -0.02, 0.05])[:3, :3].astype(np.float32)
    changes = [np.abs(drawn(model, F).astype(int) - drawn(plain, F)).mean() for F in (STRETCH, breath, turn)]
    assert changes[1] < 0.1 * changes[0] and changes[2] < 0.01


def test_strains_are_those_of_green():
    skinning = Skinning(sheet(), NODES, device="cpu")
    assert not skinning.strains(torch.from_numpy(IDENTITY)).any()
    shear = np.array([[1, 0.4, 0], [0, 1.1, 0], [0, 0.2, 0.9]], np.float32)
    F = torch.from_numpy(np.stack([np.tile(each, (len(NODES), 1, 1)) for each in (shear, np.eye(3, dtype=np.float32))]))
    expected = np.linalg.norm(shear.T @ shear - np.eye(3)) / 2
    np.testing.assert_allclose(skinning.strains(F), [[expected] * 4000, [0] * 4000], rtol=1e-5)
    assert torch.equal(skinning.strains(F[0]), skinning.strains(F)[0])


def test_what_is_beside_strained_tissue_may_have_been_under_it():
    skinning = Skinning(sheet(), NODES, device="cpu")
    F = torch.from_numpy(np.tile(np.eye(3, dtype=np.float32), (len(NODES), 1, 1)))
    F[7] = torch.from_numpy(STRETCH)
    follows = ((skinning.neighbours == 7) & (skinning.weights > 0)).any(1)
    assert 0 < follows.sum() < len(follows)
    np.testing.assert_allclose(skinning.strains(F), np.where(follows, 0.28125, 0), rtol=1e-5)


def test_dye_is_seen_in_strained_tissue():
    everywhere = [DyedSpot(np.array([0.0, 0.0, 0.1]), 1.0)]
    model = bared()
    plain = dataclasses.replace(model, bared=None)
    assert np.abs(drawn(model, STRETCH, everywhere).astype(int) - drawn(plain, STRETCH, everywhere)).max() <= 1


def test_flesh_in_cuts_keeps_its_colour():
    renderer = DeformableRenderer(bared(), NODES, CPU)
    corners = np.array([[-0.03, 0, 0.09], [0.03, 0, 0.09], [0.03, 0, 0.12], [-0.03, 0, 0.12]])
    renderer.cut(corners[[[0, 1, 2], [0, 2, 3]]])
    flesh = renderer.model.select(slice(4000, None))
    assert flesh.bared is not None and not flesh.bared.any()
    renderer.render(CAMERA, NODES @ STRETCH.T, np.tile(STRETCH, (len(NODES), 1, 1)))


@pytest.mark.parametrize("name, error", [("m.ply", 0.0), ("m.compressed.ply", 0.5 / 32)])
def test_files_keep_it(tmp_path, name, error):
    model = bared()
    model.bared[::2] = 0
    save_ply(model, tmp_path / name)
    found = load_ply(tmp_path / name)
    same = torch.cdist(model.means.double(), found.means.double()).argmin(1)  # a compressed model has another order
    assert found.bared is not None
    assert (found.bared[same] - model.bared).abs().max() <= error + 1e-6 and not found.bared[same][::2].any()
    model.bared[7, 1] = torch.nan
    with pytest.raises(ModelError, match="bared is not finite in 1 Gaussians"):
        save_ply(model, tmp_path / ("other-" + name))


def test_other_programs_find_the_same_vertices(tmp_path):
    model = bared()
    save_ply(model, tmp_path / "bared.ply")
    save_ply(dataclasses.replace(model, bared=None), tmp_path / "plain.ply")
    vertices = [PlyData.read(tmp_path / f"{name}.ply")["vertex"].data for name in ("bared", "plain")]
    assert vertices[0].dtype == vertices[1].dtype and (vertices[0] == vertices[1]).all()
    assert load_ply(tmp_path / "plain.ply").bared is None
    np.testing.assert_allclose(vertices[0]["f_dc_0"] * SH_C0 + 0.5, model.sh[:, 0, 0] * SH_C0 + 0.5)
