"""The Gaussian model and its files."""

import numpy as np
import pytest
import torch
from plyfile import PlyData

from endo_sim_ros.gaussians import GaussianModel, ModelError, load_ply, save_ply


def model(n=20, degree=0):
    g = torch.Generator().manual_seed(0)
    r = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    return GaussianModel(r(n, 3), r(n, 4), r(n, 3), r(n), r(n, (degree + 1) ** 2, 3))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_round_trip_is_exact(tmp_path, degree):
    sent = model(degree=degree)
    save_ply(sent, tmp_path / "deep" / "model.ply")
    received = load_ply(tmp_path / "deep" / "model.ply")
    for name, value in sent.tensors().items():
        assert torch.equal(value, received.tensors()[name]), name
    assert received.sh_degree == degree
    assert list(tmp_path.rglob("*.part")) == []


def test_ply_has_the_layout_of_the_original_3dgs(tmp_path):
    sent = model(degree=1)
    save_ply(sent, tmp_path / "m.ply")
    header = (tmp_path / "m.ply").read_bytes()[:10_000].split(b"end_header")[0].decode()
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property float")]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:18] == [f"f_rest_{i}" for i in range(9)]
    assert names[18:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    vertex = PlyData.read(str(tmp_path / "m.ply"))["vertex"]
    np.testing.assert_array_equal(vertex["f_rest_0"], sent.sh[:, 1, 0])  # red first, then green, then blue
    np.testing.assert_array_equal(vertex["f_rest_3"], sent.sh[:, 1, 1])
    np.testing.assert_array_equal(vertex["rot_0"], sent.quats[:, 0])


def test_opacity_of_one_is_kept(tmp_path):
    sent = model()
    sent.logit_opacities[3] = float("inf")
    save_ply(sent, tmp_path / "m.ply")
    assert load_ply(tmp_path / "m.ply").opacities[3] == 1


@pytest.mark.parametrize(
    "damage, sentence",
    [
        (lambda data: b"", "not a readable PLY"),
        (lambda data: b"solid nothing", "not a readable PLY"),
        (lambda data: data[:-7], "not a readable PLY"),
        (lambda data: data.replace(b"property float opacity", b"property float opaqueY"), "missing field opacity"),
        (lambda data: data.replace(b"element vertex", b"element vortex"), "not a readable PLY"),
        (lambda data: data[:-4] + np.float32(np.nan).tobytes(), "quats of Gaussian 19 is not finite"),
    ],
)
def test_damaged_files_are_one_sentence_with_the_file_name(tmp_path, damage, sentence):
    path = tmp_path / "m.ply"
    save_ply(model(), path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ModelError, match=f"m.ply.*{sentence}"):
        load_ply(path)
    with pytest.raises(ModelError, match="absent.ply: no such file"):
        load_ply(tmp_path / "absent.ply")


def test_covariances_are_those_of_the_rotated_axes():
    sent = model()
    covariances = sent.covariances
    eigenvalues = torch.linalg.eigvalsh(covariances)
    torch.testing.assert_close(eigenvalues, (sent.scales**2).sort(1).values, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(covariances, covariances.transpose(1, 2))


def test_shapes_that_disagree_are_refused():
    good = model().tensors()
    with pytest.raises(ModelError, match=r"quats has shape \(19, 4\), expected \(20, 4\)"):
        GaussianModel(**good | {"quats": good["quats"][1:]})
    with pytest.raises(ModelError, match="sh has shape"):
        GaussianModel(**good | {"sh": torch.zeros(20, 2, 3)})
