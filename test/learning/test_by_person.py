"""Demonstrations by a person: the same dataset as a script's, by devices that the tests make."""

import json
import os
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from endo_sim_command import endo_sim_here

from endo_sim_ros.learning import by_person, demonstrations
from endo_sim_ros.learning.by_person import Wish, demonstrate_by_person
from endo_sim_ros.learning.config import DemonstrationConfig, Randomisation, SightConfig
from endo_sim_ros.learning.demonstrations import Demonstrations, demonstrate
from endo_sim_ros.learning.person_config import GamepadConfig, PersonConfig, PushedConfig
from endo_sim_ros.physics import MotionConfig

SIGHT = SightConfig(image_width=40, eyes=2, segmentation=True)
SCENES = ["phantom:0", "phantom:1"]
BY_PERSON = DemonstrationConfig(by="person", images="png", seed=7)


class Screen:
    """Nobody looks at it, and time does not pass."""

    def __init__(self):
        self.views = []

    def show(self, view):
        self.views.append(view)

    def wait(self, until):
        pass


class Hand:
    """Asks for what stands in a list, and then ends."""

    def __init__(self, *wishes):
        self.wishes = [Wish(), *wishes]

    def read(self):
        return self.wishes.pop(0) if self.wishes else Wish(word="finish")


def wishes(actions):
    """What a hand asks for, so that a single tool takes these actions [T, 4]: its jaw closes, or opens, where the last number changes."""
    before = -1.0
    for action in actions:
        yield Wish(action[:3].copy(), jaw=action[3] != before)
        before = action[3]


def tables(root):
    return [pq.read_table(path) for path in sorted(root.glob("data/*/*.parquet"))]


@pytest.fixture(scope="module")
def scripted(tmp_path_factory):
    """Two episodes by the script, without noise, and its actions in each."""
    out, played, kept = tmp_path_factory.mktemp("scripted") / "out", demonstrations.take, []

    def take(batch, episodes, seen, actions, noisy):
        if not episodes[0].rows:
            kept.append([])
        actions = np.where([False, False, False, True], np.where(actions > 0, 1.0, -1.0), actions)  # jaws of a person close at once
        kept[-1].append(actions[0].copy())
        return played(batch, episodes, seen, actions, actions)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demonstrations, "take", take)
        config = replace(BY_PERSON, by="script", episodes=2, environments=1, noise=0.0)
        assert demonstrate("retraction", SCENES, out, config, SIGHT, device="cpu") == (2, 2)
    return out, sorted(kept[:2], key=len), kept[:2]


def by_hand(out, hand, episodes=2, screen=None):
    return play("retraction", out, [hand], screen or Screen(), SCENES, PersonConfig(width=80), episodes)


def play(task, out, hands, screen, scenes=SCENES[:1], person=PersonConfig(width=40), episodes=1):
    config = replace(BY_PERSON, episodes=episodes)
    data = Demonstrations(task, scenes, out, 1, config, SIGHT, Randomisation(), MotionConfig(), "cpu")
    return demonstrate_by_person(data, screen, hands, person)


def acted(scripted):
    """The script's actions in the order of the seeds: the scene of seed 7 is the second."""
    _, _, (of_first_scene, of_second_scene) = scripted
    return of_second_scene, of_first_scene


@pytest.mark.slow
def test_the_same_actions_give_the_same_dataset_whoever_takes_them(scripted, tmp_path):
    first, second = acted(scripted)
    screen = Screen()
    idle = [Wish(np.array([0, 0, 1.0])), *[Wish()] * 3]  # an episode begins when the person rests, and then moves
    assert by_hand(tmp_path / "out", Hand(*wishes(first), *idle, *wishes(second)), screen=screen) == 2
    for mine, other in zip(tables(tmp_path / "out"), tables(scripted[0]), strict=True):
        assert mine.equals(other)
    assert "A person, who saw" in (tmp_path / "out/README.md").read_text()
    view = screen.views[0]
    assert view.image.shape[1] == 80 and view.image.std() > 5 and "move to begin" in view.lines
    solved = screen.views[1 + len(first)].lines
    assert any("solved" in line for line in solved) and any(" lifted by 0.0 mm" in f" {line}" for line in solved), "the next one"
    assert max(line for view in screen.views[: len(first)] for line in view.lines if "lifted" in line) > "lifted by 5.0 mm of 6 mm"
    K, depth = view.camera.K, 0.1
    assert 0.5 * depth / K[1, 1] / 0.002 < view.pixel < 1.5 * depth / K[1, 1] / 0.002, "steps of 2 mm at the depth of the tip"


@pytest.mark.thorough
@pytest.mark.slow
def test_an_interrupted_person_goes_on_and_may_drop_what_was_solved(scripted, tmp_path):
    first, second = acted(scripted)
    out = tmp_path / "out"

    class Tired(Hand):
        def read(self):
            if not self.wishes:
                raise KeyboardInterrupt
            return super().read()

    with pytest.raises(KeyboardInterrupt):
        by_hand(out, Tired(*wishes(first), Wish(), *list(wishes(second))[:5]))
    assert json.loads((out / "meta/info.json").read_text())["total_episodes"] == 1, "the solved one is kept"
    half = list(wishes(second))[:4]
    hand = Hand(*half, Wish(word="again"), Wish(), *wishes(second), Wish(word="drop"), Wish(), *wishes(second), Wish(word="finish"))
    assert by_hand(out, hand, episodes=3) == 2 and not hand.wishes
    for mine, other in zip(tables(out), tables(scripted[0]), strict=True):
        assert mine.equals(other)
    lost = Hand(*[Wish(np.array([0, 0, 0.1]))] * 60, Wish())
    screen = Screen()
    assert by_hand(out, lost, episodes=3, screen=screen) == 2
    assert "lost: out of time; here it is again" in screen.views[-1].lines
    with pytest.raises(ValueError, match="was begun with .*by 'person'"):
        demonstrate("retraction", SCENES, out, replace(BY_PERSON, by="script", noise=0.0), SIGHT, device="cpu")


def test_a_person_turns_the_endoscope(tmp_path):
    """In a task whose fourth number is a speed, which is not that of a jaw."""
    screen, hand = Screen(), Hand(Wish(), *[Wish(turn=-1.0, jaw=True)] * 5)
    play("camera", tmp_path, [hand], screen)
    assert [line for line in screen.views[-1].lines if "left" in line] == ["5.8 s left"], "five steps of 0.04 s"
    assert not any("jaw" in line for line in screen.views[-1].lines)
    rolled = [next(line for line in view.lines if "rolled" in line) for view in (screen.views[0], screen.views[-1])]
    degrees = [float(line.removeprefix("rolled by ").partition("°")[0]) for line in rolled]
    assert degrees[1] - degrees[0] == pytest.approx(-5 * np.rad2deg(0.02), abs=1.01)
    assert (screen.views[0].image != screen.views[-1].image).mean() > 0.1


def test_each_hand_acts_with_the_arm_on_its_side(tmp_path, monkeypatch):
    taken = []
    monkeypatch.setattr(by_person, "take", lambda *given: taken.append(given[-1].reshape(-1, 4)) or demonstrations.take(*given))
    right = [Wish(), *[Wish(np.array([0.5, 0, 0]), closed=True, hand=0), Wish(hand=0), Wish(closed=False, hand=0)]]
    left = [Wish(), *[Wish(np.array([0, 0, 0.5]), hand=1), Wish(closed=True, hand=1), Wish(np.array([0, 1.0, 0]), hand=1)]]
    hands, screen = [Hand(*right), Hand(*left)], Screen()
    play("handover", tmp_path, hands, screen)
    assert (np.array(taken) == [
        [[0.5, 0, 0, 1], [0, 0, 0.5, -1]],
        [[0, 0, 0, 1], [0, 0, 0, 1]],
        [[0, 0, 0, -1], [0, 1, 0, 1]],
    ]).all()  # fmt: skip
    assert {"PSM1 at work", "PSM1: jaw open", "PSM2: jaw closed"} <= set(screen.views[-1].lines)


def test_of_two_hands_with_one_arm_the_one_that_closes_counts(tmp_path, monkeypatch):
    taken = []
    monkeypatch.setattr(by_person, "take", lambda *given: taken.append(given[-1][0, 3]) or demonstrations.take(*given))
    right = [Wish(), Wish(closed=True, hand=0), Wish(closed=True, hand=0), Wish(closed=False, hand=0), Wish(hand=0)]
    left = [Wish(), Wish(closed=False, hand=1), Wish(hand=1), Wish(closed=True, hand=1), Wish(closed=False, hand=1)]
    play("palpation", tmp_path, [Hand(*right), Hand(*left)], screen := Screen())
    assert taken == [1, 1, 1, -1]
    assert "reporting: 3 of 10 steps" in screen.views[-2].lines and "not reporting" in screen.views[-1].lines


@pytest.mark.slow
def test_the_last_episode_can_be_dropped_as_well(scripted, tmp_path):
    first, _ = acted(scripted)
    screen, more = Screen(), Wish(np.array([0, 0, 0.5]))
    hand = Hand(*wishes(first), Wish(), Wish(word="drop"), Wish(), *wishes(first), Wish(), more, more)
    assert by_hand(tmp_path / "out", hand, episodes=1, screen=screen) == 1 and hand.wishes == [more], "the first move ends"
    assert {"1 of 1 episodes", "move to end"} <= set(screen.views[-1].lines)
    assert tables(tmp_path / "out")[0].equals(tables(scripted[0])[0])


@pytest.mark.thorough
def test_a_person_is_told_how_slowly_time_goes_and_what_is_gone(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(by_person, "time", SimpleNamespace(monotonic=lambda: clock[0]))

    class Slow(Screen):
        late = 0.1  # s that a step takes

        def wait(self, until):
            clock[0] = max(clock[0] + self.late, until)

    for screen in (Slow(), quick := Slow()):
        quick.late = 0.0
        hand = Hand(Wish(), *[Wish(np.array([0, 0, 0.1]), gone=True)] * 30)
        play("retraction", tmp_path, [hand], screen, person=PersonConfig(width=320))
        assert f"nothing comes from {hand}; the mouse and the keys go on" in screen.views[-1].lines
        slow = [line for line in screen.views[-1].lines if "real time" in line]
        assert slow == ([] if screen is quick else ["time goes at 0.4 of real time: --page.width 160 draws less"])


def test_what_no_device_may_ask_for_is_said_of_it(tmp_path):
    class Broken(Hand):
        def __str__(self):
            return "my wheel"

    with pytest.raises(ValueError, match=r"my wheel asks for the way .*nan.*, which must be finite"):
        play("palpation", tmp_path, [Broken(Wish(np.array([0, np.nan, 0])))], Screen())


def test_mistakes_are_told_before_the_page_opens(tmp_path):
    pytest.importorskip("viser")
    done = endo_sim_here("demonstrate", "retraction", tmp_path / "out", "--by", "person", "--image-width", 37)
    assert done.returncode == 2 and "37×29 images make no video" in done.stderr and "http" not in done.stdout


def test_options_that_have_no_effect_are_refused(tmp_path):
    gone = GamepadConfig(file="none", stick_near=5, speed=0.5)
    assert PersonConfig(gamepad=gone, mouse_3d=PushedConfig(speed=0.5)).without_effect() == [
        "gamepad.speed has no effect while gamepad.file is none; name one",
        "gamepad.stick_near has no effect while gamepad.file is none; name one",
    ]
    command = "demonstrate", "retraction", tmp_path / "out"
    for *words, said in (
        ("--by", "person", "--noise", 0.3, "noise has no effect while by is person; set by to script"),
        (
            "--by",
            "person",
            "--page.openxr.use",
            "off",
            "--page.openxr.step",
            0.01,
            "page: openxr.step has no effect while openxr.use is off",
        ),
        ("--by", "person", "--page.hand-step", 0.01, "--page.hand-step is now --page.openxr.step"),
        ("--by", "person", "--page.speed", 0.5, "--page.speed is now --page.gamepad.speed and --page.mouse-3d.speed"),
        ("--vary.tool", 1, "--no-instrument", "vary.tool has no effect while instrument is false; leave one of the two out"),
        ("--page.port", 9000, "page: there is none while by is script"),
    ):
        done = endo_sim_here(*command, *words)
        assert done.returncode == 2 and said in done.stderr


@pytest.mark.dds
def test_the_command_serves_a_page_for_a_person(tmp_path):
    pytest.importorskip("viser")
    port = 20000 + (os.getpid() + 31) % 20000
    words = ["demonstrate", "retraction", tmp_path / "out", "--by", "person", "--page.port", port, "--device", "cpu"]
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "endo_sim_ros.cli", *map(str, words)], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    )
    try:
        assert process.stdout is not None
        line = next(line for line in process.stdout if line.startswith("open http"))
        with urllib.request.urlopen(line.split()[1], timeout=120) as answer:
            assert answer.status == 200 and b"<html" in answer.read().lower()
    finally:
        process.terminate()
        assert process.wait(120) == 143
    assert not (tmp_path / "out").exists(), "nothing was solved"
