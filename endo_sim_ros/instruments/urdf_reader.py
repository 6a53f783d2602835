"""The shape of an instrument from a robot description (URDF) with its meshes, in place of the shape that `shapes` builds.

Joints are not taken from it: those of the arm's parameter file count. Both must describe the same arm, so that each link of the file
stays where it is in the frame of the same link of ours.
"""

import itertools
import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments.arm_files import load_arm
from endo_sim_ros.instruments.kinematics import ArmKinematics
from endo_sim_ros.instruments.shapes import LINKS, SHAPES, Capsule, Material, Part, build_instrument, link_poses
from endo_sim_ros.instruments.urdf import read_numbers, read_origin

log = logging.getLogger(__name__)

_KINDS = ["revolute", "revolute", "prismatic", "revolute", "revolute", "revolute"]
_MOST_FACES = 200_000  # of all meshes; drawing takes time for each, and a picture has as many pixels
_MOST_BYTES = 64_000_000  # of one mesh; so many triangles take 54 MB in the wordiest format
_LARGEST = 1.5  # m: no link is as long; one of a hundred is in millimetres
_SMALLEST = 1e-3  # m: no link is as short; one of a few micrometres was scaled twice
_OFF = 1e-3  # m, and its thousandfold in mrad, by which axes may differ from those of the arm
_MILLIMETRE = 1e-3  # m
_DARK = 0.2  # mean of red, green and blue below which a surface is that of a shaft
_SHAFT_BEHIND = 0.03  # m behind the wrist; where nothing of the file is, the shaft is ours


class _AnotherArmError(ConfigError):
    """The file describes another arm than it was read for."""


class _Joint(NamedTuple):
    kind: str
    parent: str
    child: str
    origin: np.ndarray  # [4, 4] in the frame of the parent
    axis: np.ndarray  # [3] in that of the child


def load_shape(tool_type: str) -> tuple[list[Part], list[Capsule]]:
    """The parts and capsules of an instrument by what the topic ``tool_type`` says.

    Args:
        tool_type: What loads the tool, and after an @ the path of the URDF that has its shape, if that is not ours.

    Raises:
        ConfigError: If there is no such tool, or the URDF cannot be used.
    """
    tool, _, description = tool_type.partition("@")
    if not description:
        return build_instrument(load_arm("PSM", tool))
    try:
        return read_urdf(description, load_arm("PSM", tool))
    except ConfigError as error:
        try:
            return read_urdf(description, load_arm("PSM_Si", tool))
        except _AnotherArmError:  # so that what is wrong with the file of a PSM is said
            raise error from None


def read_urdf(path: str | Path, arm: ArmKinematics) -> tuple[list[Part], list[Capsule]]:
    """The parts and capsules of an instrument, as `build_instrument` gives them, from the visual meshes of a URDF.

    What moves with the insertion moves with the roll here. Links whose mesh is missing are not drawn, and a warning names them; a
    missing shaft is replaced by ours. Dark colours are those of a shaft, others steel.

    Args:
        path: The file. Meshes are looked for beside it; ``package://`` names the folder above, or one further up.
        arm: The arm with its tool that carries the instrument.

    Raises:
        ConfigError: If the file cannot be read, describes another arm, or has no usable mesh.
    """
    path = Path(path)
    try:
        robot = ElementTree.parse(path).getroot()
        joints = [_joint(element) for element in robot.iter("joint") if element.find("parent") is not None]
    except (OSError, ElementTree.ParseError, ValueError, AttributeError, LookupError) as error:
        raise ConfigError(f"{path}: this is no readable URDF: {error}") from None
    if twice := [link for link, count in Counter(joint.child for joint in joints).items() if count > 1]:
        raise ConfigError(f"{path}: {twice[0]} is the child of several joints; links of a URDF are a tree, without circles")
    chain = next((way for way in _ways(joints) if [j.kind for j in way if j.kind != "fixed"][:6] == _KINDS), None)
    if chain is None or len(arm.joints) < 6:
        raise ConfigError(f"{path}: no chain of joints goes from a base by {', '.join(_KINDS)}, as that of {arm.name or 'an arm'} does")
    poses = _poses(joints, chain[0].parent)
    moving = [joint for joint in chain if joint.kind != "fixed"][:6]
    base = _base(path, arm, [(poses[j.child][:3, 3], poses[j.child][:3, :3] @ j.axis) for j in moving])
    zero = link_poses(arm, np.zeros(len(arm.joints)), base=base)
    parts = _Meshes(path, robot).parts(_links(joints, moving, poses, zero), poses, zero)
    shape = SHAPES.get(arm.tool.rstrip("_0123456789"), SHAPES["LARGE_NEEDLE_DRIVER"])
    capsules = [_capsule(link, np.concatenate([p.vertices for p in parts if p.link == link])) for link in LINKS if _has(parts, link)]
    if not any(part.link == "roll" and part.vertices[:, 2].min() < -_SHAFT_BEHIND for part in parts):
        ours, around = build_instrument(arm, shape)
        parts += [part for part in ours if part.material == Material.SHAFT]
        capsules.append(next(capsule for capsule in around if capsule.link == "roll"))
    return parts, capsules


def _unit(size: float) -> str:
    """What to do about an implausible size, m: in a URDF all is in metres."""
    if _SMALLEST <= size * _MILLIMETRE <= _LARGEST:
        return 'it looks like millimetres; a URDF has metres, and a mesh in millimetres scale="0.001 0.001 0.001"'
    return "if the unit is not the metre, give the URDF the right scale"


def _has(parts: list[Part], link: str) -> bool:
    return any(part.link == link for part in parts)


def _joint(element: ElementTree.Element) -> _Joint:
    kind = element.get("type", "fixed").replace("continuous", "revolute")
    ends = [element.find(name) for name in ("parent", "child")]
    parent, child = (end.attrib["link"] for end in ends if end is not None)
    axis = element.find("axis")
    direction = np.array([1.0, 0, 0]) if axis is None else read_numbers(axis.get("xyz", "1 0 0"), 3)
    length = np.linalg.norm(direction)
    if kind != "fixed" and not length > 0:
        raise ValueError(f"the axis of {element.get('name')} has no direction")
    return _Joint(kind, parent, child, read_origin(element), direction / max(length, 1e-12))


def _ways(joints: list[_Joint]) -> Iterator[list[_Joint]]:
    """All ways from a root to a leaf of a tree; what goes round in circles has no root."""
    children = {joint.child for joint in joints}
    waiting = [[joint] for joint in reversed(joints) if joint.parent not in children]
    while waiting:
        way = waiting.pop()
        after = [joint for joint in reversed(joints) if joint.parent == way[-1].child]
        waiting += [[*way, joint] for joint in after]
        if not after:
            yield way


def _poses(joints: list[_Joint], root: str) -> dict[str, np.ndarray]:
    """Poses [4, 4] of links in the root, all joints at zero."""
    poses, waiting = {root: np.eye(4)}, [root]
    while waiting:
        parent = waiting.pop()
        for joint in joints:
            if joint.parent == parent and joint.child not in poses:
                poses[joint.child] = poses[parent] @ joint.origin
                waiting.append(joint.child)
    return poses


def _base(path: Path, arm: ArmKinematics, axes: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Pose [4, 4] of the arm's base in the root of the file, in which the axes of all joints are the same lines.

    Two chains whose axes are the same lines while joints are at zero move alike (product of exponentials).
    """
    best, least = _nearest_base(arm, axes)
    if least <= _OFF:
        return best
    if _nearest_base(arm, [(at * _MILLIMETRE, way) for at, way in axes])[1] <= _OFF:
        raise ConfigError(f"{path}: the places of its joints are in millimetres; a URDF has metres: divide them by 1000")
    raise _AnotherArmError(
        f"{path}: the axes of its joints are up to {1e3 * least:.3g} mm or mrad from those of {arm.name} with {arm.tool}; name the arm "
        "and the tool that the file describes"
    )


def _nearest_base(arm: ArmKinematics, axes: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, float]:
    """The pose [4, 4] of an arm's base in which its axes are nearest to those of a file, and how far they are then, m or rad."""
    ours = [(frame[:3, 3], frame[:3, 2]) for frame in arm.link_frames(np.zeros(len(arm.joints)))[:6]]
    # The base is where the axes of yaw and pitch meet: the point nearest to both.
    across = [np.eye(3) - np.outer(way, way) for _, way in axes[:2]]
    meeting = np.linalg.lstsq(sum(across, np.zeros((3, 3))), sum((A @ at for A, (at, _) in zip(across, axes)), np.zeros(3)), rcond=None)[0]
    best, least = np.eye(4), np.inf
    for signs in itertools.product((1, -1), repeat=3):  # an axis may point either way: only the sign of its joint's position differs
        theirs = [sign * way for sign, (_, way) in zip(signs, axes)]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.align_vectors(theirs, [way for _, way in ours[:3]])[0].as_matrix(), meeting
        off = max(_apart(pose, mine, other, slides=i == 2) for i, (mine, other) in enumerate(zip(ours, axes)))
        if off < least:
            best, least = pose, off
    return best, least


def _apart(base: np.ndarray, ours: tuple[np.ndarray, np.ndarray], theirs: tuple[np.ndarray, np.ndarray], slides: bool) -> float:
    """How far apart two axes are: m, or rad; of one that slides the direction alone counts."""
    at, way = base[:3, :3] @ ours[0] + base[:3, 3], base[:3, :3] @ ours[1]
    turned = float(np.linalg.norm(np.cross(way, theirs[1])))
    return turned if slides else max(turned, float(np.linalg.norm(np.cross(theirs[0] - at, way))))


def _links(joints: list[_Joint], moving: list[_Joint], poses: dict[str, np.ndarray], zero: dict[str, np.ndarray]) -> dict[str, list[str]]:
    """Links of the file that move with each of ours."""

    def rigid(link: str) -> list[str]:
        """A link and what is fixed to it."""
        links = [link]
        for each in links:  # those that are added, too
            links += [joint.child for joint in joints if joint.parent == each and joint.kind == "fixed"]
        return links

    insertion, roll, pitch, yaw = (rigid(joint.child) for joint in moving[2:])
    jaws = [joint for joint in joints if joint.parent in yaw and joint.kind == "revolute"]
    named = {"roll": insertion + roll, "wrist_pitch": pitch, "wrist_yaw": yaw}
    return named | {f"jaw {i}": rigid(joint.child) for i, joint in enumerate(jaws)}


class _Meshes:
    """The visual meshes of a file."""

    def __init__(self, path: Path, robot: ElementTree.Element) -> None:
        try:
            import trimesh  # pyright: ignore[reportMissingImports]  (optional)
        except ImportError:
            raise ConfigError(f"{path}: its meshes are read by trimesh, which is not installed: pip install 'endo_sim_ros[urdf]'") from None
        self._trimesh, self._path = trimesh, path
        self._findings: dict[str, list[str]] = {}  # names of meshes by what is odd about them
        self._links = {link.get("name"): link for link in robot.iter("link")}
        self._materials = {m.get("name"): m for m in robot.iter("material") if m.find("color") is not None}

    def parts(self, links: dict[str, list[str]], poses: dict[str, np.ndarray], zero: dict[str, np.ndarray]) -> list[Part]:
        """The parts of the instrument; which jaw is which tells the side on which it lies."""
        found: dict[str, list[Part]] = {}
        missing, faces = [], 0
        for ours, theirs in links.items():
            frame = np.linalg.inv(zero["wrist_yaw" if ours.startswith("jaw") else ours])
            for name in theirs:
                for visual in self._links[name].iter("visual") if name in self._links else ():
                    try:
                        mesh = self._mesh(visual)
                        pose, material = frame @ poses[name] @ read_origin(visual), self._material(visual)
                    except FileNotFoundError as error:
                        missing.append(str(error))
                        continue
                    except (OSError, ValueError) as error:
                        if isinstance(error, ConfigError):
                            raise
                        raise ConfigError(f"{self._path}: a visual of {name}: {error}") from None
                    if mesh is None:
                        continue
                    faces += len(mesh.faces)
                    vertices = (mesh.vertices @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
                    found.setdefault(ours, []).append(Part(ours, material, vertices, np.asarray(mesh.faces, np.int32)))
        if faces > _MOST_FACES:
            raise ConfigError(f"{self._path}: its meshes have {faces} triangles; simplify them to less than {_MOST_FACES}")
        if missing:
            rest = "" if found else "; none is there, so there is nothing to draw"
            text = f"{self._path}: {len(missing)} meshes are missing, first {missing[0]}{rest}"
            if not found:
                raise ConfigError(text)
            log.warning("%s; their links are not drawn", text)
        if not found:
            raise ConfigError(f"{self._path}: no link of the instrument has a visual mesh")
        for what, names in self._findings.items():
            log.warning("%s: %s: %s%s", self._path, what, names[0], f" and {len(names) - 1} more" if len(names) > 1 else "")
        for ours, own in found.items():
            if (size := max(np.ptp(part.vertices, axis=0).max() for part in own)) < _SMALLEST:
                raise ConfigError(f"{self._path}: its meshes of {ours} are at most {size:.3g} m long; {_unit(size)}")
        sides = [name for name in found if name.startswith("jaw")]
        # The left jaw opens towards x of the frame of the yaw.
        sides.sort(key=lambda name: -float(np.mean([part.vertices[:, 0].mean() for part in found[name]])))
        names = dict.fromkeys(sides, "wrist_yaw") | dict(zip(sides, LINKS[3:]))  # a third one stays closed
        return [replace(part, link=names.get(link, link)) for link, own in found.items() for part in own]

    def _mesh(self, visual: ElementTree.Element) -> Any:
        """The mesh of a visual, or None where it has no shape; raises FileNotFoundError with the name of a file that is missing."""
        geometry = visual.find("geometry")
        shape = None if geometry is None else next(iter(geometry), None)
        create = self._trimesh.creation
        if shape is None or shape.tag not in ("box", "cylinder", "sphere", "mesh"):
            return None
        if shape.tag != "mesh":
            sizes = {"box": [("size", 3)], "cylinder": [("radius", 1), ("length", 1)], "sphere": [("radius", 1)]}[shape.tag]
            numbers = np.concatenate([self._size(shape, name, count) for name, count in sizes])
            if (size := numbers.max()) > _LARGEST:
                raise ValueError(f"this {shape.tag} has a size of {size:.3g} m; {_unit(size)}")
            if shape.tag == "box":
                return create.box(numbers)
            return create.cylinder(*numbers, sections=32) if shape.tag == "cylinder" else create.icosphere(3, *numbers)
        file = self._file(shape.get("filename", ""))
        if (size := file.stat().st_size) > _MOST_BYTES:
            raise ConfigError(f"{file}: this mesh has {size / 1e6:.0f} MB; simplify it to less than {_MOST_FACES} triangles")
        try:
            mesh = self._trimesh.load(file, force="mesh", process=False)
            if not np.isfinite(mesh.vertices).all():
                self._findings.setdefault("triangles with corners that are not finite are left out", []).append(file.name)
            mesh.process()  # leaves these out, and makes one of corners in one place
        except Exception as error:  # of whatever reads this format
            raise ConfigError(f"{file}: this mesh cannot be read: {error!s:.200}") from None
        mesh.apply_scale(read_numbers(shape.get("scale", "1 1 1"), 3))
        if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
            raise ConfigError(f"{file}: this mesh has no triangles, or corners that are not finite")
        if (size := np.ptp(mesh.vertices, axis=0).max()) > _LARGEST:
            raise ConfigError(f"{file}: this mesh is {size:.3g} m long; {_unit(size)}")
        closed = mesh.copy()
        closed.merge_vertices(merge_tex=True, merge_norm=True)
        if not closed.is_watertight:
            self._findings.setdefault("meshes with holes, or edges of more than two triangles, show gaps", []).append(file.name)
        if not mesh.is_winding_consistent:
            mesh.fix_normals()
        return mesh

    @staticmethod
    def _size(shape: ElementTree.Element, name: str, count: int) -> np.ndarray:
        """So many positive sizes of a shape, m; raises ValueError if it has others."""
        try:
            numbers = read_numbers(shape.get(name, ""), count)
        except ValueError as error:
            raise ValueError(f"{name} of a {shape.tag}: {error}") from None
        if numbers.min() <= 0:
            raise ValueError(f"{name} of a {shape.tag}: it must be greater than 0")
        return numbers

    def _file(self, name: str) -> Path:
        folders = [self._path.parent]
        if name.startswith("package://"):
            name, folders = name.removeprefix("package://"), [*self._path.resolve().parents]
            name, within = name.split("/", 1)[-1], name
            candidates = [folder / each for folder in folders for each in (within, name)]
        else:
            candidates = [folders[0] / name.removeprefix("file://")]
        for candidate in candidates:
            if candidate.is_file():
                return candidate
        raise FileNotFoundError(name)

    def _material(self, visual: ElementTree.Element) -> Material:
        material = visual.find("material")
        if material is not None and material.find("color") is None:
            material = self._materials.get(material.get("name"))
        color = None if material is None else material.find("color")
        if color is None:
            return Material.STEEL
        return Material.SHAFT if read_numbers(color.get("rgba", "1 1 1 1"), 4)[:3].mean() < _DARK else Material.STEEL


def _capsule(link: str, vertices: np.ndarray) -> Capsule:
    """A capsule around most of the vertices [V, 3] of a link, along their longest axis."""
    middle = vertices.mean(0).astype(np.float64)
    way = np.linalg.svd(vertices - middle, full_matrices=False)[2][0]
    along = (vertices - middle) @ way
    radius = float(np.percentile(np.linalg.norm(vertices - middle - along[:, None] * way, axis=1), 90))
    low, high = along.min() + radius, along.max() - radius
    low, high = (low, high) if low < high else (0.5 * (low + high),) * 2
    return Capsule(link, middle + low * way, middle + high * way, radius)
