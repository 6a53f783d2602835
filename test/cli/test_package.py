"""The package as users install it: what lies where, and that it starts."""

import ast
import importlib.util
import os
import re
import shlex
import subprocess
import sys
import types
from pathlib import Path
from xml.etree import ElementTree

import pytest
from thorough import mostly_thorough

from endo_sim_ros.core.config import options
from endo_sim_ros.nodes.configs import NODE_CONFIGS

ROOT = Path(__file__).parents[2]
NODES = ("physics_node", "bag_player_node")  # of those that compute, and those that do not


@pytest.fixture(scope="module")
def prefix(tmp_path_factory) -> Path:
    """The package alone, installed by pip into an empty prefix."""
    target = tmp_path_factory.mktemp("prefix")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--ignore-installed", "--prefix", str(target), "."]
    source = tmp_path_factory.mktemp("source")
    listing = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True)
    if listing.returncode:
        pytest.skip("needs git to copy the source tree")
    for name in listing.stdout.splitlines():
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
            (source / name).chmod((ROOT / name).stat().st_mode)
    done = subprocess.run(command, cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return target


@pytest.fixture(scope="module")
def linked(tmp_path_factory) -> Path:
    """What `make` adds to the environment, in which pip has put an editable package."""
    target = tmp_path_factory.mktemp("linked")
    (target / ".installed").touch()
    done = subprocess.run(["make", "-C", ROOT, "links", f"VENV={target}"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return target


@pytest.mark.dds
@pytest.mark.parametrize("install", ["prefix", "linked"])
def test_nodes_are_executables_where_ros2_run_looks(install, request):
    folder = request.getfixturevalue(install) / "lib" / "endo_sim_ros"
    found = {path.name for path in folder.iterdir() if path.is_file() and os.access(path, os.X_OK)}
    assert found == {path.name for path in (ROOT / "scripts").glob("*_node")} > set(NODES)
    assert len({(folder / name).read_bytes() for name in found}) == 1  # so that one that starts its node tells of all
    assert all((ROOT / "endo_sim_ros" / "nodes" / f"{name}.py").is_file() for name in found)


@pytest.mark.dds
@pytest.mark.parametrize("install", ["prefix", "linked"])
def test_ament_index_finds_the_package(install, request, monkeypatch):
    from ament_index_python.packages import get_package_prefix, get_package_share_directory

    prefix = request.getfixturevalue(install)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(prefix))
    assert Path(get_package_prefix("endo_sim_ros")) == prefix
    share = Path(get_package_share_directory("endo_sim_ros"))
    for name in (
        "package.xml", "msg_conventions.md", "config/endo_sim.yaml", "config/endo_sim.rviz", "config/endo_sim.foxglove.json",
        "config/sros2/endo_sim.policy.xml", "launch/endo_sim.launch.py", "launch/replay.launch.py",
    ):  # fmt: skip
        assert (share / name).is_file(), name


@pytest.mark.dds
@pytest.mark.parametrize("node", mostly_thorough(reversed(NODES)))
def test_installed_executable_starts_its_node(prefix, node):
    """A parameter out of range makes it end at once, with the reason: proof that the node itself ran."""
    site = next(prefix.glob("lib/python*/site-packages"))
    paths = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    name = "rate" if node == "bag_player_node" else "density"
    done = subprocess.run(
        [str(prefix / "lib" / "endo_sim_ros" / node), "--ros-args", "-p", f"{name}:=-1.0"],
        env={**os.environ, "PATH": paths, "PYTHONPATH": str(site)}, cwd="/", capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert name in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_headers_of_kernels_are_installed(prefix):
    installed = next(prefix.glob("lib/python*/site-packages/endo_sim_ros"))
    headers = {path.relative_to(ROOT / "endo_sim_ros") for path in (ROOT / "endo_sim_ros").rglob("*.h")}
    assert headers and headers == {path.relative_to(installed) for path in installed.rglob("*.h")}


@pytest.mark.slow
def test_parameters_of_arms_are_installed(prefix):
    installed = next(prefix.glob("lib/python*/site-packages/endo_sim_ros/instruments/parameters"))
    names = {path.name for path in (ROOT / "endo_sim_ros" / "instruments" / "parameters").iterdir()}
    assert "PSM.json" in names and names == {path.name for path in installed.iterdir()}


@pytest.mark.dds
def test_command_line_is_installed(prefix):
    assert os.access(prefix / "bin" / "endo-sim", os.X_OK)


def test_package_xml_names_what_the_code_imports():
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.get("format") == "3"
    assert package.findtext("export/build_type") == "ament_python"
    declared = {element.text for element in package.findall("exec_depend")}
    imported = set()
    for path in (ROOT / "endo_sim_ros").rglob("*.py"):
        for line in path.read_text().splitlines():
            words = line.split()
            if len(words) > 1 and words[0] in ("import", "from"):
                imported.add(words[1].split(".")[0])
    from endo_sim_ros.messages.types import MESSAGE_PACKAGES

    ros = {name for name in imported if name == "rclpy" or name.endswith(("_msgs", "_srvs", "_interfaces"))} | set(MESSAGE_PACKAGES)
    assert ros <= declared, ros - declared


@pytest.mark.slow
@pytest.mark.parametrize("module", ["endo_sim_ros.nodes.configs", "endo_sim_ros.nodes.parameter_file"])
def test_options_of_all_nodes_need_neither_ros_nor_torch(module):
    code = f"import sys, {module}; print(sorted({{'rclpy', 'torch', 'warp'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


@pytest.mark.dds
def test_what_computes_nothing_starts_without_torch():
    modules = [f"endo_sim_ros.{name}" for name in ("graph.up", "nodes.bag_player_node", "nodes.recorder_node", "nodes.scripted_tool_node")]
    code = f"import sys, {', '.join(modules)}; print(sorted({{'torch', 'warp'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


@pytest.mark.parametrize("package", ["physics", "reconstruction", "rendering"])
def test_names_of_a_package_are_those_that_type_checkers_see(package):
    """What type checkers see imported leads to the same thing when it is imported on first use."""
    lazy = importlib.import_module(f"endo_sim_ros.{package}")
    (block,) = (node for node in ast.parse(Path(lazy.__file__).read_text()).body if isinstance(node, ast.If))
    for each in block.body:
        for alias in each.names:
            assert lazy.__getattr__(alias.name) is getattr(importlib.import_module(each.module), alias.name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = lazy.nothing


@pytest.mark.slow
def test_library_works_without_ros():
    """Everything but the nodes imports with the ROS packages hidden."""
    code = """
import sys
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in ('rclpy', 'sensor_msgs', 'geometry_msgs', 'std_msgs', 'diagnostic_msgs', 'builtin_interfaces'):
            raise ImportError(name)
sys.meta_path.insert(0, Hide())
import endo_sim_ros.cli.reconstruct, endo_sim_ros.rendering, endo_sim_ros.physics, endo_sim_ros.evaluation.held_out
import endo_sim_ros.sequences.readers, endo_sim_ros.sequences.bag
from endo_sim_ros import messages
messages.encode_pose(__import__('numpy').eye(4), 1, 'world', messages.bag_types())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


class _Recorded:
    """Stands for any action of launch: keeps what it was made with."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs


def _load_launch_file(name: str, monkeypatch) -> tuple[types.ModuleType, list]:
    """A launch file and its entities. Where launch is not installed its actions only record what they are made with."""
    if importlib.util.find_spec("launch_ros") is None:
        actions = ("DeclareLaunchArgument", "IncludeLaunchDescription", "OpaqueFunction", "Node")
        fake = {action: type(action, (_Recorded,), {}) for action in actions}
        for module in ("launch", "launch.actions", "launch_ros", "launch_ros.actions"):
            monkeypatch.setitem(sys.modules, module, types.SimpleNamespace(**fake))
        sys.modules["launch"].LaunchContext = object
        sys.modules["launch"].LaunchDescription = lambda entities: types.SimpleNamespace(entities=entities)
    spec = importlib.util.spec_from_file_location("launch_file", ROOT / "launch" / name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module, module.generate_launch_description().entities


@pytest.mark.parametrize("name", ["endo_sim.launch.py", "replay.launch.py"])
def test_launch_file_is_valid(name, monkeypatch):
    _, entities = _load_launch_file(name, monkeypatch)
    declared = [entity for entity in entities if type(entity).__name__ == "DeclareLaunchArgument"]
    assert declared
    for argument in declared:
        text = argument.kwargs["description"] if isinstance(argument, _Recorded) else argument.description
        assert text.endswith("."), text


@pytest.mark.skipif(importlib.util.find_spec("launch_ros") is not None, reason="looks into stand-ins of launch")
def test_launch_file_starts_the_graph_with_what_is_given(monkeypatch):
    module, entities = _load_launch_file("endo_sim.launch.py", monkeypatch)
    defaults = {entity.args[0]: entity.kwargs["default_value"] for entity in entities[:-1]}
    assert Path(defaults["params"]).is_file()
    start = lambda **given: [  # noqa: E731
        action.kwargs for action in entities[-1].kwargs["function"](types.SimpleNamespace(launch_configurations=defaults | given))
    ]
    graph = ["reconstruction_node", "physics_node", "rendering_node"]
    assert [node["executable"] for node in start()] == graph
    assert [node["parameters"] for node in start()] == [[defaults["params"], {}]] * 3
    everything = {"bag": "b", "rate": "2.0", "loop": "true", "model": "latest", "arms": "PSM1, PSM2", "view": "true", "rviz": "true"}
    nodes = start(**everything, namespace="left", enclaves="/e")
    names = [node["executable"] for node in nodes]
    assert names == ["rviz2", *graph, "viewer_node", "bag_player_node"], "RViz first: nothing is left behind where it is not installed"
    assert {node["namespace"] for node in nodes} == {"left"}
    assert Path(nodes[0]["arguments"][1]).is_file()
    names, nodes = names[1:], nodes[1:]
    given = [node["parameters"][1] for node in nodes]
    arms = ["PSM1", "PSM2"]
    page, player = {"arm": "PSM1", "arms": arms}, {"bag": "b", "rate": 2.0, "loop": True}
    assert given == [{"model_file": "latest"}, {"arms": arms}, {"arms": arms}, page, player]
    assert [node["ros_arguments"] for node in nodes] == [["--enclave", f"/e/{name}"] for name in names]
    with pytest.raises(FileNotFoundError, match="params"):
        start(params="/does/not/exist.yaml")
    for name in names:
        assert (ROOT / "scripts" / name).is_file()
    for node, parameters in zip(names, given):  # as the nodes declare them
        configs = NODE_CONFIGS[node.replace("player_node", "player")]
        known = {option.name: option.type for config in configs for option in options(config)}
        for key, value in parameters.items():
            assert known[key] in (type(value), tuple), key


def test_replay_launch_file_hands_everything_to_the_graph(monkeypatch):
    _, entities = _load_launch_file("replay.launch.py", monkeypatch)
    bag, graph = entities
    assert type(bag).__name__ == "DeclareLaunchArgument" and type(graph).__name__ == "IncludeLaunchDescription"
    if isinstance(bag, _Recorded):
        assert bag.args == ("bag",) and "default_value" not in bag.kwargs, "it is asked for"
        assert graph.args == (str(ROOT / "launch" / "endo_sim.launch.py"),)


@pytest.fixture(scope="module")
def pdoc() -> str:
    """The command of `make api`."""
    pytest.importorskip("pdoc")
    recipe = re.search(r"^api:.*\n\t(.*)", (ROOT / "Makefile").read_text(), re.M).group(1)
    return recipe.partition("#")[0].replace("$(VENV)/bin/pdoc", f"{sys.executable} -m pdoc")


@pytest.mark.thorough
@pytest.mark.slow
def test_the_api_reference_shows_public_names(pdoc, tmp_path):
    """Of a few rooms, as the others take a minute."""
    rooms = [f"endo_sim_ros.{name}" for name in ("messages", "physics.batch", "splatting.api")]
    command = pdoc.replace(" endo_sim_ros ", f" {' '.join(rooms)} ").replace("$(OUT)", str(tmp_path))
    assert rooms[0] in command
    done = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    pages = tmp_path / "api" / "endo_sim_ros"
    for page, name in {"physics/batch": "TissueBatch", "splatting/api": "rasterize", "messages/images": "encode_image"}.items():
        assert f'id="{name}"' in (pages / f"{page}.html").read_text(), f"{page} does not show {name}"


@pytest.mark.thorough
@pytest.mark.slow
def test_every_module_can_be_in_the_api_reference(pdoc):
    from pdoc import doc, extract  # in this process, which has imported most of them

    modules = extract.walk_specs(shlex.split(re.search(r" (endo_sim_ros .*)", pdoc).group(1)))
    documented = {Path(*name.split(".")) for name in modules if doc.Module.from_name(name).members is not None}
    files = {path.relative_to(ROOT).with_suffix("") for path in (ROOT / "endo_sim_ros").rglob("*.py") if path.name[:2] != "__"}
    assert files - documented == {Path("endo_sim_ros/learning/ppo")}
