"""`endo-sim identify`: from a recording to parameters of physics_node, a map and its picture."""

from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import yaml
from made_touches import flat_tissue, press, simulate

from endo_sim_ros import cli
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.identification import identify_bag, results
from endo_sim_ros.identification.picture import color_scale, draw_map, modulus_colors, most_different
from endo_sim_ros.learning.scenes import patient_scene
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.physics.regions import TissueProperties, paint_regions

pytestmark = pytest.mark.slow
TRUTH = 16e3  # Pa; thought to be 10
TISSUE = PhysicsConfig(node_count=300, contact_radius=0.008, device="cpu", young_modulus=TRUTH)
WORDS = ["--model", "phantom:0", "--node-count", "300", "--contact-radius", "0.008", "--device", "cpu"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recordings") / "bag"
    simulate(path, patient_scene(), TISSUE, beside=(-0.01, 0.01), noise=0.05)
    return path


def identify(bag, out, *words):
    cli.parse("identify", [str(bag), "--out", str(out), *WORDS, *words]).run()


def parameters(out):
    (section,) = yaml.safe_load((out / "stiffness.yaml").read_text()).values()
    return section["ros__parameters"]


def test_a_recording_gives_parameters_with_which_physics_is_what_was_pressed(recording, tmp_path, capsys):
    identify(recording, tmp_path / "out")
    told = capsys.readouterr().out
    assert "young_modulus" in told and "known" in told and "2 touches in 2 experiments" in told
    share, count = told.split("moduli are too low, by about ")[1].split("% by the forces of ")
    assert 15 < int(share) < 100 and int(count.split()[0]) > 1000 and "which intervals do not count" in told
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["stiffness.npz", "stiffness.png", "stiffness.yaml"]
    values = parameters(tmp_path / "out")
    assert (values["node_count"], values["contact_radius"], values["regions"]) == (300, 0.008, [""])
    tissue = PhysicsConfig(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})
    assert tissue.young_modulus == pytest.approx(TRUTH, rel=0.15)
    found = np.load(tmp_path / "out" / "stiffness.npz")
    (estimate, low, high), nodes = found["estimates"][0], patient_scene().nodes(tissue)
    assert low < TRUTH < high and estimate == pytest.approx(tissue.young_modulus, rel=1e-4)
    np.testing.assert_array_equal(found["positions"], nodes.rest)
    assert found["known"].all() and (found["young_modulus"] == found["young_modulus"][0]).all()
    assert cv2.imread(str(tmp_path / "out" / "stiffness.png")).shape[1] == 640


def test_regions_of_the_options_stay_and_ratios_alone_count_where_no_modulus_is_known():
    nodes = flat_tissue()
    moduli = np.where(nodes.rest[:, 0] < -0.005, 60e3, 20e3)
    physics = PhysicsConfig(regions=("sphere 0 0 0.1 0.01 density=1100",), poisson_ratio=0.4)
    friction = SimpleNamespace(name="friction", estimate=0.123456789)
    found = SimpleNamespace(nodes=nodes, young_modulus=moduli, any_known=True, unknowns=[friction], doubts=[])
    values = results.parameters(found, physics)
    assert (values["young_modulus"], values["friction"], values["poisson_ratio"]) == (20e3, 0.123457, 0.4)
    assert values["regions"][0] == physics.regions[0]
    painted = paint_regions(TissueProperties.uniform(len(nodes), 1.0, 0.4, 1000), nodes.rest, values["regions"])
    np.testing.assert_allclose(painted.young_modulus, moduli, rtol=1e-4)
    found.any_known = False
    values = results.parameters(found, physics)
    painted = paint_regions(TissueProperties.uniform(len(nodes), 1.0, 0.4, 1000), nodes.rest, values["regions"])
    assert values["young_modulus"] == 10e3
    np.testing.assert_allclose(painted.young_modulus, moduli / 2, rtol=1e-4)
    found.doubts = ["residuals are too great"]
    values = results.parameters(found, physics)
    assert values == {"regions": [*physics.regions], "poisson_ratio": 0.4, "young_modulus": 10e3}, "physics stays as it was"


def test_a_folder_that_cannot_be_made_and_an_interrupt_are_told(recording, tmp_path, monkeypatch, caplog):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="out: no files can be written there .*; name another folder"):
        identify(recording, tmp_path / "file" / "out")
    monkeypatch.setattr(identify_bag, "identify", Mock(side_effect=KeyboardInterrupt))
    with caplog.at_level("INFO"), pytest.raises(KeyboardInterrupt):
        identify(recording, tmp_path / "out")
    assert "interrupted; nothing was written" in caplog.text and not (tmp_path / "out").exists()


def test_what_cannot_be_used_leaves_no_folder(tmp_path):
    bag = press(tmp_path / "bag", depth=-0.008)  # far from this patient
    with pytest.raises(SequenceError, match="never touches the tissue"):
        identify(bag, tmp_path / "out" / "deep")
    assert not (tmp_path / "out").exists()
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "stiffness.yaml").write_text("of another recording")
    with pytest.raises(ValueError, match="old holds what was found before; name another folder"):
        identify(bag, tmp_path / "old")
    with pytest.raises(ConfigError, match="sparse control nodes"):
        identify(bag, tmp_path / "out", "--dense")


def test_the_picture_shows_what_hides_and_stripes_what_is_not_known():
    scene = patient_scene()
    nodes = scene.nodes(TISSUE)
    moduli = np.full(len(nodes), 5e3)
    below = np.flatnonzero(~nodes.is_skin)
    uv, _ = scene.camera.project(nodes.rest.astype(float))
    hidden = below[uv[below, 0] < scene.camera.width / 2]
    moduli[hidden] = 20e3
    shown = most_different(nodes, moduli)
    assert len(shown) == nodes.is_skin.sum()
    left = uv[nodes.is_skin, 0] < 0.4 * scene.camera.width
    assert (moduli[shown][left] == 20e3).mean() > 0.9 and (moduli[shown][uv[nodes.is_skin, 0] > 0.6 * scene.camera.width] == 5e3).all()
    picture = draw_map(scene.model, scene.camera, nodes, moduli, np.ones(len(nodes), bool), "stiffness", "cpu")
    height, width = picture.shape[:2]
    rows = slice(height // 3, -height // 3)
    left, right = picture[rows, : width // 4].mean((0, 1)), picture[rows, 11 * width // 16 : 13 * width // 16].mean((0, 1))
    assert left[0] > 10 * left[2] and right[2] > right[0]
    unknown = draw_map(scene.model, scene.camera, nodes, moduli, np.zeros(len(nodes), bool), "stiffness", "cpu")
    colorful = lambda image: (image.max(2).astype(int) - image.min(2))[rows, : width // 4].mean()
    assert colorful(unknown) < 0.5 * colorful(picture)


def test_colours_tell_moduli_on_a_scale_that_is_not_too_narrow():
    low, high = color_scale(np.array([9e3, 10e3]))
    assert high / low == pytest.approx(4) and low < 9e3 < 10e3 < high
    assert color_scale(np.array([1e3, 10e3])) == (1e3, 10e3)
    colors = modulus_colors(np.array([1e3, 10e3, 5e3]), np.array([True, True, False]), (1e3, 10e3))
    assert colors[0, 2] > colors[0, 0] and colors[1, 0] > colors[1, 2] and len(set(colors[2].tolist())) == 1
