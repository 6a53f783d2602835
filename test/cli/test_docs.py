"""What the pages say: links lead somewhere, commands have these options, nodes these parameters, and code runs."""

import re
import shlex
from pathlib import Path

import pytest

from endo_sim_ros.cli import parse
from endo_sim_ros.core.config import options
from endo_sim_ros.nodes.configs import NODE_CONFIGS
from endo_sim_ros.sequences.bag import write_bag

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "msg_conventions.md", *(ROOT / "docs").glob("*.md")])
NAMES = [page.name for page in PAGES]


def shell_lines(page: Path) -> list[list[str]]:
    """The commands in blocks of shell, as words; lines that end in a backslash are one."""
    blocks = re.findall(r"```sh\n(.+?)```", page.read_text(), re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target.split("#")[0]).exists(), target


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_have_these_options(page):
    """Each is parsed but not run; tyro exits where it does not understand one."""
    inline = [shlex.split(text) for text in re.findall(r"`(endo-sim [^`|…{]+)`", page.read_text()) if " --" in text]
    for words in [*shell_lines(page), *inline]:
        if words[0].endswith("endo-sim") and "--help" not in words:
            name, *options = (word for word in words[1:] if word != "&")
            parse(name, options)


WITH_NODES = [page for page in PAGES if any(words[:3] == ["ros2", "run", "endo_sim_ros"] for words in shell_lines(page))]


@pytest.mark.parametrize("page", WITH_NODES, ids=[page.name for page in WITH_NODES])
def test_nodes_and_their_parameters_exist(page):
    known = {node: {option.name for config in configs for option in options(config)} for node, configs in NODE_CONFIGS.items()}
    for words in shell_lines(page):
        if words[:2] != ["ros2", "run"] or words[2] != "endo_sim_ros":
            continue
        node = words[3]
        assert (ROOT / "scripts" / node).is_file(), node
        section = known.get(node) or known[node.removesuffix("_node")]
        for flag, value in zip(words, words[1:]):
            if flag == "-p":
                assert value.split(":=")[0] in section, (node, value)


@pytest.mark.slow
def test_what_is_named_where_something_is_added_exists():
    section = (ROOT / "CONTRIBUTING.md").read_text().split("## Add something")[1].split("\n## ")[0]
    folders = [ROOT / folder for folder in ("endo_sim_ros", "config", "docs", "scripts", "test")]
    paths = [*ROOT.iterdir(), *(path for folder in folders for path in folder.rglob("*"))]
    known = "".join(f"/{path.relative_to(ROOT)}\n" for path in paths)
    code = "".join(path.read_text() for path in paths if path.suffix in (".py", ".h"))
    for name in re.findall(r"`([^`]+)`", section):
        if "/" in name or name.endswith(".md"):
            name = name.split()[-1]  # of a command that writes a file
            assert f"/{name.rpartition('/')[0] if 'NAME' in name else name.rstrip('/')}\n" in known, name
        else:
            assert all(re.search(rf"\b{word}\b", code) for word in re.findall(r"\w+", name)), name


@pytest.mark.dds
def test_the_code_of_the_library_page_runs(small_frames, tmp_path, monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.+?)```", (ROOT / "docs" / "library.md").read_text(), re.S)
    write_bag(tmp_path / "my_bag", small_frames)
    for long, short in {"frames, 8": "frames, 3", "iterations=1500, image_width=320": "iterations=10, max_gaussians=1000"}.items():
        assert long in code
        code = code.replace(long, short)
    monkeypatch.chdir(tmp_path)
    exec(code, {"__name__": "__main__"})
    force = [float(value) for value in re.findall(r"-?\d[\d.e-]*", capsys.readouterr().out)]
    assert force == pytest.approx([0.0, 1.5, 1.0], abs=1e-6)
