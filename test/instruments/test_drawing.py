"""Instruments in a picture: their outline is that of the projected mesh, and what is nearer hides what is farther."""

import contextlib

import cv2
import numpy as np
import pytest
import torch

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.core.light import Light
from endo_sim_ros.core.shading import shade
from endo_sim_ros.instruments import Capsule, Material, Part, build_instrument, link_poses, load_arm, place_arm
from endo_sim_ros.instruments.drawing import FIRST_LINK, TISSUE, DrawingConfig, InstrumentDrawing
from endo_sim_ros.instruments.shapes import lofted

CAMERA = Camera(intrinsic_matrix(560, 560, 320, 256), 640, 512)
TOOLS = (
    "LARGE_NEEDLE_DRIVER", "PROGRASP_FORCEPS", "CURVED_SCISSORS",
    "MARYLAND_BIPOLAR_FORCEPS", "PERMANENT_CAUTERY_HOOK", "LARGE_CLIP_APPLIER",
)  # fmt: skip


def tissue(depth=0.1, color=(0.6, 0.3, 0.3)):
    return torch.tensor(color).expand(512, 640, 3).contiguous(), torch.full((512, 640), depth), torch.ones(512, 640)


def scene(tool="LARGE_NEEDLE_DRIVER"):
    arm = load_arm("PSM", tool)
    parts, _ = build_instrument(arm)
    place = place_arm("PSM1", arm, CAMERA, 0.08)
    poses = {link: place.base @ pose for link, pose in link_poses(arm, place.joints + [0, 0, 0, 0.3, 0.4, -0.3], 0.7).items()}
    return parts, poses


def cylinder(radius, start, end, count=256, material=Material.STEEL):
    angle = 2 * np.pi * np.arange(count) / count
    rings = [np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], 1) for z in (start, end)]
    return Part("roll", material, *lofted(np.array(rings)))


@pytest.mark.parametrize("tool", TOOLS)
def test_the_outline_is_that_of_the_projected_triangles(tool):
    parts, poses = scene(tool)
    labels = InstrumentDrawing([parts], device="cpu").draw([poses], CAMERA, *tissue(0.3)).labels.numpy()
    fine = 8
    silhouette = np.zeros((512 * fine, 640 * fine), np.uint8)
    for part in parts:
        local = part.vertices @ poses[part.link][:3, :3].T + poses[part.link][:3, 3]
        uv, z = CAMERA.project(local)
        for face in part.faces[(z[part.faces] > 2e-3).all(1)]:
            corners = np.round((uv[face] * fine - 0.5) * 16).astype(np.int64)
            if (np.abs(corners) < 2**24).all():
                cv2.fillConvexPoly(silhouette, corners.astype(np.int32), 1, shift=4)
    expected = cv2.resize(silhouette.astype(np.float32), (640, 512), interpolation=cv2.INTER_AREA) > 0.5
    drawn = labels >= FIRST_LINK
    assert 0.03 < drawn.mean() < 0.5
    assert (drawn & expected).sum() / (drawn | expected).sum() > 0.995


def test_depth_is_that_of_the_surface():
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # across the picture
    pose[:3, 3] = 0, 0, 0.06
    picture = InstrumentDrawing([[cylinder(5e-3, -0.1, 0.1)]], device="cpu").draw([{"roll": pose}], CAMERA, *tissue())
    rays = CAMERA.rays()[:, 320]  # z = 1
    y = rays[:, 1]
    # |(y z, z - 0.06)| = 0.005
    a, b, c = y**2 + 1, -2 * 0.06, 0.06**2 - 0.005**2
    root = b * b - 4 * a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / (2 * a), 0.1)
    inside = cv2.erode((root > 0).astype(np.uint8)[:, None], np.ones((3, 1))).ravel() > 0  # pixels at the rim show both
    np.testing.assert_allclose(picture.depths[:, 320].numpy()[inside], depth[inside], atol=5e-5)
    assert (picture.labels[:, 320].numpy()[inside] == FIRST_LINK).all()


@pytest.mark.parametrize("opacity", [1.0, 0.7, 0.0])
def test_depth_at_outlines_is_that_of_what_the_label_tells(opacity):
    parts, poses = scene()
    colors, depths, alphas = tissue(0.3)
    depths, alphas = opacity * depths, opacity * alphas
    picture = InstrumentDrawing([parts], device="cpu").draw([poses], CAMERA, colors, depths, alphas)
    metres, tool = picture.depths / picture.alphas.clamp_min(1e-6), picture.labels >= FIRST_LINK
    mixed = (picture.alphas != alphas) & (picture.alphas != 1) if opacity < 1 else ((picture.colors != colors).any(-1) & ~tool)
    assert int(mixed.sum()) > 500, "outlines cover parts of pixels"
    assert 0.04 < float(metres[tool].min()) and float(metres[tool].max()) < 0.15
    if opacity > 0:
        assert float((metres[~tool] - 0.3).abs().max()) < 1e-6
    else:
        assert float(metres[~tool].max()) < 0.15 and float(picture.alphas[~tool].max()) <= 0.5


def test_a_part_bends_with_its_bones():
    across = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    whole, bones = np.eye(4), {}
    whole[:3, :3], whole[2, 3] = across, 0.06
    for name, at in (("first", -0.02), ("second", 0.0), ("third", 0.02)):
        bones[name] = whole.copy()
        bones[name][:3, :3] = across * 5e-3  # whose vertices are a circle of radius 1
        bones[name][:3, 3] += at * across[:, 2]
    circle = cylinder(1.0, 0.0, 1.0).vertices[:256] * [1, 1, 0]
    (_, faces), vertices = lofted(np.stack([circle + [0, 0, i] for i in range(3)])), np.concatenate([*[circle] * 3, np.zeros((2, 3))])
    normals = np.concatenate([*[circle] * 3, [[0, 0, -1], [0, 0, 1]]])
    part = Part("tube", Material.VESSEL, vertices, faces, (*(name for name in bones for _ in range(256)), "first", "third"), normals)
    drawing = InstrumentDrawing([[part]], device="cpu")
    assert drawing.links == ((0, "tube"), (0, "first"), (0, "second"), (0, "third"))
    draw = lambda: drawing.draw([{"tube": np.eye(4), **bones}], CAMERA, *tissue())
    rod = cylinder(5e-3, -0.02, 0.02, material=Material.VESSEL)
    straight, rigid = draw(), InstrumentDrawing([[rod]], device="cpu").draw([{"roll": whole}], CAMERA, *tissue())
    assert (straight.labels == rigid.labels).float().mean() > 0.999 and (straight.labels == FIRST_LINK).any()
    np.testing.assert_allclose(straight.depths, rigid.depths, atol=1e-3)
    assert (straight.colors - rigid.colors).abs().mean() < 1e-3, "it is lit by the normals it was given"
    bones["third"][1, 3] += 0.01  # its end is lower in the picture
    bent = draw()
    rows = lambda picture, column: np.flatnonzero(picture.labels[:, column] == FIRST_LINK).mean()
    assert abs(rows(bent, 200) - rows(straight, 200)) < 1 and rows(bent, 490) - rows(straight, 490) > 60


@pytest.mark.parametrize("before", [True, False])
def test_what_is_nearer_hides_what_is_farther(before):
    colors, depths, alphas = tissue(0.1 if before else 0.03)
    parts, poses = scene()
    picture = InstrumentDrawing([parts], device="cpu").draw([poses], CAMERA, colors, depths, alphas)
    changed = (picture.colors != colors).any(-1)
    assert bool(changed.any()) == before == bool((picture.labels >= FIRST_LINK).any())
    if not before:
        assert torch.equal(picture.depths, depths) and bool((picture.labels == TISSUE).all())


@pytest.mark.parametrize("axis", [(1.0, 0.01, 0.0), (0.01, 1.0, 0.0), (1.0, 0.5, 0.0), (1.0, -0.5, 0.0), (0.5, 1.0, 0.0)])
def test_edges_have_every_shade(axis):
    pose = np.eye(4)
    pose[:3, 2] = axis / np.linalg.norm(axis)  # level and upright edges cross a row or column of pixels within a hundred
    pose[:3, 0] = 0, 0, 1
    pose[:3, 1] = np.cross(pose[:3, 2], pose[:3, 0])
    pose[2, 3] = 0.06
    colors, depths, alphas = tissue(0.3)
    picture = InstrumentDrawing([[cylinder(5e-3, -0.1, 0.1)]], device="cpu").draw([{"roll": pose}], CAMERA, colors, depths, 0 * alphas)
    counts = (4 * picture.alphas).round().int().flatten().bincount(minlength=5)
    assert len(counts) == 5 and bool((counts[1:4] > 100).all())


def test_edges_are_as_soft_as_a_pixel():
    parts, poses = scene()
    colors, depths, alphas = tissue(0.3, (0.0, 1.0, 0.0))
    picture = InstrumentDrawing([parts], device="cpu").draw([poses], CAMERA, colors, depths, alphas)
    share = 1 - (picture.colors[..., 1] - picture.colors[..., 0]).clamp(0, 1)  # steel and plastic are grey
    rim = (share > 0.1) & (share < 0.9)
    assert 300 < int(rim.sum()) < 12_000


@pytest.mark.parametrize("plain", [False, True])
def test_outlines_blend_what_is_lit(plain):
    parts, poses = scene()
    light = Light(distance=0.9, angle=2.0, tilt_x=0.3, reference=0.1)
    drawing = InstrumentDrawing([parts], DrawingConfig(mirror=0.0, ambient=0.0), "cpu")  # nothing that depends on the tissue
    colors, depths, alphas = tissue(0.3)
    with compare_plain() if plain else contextlib.nullcontext():
        alone = drawing.draw([poses], CAMERA, colors, depths, 0 * alphas)
        whole = drawing.draw([poses], CAMERA, colors, depths, alphas, light)
        share, instrument = alone.alphas, alone.colors - (1 - alone.alphas[..., None]) * colors
        lit = shade(light, whole.colors, whole.depths, whole.alphas, CAMERA)
        metres = torch.where(share > 0, alone.depths / share, 0.1)
        expected = shade(light, instrument, metres, alphas, CAMERA) + shade(light, (1 - share[..., None]) * colors, depths, alphas, CAMERA)
    assert int(((share > 0) & (share < 1)).sum()) > 900
    torch.testing.assert_close(lit, expected, atol=1e-4, rtol=1e-4)


def upright(depth=0.06):
    """Pose of a cylinder that stands upright in the middle of the picture."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    pose[2, 3] = depth
    return {"roll": pose}


def test_metal_mirrors_the_tissue_that_lies_in_that_direction():
    colors, depths, alphas = tissue()
    colors[:, :320], colors[:, 320:] = torch.tensor([0.6, 0.2, 0.2]), torch.tensor([0.2, 0.6, 0.2])
    drawing = InstrumentDrawing([[cylinder(8e-3, -0.1, 0.1)]], DrawingConfig(ambient=1.0), "cpu")  # no lamp
    picture = drawing.draw([upright()], CAMERA, colors, depths, alphas)
    columns = np.flatnonzero(picture.labels[256] == FIRST_LINK)
    left, middle, right = (picture.colors[256, columns[round(share * len(columns))]] for share in (0.04, 0.5, 0.96))
    assert left[0] > 1.3 * left[1] and right[1] > 1.3 * right[0]
    assert middle.max() < 0.5 * min(left.max(), right.max()), "it mirrors the dark lens"


@pytest.mark.parametrize("white", [1.0, 0.8])
@pytest.mark.parametrize("shoulder", [0.0, 0.5])
def test_the_brightest_shine_is_as_white_through_any_tone_curve(shoulder, white):
    light = Light(shoulder=shoulder)
    colors, depths, alphas = tissue()
    drawing = InstrumentDrawing([[cylinder(8e-3, -0.1, 0.1)]], DrawingConfig(white=white), "cpu")
    picture = drawing.draw([upright()], CAMERA, colors, depths, alphas, light)
    shine = picture.colors[picture.labels == FIRST_LINK].max()
    torch.testing.assert_close(shine, torch.tensor(white * (1 + shoulder)))
    if white == 1:
        assert shade(light, picture.colors, picture.depths, picture.alphas, CAMERA).max() == 1


def test_gaps_within_an_instrument_are_dark():
    rod, shades = cylinder(3e-3, -0.1, 0.1), []
    for radius in (3e-3, 5e-3):
        capsule = Capsule("roll", np.array([0, 0, -0.1]), np.array([0, 0, 0.1]), radius)
        drawing = InstrumentDrawing([[rod]], DrawingConfig(shadows=False), "cpu", [[capsule]])
        picture = drawing.draw([upright()], CAMERA, *tissue())
        shades.append(float(picture.colors[picture.labels == FIRST_LINK].mean()))
    assert shades[1] < 0.6 * shades[0]


def test_smooth_where_faces_go_on_and_sharp_where_they_do_not():
    part = cylinder(4e-3, 0.0, 0.02, 40)
    normals, corners = part.corner_normals, part.vertices[part.faces]
    side = np.abs(normals[:, 0, 2]) < 0.5
    outwards = corners[side][..., :2] / 4e-3
    np.testing.assert_allclose(normals[side][..., :2], outwards, atol=0.09)
    np.testing.assert_allclose(np.abs(normals[~side][..., 2]), 1, atol=1e-6)


def test_two_instruments_have_labels_of_their_own_and_repeat():
    parts, poses = scene()
    moved = {link: np.array([[1, 0, 0, -0.01], [0, 1, 0, -0.01], [0, 0, 1, 0.01], [0, 0, 0, 1]]) @ pose for link, pose in poses.items()}
    drawing = InstrumentDrawing([parts, parts], device="cpu")
    first, second = (drawing.draw([poses, moved], CAMERA, *tissue(0.3)) for _ in range(2))
    found = set(first.labels.unique().tolist()) - {TISSUE}
    assert {drawing.links[label - FIRST_LINK][0] for label in found} == {0, 1}
    assert torch.equal(first.colors, second.colors)
