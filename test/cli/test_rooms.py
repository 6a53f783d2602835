"""The rooms of the package as docs/architecture.md draws them: a room imports only rooms above it, and there are no circles."""

import ast
import functools
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for folder in ("endo_sim_ros", "benchmarks")
    for path in (ROOT / folder).rglob("*.py")
}
# The order of the table in docs/architecture.md.
ORDER = re.findall(r"^\| `([a-z]+)(?:/|\.py)` \|", (ROOT / "docs" / "architecture.md").read_text(), re.M)
ROS = ("rclpy", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "rcl_interfaces", "rosgraph_msgs", "sensor_msgs", "std_msgs")


@functools.cache
def imported(path: Path) -> set[str]:
    """Modules that a file imports anywhere but for type checkers, whole names; relative imports are not used here."""
    tree, found = ast.parse(path.read_text()), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def module_of(name: str) -> str | None:
    """The file's module that an imported name is, or is taken from."""
    while name and name not in FILES:
        name = name.rpartition(".")[0]
    return name or None


def room_of(module: str) -> str:
    parts = module.split(".")
    return parts[0] if parts[0] == "benchmarks" else parts[1] if len(parts) > 1 else ""


@functools.cache  # not where tests are found, which every process of them does
def imports() -> dict[str, set[str]]:
    """The modules of the package that each of its modules imports."""
    return {name: {module for each in imported(path) if (module := module_of(each))} - {name} for name, path in FILES.items()}


def test_every_room_is_in_the_drawing():
    rooms = {room_of(name) for name in FILES} - {"", "benchmarks"}
    assert rooms == set(ORDER)


@pytest.mark.parametrize("room", ORDER)
def test_a_room_imports_only_rooms_above_it(room):
    below = set(ORDER[ORDER.index(room) + 1 :]) | ({"benchmarks"} if room != "cli" else set())  # `endo-sim bench` runs them
    wrong = {(name, other) for name, others in imports().items() if room_of(name) == room for other in others if room_of(other) in below}
    assert not wrong


def test_files_import_each_other_in_no_circle():
    packages = {name for name, path in FILES.items() if path.name == "__init__.py"}  # they only gather names
    graph = {name: {other for other in others if other not in packages} for name, others in imports().items() if name not in packages}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_backends_of_physics_import_of_it_only_what_lies_below_them():
    inside = {name for name in FILES if name.startswith("endo_sim_ros.physics")}
    backends = {name for name in inside if name.startswith("endo_sim_ros.physics.backends")}
    below = {"endo_sim_ros.physics.materials", "endo_sim_ros.physics.stencils"}
    assert not {(name, other) for name in backends for other in imports()[name] & inside - backends - below}
    assert not {(name, other) for name in below for other in imports()[name] & inside}


@pytest.mark.slow
def test_only_nodes_graph_and_messages_import_ros():
    for name, path in FILES.items():
        if room_of(name) not in ("nodes", "graph", "messages", "benchmarks"):
            assert not [each for each in imported(path) if each.split(".")[0] in ROS], name
