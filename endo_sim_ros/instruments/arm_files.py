"""Parameter files of arms and tools: the JSON with comments of the dVRK, ours in ``parameters/`` or your own."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.folders import naming
from endo_sim_ros.instruments.kinematics import ArmKinematics, Joint, nearest_rotations

__all__ = ["arm_names", "load_arm", "save_tool", "tool_names"]

_SHIPPED = Path(__file__).parent / "parameters"
_MOST_BYTES = 1_000_000  # of a parameter file; one takes 3000
_STRING = r'("(?:\\.|[^"\\])*")'
_RIGHT = math.pi / 2
_LONGEST, _WIDEST = 2.0, 4 * math.pi  # m, rad: arms have 0.5 m and three quarters of a turn; millimetres and degrees are more
# What the closed-form inverse builds upon, joint by joint: alpha, a, angle, shift; None may be anything.
_REMOTE_CENTRE = ((_RIGHT, 0, _RIGHT, 0), (-_RIGHT, 0, -_RIGHT, 0), (_RIGHT, 0, 0, None))
_WRISTS = {1: ((0, 0, None, None),), 3: ((0, 0, None, None), (-_RIGHT, 0, -_RIGHT, 0), (-_RIGHT, None, -_RIGHT, 0))}


def arm_names() -> list[str]:
    """Names of the arms that `load_arm` knows without a file."""
    return sorted(path.stem for path in _SHIPPED.glob("*.json") if re.match("(PSM|ECM)", path.stem))


def tool_names() -> list[str]:
    """Names of the tools, endoscopes among them, that `load_arm` knows without a file."""
    return sorted({path.stem for path in _SHIPPED.glob("*.json")} - {*arm_names()})


def load_arm(arm: str = "PSM", tool: str = "") -> ArmKinematics:
    """An arm with its tool.

    Args:
        arm: One of `arm_names`, or the path of a kinematic file of the dVRK, such as ``dvrk_config/kinematic/psm.json``.
        tool: One of `tool_names`, also as ``LARGE_NEEDLE_DRIVER:400006``, or the path of a tool file of the dVRK. Without its
            number it is that for the arm: 420 for an arm whose name ends with ``Si``, otherwise 400. Empty takes a large
            needle driver or a straight endoscope, or nothing where the file of the arm brings its own tip.

    Raises:
        ConfigError: If there is no such arm or tool, or a file does not hold one.
    """
    path = _find("arm", arm, arm_names())
    joints, fields = _read(path)
    if not tool and len(joints) in (3, 4) and "tooltip_offset" not in fields:
        tool = "LARGE_NEEDLE_DRIVER" if len(joints) == 3 else "ENDOSCOPE_STRAIGHT"
    if tool:
        stem = tool.replace(":", "_")
        numbered = [name for name in tool_names() if re.fullmatch(rf"{re.escape(stem)}_4{2 * path.stem.lower().endswith('si')}\d+", name)]
        path = _find("tool", numbered[0] if numbered else stem if stem in tool_names() else tool, tool_names())
        more, changed = _read(path)
        joints, fields = joints + more, fields | changed
    where = " and ".join(dict.fromkeys([arm, path.stem if tool else arm]))
    _check_structure(joints, where)
    offset = _matrix(fields, "tooltip_offset", where) if "tooltip_offset" in fields else np.eye(4)
    R = offset[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0 or (offset[3] != [0, 0, 0, 1]).any():
        raise ConfigError(f"{where}: tooltip_offset must be a rotation and a position, with the last row 0 0 0 1, got {offset.tolist()}")
    if np.abs(offset[:3, 3]).max() > _LONGEST:
        raise ConfigError(f"{where}: tooltip_offset moves the tip by {offset[:3, 3].tolist()}; give it in metres")
    offset[:3, :3] = nearest_rotations(R)
    coupling = None
    if "coupling" in fields:
        table = fields["coupling"] if isinstance(fields["coupling"], dict) else {}
        coupling = _matrix(table, "ActuatorToJointPosition", f"{where}: coupling")
        if abs(np.linalg.det(coupling)) < 1e-9:
            raise ConfigError(f"{where}: coupling.ActuatorToJointPosition has no inverse; each disc must move a joint")
    jaw = _limits(fields["jaw"], f"{where}: jaw", True) if "jaw" in fields else None
    return ArmKinematics(Path(arm).stem, path.stem if tool else "", tuple(joints), offset, jaw, coupling)


def save_tool(path: Path, arm: ArmKinematics) -> None:
    """Write the tool of an arm as a file that `load_arm` reads. Its name names the tool, and with it the shape.

    Args:
        path: The file, such as ``LARGE_NEEDLE_DRIVER_400006.json``.
        arm: An arm with a wrist.
    """
    joints = [
        {"name": joint.name, "type": joint.kind, "alpha": joint.alpha, "A": joint.a, "theta": joint.angle, "D": joint.shift}
        | {"offset": 0, "qmin": joint.lower, "qmax": joint.upper}
        for joint in arm.joints[3:]
    ]
    fields: dict[str, Any] = {"DH": {"convention": "modified", "joints": joints}, "tooltip_offset": arm.tooltip_offset.tolist()}
    if arm.jaw is not None:
        fields["jaw"] = {"qmin": arm.jaw[0], "qmax": arm.jaw[1]}
    if arm.coupling is not None:
        fields["coupling"] = {"ActuatorToJointPosition": arm.coupling.tolist()}
    with naming(path):
        path.write_text(json.dumps(fields, indent=1) + "\n", "utf-8")


def _find(what: str, name: str, known: list[str]) -> Path:
    if name in known:
        return _SHIPPED / f"{name}.json"
    if what == "tool" and "@" not in name and name.endswith(".urdf"):
        hint = f"give it after the name of a tool, as LARGE_NEEDLE_DRIVER@{name}"
        raise ConfigError(f"{name}: a URDF has the shape of a tool alone; {hint}, to physics_node or endo-sim view")
    if not name.endswith(".json"):
        raise ConfigError(f"{what} must be the path of a .json file or one of {', '.join(known)}, got {name!r}")
    if not Path(name).is_file():
        raise ConfigError(f"{name}: there is no such file; {what} is the path of a kinematic file or one of {', '.join(known)}")
    return Path(name)


def _read(path: Path) -> tuple[list[Joint], dict[str, Any]]:
    """The joints of a file, and its other fields, in which ``-`` of older files is ``_``."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes, far more than the parameters of an arm need")
        text = re.sub(_STRING + r"|//[^\n]*|/\*.*?\*/", r"\1", path.read_text("utf-8"), flags=re.S)
        fields = json.loads(re.sub(_STRING + r"|,(?=\s*[}\]])", r"\1", text))  # the dVRK's reader allows a last comma, too
        if not isinstance(fields, dict):
            raise ValueError(f"expected an object, got a {type(fields).__name__}")
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not a readable kinematic file, which is JSON with comments ({error})") from None
    fields = {name.replace("-", "_"): value for name, value in fields.items()}
    table = fields.pop("DH", {})
    rows = table.get("joints", table.get("links", [])) if isinstance(table, dict) else None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ConfigError(f"{path}: DH must be an object with a list of joints, each of them an object")
    if not rows and "tooltip_offset" not in fields:
        raise ConfigError(f"{path}: it has neither DH.joints nor a tooltip_offset; give the kinematic file of an arm or a tool")
    return [_joint(row, table.get("convention"), f"{path}: joint {i}") for i, row in enumerate(rows, 1)], fields


def _joint(row: dict[str, Any], convention: Any, where: str) -> Joint:
    where = f"{where} ({row['name']})" if isinstance(row.get("name"), str) else where
    if row.get("convention", convention) != "modified":
        raise ConfigError(f"{where}: convention must be 'modified', got {row.get('convention', convention)!r}")
    if row.get("type") not in ("revolute", "prismatic"):
        raise ConfigError(f"{where}: type must be 'revolute' or 'prismatic', got {row.get('type')!r}")
    if row.get("mode", "active") != "active":
        raise ConfigError(f"{where}: mode must be 'active', got {row['mode']!r}; linkages with passive joints are not known")
    turns = row["type"] == "revolute"
    angles = {"alpha", "theta", "offset"} if turns else {"alpha", "theta"}
    alpha, a, theta, shift, offset = (_number(row, name, where, name in angles) for name in ("alpha", "A", "theta", "D", "offset"))
    lower, upper = _limits(row, where, turns)
    angle, shift = (theta + offset, shift) if turns else (theta, shift + offset)
    return Joint(str(row.get("name", where.rpartition(": ")[2])), row["type"], _exact(alpha), a, _exact(angle), shift, lower, upper)


def _exact(angle: float) -> float:
    """1.5708 means π/2: the dVRK, too, takes fractions of π that are printed with four decimals for exact ones."""
    near = round(angle / (math.pi / 12)) * (math.pi / 12)
    return near if abs(angle - near) < 1e-5 else angle


def _number(row: dict[str, Any], name: str, where: str, is_angle: bool) -> float:
    value = row.get(name, 0 if name in ("theta", "offset") else None)
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise ConfigError(f"{where}: {name} must be a finite number (m, rad), got {value!r:.60}")
    most, unit = (_WIDEST, "radians") if is_angle else (_LONGEST, "metres")
    if abs(value) > most:
        raise ConfigError(f"{where}: {name} is {value:g}, but no arm has more than {most:.3g} {unit}; give it in {unit}")
    return float(value)


def _limits(row: Any, where: str, are_angles: bool) -> tuple[float, float]:
    if not isinstance(row, dict):
        raise ConfigError(f"{where} must be an object with qmin and qmax, got {row!r:.60}")
    lower, upper = _number(row, "qmin", where, are_angles), _number(row, "qmax", where, are_angles)
    if lower >= upper:
        raise ConfigError(f"{where}: qmin {lower:g} must be below qmax {upper:g}")
    return lower, upper


def _matrix(fields: dict[str, Any], name: str, where: str) -> np.ndarray:
    try:
        matrix = np.array(fields.get(name), np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ConfigError(f"{where}: {name} must be four rows of four finite numbers, got {fields.get(name)!r:.60}")
    return matrix


def _check_structure(joints: list[Joint], where: str) -> None:
    """Raise ConfigError unless the joints are those of a PSM with an instrument, or of an ECM."""
    if len(joints) not in (4, 6):
        raise ConfigError(
            f"{where}: together they have {len(joints)} joints, but an arm with its tool has 6 (PSM with an instrument) or 4 (ECM with an "
            "endoscope); give the arm's file as arm and the tool's as tool"
        )
    for joint, pattern in zip(joints, (*_REMOTE_CENTRE, *_WRISTS[len(joints) - 3])):
        kind = "prismatic" if joint is joints[2] else "revolute"
        for name, wanted in zip(("alpha", "a", "angle", "shift"), pattern):
            found = getattr(joint, name)
            if joint.kind != kind or wanted is not None and abs(found - wanted) > 1e-9:
                raise ConfigError(
                    f"{where}: joint {joint.name} is {joint.kind} with {name} {found:g}, where a PSM or ECM has a {kind} joint"
                    f"{'' if wanted is None else f' with {wanted:g}'}; arms of another build are not known"
                )
