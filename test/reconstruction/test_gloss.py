"""Training finds what reflects."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from lit_wall import CAMERA, wall
from short_training import options
from thorough import mostly_thorough
from torch.nn.functional import normalize, softplus
from trained import trainer_of

from endo_sim_ros.core.cameras import Camera, look_at
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.light import Light
from endo_sim_ros.core.reflections import facing, seen_colors
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.evaluation.deformed_truth import deformed_truth_psnr
from endo_sim_ros.reconstruction import Trainer, pipeline, prepare, preset
from endo_sim_ros.reconstruction.config import LearningRatesConfig
from endo_sim_ros.reconstruction.gloss import lobes, smoothed_normals, start_films, start_gloss, strongest_sheen, surface_normals
from endo_sim_ros.reconstruction.highlights import highlights
from endo_sim_ros.reconstruction.photometry import remove_light, unlit_colors
from endo_sim_ros.reconstruction.scene import TrainingView
from endo_sim_ros.reconstruction.stage_configs import GlossConfig, TiltedConfig
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

TURNS = np.eye(4), look_at(np.zeros(3), np.array([0.005, 0, 0.1]))  # of a lens that stays where it is


def wavy_film(x: torch.Tensor, y: torch.Tensor, fine: float) -> torch.Tensor:
    """Normals [N, 3] of the film on `wet_wall`, not of length 1."""
    return torch.stack([0.25 * torch.sin(60 * fine * x), 0.25 * torch.cos(70 * fine * y), -torch.ones_like(x)], 1)


def wall_colors(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Colours [N, 3] of `wet_wall` itself."""
    return 0.35 + 0.15 * torch.stack([torch.sin(90 * x), torch.sin(70 * y), torch.cos(80 * x)], 1)


def wet_wall(glint: float = 0.8, fine: float = 1.0) -> GaussianModel:
    """A wall of smooth colours whose film is wavy: 1 to 2 waves across it, or so many times as many."""
    model = wall()
    x, y = model.means[:, :2].T
    flat = torch.tensor([0.0, 0.0, -1.0]).repeat(len(model), 1)
    gloss = torch.cat([flat, wavy_film(x, y, fine), torch.tensor([0.1, glint]).expm1().log().repeat(len(model), 1)], 1)
    light = Light(sheen_sharpness=12.0, glint_sharpness=150.0, facing=0.45)
    return dataclasses.replace(model, sh=((wall_colors(x, y) - 0.5) / SH_C0)[:, None], gloss=gloss, light=light)


def filmed(seen: GaussianModel, x: float, y: float) -> Frame:
    """A picture and its depth, from beside the middle."""
    pose = np.eye(4)
    pose[:2, 3] = x, y
    camera = CAMERA.at(pose).resized(96, 77)
    image, depth = DeformableRenderer(seen, None, RenderingConfig(device="cpu")).render(camera)
    return Frame(round((x + 1) * 1e9), image, camera, depth=depth)


PLACES = (-0.008, 0.0), (0.0, 0.008), (0.008, 0.0)
PLAIN = {"light": False, "exposure": False, "extrapolation": 0.0, "iterations": 150, "refine_every": 50, "max_gaussians": 3000}


@pytest.mark.thorough
@pytest.mark.slow
def test_training_that_knows_reflections_foresees_another_view():
    true = wet_wall()
    views, other = [filmed(true, *at) for at in PLACES], filmed(true, 0.002, 0.001)
    found = {}
    for reflections in (False, True):
        trained = trainer_of(views, options(depth="topic", reflections=reflections, **PLAIN)).run()
        found[reflections] = metrics.psnr(filmed(trained, 0.002, 0.001).image, other.image)
        assert trained.reflects == reflections
    assert found[True] > found[False] + 1


@pytest.mark.thorough
def test_films_face_the_lens_at_first_where_a_view_shows_a_highlight(monkeypatch):
    config, fine = options(depth="topic", **PLAIN), 5.0  # highlights narrower than what is around them
    model = prepare([filmed(wet_wall(0.8, fine), *at) for at in PLACES], config).model
    monkeypatch.setattr(pipeline, "start_films", lambda model, *_: model)
    before = prepare([filmed(wet_wall(0.8, fine), *at) for at in PLACES], config).model
    assert model.gloss is not None and before.gloss is not None
    shining = (model.gloss != before.gloss).any(1)
    x, y = model.means[:, :2].T
    truth = normalize(wavy_film(x, y, fine), dim=1)
    off, off_before = (torch.rad2deg((each.gloss[:, 3:6] * truth).sum(1).clamp(-1, 1).acos())[shining].median() for each in (model, before))
    assert 40 < shining.sum() < 400 and off < 6 < 9 < off_before
    wrong, wrong_before = ((each.sh[:, 0] * SH_C0 + 0.5 - wall_colors(x, y)).abs()[shining].mean() for each in (model, before))
    assert wrong < 0.75 * wrong_before, (wrong, wrong_before)
    strengths = softplus(model.gloss[shining, 7])
    assert 0.3 < strengths.median() < 0.7 and (model.gloss[shining, 7] >= before.gloss[shining, 7]).all()
    torch.testing.assert_close(model.sh[~shining], before.sh[~shining], rtol=0, atol=0)


def spotted(radius: float, *places: float, level: int = 240) -> tuple[GaussianModel, list[TrainingView]]:
    """A grey wall with a light spot, and pictures of it from so far to the right, m. The radius is in pixels."""
    camera = Camera(np.array([[125.0, 0, 80], [0, 125, 64], [0, 0, 1]]), 160, 128)
    image = np.full((128, 160, 3), 100, np.uint8)
    cv2.circle(image, (80, 64), round(radius), (level,) * 3, -1)
    points = camera.backproject(np.full((128, 160), 0.1)).reshape(-1, 3)
    model = GaussianModel.from_points(
        *(torch.from_numpy(each).float() for each in (points, image.reshape(-1, 3) / 255.0, np.full(len(points), 1e-4)))
    )
    views = []
    for place in places:
        pose = np.eye(4)
        pose[0, 3] = place
        views.append(TrainingView(len(views), np.roll(image, -round(place / 0.1 * 125), 1), camera.at(pose)))
    return model, views


LIT = np.array([0.8, 1.5, 0.1, -0.1]), np.array([[0.2, 0.1, 0.0]]), 0.1, 0.05  # light, exposure, depth and tolerance
PLAIN_LIGHT = np.zeros(4), np.zeros((1, 3)), 0.1, 0.05  # as without a light


def test_a_view_shows_its_highlights_as_before_once_films_make_them():
    model, views = spotted(2, 0.0)
    glossy = start_gloss(remove_light(model, unlit_colors(model.means, views, *LIT)), [views[0].camera], GlossConfig())
    found = start_films(glossy, unlit_colors(model.means, views, *LIT), 60, GlossConfig(neighbours=16))
    ((_, index, _, colors),) = unlit_colors(model.means, views, *LIT)
    facings = facing(found, torch.zeros(3))
    lit = dataclasses.replace(found, light=lobes(GlossConfig()))
    cosines = (facings.films[:, :3] * normalize(-found.means, dim=1)).sum(1)
    glints = facings.films[:, 3] * (150 * (cosines - 1)).exp()
    shown = ((seen_colors(lit, facings.cosines)[:, 0] * SH_C0 + 0.5).square() + glints[:, None]).sqrt().mean(1)[index]
    spot = torch.from_numpy(highlights(views[0].image, views[0].tissue, 60)).flatten()
    middle = spot & torch.from_numpy(views[0].image[..., 0] > 200).flatten()
    assert 20 < spot.sum() < 50 < 100 * middle.sum()
    truth = colors.mean(1)
    torch.testing.assert_close(shown[middle], truth[middle], rtol=0, atol=1 / 255)
    torch.testing.assert_close(shown[spot], truth[spot], rtol=0, atol=4 / 255)  # glow, in which a glint is as strong as anywhere
    torch.testing.assert_close(found.gloss[~spot], glossy.gloss[~spot], rtol=0, atol=0)
    assert (found.sh != glossy.sh).any((1, 2))[middle].all()


@pytest.mark.parametrize(
    ("radius", "level", "places", "found"),
    [(2, 240, (0.0, 0.01), True), (2, 240, (-0.015, 0.015), False), (12, 255, (0.0,), False)],
    ids=["seen from next to each other", "the same from 17 degrees apart", "wide"],
)
def test_what_stays_bright_for_other_lenses_and_what_is_wide_stays_white(radius, level, places, found):
    model, views = spotted(radius, *places, level=level)
    glossy = start_gloss(model, [view.camera for view in views])
    films = start_films(glossy, unlit_colors(model.means, views, np.zeros(4), np.zeros((len(views), 3)), 0.1, 0.05), 60)
    assert bool((films.gloss != glossy.gloss).any()) == found and bool((films.sh != glossy.sh).any()) == found


@pytest.mark.parametrize("level", [100, 255])
def test_films_are_as_the_surface_where_nothing_is_brighter_than_around(level):
    model, (view,) = spotted(0.0, 0.0)
    views = [dataclasses.replace(view, image=np.full_like(view.image, level))]
    glossy = start_gloss(model, [view.camera])
    for each in (glossy, glossy.select([0])):
        assert start_films(each, unlit_colors(each.means, views, *PLAIN_LIGHT), 60) is each
    masked = [dataclasses.replace(view, mask=np.zeros_like(view.image[..., 0]))]
    assert start_films(glossy, unlit_colors(glossy.means, masked, *PLAIN_LIGHT), 60) is glossy


@pytest.mark.thorough
@pytest.mark.slow
def test_lobes_grow_no_stronger_than_the_strongest(small):
    bright = [dataclasses.replace(view, image=np.full_like(view.image, 240)) for view in small[::4]]
    eyes = torch.from_numpy(np.array([view.camera.position for view in bright])).float()
    for strongest in (0.2, 0.4):
        gloss = GlossConfig(strongest=strongest)
        rates, views_alone = LearningRatesConfig(gloss=0.1, gloss_decay=1), TiltedConfig(every=0)
        config = options(iterations=30, refine_every=10, rates=rates, tilted=views_alone, gloss=gloss).replaced({"views.even": 0})
        scene = prepare(bright, config)  # views as bright as these do not tell whether anything reflects
        glossy = start_gloss(scene.model, [view.camera for view in scene.views], gloss)
        assert glossy.gloss is not None
        glossy.gloss[:, 6:] = 1.0  # much too strong
        model = Trainer(dataclasses.replace(scene, model=glossy), config).run()
        sheen, glint = softplus(model.gloss[:, 6:]).unbind(1)
        limits = strongest_sheen(model, eyes, gloss)
        assert limits.min() < 0.5 * strongest and limits.max() == strongest
        near = 1e-3  # limits are told at a refinement, and have a share of the tissue's own light, which goes on to change
        at_limit = (sheen > limits - near).float().mean()  # few are: normals that are averaged face the lens, and limits are wide there
        assert (sheen < limits + near).all() and at_limit > 0.01
        assert 0.8 * strongest < glint.max() < strongest + 1e-4


def test_lobes_that_no_view_sees_stay_weak():
    model = dataclasses.replace(wall(1), means=torch.tensor([[0.0, 0.0, 0.1]]), gloss=torch.tensor([[0.0, 0.0, -1.0] * 2 + [0.0, 0.0]]))
    eyes = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [10.0, 0.0, 0.1]])  # straight, 45 and 90 degrees off
    options = GlossConfig()
    limits = [float(strongest_sheen(model, eye[None], options)) for eye in eyes]
    assert float(strongest_sheen(model, eyes, options)) == options.strongest
    first = options.sheen * float((model.sh[0, 0] * SH_C0 + 0.5).square().mean())
    expected = [options.strongest, first + options.strongest * np.exp(12 * (np.sqrt(0.5) - 1)), first]
    assert limits == pytest.approx(expected, rel=0.02)


def test_normals_of_inexact_depth_are_those_of_the_surface_once_smoothed():
    rng = np.random.default_rng(0)
    right, down = rng.uniform(-0.03, 0.03, (2, 20_000))  # a dome of 10 cm radius, 10 cm away, points 0.4 mm apart
    ball = np.stack([right, down, 0.2 - np.sqrt(0.1**2 - right**2 - down**2)], 1)
    truth = (ball - [0, 0, 0.2]) / 0.1
    uneven = 0.0006 * np.sin(2100 * right) * np.sin(1900 * down)  # as depth errs: alike from one pixel to the next, not over a centimetre
    points = ball * (1 + (uneven + rng.normal(0, 0.0001, len(ball))) / ball[:, 2])[:, None]
    normals = surface_normals(points, 24)
    normals *= np.sign((normals * truth).sum(1, keepdims=True))
    off = lambda normals: np.degrees(np.arccos(np.clip((normals * truth).sum(1), -1, 1)))[np.hypot(right, down) < 0.02]
    smoothed = smoothed_normals(points, normals, 0.008)
    assert np.median(off(normals)) > 15 and np.median(off(smoothed)) < 4, (np.median(off(normals)), np.median(off(smoothed)))
    np.testing.assert_allclose(np.linalg.norm(smoothed, axis=1), 1)
    assert smoothed_normals(points, normals, 0.0) is normals
    far = smoothed_normals(np.concatenate([points, [[1e9, 0, 0]]]), np.concatenate([normals, [[0, 0, -1.0]]]), 0.008)
    np.testing.assert_allclose(far[:-1], smoothed, atol=0.03)
    np.testing.assert_allclose(far[-1], [0, 0, -1])
    tissue = dataclasses.replace(wall(1).select([0] * len(points)), means=torch.from_numpy(points.astype(np.float32)))
    for width, expected in ((0.0, normals), (0.08, smoothed)):  # of the distance, which is some 10 cm
        gloss = start_gloss(tissue, [CAMERA.at(np.eye(4))], GlossConfig(smoothing=width)).gloss.numpy()
        assert np.median(off(gloss[:, :3])) == pytest.approx(np.median(off(expected)), rel=0.05)
        np.testing.assert_array_equal(gloss[:, :3], gloss[:, 3:6])


@pytest.mark.parametrize("both_sides", [False, True])
def test_normals_of_thin_tissue_stay(both_sides):
    rng = np.random.default_rng(0)
    around, along = rng.uniform(-np.pi / (1 if both_sides else 2), np.pi / (1 if both_sides else 2), 5000), rng.uniform(-0.03, 0.03, 5000)
    normals = np.stack([np.sin(around), np.zeros(5000), -np.cos(around)], 1)  # of a post 2 mm thick
    smoothed = smoothed_normals(0.001 * normals + np.stack([np.zeros(5000), along, np.full(5000, 0.1)], 1), normals, 0.004)
    assert np.degrees(np.arccos(np.clip((smoothed * normals).sum(1), -1, 1))).mean() < 1


def test_normals_of_surfaces_that_lie_apart_do_not_mix():
    right, down = np.meshgrid(np.linspace(-0.03, 0.03, 40), np.linspace(-0.03, 0.03, 40))
    near = np.stack([right, down, np.full_like(right, 0.06)], -1).reshape(-1, 3)
    far = near + [0, 0, 0.06]
    normals = np.repeat([[0, 0, -1.0], [0.6, 0, -0.8]], len(near), 0)
    np.testing.assert_allclose(smoothed_normals(np.concatenate([near, far]), normals, 0.008), normals, atol=1e-6)


@pytest.mark.slow
def test_what_reflects_settles_in_the_end(small):
    config = options(iterations=20, rates=LearningRatesConfig(gloss=0.02, gloss_decay=0.01, gloss_decay_from=0.5))
    trainer, found = trainer_of(small[::4], config), []
    while trainer.iteration < 20:
        trainer.step()
        found.append(trainer.optimizer.rates["gloss"] / config.learning_rate)
    assert found == pytest.approx([0.02] * 10 + [0.02 * 0.01 ** (i / 10) for i in range(10)])
    assert trainer.optimizer.rates["sh_base"] == config.learning_rate * config.rates.sh_base


@pytest.mark.slow
@pytest.mark.parametrize("tissue", ["in even light", "matt", "wet"])
@pytest.mark.parametrize("vignette", mostly_thorough([0.0, 3.0]))
def test_tissue_reflects_only_where_light_does_not_explain_how_views_differ(tissue, vignette):
    """Waves that two views see from either side, in even light or that of a lamp at the lens.

    The lens darkens pictures towards the edge by a power of the cosine of the angle from its axis."""
    views = []
    for stamp, side in enumerate((-0.02, 0.02)):
        camera = CAMERA.at(look_at(np.array([side, 0, 0]), np.array([0, 0, 0.1]))).resized(96, 77)
        depth, wave = np.full((77, 96), 0.1), lambda x, y: 0.003 * np.sin(90 * x) * np.cos(70 * y)
        for _ in range(30):  # until a pixel's point is on the surface
            x, y, z = np.moveaxis(camera.backproject(depth), -1, 0)
            depth = depth + 0.1 + wave(x, y) - z
        normal = np.stack([0.27 * np.cos(90 * x) * np.cos(70 * y), -0.21 * np.sin(90 * x) * np.sin(70 * y), np.full_like(x, -1)], -1)
        towards = camera.position - np.stack([x, y, z], -1)
        cosine = (normal * towards).sum(-1) / np.linalg.norm(normal, axis=-1) / np.linalg.norm(towards, axis=-1)
        colors = 0.4 + 0.1 * np.stack([np.sin(50 * x), np.sin(40 * y), np.cos(60 * x)], -1)
        aside = camera.rays()[..., 2:] / np.linalg.norm(camera.rays(), axis=-1, keepdims=True)
        cosine = np.ones_like(x)[..., None] if tissue == "in even light" else cosine[..., None]
        shown = colors * cosine**0.45 + (0.5 * np.exp(150 * (cosine - 1)) if tissue == "wet" else 0)
        image = np.uint8(255 * shown.clip(0, 1) * aside**vignette)
        views.append(Frame(stamp, image, camera, depth=depth.astype(np.float32)))
    config = options(depth="topic", extrapolation=0.0)
    scene = prepare(views, config)
    assert (scene.model.gloss is not None) == (tissue == "wet")
    (told,) = [decision for decision in scene.decisions if "times as much in brightness if tissue grew darker" in decision]
    assert told.startswith("tissue may reflect: views would differ" if tissue == "wet" else "nothing reflects: views would differ")
    assert prepare(views, config.replaced({"gloss.most_turning": 1e6})).model.gloss is not None
    turned = [dataclasses.replace(view, camera=view.camera.at(views[0].camera.pose @ turn), depth=None) for view, turn in zip(views, TURNS)]
    for untold in (prepare(views[:1], config), prepare(turned, options(extrapolation=0.0))):
        assert untold.model.gloss is None and "nothing reflects: whether it does cannot be told" in untold.decisions[-1]
    if tissue == "in even light":  # with the very same colours, too: half a grey level is no difference to divide by
        flat = [dataclasses.replace(view, image=np.full_like(view.image, 128)) for view in views]
        (told,) = [decision for decision in prepare(flat, config.replaced({"views.even": 0})).decisions if "grew darker" in decision]
        assert float(told.split("differ ")[1].split()[0]) < 100


@pytest.mark.thorough
@pytest.mark.slow
def test_a_short_training_leaves_little_that_flashes_when_tissue_is_pulled():
    """Two views of a synthetic patient, against strengths at first that are more than half of the tissue's own light."""
    patient = PhantomConfig(rounds=0.5, frames=2, width=96, height=80)
    views = list(phantom_sequence(patient))
    cameras, found = [view.camera for view in views], []
    short = {"iterations": 100, "max_gaussians": 3000, "image_width": 96, "interpolation.neighbours": 4}
    for start in ({}, {"gloss.sheen": 0.2, "gloss.glint": 0.5}):
        config = preset("laptop", device="cpu", **short | start)
        model = Trainer(prepare(views, config), config).run()
        assert (model.sh * SH_C0 + 0.5).min() > 0.99 / 255  # what is black would stay so
        found.append(deformed_truth_psnr(model, patient, cameras, cameras, "cpu"))
    (pulled, at_rest), (before, before_at_rest) = found
    assert pulled > before + 0.1 and at_rest > before_at_rest
