"""The Gaussian model and its files."""

import dataclasses

import numpy as np
import pytest
import torch
from lit_wall import LAMP
from plyfile import PlyData

from endo_sim_ros.core.gaussians import GaussianModel, ModelError, load_ply, save_ply
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig


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
    with pytest.raises(ModelError, match=f"{tmp_path.name}: a folder; give a PLY file, as its model.ply"):
        load_ply(tmp_path)


def test_a_file_in_which_some_gaussians_lack_what_they_reflect_is_refused_with_its_name(tmp_path):
    path = tmp_path / "m.ply"
    save_ply(dataclasses.replace(model(), gloss=torch.ones(20, 8)), path)
    path.write_bytes(path.read_bytes().replace(b"element gloss 20", b"element gloss 19")[:-32])
    with pytest.raises(ModelError, match="m.ply: gloss has 19 rows for 20 Gaussians; write or reconstruct it again"):
        load_ply(path)


@pytest.fixture(scope="module")
def tissue():
    """A piece of tissue 3 cm wide with its camera."""
    scene = load_scene(None)
    return scene.model, scene.cameras[0].resized(160, 128)


def test_a_compressed_model_looks_the_same_at_a_quarter_of_the_size(tmp_path, tissue):
    model, camera = tissue
    save_ply(model, tmp_path / "m.ply")
    save_ply(dataclasses.replace(model, light=LAMP), tmp_path / "m.compressed.ply")
    sizes = [(tmp_path / name).stat().st_size for name in ("m.ply", "m.compressed.ply")]
    assert sizes[1] < 0.26 * sizes[0]
    received = load_ply(tmp_path / "m.compressed.ply")
    assert len(received) == len(model) and received.light == LAMP
    draw = lambda model: DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(camera)
    image, depth = draw(model)
    again, depth_again = draw(dataclasses.replace(received, light=model.light))
    assert image.std() > 10 and metrics.psnr(again, image) > 45
    assert np.abs(depth_again - depth)[depth > 0].mean() < 2e-5
    save_ply(received, tmp_path / "again.ply")
    assert torch.equal(load_ply(tmp_path / "again.ply").means, received.means)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 3])
def test_every_field_of_a_compressed_model_is_near(tmp_path, degree):
    sent = dataclasses.replace(model(n=600, degree=degree), means=torch.rand(600, 3, generator=torch.Generator().manual_seed(0)))
    save_ply(sent, tmp_path / "m.compressed.ply")
    vertices = PlyData.read(str(tmp_path / "m.compressed.ply"))
    assert [element.count for element in vertices] == [3, 600] + [600] * (degree > 0)
    received = load_ply(tmp_path / "m.compressed.ply")
    distance, nearest = torch.cdist(received.means, sent.means).min(1)
    assert distance.max() < 1e-3 and len(nearest.unique()) == 600  # a chunk is as wide as the model, in 1023 steps
    sent = sent.select(nearest)
    torch.testing.assert_close(received.log_scales, sent.log_scales, atol=4e-3, rtol=0)
    torch.testing.assert_close(received.opacities, sent.opacities, atol=2e-3 + 1e-6, rtol=0)
    torch.testing.assert_close(received.rotations, sent.rotations, atol=6e-3, rtol=0)
    torch.testing.assert_close(received.sh[:, 0], sent.sh[:, 0], atol=2e-2, rtol=0)
    torch.testing.assert_close(received.sh[:, 1:], sent.sh[:, 1:].clamp(-4, 4), atol=2e-2, rtol=0)


@pytest.mark.slow
def test_another_implementation_reads_compressed_models_alike(tmp_path):
    gaussforge = pytest.importorskip("gaussforge", reason="GaussForge is not installed")
    sent = model(n=300, degree=2)
    save_ply(sent, tmp_path / "m.compressed.ply")
    data = (tmp_path / "m.compressed.ply").read_bytes()
    (tmp_path / "theirs.ply").write_bytes(gaussforge.GaussForge().convert(data, "compressed.ply", "ply")["data"])
    ours, theirs = load_ply(tmp_path / "m.compressed.ply"), load_ply(tmp_path / "theirs.ply")
    for name, tolerance in {"means": 1e-5, "log_scales": 1e-5, "sh": 2e-2, "rotations": 1e-4, "opacities": 1e-5}.items():
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), atol=tolerance, rtol=0, msg=lambda m, n=name: f"{n}: {m}")
    save_ply(sent, tmp_path / "m.ply")
    (tmp_path / "c.ply").write_bytes(gaussforge.GaussForge().convert((tmp_path / "m.ply").read_bytes(), "ply", "compressed.ply")["data"])
    back = load_ply(tmp_path / "c.ply")
    distance, nearest = torch.cdist(back.means, sent.means).min(1)
    assert distance.max() < 1e-2 and len(nearest.unique()) == 300
    torch.testing.assert_close(back.rotations, sent.select(nearest).rotations, atol=6e-3, rtol=0)


@pytest.mark.parametrize(
    "damage, sentence",
    [
        (lambda data: data[:-7], "claims 300 vertices of 16 bytes or more"),
        (lambda data: data.replace(b"element chunk 2", b"element chunk 1"), "do not fit 300 Gaussians"),
        (lambda data: data.replace(b"element chunk 2", b"element chunk 9999999"), "claims 9999999 rows of chunk"),
        (lambda data: data.replace(b"float max_scale_x", b"float max_scale_w"), "missing field max_scale_x"),
        (lambda data: data.replace(b"uint packed_color", b"list uint uint packed_color"), "'property list"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "does not begin with vertices"),
    ],
)
def test_damaged_compressed_models_are_one_sentence(tmp_path, damage, sentence):
    path = tmp_path / "m.compressed.ply"
    save_ply(model(n=300), path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ModelError, match=f"m.compressed.ply.*{sentence}"):
        load_ply(path)


@pytest.mark.slow
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
