"""The leaderboard, and tasks and policies that users write."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blue_seeker import BlueSeeker
from endo_sim_command import endo_sim_here
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.instruments.drawing import FIRST_LINK
from endo_sim_ros.learning import benchmark as module
from endo_sim_ros.learning.benchmark import CONDITIONS, Result, benchmark, interval, read_results, robustness, table
from endo_sim_ros.learning.config import COMPARED_IN, BenchmarkConfig, SightConfig
from endo_sim_ros.learning.policies import StillPolicy, make_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import TASKS, find_task
from endo_sim_ros.learning.train import TESTED_FROM, play

ROOT = Path(__file__).parents[2]
SEEKER = f"{ROOT / 'test/learning/blue_seeker.py'}:BlueSeeker"
FEW = BenchmarkConfig(episodes=3, image_width=32)


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    """The task of the guide, as a file."""
    guide = (ROOT / "docs/learning.md").read_text()
    (code,) = (block for block in re.findall(r"```python\n(.+?)```", guide, re.S) if "class Press(Task)" in block)
    path = tmp_path_factory.mktemp("tasks") / "press.py"
    path.write_text(code)
    return f"{path}:Press"


@pytest.mark.thorough
@pytest.mark.slow
def test_a_leaderboard_is_added_to_and_says_what_the_episodes_gave(tmp_path, press):
    out = tmp_path / "out"
    benchmark(out, ["still"], ["phantom:0"], FEW, "cpu")
    benchmark(out, ["scripted", "still"], ["phantom:0"], FEW, "cpu")
    done = endo_sim_here(
        *("benchmark", out, "scripted", "still", "--task", press, "--scenes", "phantom:0", "--episodes", 3, "--image-width", 32),
        *("--device", "cpu"),
    )
    assert done.returncode == 0, done.stderr
    assert "press       scripted  100%" in done.stdout and "press       still     0%" in done.stdout, done.stdout
    results = read_results(out)
    assert len(results) == 4 and len(json.loads((out / "benchmark.json").read_text())) == 4
    found = {(result.task, result.policy): result for result in results}
    returns, solved, steps = play(
        TaskBatch("retraction", load_scene("phantom:0"), 3, device="cpu"),
        make_policy("scripted", "retraction", 3),
        TESTED_FROM + np.arange(3),
    )
    scripted = found["retraction", "scripted"]
    assert (scripted.solved, scripted.mean_return, scripted.mean_steps) == (solved.sum(), returns.mean(), steps.mean())
    assert found["retraction", "still"].solved == 0 and found["retraction", "still"].mean_steps == 60
    page = (out / "benchmark.html").read_text()
    assert page.count("<video") == 4 == len(list(out.glob("*.mp4"))) and "retraction-scripted.mp4" in page
    import av

    with av.open(str(out / "press-scripted.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) > found["press", "scripted"].mean_steps
    (out / "benchmark.json").write_text("[{}]")
    with pytest.raises(ValueError, match="not the results of `endo-sim benchmark`"):
        benchmark(out, ["still"], ["phantom:0"], FEW, "cpu")


@pytest.mark.slow
def test_other_conditions_are_other_episodes(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "CONDITIONS", {name: CONDITIONS[name] for name in ("as usual", "stiffness", "breath")})
    config = BenchmarkConfig(episodes=2, robustness=True, image_width=32)
    results = benchmark(tmp_path, ["scripted"], ["phantom:1"], config, "cpu")
    assert len({result.mean_return for result in results}) == 3
    assert robustness(results) == [["task", "policy", "as usual", "stiffness", "breath"], ["retraction", "scripted", *["100%"] * 3]]
    assert "breathing 0.004" in (tmp_path / "benchmark.html").read_text()


@pytest.mark.slow
def test_a_scene_that_the_task_refuses_is_left_out_and_none_is_played_twice(tmp_path, caplog, small, monkeypatch):
    config = BenchmarkConfig(episodes=1, image_width=32)
    monkeypatch.setattr(StillPolicy, "training", "interrupted after 1 of 9 steps", raising=False)
    results = benchmark(tmp_path / "out", ["still"], [small, "phantom:0"], config, "cpu")
    assert [result.scene for result in results] == ["phantom:0"] and read_results(tmp_path / "out") == results
    assert table(results)[1][1] == "still, interrupted after 1 of 9 steps"
    assert f"{small} is left out: retraction: no skin node is" in caplog.text
    for given, sentence in (
        ([small], f"^{small}: retraction: no skin node is"),
        (["phantom:3", "phantom:3"], "^phantom:3: the same scene as phantom:3; give each once$"),
        ([], "there is no scene; give one or more"),
    ):
        with pytest.raises(ValueError, match=sentence):
            benchmark(tmp_path / "none", ["still"], given, config, "cpu")
    assert not (tmp_path / "none").exists()


def test_the_table_sums_over_scenes_and_gives_wilsons_interval():
    results = [
        Result("t", "a", "phantom:3", "as usual", 10, 9, 1.0, 20.0),
        Result("t", "a", "phantom:4", "as usual", 30, 15, 2.0, 40.0),
        Result("t", "b", "phantom:3", "as usual", 10, 10, 0.5, 20.0),
        Result("t", "a", "phantom:3", "light", 10, 0, 1.0, 20.0),
    ]
    head, best, second = table(results)
    assert best[:3] == ["t", "b", "100%"]
    assert second == ["t", "a", "60%", "45% to 74%", "1.75", "35", "40", "phantom:3 (10), phantom:4 (30)"]
    for solved, episodes in ((0, 5), (24, 40), (100, 100)):
        wilson = binomtest(solved, episodes).proportion_ci(method="wilson")
        np.testing.assert_allclose(interval(solved, episodes), (wilson.low, wilson.high), atol=1e-4)


def test_an_interrupted_run_takes_no_complete_ones_place():
    whole, part, more = (
        Result("t", "a", "phantom:3", "as usual", episodes, episodes, 1.0, 20.0, complete=episodes == 10) for episodes in (10, 2, 4)
    )
    assert module._merge([whole], [part]) == [whole] and module._merge([part], [whole]) == [whole]
    assert module._merge([part], [more]) == [more] == module._merge([more], [part])
    assert table([more])[1][6] == "4, interrupted"


def test_patients_of_the_benchmark_are_not_those_that_are_trained_on_and_differ():
    assert "phantom:0" not in COMPARED_IN
    first, other = (load_scene(scene).model for scene in ("phantom:0", "phantom:3"))
    assert load_scene() is load_scene("phantom:0")
    assert len(first.means) != len(other.means) or not np.allclose(first.means, other.means)
    with pytest.raises(ValueError, match="phantom:x: the seed of a synthetic patient is a number, as in phantom:1"):
        load_scene("phantom:x")


def test_tasks_and_policies_of_files_are_found_and_what_is_wrong_is_said(press, tmp_path):
    assert find_task(press).name == "press" and find_task(press) is find_task(press)
    for task in TASKS.values():  # has what those of users must have
        assert find_task(f"{task.__module__}:{task.__name__}") is task
    seeker = make_policy(SEEKER, "retraction", 2)
    assert seeker.count == 2 and seeker.sight == BlueSeeker.sight
    (tmp_path / "blind.py").write_text(
        "class Blind:\n    actions, sight = 'cartesian', 'all'\n\n    def __init__(self, count):\n        pass\n"
    )
    with pytest.raises(
        ValueError, match="Blind is no policy: its `actions` are one of cartesian, joints, joint_positions, and its `sight` is"
    ):
        make_policy(f"{tmp_path / 'blind.py'}:Blind", "retraction")
    (tmp_path / "alone.py").write_text("class Alone:\n    actions, sight = 'cartesian', None\n")
    with pytest.raises(ValueError, match="Alone is called with the number of episodes alone: .*takes no arguments"):
        make_policy(f"{tmp_path / 'alone.py'}:Alone", "retraction")
    (tmp_path / "raises.py").write_text(
        "class Raises:\n    actions, sight = 'cartesian', None\n\n    def __init__(self, count):\n        [][1]\n"
    )
    with pytest.raises(RuntimeError, match=r"raises.py failed at line 5: IndexError: list index out of range"):
        make_policy(f"{tmp_path / 'raises.py'}:Raises", "retraction")
    (tmp_path / "trained").mkdir()
    (tmp_path / "trained/policy.npz").touch()
    with pytest.raises(ValueError, match="has no checkpoint of lerobot; give .*trained/policy.npz, as `endo-sim train` wrote it, or"):
        make_policy(str(tmp_path / "trained"), "retraction")
    (tmp_path / "broken.py").write_text("import nothing_of_this_name")
    for named, sentence in (
        ("nowhere.py:Task", "nowhere.py cannot be loaded: FileNotFoundError"),
        (f"{tmp_path / 'broken.py'}:Task", "cannot be loaded: ModuleNotFoundError: No module named 'nothing_of_this_name'"),
        (SEEKER, "is no task; a task is a subclass of endo_sim_ros.learning.tasks.Task"),
        (press + "ure", "has no 'Pressure'"),
        (
            "sewing",
            "there is no task 'sewing'; there are retraction, palpation, tracking, exposure, tension, handover, camera, clip, dissect, "
            "and your own as",
        ),
    ):
        with pytest.raises(ValueError, match=re.escape(sentence)):
            find_task(named)


def test_an_error_of_a_policy_of_ones_own_names_its_line(tmp_path):
    path = tmp_path / "boom.py"
    path.write_text(
        "import numpy as np\n\n\nclass Boom:\n    actions, sight = 'cartesian', None\n\n    def __init__(self, count):\n        pass\n\n"
        "    def reset(self, episodes):\n        pass\n\n    def act(self, observations):\n        return np.zeros(-1)\n"
    )
    with pytest.raises(RuntimeError, match=re.escape(f"{path} failed at line 14: ValueError: negative dimensions")):
        benchmark(tmp_path / "out", [f"{path}:Boom"], ["phantom:0"], FEW, "cpu")
    for name, acts, said in (
        ("Blank", "np.full((len(o), 4), np.nan)", "the action of episode 0 is not finite"),
        ("Text", "'left'", r"actions must be 3 × 4 numbers \(could not convert string to float: 'left'\)"),
        ("Torch", "__import__('torch').zeros(3, 4, requires_grad=True)", r"actions must be 3 × 4 numbers \(Can't call numpy"),
    ):
        methods = f"    def reset(self, b): pass\n    def act(self, o): return {acts}\n"
        head = f"import numpy as np\nclass {name}:\n    actions, sight = 'cartesian', None\n    def __init__(self, n): pass\n"
        (other := tmp_path / f"{name}.py").write_text(head + methods)
        with pytest.raises(ValueError, match=f"^{re.escape(str(other))}:{name}: retraction: {said}"):
            benchmark(tmp_path / "out", [f"{other}:{name}", "still"], ["phantom:0"], FEW, "cpu")
    (tmp_path / "bare.py").write_text("class Bare:\n    actions, sight = 'cartesian', None\n    def __init__(self, n): pass\n")
    with pytest.raises(ValueError, match="Bare is no policy: it has no reset and no act; see endo_sim_ros.learning.policies.Policy"):
        make_policy(f"{tmp_path / 'bare.py'}:Bare", "retraction")


@pytest.mark.parametrize(
    "right, wrong, sentence",
    [
        ('name, sentence = "press", ', "sentence = ", "has no name, which each task has; see"),
        ("observation_names", "names", "has no observation_names, which"),
        ("def physics", "def physic", "has no physics, which"),
        ("horizon, force_limit = 100", "horizon, force_limit = 0", "horizon is 0; it is a number of steps, 1 or more"),
        ("low, high =", "high, low =", r"low is \(0.02, 0.02, 0.025\) and high .*, and low not above high"),
        ("super().__init__(nodes, endoscope, count)", "pass", r"Press: its __init__ must call that of Task: super\(\).__init__\("),
        ("self._held / self.hold]", "np.full(2, np.nan)]", "press: the observation held of episode 0 is not a number"),
        ("self._held / self.hold]", "self._held[:1]]", r"press: _columns, for held, gives the shape \[1\], and must give .*shape \[2\]"),
        ("self._held / self.hold]", "]", "press: observation_names has 9 names for 8 numbers; beside"),
        ("return self._held >= self.hold", "pass", "press: _judge_goal gives nothing, and must give a value for each episode"),
        ("return self._held >= self.hold", "return True", r"press: _judge_goal gives the shape \[\], and must"),
        ("return -norm(self._way) / LENGTH -", "return np.nan *", "press: the reward of episode 0 is nan"),
        ("here[:, 0] - self.tip", "here[:, 0] - self.tipp", r"press.py failed at line 36: AttributeError: 'Press' object has no"),
    ],
)
def test_mistakes_in_a_task_of_ones_own_are_told(press, tmp_path, right, wrong, sentence):
    code = Path(press.rpartition(":")[0]).read_text()
    assert code.count(right) == 1
    (tmp_path / "press.py").write_text(code.replace(right, wrong))
    done = endo_sim_here(
        *("benchmark", tmp_path / "out", "scripted", "--task", f"{tmp_path / 'press.py'}:Press", "--scenes", "phantom:0", "--episodes", 2),
        *("--device", "cpu"),
    )
    assert done.returncode and re.search(sentence, done.stderr) and "scripted:" not in done.stderr, done.stderr
    assert done.stderr.count("\n") == 1


def test_rows_of_other_numbers_of_episodes_in_each_scene_tell_them():
    few, more = (Result("retraction", "still", f"phantom:{3 + n}", "as usual", n, 0, 0.0, 60.0) for n in (2, 4))
    assert table([few, more])[1][-2:] == ["6", "phantom:5 (2), phantom:7 (4)"]
    assert table([few, replace(more, episodes=2)])[1][-2:] == ["4", "phantom:5, phantom:7"]


def test_an_image_policy_takes_what_a_robot_has():
    batch = TaskBatch("retraction", load_scene(), 2, "sensors", sight=BlueSeeker.sight, device="cpu")
    batch.reset([0, 1], [np.random.default_rng(s) for s in (4, 5)])
    seen = batch.observe()
    assert seen.keys() == {"arm", "image", "image_right"} and seen["arm"].shape == (2, 11)
    to_eye = invert_pose(batch.task.endoscope)
    np.testing.assert_allclose(seen["arm"][:, :3], batch.task.tips() @ to_eye[:3, :3].T + to_eye[:3, 3], rtol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(seen["arm"][:, 3:7]).as_matrix(), [to_eye[:3, :3]] * 2, atol=1e-6)
    np.testing.assert_array_equal(seen["arm"][:, 7:], [np.float32([TASKS["retraction"].open_jaw, 0, 0, 0])] * 2)
    for _ in range(25):
        seen, _ = batch.step(np.tile([0, 0, -1, 1], (2, 1)))
    assert (seen["arm"][:, 7] == TASKS["retraction"].closed_jaw).all()
    np.testing.assert_allclose(seen["arm"][:, 8:], batch.task.forces() @ to_eye[:3, :3].T, rtol=1e-6)


@pytest.mark.parametrize("task", ["exposure", "camera"])
def test_arms_are_measured_where_the_endoscope_sees_them(task):
    """Also while it moves."""
    sight = SightConfig(image_width=128, segmentation=True)
    batch = TaskBatch(task, load_scene(), 2, "sensors", sight=sight, device="cpu")
    batch.reset([0, 1], [np.random.default_rng(s) for s in (4, 5)])
    assert batch.pictures is not None
    K = batch.pictures.camera.K
    for _ in range(3):
        seen, _ = batch.step(np.tile([0.5, 0.5, 0.2, 0.0], (2, 1)))
        for x, y, z, labels in zip(*seen["arm"][:, :3].T.astype(float), seen["segmentation"][..., 0]):
            rows, columns = np.nonzero(labels >= FIRST_LINK)
            far = np.hypot(columns - (K[0, 0] * x / z + K[0, 2]), rows - (K[1, 1] * y / z + K[1, 2]))
            assert far.min() < 4, (far.min(), len(rows))
