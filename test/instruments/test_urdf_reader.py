"""A robot description with meshes takes the place of the shape that is built."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.cameras import make_pose
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import build_instrument, link_poses, load_arm
from endo_sim_ros.instruments.urdf import robot_description
from endo_sim_ros.instruments.urdf_reader import load_shape, read_urdf

ARM = load_arm("PSM", "LARGE_NEEDLE_DRIVER")
SURROL = Path(__file__).parents[3] / "shared" / "data" / "instruments" / "psm" / "psm.urdf"
JOINTS, JAW = np.array([0.3, -0.2, 0.12, 0.7, -0.5, 0.4]), 0.6


JOINT = '<joint name="{0}" type="fixed"><parent link="{1}" /><child link="{2}" /></joint>'
CIRCLE = "".join(JOINT.format(*names) for names in (("in", "PSM1_yaw", "here"), ("on", "here", "there"), ("back", "there", "here")))
LONG = "".join(JOINT.format(k, f"link {k}" if k else "PSM1_wrist_pitch", f"link {k + 1}") for k in range(1500))


def written(folder, text=None, **changes):
    """The file that describes our own arm, with some texts replaced."""
    text = (
        robot_description({"PSM1": (ARM, make_pose([0.1, -0.2, 0.3], [0.5, 0.1, -0.7, 0.3]), build_instrument(ARM)[1])})
        if text is None
        else text
    )
    for old, new in changes.get("replace", ()):
        assert old in text
        text = text.replace(old, new)
    file = folder / "psm.urdf"
    file.write_text(text)
    return file


def in_base(parts, joints, jaw):
    """Vertices of each link in the base frame."""
    poses = link_poses(ARM, joints, jaw)
    found = {}
    for part in parts:
        found.setdefault(part.link, []).append(part.vertices @ poses[part.link][:3, :3].T + poses[part.link][:3, 3])
    return {link: np.concatenate(own) for link, own in found.items()}


def test_what_was_written_is_read_back(tmp_path):
    """Cylinders of the description lie around the capsules that they were made of, wherever the base stands and however joints move."""
    parts, capsules = read_urdf(written(tmp_path), ARM)
    ours = build_instrument(ARM)[1]
    vertices, poses = in_base(parts, JOINTS, JAW), link_poses(ARM, JOINTS, JAW)
    assert set(vertices) == {capsule.link for capsule in ours}
    for link, found in vertices.items():
        own = [capsule for capsule in ours if capsule.link == link]
        away = []
        for capsule in own:
            start, end = (poses[link] @ [*point, 1] for point in (capsule.start, capsule.end))
            way, arm = (end - start)[:3], found - start[:3]
            share = np.clip(arm @ way / (way @ way), 0, 1)
            away.append(np.linalg.norm(arm - share[:, None] * way, axis=1) - capsule.radius)
        away = np.min(away, 0)  # the middles of their ends lie on the axis, all other corners on the capsule
        assert away.max() < 1e-6 and (np.abs(away) < 1e-6).mean() > 0.7
    assert {capsule.link for capsule in capsules} == set(vertices)


@pytest.mark.skipif(not SURROL.exists(), reason=f"{SURROL} is not there")
def test_a_description_of_somebody_else_fits_our_arm(caplog):
    parts, capsules = read_urdf(SURROL, ARM)
    assert "3 meshes are missing, first meshes/visual/main_insertion_link_1.obj" in caplog.text
    theirs, ours = in_base(parts, JOINTS, JAW), in_base(build_instrument(ARM)[0], JOINTS, JAW)
    for link in ("wrist_pitch", "jaw_left", "jaw_right"):
        assert np.linalg.norm(theirs[link].mean(0) - ours[link].mean(0)) < 4e-3, link
    assert np.ptp(theirs["roll"], axis=0).max() > 0.2  # with our shaft, as theirs is missing
    # Jaws open to their own sides.
    closed = in_base(parts, JOINTS, 0.0)
    apart = lambda found: np.linalg.norm(found["jaw_left"].mean(0) - found["jaw_right"].mean(0))
    assert apart(theirs) > apart(closed)


def test_meshes_are_found_scaled_and_coloured(tmp_path):
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((8, 8, 12)).export(tmp_path / "meshes" / "box.stl")  # mm
    cylinder = '<cylinder radius="0.0032" length="0.0091" /></geometry></visual></link><joint name="PSM1_wrist_pitch"'
    mesh = '<mesh filename="package://{}" scale="0.001 0.001 0.001"/></geometry>'
    black = '<material name="b"><color rgba="0 0 0 1"/></material></visual></link><joint name="PSM1_wrist_pitch"'
    for name in ("my_robot/meshes/box.stl", f"{tmp_path.name}/meshes/box.stl"):
        parts, _ = read_urdf(written(tmp_path, replace=[(cylinder, mesh.format(name) + black)]), ARM)
        (part,) = [part for part in parts if part.link == "wrist_pitch"]
        assert part.material.name == "SHAFT" and np.allclose(np.sort(np.ptp(part.vertices, axis=0)), [0.008, 0.008, 0.012], atol=1e-6)


@pytest.mark.parametrize(
    ("replace", "sentence"),
    [
        ([("<robot", "<robot <")], "this is no readable URDF"),
        ([('xyz="0 0 1"', 'xyz="0 nan 1"')], "expected 3 finite numbers"),
        ([('xyz="0 0 1"', 'xyz="0 0 0"')], "has no direction"),
        ([('type="prismatic"', 'type="fixed"')], "no chain of joints"),
        ([("<cylinder", '<mesh filename="gone.stl"'), ("length=", "len=")], r"\d+ meshes are missing, first gone.stl; none is there"),
        ([("<visual>", "<collision>"), ("</visual>", "</collision>")], "no link of the instrument has a visual mesh"),
        ([("<cylinder", "<box"), ("length=", "size=")], r"psm.urdf: a visual of \w+: size of a box: expected 3 finite numbers, got '0\."),
        (
            [("<cylinder", "<sphere"), ('radius="', 'radius="n')],
            "psm.urdf: a visual of .*: radius of a sphere: expected 1 finite number, got 'n0",
        ),
        ([("radius=", "radios=")], "psm.urdf: a visual of .*: radius of a cylinder: expected 1 finite number, got ''"),
        ([('radius="', 'radius="-')], "psm.urdf: a visual of .*: radius of a cylinder: it must be greater than 0"),
        ([('length="', 'length="9')], "psm.urdf: a visual of .*: this cylinder has a size of 9.* m; it looks like millimetres"),
        ([('<visual><origin xyz="', '<visual><origin xyz="1 ')], "psm.urdf: a visual of .*: expected 3 finite numbers"),
        (
            [("</visual>", '<material><color rgba="1 1" /></material></visual>')],
            "psm.urdf: a visual of .*: expected 4 finite numbers, got '1 1'",
        ),
        ([("<cylinder", f'<mesh filename="{"x" * 300}"'), ("length=", "len=")], "psm.urdf: a visual of .*: .*File name too long"),
        ([("</robot>", CIRCLE + "</robot>")], "psm.urdf: here is the child of several joints"),
    ],
)
def test_a_bad_file_is_one_sentence(tmp_path, replace, sentence):
    with pytest.raises(ConfigError, match=sentence):
        read_urdf(written(tmp_path, replace=replace), ARM)


def test_a_scale_that_is_no_number_names_file_and_link(tmp_path):
    trimesh.creation.box((0.008, 0.008, 0.012)).export(tmp_path / "box.stl")
    file = written(tmp_path, replace=[("<cylinder", '<mesh filename="box.stl" scale="mm"'), ("length=", "len=")])
    with pytest.raises(ConfigError, match="psm.urdf: a visual of .*: expected 3 finite numbers, got 'mm'"):
        read_urdf(file, ARM)


@pytest.mark.parametrize("model", ["PSM", "PSM_Si"])
def test_nodes_are_told_what_is_wrong_with_the_file_not_that_it_is_of_another_arm(tmp_path, model):
    arm = load_arm(model, "LARGE_NEEDLE_DRIVER")
    text = robot_description({"PSM1": (arm, np.eye(4), build_instrument(arm)[1])})
    file = written(tmp_path, text, replace=[("radius=", "radios=")])
    with pytest.raises(ConfigError, match="psm.urdf: a visual of .*: radius of a cylinder: expected 1 finite number"):
        load_shape(f"LARGE_NEEDLE_DRIVER:{arm.tool.rpartition('_')[2]}@{file}")


def test_a_way_of_links_as_long_as_one_likes_is_followed(tmp_path):
    assert read_urdf(written(tmp_path, replace=[("</robot>", LONG + "</robot>")]), ARM)


def test_the_file_of_another_tool_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"up to 0\.\d+ mm or mrad|up to \d+(\.\d+)? mm or mrad from those of PSM with PROGRASP"):
        read_urdf(written(tmp_path), load_arm("PSM", "PROGRASP_FORCEPS:420093"))


@pytest.mark.parametrize("model", ["PSM", "PSM_Si"])
def test_a_file_in_millimetres_is_told_so(tmp_path, model):
    arm = load_arm(model, "LARGE_NEEDLE_DRIVER")
    text = robot_description({"PSM1": (arm, make_pose([0.1, -0.2, 0.3], [0.5, 0.1, -0.7, 0.3]), build_instrument(arm)[1])})
    places = re.sub('xyz="([^"]*)" rpy', lambda found: f'xyz="{" ".join(str(1e3 * float(n)) for n in found[1].split())}" rpy', text)
    assert places != text
    with pytest.raises(ConfigError, match="psm.urdf: the places of its joints are in millimetres; a URDF has metres: divide them by 1000"):
        load_shape(f"LARGE_NEEDLE_DRIVER:{arm.tool.rpartition('_')[2]}@{written(tmp_path, places)}")
    sizes = re.sub('(radius|length)="([^"]*)"', lambda found: f'{found[1]}="{1e3 * float(found[2])}"', text)
    with pytest.raises(ConfigError, match="psm.urdf: a visual of .*: this cylinder has a size of .* m; it looks like millimetres"):
        read_urdf(written(tmp_path, sizes), arm)


BOX = trimesh.creation.box((0.004, 0.004, 0.004))
MANY = trimesh.Trimesh(BOX.vertices, np.tile(BOX.faces, (20_000, 1)), process=False)


@pytest.mark.parametrize(
    ("mesh", "sentence"),
    [
        (trimesh.creation.box((8, 8, 9100)), "is 9.1e.03 m long; if the unit is not the metre, give the URDF the right scale"),
        (
            trimesh.creation.box((8, 8, 300)),
            'it looks like millimetres; a URDF has metres, and a mesh in millimetres scale="0.001 0.001 0.001"',
        ),
        pytest.param(MANY, "triangles; simplify them to less than 200000", marks=pytest.mark.thorough),
        (trimesh.creation.box((8e-6, 8e-6, 9e-6)), "meshes of roll are at most 9e-06 m long; if the unit is not the metre, give"),
        (b"solid nothing", "has no triangles|cannot be read"),
    ],
)
def test_a_bad_mesh_is_one_sentence(tmp_path, mesh, sentence):
    file = tmp_path / "bad.stl"
    file.write_bytes(mesh) if isinstance(mesh, bytes) else mesh.export(file)
    with pytest.raises(ConfigError, match=sentence):
        read_urdf(written(tmp_path, replace=[("<cylinder", '<mesh filename="bad.stl"'), ("length=", "len=")]), ARM)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (
            lambda corners, faces: corners.__setitem__((3, 0), np.nan),
            "triangles with corners that are not finite are left out: box.stl and 6 more",
        ),
        (
            lambda corners, faces: faces.__setitem__(0, faces[1]),
            "holes, or edges of more than two triangles, show gaps: box.stl and 6 more",
        ),
        (lambda corners, faces: None, None),
    ],
)
def test_what_a_mesh_lacks_is_told_once(tmp_path, caplog, spoil, told):
    box = trimesh.creation.box((0.008, 0.008, 0.012))
    corners, faces = box.vertices.copy(), box.faces.copy()
    spoil(corners, faces)
    trimesh.Trimesh(corners, faces, process=False).export(tmp_path / "box.stl")
    read_urdf(written(tmp_path, replace=[("<cylinder", '<mesh filename="box.stl"'), ("length=", "len=")]), ARM)
    assert caplog.text.count(told) == 1 if told else not caplog.text


def test_a_huge_mesh_is_refused_before_it_is_read(tmp_path):
    with open(tmp_path / "huge.stl", "wb") as file:
        file.truncate(314_000_000)  # takes no room
    with pytest.raises(ConfigError, match="huge.stl: this mesh has 314 MB; simplify it to less than 200000 triangles"):
        read_urdf(written(tmp_path, replace=[("<cylinder", '<mesh filename="huge.stl"'), ("length=", "len=")]), ARM)


def test_an_open_mesh_that_turns_its_back_is_drawn_all_the_same(tmp_path):
    """Corners in no order: triangles seen from behind are not drawn, so they are made to agree."""
    box = trimesh.creation.box((0.008, 0.008, 0.012))
    faces = box.faces.copy()
    faces[::2] = faces[::2, ::-1]
    trimesh.Trimesh(box.vertices, faces, process=False).export(tmp_path / "box.ply")
    file = written(tmp_path, replace=[("<cylinder", '<mesh filename="box.ply"'), ("length=", "len=")])
    for part in read_urdf(file, ARM)[0]:
        corners = part.vertices[part.faces].astype(np.float64)
        assert np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0


def test_axes_may_point_the_other_way(tmp_path):
    turned = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    assert turned[2, 2] < 0  # an axis of 0 0 -1 is that line, too
    expected = in_base(read_urdf(written(tmp_path), ARM)[0], JOINTS, JAW)
    found = in_base(read_urdf(written(tmp_path, replace=[('xyz="0 0 1"', 'xyz="0 0 -1"')]), ARM)[0], JOINTS, JAW)
    for link in expected:
        np.testing.assert_allclose(found[link], expected[link], atol=1e-5)
