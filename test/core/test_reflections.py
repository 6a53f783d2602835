"""Reflections: the formula, its gradients, and highlights that stay with the light and the lens."""

import contextlib
import dataclasses
import json

import numpy as np
import pytest
import torch
from lit_wall import CAMERA, wall
from plyfile import PlyData
from torch.nn.functional import softplus
from underflow import kernels_with_subnormals, tells_underflow

from endo_sim_ros.core.cameras import Camera, look_at
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel, ModelError, load_ply, save_ply
from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.core.light import Light
from endo_sim_ros.core.reflections import add_glints, facing, seen_colors, stored_strengths, unlit
from endo_sim_ros.core.shading import shade, to_bytes
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.reconstruction.gloss import start_gloss, surface_normals
from endo_sim_ros.reconstruction.stage_configs import GlossConfig
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.splatting import camera_arrays, rasterize, render

DEVICES = ["cpu", *([pytest.param("cuda", marks=pytest.mark.gpu)] if torch.cuda.is_available() else [])]
WET = Light(sheen_sharpness=12.0, glint_sharpness=150.0, facing=0.45)


def glossy(count: int = 500, strengths: tuple[float, float] = (0.1, 0.5), film: float = 0.0) -> GaussianModel:
    """A wall at z = 0.1 m, which faces a lens at the origin, under a film of this slope."""
    model = wall(count)
    gloss = torch.tensor([0.0, 0.0, -2.0, film, 0.0, -1.0, *torch.tensor(strengths).expm1().log()]).repeat(count, 1)
    return dataclasses.replace(model, gloss=gloss, light=WET)


def test_colours_are_those_of_the_formula():
    model = glossy(film=0.2)
    model.sh[:50] = -4.0  # less than black
    cosines, films = facing(model, torch.zeros(3))
    p = model.means.double().numpy()
    c = p[:, 2] / np.linalg.norm(p, axis=1)
    np.testing.assert_allclose(cosines, c, atol=1e-6)
    np.testing.assert_allclose(films, np.tile([0.2 / np.hypot(1, 0.2), 0, -1 / np.hypot(1, 0.2), 0.5], (len(p), 1)), atol=1e-6)
    base = (model.sh[:, 0].numpy() * SH_C0 + 0.5).clip(0)
    squares = (base * (c**0.45)[:, None]) ** 2 + 0.1 * np.exp(12 * (c - 1))[:, None]
    np.testing.assert_allclose((seen_colors(model, cosines)[:, 0] * SH_C0 + 0.5) ** 2, squares, rtol=1e-4)


def glints_of(films: torch.Tensor, alphas: torch.Tensor, camera: Camera, sharpness: float) -> torch.Tensor:
    """The formula, as it is written: films [4, H, W], alphas [H, W]."""
    rays = torch.from_numpy(camera.rays() @ camera.pose[:3, :3].T).to(films.dtype)
    v = -torch.nn.functional.normalize(rays, dim=-1)
    n = (films[:3] / alphas.clamp_min(1e-3)).permute(1, 2, 0)
    glints = alphas * films[3] * (-0.5 * sharpness * (n - v).square().sum(-1)).exp()
    return torch.where(alphas > 1e-3, glints, 0)


@pytest.mark.parametrize("device", DEVICES)
def test_glints_of_pixels_and_their_gradients_are_those_of_the_formula(device):
    g = torch.Generator().manual_seed(0)
    cameras = [CAMERA, CAMERA.beside(0.02)]
    size = 2, CAMERA.height, CAMERA.width
    alphas = torch.rand(size, generator=g).clamp_max(0.9)
    alphas[:, :3] = 0
    normals = torch.tensor([0.0, 0.0, -1.0]) + 0.2 * torch.randn((*size, 3), generator=g)
    normals[:, 5, ::2] *= -1  # turned away
    films = torch.cat([normals, torch.rand((*size, 1), generator=g)], -1).permute(0, 3, 1, 2) * alphas[:, None]
    colors = 0.1 + torch.rand((*size, 3), generator=g)
    learnt = [each.double().requires_grad_() for each in (colors, films, alphas)]
    glints = torch.stack([glints_of(*each, 150.0) for each in zip(*learnt[1:], cameras)])
    weights = torch.rand(colors.shape, generator=g)
    truth = (learnt[0].square() + glints[..., None]).sqrt()
    expected = torch.autograd.grad((weights * truth).sum(), learnt)

    matrices = [torch.from_numpy(np.stack(each)).float().to(device) for each in zip(*((c.viewmat, c.K) for c in cameras))]
    own = [each.to(device).requires_grad_() for each in (colors, films, alphas)]  # films are not contiguous
    pictures = add_glints(*own, *matrices, 150.0)
    torch.testing.assert_close(pictures.detach().cpu(), truth.float().detach(), atol=2e-5, rtol=0)
    for actual, gradient in zip(torch.autograd.grad((weights.to(device) * pictures).sum(), own), expected):
        assert gradient.abs().amax((0, -2, -1)).min() > 0.1
        assert (actual.cpu() - gradient).abs().max() < 1e-4 * gradient.abs().max()
    faint = own[1].detach() * torch.tensor([1, 1, 1, 1e-9], device=device)[:, None, None]
    black = [torch.zeros_like(own[0]).requires_grad_(), faint.requires_grad_(), own[2]]
    for gradient in torch.autograd.grad(add_glints(*black, *matrices, 150.0).sum(), black):
        assert gradient.isfinite().all() and gradient.abs().max() < 1.5 * 255


def test_gradients_are_those_of_finite_differences():
    model = glossy(20, film=0.2)
    doubles = {name: value.double() for name, value in model.tensors().items()}
    eye = torch.tensor([0.01, 0.02, 0.0], dtype=torch.float64)

    def colours(gloss: torch.Tensor, sh: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        gloss = torch.cat([doubles["gloss"][:, :3], gloss], 1)  # the surface's normals are not learnt
        own = GaussianModel(**doubles | {"gloss": gloss, "sh": sh}, light=WET)
        cosines, films = facing(own, eye)
        return seen_colors(own, cosines), films

    learnt = doubles["gloss"][:, 3:].clone()
    assert torch.autograd.gradcheck(colours, (learnt.requires_grad_(), doubles["sh"].requires_grad_()))


@pytest.mark.parametrize("device", DEVICES)
def test_films_that_face_different_ways_hardly_glint_though_their_mean_faces_the_lens(device):
    camera = Camera(np.array([[100.0, 0, 2], [0, 100, 2], [0, 0, 1]]), 4, 4)
    matrices = [torch.from_numpy(array).float().to(device) for array in camera_arrays([camera])[:2]]

    def glint(degrees: float) -> float:
        """Of two films in front of each other, turned so far to either side."""
        films = torch.zeros(1, 4, 4, 4, device=device)
        films[:, 2:], films[:, 2] = 0.5, -np.cos(np.radians(degrees))
        black = torch.zeros(1, 4, 4, 3, device=device)
        return float(add_glints(black, films, torch.ones(1, 4, 4, device=device), *matrices, 150.0).square().mean())

    assert glint(0) > 0.48 and glint(40) < 0.02 * glint(0) < glint(5)


def test_strengths_are_stored_and_read_back():
    strengths = torch.tensor([1e-6, 1e-3, 0.2, 4.0, 100.0, 3e4])
    torch.testing.assert_close(softplus(stored_strengths(strengths)), strengths, rtol=1e-3, atol=0)
    assert softplus(stored_strengths(torch.zeros(1))) < 2e-6


def test_taking_reflections_out_and_seeing_again_gives_the_colours_back():
    model = glossy(strengths=(0.05, 0.05))
    model = dataclasses.replace(model, sh=model.sh.clamp_min(0))  # brighter than what is reflected
    cosines = facing(model, torch.tensor([0.01, 0.0, 0.0])).cosines
    again = seen_colors(dataclasses.replace(model, sh=unlit(model, cosines)), cosines)
    glints = 0.05 * torch.exp(150 * (cosines - 1))
    light = lambda sh: (sh * SH_C0 + 0.5).square()
    torch.testing.assert_close(light(again) + glints[:, None, None], light(model.sh[:, :1]), atol=1e-5, rtol=0)


def test_normals_of_a_sphere_point_along_its_radius():
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points *= 0.05 / np.linalg.norm(points, axis=1, keepdims=True)
    along = np.abs((surface_normals(points, 24) * points).sum(1)) / 0.05
    assert np.degrees(np.arccos(along.clip(0, 1))).max() < 5


def test_a_model_that_starts_to_reflect_looks_as_it_did_from_the_nearest_camera():
    plain = dataclasses.replace(wall(500), light=None)
    plain = dataclasses.replace(plain, sh=plain.sh.clamp_min(0))
    camera = CAMERA
    model = dataclasses.replace(start_gloss(plain, [camera]), light=WET)
    assert model.gloss is not None and (model.gloss[:, 2] < 0).all()  # towards the camera
    # But for glints, which are of pixels, while those taken out are of Gaussians, here 10 pixels wide.
    torch.testing.assert_close(render(model, camera).colors, render(plain, camera).colors, atol=0.015, rtol=0)
    dull = dataclasses.replace(start_gloss(plain, [camera], GlossConfig(glint=1e-3)), light=WET)
    torch.testing.assert_close(render(dull, camera).colors, render(plain, camera).colors, atol=2e-4, rtol=0)


def test_the_highlight_is_where_the_surface_faces_the_lens():
    model = glossy(8000)
    dark = dataclasses.replace(model, sh=torch.full_like(model.sh, -0.5 / SH_C0))
    for x in (-0.02, 0.02):
        pose = np.eye(4)
        pose[0, 3] = x
        seen = render(dark, CAMERA.at(pose))
        brightness = seen.colors[0, ..., 0] / seen.alphas[0].clamp_min(0.5)
        row, column = np.unravel_index(int(brightness.argmax()), brightness.shape)
        assert abs(row - 64) < 12 and abs(column - 80) < 12  # it moved with the lens, not with the sheet


def test_a_sheet_that_turns_looks_as_one_that_was_built_turned():
    model = glossy(2000, film=-0.1)
    camera = CAMERA
    nodes = model.means[::20].double().numpy()
    a = np.radians(25)
    R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about = np.array([0, 0, 0.1])
    turn = lambda points: (points - about) @ R.T + about
    renderer = DeformableRenderer(model, nodes, RenderingConfig(device="cpu"))
    (turned,) = renderer.views([camera], turn(nodes).astype(np.float32), np.tile(R, (len(nodes), 1, 1)).astype(np.float32))
    R32 = torch.from_numpy(R).float()
    gloss = torch.cat([model.gloss[:, :3] @ R32.T, model.gloss[:, 3:6] @ R32.T, model.gloss[:, 6:]], 1)
    covars = R32 @ model.covariances @ R32.T
    built = dataclasses.replace(model, means=torch.from_numpy(turn(model.means.double().numpy())).float(), gloss=gloss)
    expected = render(built, camera, covars=covars)
    picture = to_bytes(shade(WET, expected.colors[0], expected.depths[0], expected.alphas[0], camera)).numpy()
    assert np.abs(turned.image.astype(int) - picture).max() <= 1
    (still,) = renderer.views([camera])
    assert np.abs(still.image.astype(int) - turned.image).mean() > 3


def turned_cameras() -> list[Camera]:
    """Two cameras before the wall that differ in all, 150×91 pixels."""
    eyes = np.array([0.0, 0.0, 0.0]), np.array([0.03, -0.02, 0.01])
    K = CAMERA.K * np.array([[150 / CAMERA.width], [91 / CAMERA.height], [1]])
    other = K * np.array([[1.2], [0.9], [1]])
    return [Camera(each, 150, 91, look_at(eye, np.array([0, 0, 0.1]))) for each, eye in zip((K, other), eyes)]


@pytest.mark.parametrize("device", DEVICES)
def test_glints_of_the_rasteriser_are_those_of_films_that_it_draws(device):
    model, cameras = glossy(2000, film=0.1).to(device), turned_cameras()
    matrices = [torch.from_numpy(array).float().to(device) for array in camera_arrays(cameras)[:2]]
    masks = torch.ones(2, 91, 150, dtype=torch.bool, device=device)
    masks[1, :40] = False
    films = facing(model, torch.zeros(3, device=device)).films
    tensors = model.means, model.quats, model.scales, model.opacities, model.sh, *matrices, 150, 91
    drawn = rasterize(*tensors, extras=films, masks=masks)
    expected = add_glints(drawn.colors, drawn.extras, drawn.alphas, *matrices, 150.0)
    assert (expected - drawn.colors).abs().amax((1, 2, 3)).min() > 0.05
    for plain in (False, True):
        with compare_plain() if plain else contextlib.nullcontext():
            found = rasterize(*tensors, extras=films, masks=masks, glints=150.0)
        torch.testing.assert_close(found.colors, expected, atol=2e-5, rtol=0)
        assert found.extras is None
    least = [rasterize(*tensors, extras=films, glints=sharpness).colors for sharpness in (0.0, 1e-6)]
    torch.testing.assert_close(*least, atol=1e-5, rtol=0)
    for wrong in (-1.0, float("nan")):
        with pytest.raises(ValueError, match="rasterize: glints must not be negative, got"):
            rasterize(*tensors, extras=films, glints=wrong)
    nothing = [each[:0] for each in tensors[:5]]
    assert not rasterize(*nothing, *matrices, 150, 91, extras=films[:0]).extras.any()


@pytest.mark.parametrize("after_a_cut", [False, True])
def test_what_copies_of_tissue_show_of_themselves_is_that_of_the_formula(after_a_cut):
    model = glossy(600, strengths=(0.3, 0.5), film=0.3)
    g = torch.Generator().manual_seed(0)
    turns = torch.nn.functional.normalize(torch.randn(len(model), 3, generator=g), dim=1)  # many away from the lens
    model = dataclasses.replace(model, gloss=torch.cat([turns, model.gloss[:, 3:]], 1))
    nodes = model.means[::20].double().numpy()
    skinning = Skinning(model, nodes, device="cpu")
    if after_a_cut:
        flesh = model.select(slice(0, 50))
        skinning.append(flesh)
        model = dataclasses.replace(model, **{name: torch.cat([each, each[:50]]) for name, each in model.tensors().items()})
    F = torch.eye(3) + 0.2 * torch.randn(3, len(nodes), 3, 3, generator=g)
    means = model.means + 0.01 * torch.randn(3, len(model), 3, generator=g)
    sh = 8 * torch.rand(3, len(model), 1, 3, generator=g) - 4  # some less than black
    eyes = torch.tensor([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, -0.04, 0.02]])
    seen = skinning.seen(F, means, eyes, sh)
    blended = (skinning.weights[..., None, None] * F[:, skinning.neighbours.long()]).sum(2)
    cofactors = torch.linalg.det(blended)[..., None, None] * torch.linalg.inv(blended).mT
    for b in range(3):
        normals = torch.cat([(cofactors[b] @ model.gloss[:, i : i + 3, None])[..., 0] for i in (0, 3)], 1)
        now = dataclasses.replace(model, means=means[b], sh=sh[b], gloss=torch.cat([normals, model.gloss[:, 6:]], 1))
        cosines, films = facing(now, eyes[b])
        torch.testing.assert_close(seen.sh[b], seen_colors(now, cosines), atol=2e-4, rtol=0)
        torch.testing.assert_close(seen.films[b], films, atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match=r"skinning: sh has shape \(3, 100, 1, 3\), expected"):
        skinning.seen(F, means, eyes, sh[:, :100])
    with pytest.raises(ValueError, match=r"skinning: F has shape \(2, 30, 3, 3\), expected \(3, 30, 3, 3\)"):
        skinning.seen(F[:2], means, eyes, sh)


@pytest.mark.parametrize("learnt", ["means", "quats", "log_scales", "logit_opacities", "sh"])
def test_any_part_of_what_glints_may_be_learnt_alone(learnt):
    model = glossy(300, film=0.05)
    leaf = getattr(model, learnt).clone().requires_grad_()
    everything = {name: each.clone().requires_grad_() for name, each in model.tensors().items()}
    alone, together = (render(dataclasses.replace(model, **own), CAMERA).colors.square().sum() for own in ({learnt: leaf}, everything))
    expected = torch.autograd.grad(together, everything[learnt])[0]
    assert expected.any() or learnt == "quats"  # round Gaussians
    assert torch.equal(torch.autograd.grad(alone, leaf)[0], expected)


@pytest.mark.parametrize("device", DEVICES)
def test_pictures_with_and_without_gradients_have_the_same_glints(device):
    model = glossy(2000, film=0.05).to(device)
    draw = lambda each: render(each, CAMERA.beside(0.01)).colors
    found = draw(model)
    leaf = model.logit_opacities.clone().requires_grad_()
    learnt = draw(dataclasses.replace(model, logit_opacities=leaf))
    assert learnt.requires_grad and not found.requires_grad
    torch.testing.assert_close(found, learnt.detach(), atol=1e-6, rtol=0)
    with compare_plain():
        torch.testing.assert_close(draw(model), found, atol=2e-5, rtol=0)
    assert (found - draw(glossy(2000, (0.1, 1e-6)).to(device))).abs().max() > 0.1


@tells_underflow
def test_where_no_glint_is_no_number_is_subnormal(monkeypatch):
    model = glossy(2000, film=0.5)
    sharp = dataclasses.replace(model, light=dataclasses.replace(WET, glint_sharpness=900.0))
    assert not kernels_with_subnormals(lambda: render(sharp, CAMERA), monkeypatch)


def test_each_eye_sees_highlights_of_its_own():
    model = glossy(2000)
    left = CAMERA
    right = left.beside(0.02)
    both = render(model, left, right)
    for eye, camera in enumerate((left, right)):
        torch.testing.assert_close(both.colors[eye], render(model, camera).colors[0], atol=2e-4, rtol=0)
    assert (both.colors[0] - both.colors[1]).abs().max() > 0.02


@pytest.mark.parametrize("name, error", [("m.ply", 0.0), ("m.compressed.ply", 0.04)])
def test_files_keep_what_reflects(tmp_path, name, error):
    model = glossy(300)
    g = torch.Generator().manual_seed(0)
    model.gloss[:, :6] = torch.nn.functional.normalize(torch.randn(300, 2, 3, generator=g), dim=2).flatten(1)
    model.gloss[:, 6:] = torch.linspace(-6, 7, 600).view(300, 2)  # up to the strongest that there may be
    save_ply(model, tmp_path / name)
    found = load_ply(tmp_path / name)
    same = torch.cdist(model.means, found.means).argmin(1)  # a compressed model has another order
    assert found.light == WET and found.gloss is not None
    assert (found.gloss[same] - model.gloss).abs().max() <= error


def test_other_programs_find_the_same_vertices_and_no_light_means_no_gloss(tmp_path):
    model = glossy(50)
    save_ply(model, tmp_path / "glossy.ply")
    save_ply(dataclasses.replace(model, gloss=None), tmp_path / "plain.ply")
    vertices = [PlyData.read(tmp_path / f"{name}.ply")["vertex"].data for name in ("glossy", "plain")]
    assert vertices[0].dtype == vertices[1].dtype and (vertices[0] == vertices[1]).all()
    text = (tmp_path / "glossy.ply").read_bytes()
    start = text.index(b"comment")
    (tmp_path / "unlit.ply").write_bytes(text[:start] + text[text.index(b"\n", start) + 1 :])
    assert not load_ply(tmp_path / "unlit.ply").reflects and load_ply(tmp_path / "glossy.ply").reflects


def test_harmonics_beside_gloss_are_drawn_as_they_are():
    model = glossy(500)
    model = dataclasses.replace(model, sh=torch.cat([model.sh, 0.3 * torch.ones(500, 3, 3)], 1))
    seen = render(model, CAMERA).colors
    assert torch.equal(seen, render(dataclasses.replace(model, gloss=None), CAMERA).colors)


@pytest.mark.parametrize("name", ["m.ply", "m.compressed.ply"])
def test_gloss_that_is_not_finite_is_not_written(tmp_path, name):
    model = glossy(50)
    model.gloss[7, 6] = torch.nan
    with pytest.raises(ModelError, match="gloss is not finite in 1 Gaussians"):
        save_ply(model, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_light_of_an_older_file_reflects_nothing():
    later = "sheen_sharpness", "glint_sharpness", "facing", "filled", "shoulder"
    values = {name: value for name, value in json.loads(WET.to_json()).items() if name not in later}
    assert Light.from_json(json.dumps(values)) == Light()
    with pytest.raises(ValueError, match="expected the values"):
        Light.from_json(json.dumps(values | {"shine": 1.0}))
