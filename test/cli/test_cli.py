"""The commands as a user types them."""

import errno
import inspect
import logging
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from dense_sheet import sheet
from endo_sim_command import endo_sim_here
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from waiting import wait_until

from endo_sim_ros import cli
from endo_sim_ros.cli import convert
from endo_sim_ros.core.config import ConfigError, options
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import load_ply, save_ply
from endo_sim_ros.evaluation import held_out, plots
from endo_sim_ros.physics import PhysicsConfig, tissue
from endo_sim_ros.reconstruction import ReconstructionConfig, from_bag
from endo_sim_ros.reconstruction.from_bag import reconstruct_bag
from endo_sim_ros.reconstruction.presets import preset
from endo_sim_ros.reconstruction.trainer import Progress
from endo_sim_ros.sequences import bag_private
from endo_sim_ros.sequences.bag import read_bag, write_bag
from endo_sim_ros.sequences.readers import READERS

ROOT = Path(__file__).parents[2]


@pytest.mark.dds
@pytest.mark.parametrize("program", [["cli", "config"], ["nodes.physics_node", "--help"]])
def test_an_interrupt_while_a_program_starts_ends_it_without_a_traceback(program):
    heard = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # the tests may run where nobody hears it, in the background of a shell
    command = [sys.executable, "-m", f"endo_sim_ros.{program[0]}", *program[1:]]
    started = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, preexec_fn=heard)
    wait_until(lambda: "numpy" in Path(f"/proc/{started.pid}/maps").read_text(), 30, "the imports of the program")
    started.send_signal(signal.SIGINT)
    said, _ = started.communicate(timeout=120)
    assert b"Traceback" not in said and started.returncode in (-signal.SIGINT, 130)


@pytest.mark.parametrize("server", [True, False])
def test_an_interrupt_ends_the_server_of_processes_without_a_traceback_while_it_imports(server):
    heard = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    own = "from multiprocessing.forkserver import main; " if server else ""  # as Python begins one
    code = own + "import endo_sim_ros, os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(60)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, preexec_fn=heard, timeout=120)
    assert (b"Traceback" in ended.stderr) != server  # other people's programs are left as they are


@pytest.mark.dds
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.thorough)])
def test_a_command_that_is_told_to_end_cleans_up(number, tmp_path):
    heard = lambda: signal.signal(number, signal.SIG_DFL)
    bag = tmp_path / "bag"
    command = [sys.executable, "-m", "endo_sim_ros.cli", "phantom", str(bag), "--frames", "5000"]
    program = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, preexec_fn=heard)
    wait_until(bag.exists, 30, "the bag")
    program.send_signal(number)
    _, said = program.communicate(timeout=120)
    assert program.returncode == 128 + number and b"Traceback" not in said
    assert not bag.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_a_callback_that_may_not_raise_is_heard(number):
    code = f"""
import os, signal, time, weakref
from endo_sim_ros import cli
signal.signal({int(number)}, signal.SIG_DFL)
class Thing: pass
def busy():
    thing = Thing()
    kept.append(weakref.ref(thing, lambda _: (os.kill(os.getpid(), {int(number)}), time.sleep(0))))
def run(self):
    busy()
    time.sleep(60)
    print("went on")
kept = []
cli.parse = lambda name, words: type("Command", (), {{"run": run}})()
raise SystemExit(cli.main())
"""
    done = subprocess.run([sys.executable, "-c", code, "config"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 128 + number and not done.stdout and not done.stderr


def test_help_names_every_command_and_imports_none():
    code = "import sys; sys.argv = ['endo-sim', '--help']; from endo_sim_ros.cli import main; main(); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in cli.COMMANDS:
        assert re.search(rf"^  {name} +[A-Z]", done.stdout, re.M), name
    assert re.search(r"continue it\.\n  imitate", done.stdout), "of each the first paragraph"
    assert not {"torch", "warp", "rclpy", "numpy", "cv2", "tyro", "rich"} & set(done.stderr.split())


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [["cli", "--help"], ["cli", "config", "--help"], pytest.param(["nodes.physics_node", "--help"], marks=pytest.mark.thorough)]
)
def test_help_that_nobody_reads_on_ends_without_an_error(words):
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", f"endo_sim_ros.{words[0]}", *words[1:]]
    with open(write, "wb") as output:
        done = subprocess.run(command, cwd=ROOT, stdout=output, stderr=subprocess.PIPE)
    assert done.returncode == -signal.SIGPIPE and not done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_explains_its_options(name, capsys):
    with pytest.raises(SystemExit) as end:
        cli.parse(name, ["--help"])
    assert end.value.code == 0 and cli.summary(name).split()[0] in capsys.readouterr().out


def test_convert_offers_every_option_of_every_reader():
    offered = inspect.signature(convert.Command).parameters
    for layout, reader in READERS.items():
        assert set(inspect.signature(reader.read).parameters) - {"path"} <= offered.keys(), layout
        assert re.search(rf"Layout: .*\b{layout.lower()}\b", inspect.getsource(convert)), layout


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "patient"
    done = endo_sim_here("phantom", path, "--frames", 6, "--width", 128, "--height", 96)
    assert done.returncode == 0, done.stderr
    assert "6 frames" in done.stdout
    return path


@pytest.mark.dds
def test_bag_is_read_by_the_authors_of_the_format(bag):
    """The mcap library and its ROS 2 decoder see the same bytes as our reader."""
    frame = next(iter(read_bag(bag)))
    found = {}
    with next(bag.glob("*.mcap")).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert {chunk.compression for chunk in reader.get_summary().chunk_indexes} == {"zstd"}
        for _, channel, _, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, message)
    image = found["/endoscope/left/image_raw"]
    pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
    np.testing.assert_array_equal(pixels, frame.image)
    assert found["/endoscope/right/camera_info"].p[3] == pytest.approx(-frame.camera.K[0, 0] * frame.baseline)
    position = found["/ECM/measured_cp"].pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], frame.camera.position)


@pytest.mark.thorough
@pytest.mark.dds
def test_a_killed_reconstruction_goes_on_to_the_same_model(bag, tmp_path, caplog):
    values = {"iterations": 120, "max_gaussians": 2000, "keyframes": 2, "image_width": 64, "device": "cpu"}
    options = [word for name, value in values.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    command = [sys.executable, "-m", "endo_sim_ros.cli", "reconstruct", bag, tmp_path / "killed", *options]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 300
        while not (tmp_path / "killed" / "checkpoint.pt").exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        process.kill()
    assert process.returncode == -9 and not (tmp_path / "killed" / "model.ply").exists()
    config = ReconstructionConfig(**values)
    with pytest.raises(SequenceError, match=r"killed/checkpoint.pt: the checkpoint was made with other options \(seed\)"):
        reconstruct_bag(tmp_path / "no_bag", tmp_path / "killed", replace(config, seed=1), resume=True)
    with caplog.at_level(logging.INFO):
        reconstruct_bag(bag, tmp_path / "killed", config, resume=True)
    assert re.search(r"going on after [1-9]\d* iterations", caplog.text)
    reconstruct_bag(bag, tmp_path / "whole", config)
    assert (tmp_path / "killed" / "model.ply").read_bytes() == (tmp_path / "whole" / "model.ply").read_bytes()


@pytest.mark.slow
def test_an_interrupted_reconstruction_says_how_to_go_on(small_frames, tmp_path, monkeypatch, caplog):
    write_bag(tmp_path / "bag", small_frames)

    def interrupted(self, on_progress, every):
        on_progress(Progress(100, 200, 0.1, 5))
        raise KeyboardInterrupt

    monkeypatch.setattr(from_bag.Trainer, "run", interrupted)
    caplog.set_level(logging.INFO)
    config = ReconstructionConfig(iterations=200, max_gaussians=2000, keyframes=2, image_width=48, device="cpu")
    with pytest.raises(KeyboardInterrupt):
        reconstruct_bag(tmp_path / "bag", tmp_path / "out", config)
    last = caplog.messages[-1]
    assert last.endswith("checkpoint.pt: holds what was reached after 100 of 200 iterations; --resume goes on from there")
    assert (tmp_path / "out/checkpoint.pt").is_file()


def test_what_other_packages_tell_programmers_is_not_shown():
    code = """if True:
    import logging, sys
    from unittest.mock import Mock
    from endo_sim_ros import cli
    def run():
        for name in ("torch", "endo_sim_ros.core"):
            logging.getLogger(name).info("%s informs", name)
            logging.getLogger(name).warning("%s warns", name)
    cli.parse, sys.argv = (lambda *words: Mock(run=run)), ["endo-sim", "demo"]
    cli.main()
    """
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr.splitlines()[:-1] == ["torch warns", "endo_sim_ros.core informs", "endo_sim_ros.core warns"], done.stderr


@pytest.mark.slow
def test_options_given_beside_a_preset_count_whatever_their_value(monkeypatch):
    taken = []
    monkeypatch.setattr(from_bag, "reconstruct_bag", lambda *arguments: (taken.append(arguments[2]), []))
    monkeypatch.setattr(held_out, "measure_held_out", lambda *arguments: None)
    for given in ("--preset paper --lambda-tv 0 --sh-degree 3", "--lambda-tv 0 --sh-degree 3 --preset=paper", ""):
        monkeypatch.setattr(sys, "argv", f"endo-sim reconstruct bag out {given}".split())
        assert cli.main() == 0
    assert taken[0] == taken[1] == preset("paper", lambda_tv=0.0, sh_degree=3)
    assert taken[2] == ReconstructionConfig()


def test_an_option_that_is_given_twice_is_refused():
    for words in ("my_bag out --arms PSM1 --fps 5 --arms PSM2", "my_bag out --arms=PSM1 --arms PSM2"):
        with pytest.raises(ConfigError, match="--arms is given twice; give it once, with all its values"):
            cli.parse("export", words.split())
    with pytest.raises(ConfigError, match="--lambda-tv is given twice"):
        cli.parse("reconstruct", "my_bag out --lambda-tv 1 --lambda_tv=2".split())
    assert cli.parse("export", "my_bag out --arms PSM1 PSM2".split()).arms == ("PSM1", "PSM2")


def test_a_tissue_has_its_options_unless_the_words_give_them():
    assert cli.parse("touch", "model.ply --tissue fat --density 900".split()).config == tissue("fat", density=900.0)
    assert cli.parse("touch", ["model.ply"]).config == PhysicsConfig()
    with pytest.raises(SystemExit):
        cli.parse("touch", "model.ply --tissue jelly".split())
    with pytest.raises(ConfigError, match="tissue must be one of default, liver, gall_bladder, lung, fat, got 'jelly'"):
        tissue("jelly")


def test_a_preset_is_that_of_the_words_and_not_of_the_process(caplog):
    command = cli.parse("reconstruct", ["no_bag", "out", "--preset", "paper", "--mcmc.growth", "0.3"])
    assert command.config == preset("paper").replaced({"mcmc.growth": 0.3})
    with pytest.raises(SequenceError, match="no_bag: no such bag"):
        command.run()
    assert "mcmc.growth has no effect while densification is gradient" in caplog.text


@pytest.mark.slow
def test_help_tells_range_and_unit(capsys):
    with pytest.raises(SystemExit):
        cli.parse("touch", ["--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "Stiffness of the tissue. [1 Pa or more]" in text
    with pytest.raises(SystemExit):
        cli.parse("reconstruct", ["--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert all(option.range is None or option.help.rpartition(" [")[2] in text for option in options(ReconstructionConfig))


@pytest.mark.parametrize("name", ["right_views", "confined"])
def test_an_option_that_is_gone_is_refused(name):
    with pytest.raises(ConfigError, match=f"{name.replace('_', '.')} is now gone"):
        cli.parse("reconstruct", ["bag", "out", f"--{name.replace('_', '-')}"])
    with pytest.raises(ConfigError, match=f"{name} is now gone"):
        ReconstructionConfig().replaced({name: True})


@pytest.mark.slow
@pytest.mark.parametrize("words", ["reconstruct black results/a/b", "train results/a/b --model none.ply", "evaluate damaged.mcap"])
def test_a_command_that_is_refused_leaves_no_empty_folder(words, small_frames, tmp_path, monkeypatch, capsys):
    write_bag(tmp_path / "black", [replace(frame, image=np.zeros_like(frame.image)) for frame in small_frames[:3]])
    (tmp_path / "damaged.mcap").write_bytes(b"no bag")
    (tmp_path / "kept").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["endo-sim", *words.split(), *("--device", "cpu")])
    monkeypatch.setattr(plots, "available", lambda: True)
    assert cli.main() in (1, 2)
    assert [path.name for path in tmp_path.rglob("*") if path.is_dir() and not any(path.iterdir())] == ["kept"], capsys.readouterr().err
    assert (tmp_path / "evaluation" / "table.md").exists() == (words == "evaluate damaged.mcap")


def test_an_old_flag_is_refused_with_the_new_one(monkeypatch, capsys):
    monkeypatch.setattr(ReconstructionConfig, "renamed", {"views": "keyframes"})
    monkeypatch.setattr(sys, "argv", "endo-sim reconstruct bag out --views 3".split())
    assert cli.main() == 2
    assert capsys.readouterr().err == "endo-sim: --views is now --keyframes\n"


@pytest.mark.parametrize(
    "error, status",
    [(ConfigError(), 2), (PermissionError(), 2), (RuntimeError(), 1), (OSError(), 1), (ImportError(), 1), (KeyboardInterrupt(), 130)],
)
def test_the_status_tells_what_was_given_wrong_from_what_failed_later(error, status, monkeypatch):
    monkeypatch.setattr(cli, "parse", Mock(side_effect=error))
    monkeypatch.setattr(sys, "argv", ["endo-sim", "demo"])
    assert cli.main() == status


NO_ROOM = "there is no room on this disk; make room, or name a place on another disk\n"


def test_a_full_disk_is_told_with_the_file_that_found_no_room(tmp_path):
    save_ply(sheet(), tmp_path / "model.ply")
    out = tmp_path / "out.ply"
    (tmp_path / "out.ply.part").symlink_to("/dev/full")  # what is written until the file is whole
    assert endo_sim_here("compress", tmp_path / "model.ply", out).stderr == f"endo-sim: {out}: {NO_ROOM}"
    cameras = tmp_path / "scene" / "cameras.json"
    cameras.parent.mkdir()
    cameras.symlink_to("/dev/full")
    assert endo_sim_here("scene", cameras.parent, "--image-width", 64).stderr.endswith(f"endo-sim: {cameras}: {NO_ROOM}")


def test_a_full_disk_is_told_with_the_bag_that_found_no_room(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_private, "flush", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    done = endo_sim_here("phantom", tmp_path / "bag", "--frames", 2, "--width", 64, "--height", 64)
    assert done.returncode == 1 and done.stderr == f"endo-sim: {tmp_path / 'bag'}: {NO_ROOM}"


def test_a_gpu_that_fails_is_one_sentence(monkeypatch, capsys):
    error = RuntimeError("CUDA error: unspecified launch failure\nCUDA kernel errors might be reported elsewhere\n")
    monkeypatch.setattr(cli, "parse", Mock(side_effect=error))
    monkeypatch.setattr(sys, "argv", ["endo-sim", "demonstrate"])
    assert cli.main() == 1
    said = (
        "endo-sim: the GPU failed (CUDA error: unspecified launch failure); what was finished is kept; see what nvidia-smi says, or go on"
    )
    assert capsys.readouterr().err == said + " with --device cpu\n"


@pytest.mark.dds
def test_a_result_is_not_written_into_a_bag(bag, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["endo-sim", "reconstruct", str(bag), str(bag)])
    assert cli.main() == 2 and "is a bag; name another folder for the result" in " ".join(capsys.readouterr().err.split())
    assert not (bag / "model.ply").exists()


def test_reconstruct_writes_a_model_and_measures_held_out_views(bag, tmp_path, caplog):
    out = tmp_path / "result"
    caplog.set_level(logging.INFO)
    done = endo_sim_here("reconstruct", bag, out, "--iterations", 40, "--max-gaussians", 4000, "--keyframes", 3, "--device", "cpu")
    assert done.returncode == 0, done.stderr
    psnr = float(next(line for line in caplog.messages if line.startswith("PSNR [dB]")).split()[-1])
    assert 18 < psnr < 45
    assert 1000 < len(load_ply(out / "model.ply")) <= 4000
    assert (out / "checkpoint.pt").is_file()
    assert cv2.imread(str(out / "held_out.png")).std() > 10
    touched = endo_sim_here("touch", out / "model.ply", "--out", out / "touch.png", "--node-count", 400, "--device", "cpu")
    assert touched.returncode == 0 and "undone" not in caplog.text + touched.stderr, touched.stderr
    picture = cv2.imread(str(out / "touch.png"))
    assert picture.shape[1] == 3 * 256 and picture.std() > 10


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (("convert", "no/such/thing", "no_bag"), "no/such/thing: no such file or folder"),
        (("convert", "launch", "no_bag"), "no known layout recognised"),
        (("reconstruct", "no_bag", "out"), "no_bag: no such bag"),
        (("reconstruct", "no_bag", "README.md"), r"README.md: no files can be written there \(File exists\); name another folder"),
        (("reconstruct", "no_bag", "README.md/out"), r"README.md/out: no files can be written there \(Not a directory\)"),
        (("reconstruct", "no_bag", "/proc"), r"/proc: no files can be written there \(.*\); name another folder"),
        (("reconstruct", "no_bag", "no_out", "--device", "cuda:99"), "device 'cuda:99' asked for, but"),
        (("reconstruct", "no_bag", "no_out", "--resume"), "no_out/checkpoint.pt: there is no such checkpoint to go on from"),
        (("evaluate", "phantom:0", "--out", "README.md"), r"README.md: no files can be written there \(File exists\); name another folder"),
        (("evaluate", "phantom:0", "--out", "/proc"), r"/proc: no files can be written there \(.*\); name another folder"),
        (("export", "no_bag", "README.md/out"), r"README.md/out: no files can be written there \(Not a directory\); name another folder"),
        (("train", "README.md/out"), r"README.md/out: no files can be written there \(Not a directory\); name another folder"),
        (("scene", "README.md/out"), r"README.md/out: no files can be written there \(Not a directory\); name another folder"),
        (("phantom", "README.md"), "README.md exists already"),
        (("phantom", "no_bag", "--frames", "0"), r"PhantomConfig.frames must lie in \[1, 100000\], got 0"),
        (("demo", "--bag", "no_bag"), "no_bag: no such bag"),
        (("train", "no_out", "--algorithm", "cem", "--ppo.steps", "5"), "options that begin with --ppo. are for ppo, the others for cem"),
        (("reconstrut", "bag"), "there is no command reconstrut; the commands are demo, view, "),
        (("touch", "no.ply", "--out", "t.txt"), "t.txt: no such kind of picture can be written; let the name end in .png"),
        (("touch", "no.ply", "--out", "nowhere/t.png"), "nowhere/t.png: the picture cannot be written; does the folder exist?"),
        (("plot",), "no files to plot; give those that `endo-sim bench … --json FILE` wrote"),
        (("config", "policy_nod"), "no node is called policy_nod; there are reconstruction_node, "),
    ],
)
def test_mistakes_are_one_sentence(arguments, sentence, tmp_path, monkeypatch, capsys):
    extra = ("--out", tmp_path) if arguments[0] == "demo" else ()
    monkeypatch.setattr(sys, "argv", ["endo-sim", *map(str, arguments + extra)])
    monkeypatch.chdir(ROOT)
    try:
        status = cli.main()
    except SystemExit as end:  # of the parser of arguments
        status = end.code
    said = capsys.readouterr()
    assert status == 2 and "Traceback" not in said.err
    text = " ".join((said.err + said.out).replace("│", " ").split())
    assert re.search(sentence, text), text
    assert not (ROOT / "out" / "metadata.yaml").exists()
