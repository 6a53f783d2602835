"""What is estimated of tissue that is known."""

from dataclasses import replace

import numpy as np
import pytest
from slab import FINER, HEAVY, NODES, PHYSICS, pressed

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.identification import IdentificationConfig, estimate, find_inclusion, identify, solving
from endo_sim_ros.identification.acquire import Search, expected_information
from endo_sim_ros.identification.ball import Ball
from endo_sim_ros.identification.forward import ForwardModel
from endo_sim_ros.identification.maps import seen_from
from endo_sim_ros.identification.observations import Observations
from endo_sim_ros.identification.replayed_errors import learn_errors
from endo_sim_ros.identification.synthetic import measure
from endo_sim_ros.identification.unknowns import Unknowns
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.physics.regions import TissueProperties, inside_sphere, paint_regions

pytestmark = pytest.mark.slow
EXACT = IdentificationConfig(model_error=0.0, surface_error=0.0)


def measured(seed: int = 0, modulus: float = 7e3, noise: bool = True, **given):
    rng = np.random.default_rng(seed)
    truth = replace(PHYSICS, young_modulus=modulus)
    return measure(replace(pressed(), **given), NODES, truth, rng, noise=noise)


@pytest.fixture(scope="module")
def one():
    """A press, and what is estimated from it."""
    return (press := measured()), identify([press], NODES, PHYSICS, EXACT, "cpu")


def test_a_modulus_is_found_and_its_interval_holds_it(one):
    found = one[1]
    told = found["young_modulus"]
    assert told.told == "known" and told.low < 7e3 < told.high and abs(told.estimate / 7e3 - 1) < 0.1
    assert not found.doubts and 0.5 < found.chi_square < 1.5
    assert np.allclose(found.young_modulus, told.estimate) and found.known.all()
    assert "young_modulus" in found.summary() and "known" in found.summary()


def test_without_noise_the_truth_comes_out():
    found = identify([measured(noise=False, tip_noise=1e-5)], NODES, PHYSICS, replace(EXACT, tip_smoothing=0.0), "cpu")
    assert found["young_modulus"].estimate == pytest.approx(7e3, rel=0.01)
    assert np.abs(found.tip_offset).max() < 5e-5


def test_a_tool_that_trembles_on_skin_that_sticks_is_expected_to():
    """What errors of single tips do beyond what derivatives tell is about what it is in other draws, and explains those."""
    config, physics = EXACT, replace(PHYSICS, friction=0.5)
    steady = measure(replace(pressed(steps=40), tip_noise=0.001), NODES, physics, np.random.default_rng(0), noise=False)
    model, seen = ForwardModel(NODES, physics, "cpu"), Observations(steady, config.tip_smoothing)
    unknowns = Unknowns(NODES, physics, config, estimate.touched_places([steady], NODES, physics))
    learn_errors(seen, model, unknowns, np.zeros(unknowns.count + solving.NUISANCES))
    uneven = seen.uneven
    assert np.sqrt(uneven.max()) > 0.02  # N
    chi = []
    for trembling in (uneven, 0 * uneven):
        seen.uneven, total = trembling, []
        for seed in range(4):
            errors = seen.smoother @ (0.001 * np.random.default_rng([1, seed]).standard_normal(steady.tips.shape))
            jogs = [np.zeros(3), *config.tip_step * np.eye(3), errors]
            told = seen.predicted(model.replay(seen.experiment, [replace(unknowns.copy(np.zeros(1)), jog=jog) for jog in jogs]))
            off = told[4] - told[0] + seen.noise * np.random.default_rng([2, seed]).standard_normal(len(seen.values))
            by_tip = (told[1:4] - told[0]).T / config.tip_step
            covariance = seen.covariance(by_tip, np.zeros((len(off), 1)))
            total.append(off @ covariance.solve(off[:, None])[:, 0] / len(off))
        chi.append(np.mean(total))
    assert 0.7 < chi[0] < 1.2 and chi[1] > 1.4, chi


@pytest.mark.thorough
def test_finer_nodes_correct_what_coarse_ones_make_too_stiff():
    modulus = 7e3
    exact = replace(pressed(), tip_noise=1e-4)  # of noisy tips the errors of single presses are as great as those of the grid
    experiment = measure(exact, FINER, replace(PHYSICS, young_modulus=modulus), np.random.default_rng(0), noise=False)
    coarse, finer = (identify([experiment], NODES, PHYSICS, EXACT, "cpu", finer=each)["young_modulus"] for each in (None, FINER))
    assert coarse.estimate < 0.95 * modulus and finer.estimate == pytest.approx(modulus, rel=0.03)
    assert finer.low < modulus < finer.high
    assert np.log(finer.high / finer.low) > np.log(coarse.high / coarse.low)  # as finer ones are not exact, either


@pytest.mark.thorough
def test_doubts_about_the_model_widen_intervals(one):
    press, exact = one
    doubted = identify([press], NODES, PHYSICS, IdentificationConfig(), "cpu")
    widths = [np.log(told.high / told.low) for each in (exact, doubted) for told in [each["young_modulus"]]]
    assert widths[1] > 1.5 * widths[0]


@pytest.mark.thorough
def test_without_force_only_ratios_are_known():
    physics = replace(PHYSICS, regions=("box -1 -1 0 0 1 1 young_modulus=4000",))
    factors = np.where(NODES.rest[:, 0] <= 0, 1.0, 3.0)
    nodes = np.flatnonzero(NODES.is_skin & ~NODES.pinned)
    rng = np.random.default_rng(0)
    blank = replace(pressed(0.0, 0.0, 0.008), displacements=np.zeros((24, len(nodes), 3)), nodes=nodes, displacement_noise=1e-4)
    experiment = replace(measure(blank, NODES, replace(PHYSICS, young_modulus=9e3), rng, factors), forces=np.full((24, 3), np.nan))
    found = identify([experiment], NODES, physics, replace(EXACT, stiffness="regions", tip_offset=0.0001), "cpu")
    assert [each.told for each in found.unknowns] == ["ratio only"] * 2
    assert any("only ratios" in finding for finding in found.findings) and not found.known.any()
    rest, region = (each.estimate for each in found.unknowns)
    assert rest / region == pytest.approx(3, rel=0.3)
    alone = identify([experiment], NODES, PHYSICS, EXACT, "cpu")["young_modulus"]
    assert alone.told == "not told by these data" and alone.high / alone.low > 10


@pytest.mark.thorough
def test_other_numbers_than_stiffness_are_estimated():
    truth = replace(PHYSICS, poisson_ratio=0.42)
    nodes = np.flatnonzero(NODES.is_skin & ~NODES.pinned)
    blank = replace(pressed(depth=0.008), displacements=np.zeros((24, len(nodes), 3)), nodes=nodes, displacement_noise=5e-4)
    config, held = replace(EXACT, unknowns=("poisson_ratio", "hold_rim")), []
    for seed in range(3):
        found = identify([measure(blank, NODES, truth, np.random.default_rng(seed))], NODES, PHYSICS, config, "cpu")
        told = found["poisson_ratio"]
        assert told.estimate == pytest.approx(0.42, abs=0.01)
        held.append(told.low < 0.42 < told.high)
    assert sum(held) >= 2
    assert found["hold_rim"].told == "not told by these data" and any("hold_rim" in each for each in found.findings)


def test_unknowns_that_do_not_exist_are_refused():
    with pytest.raises(ConfigError, match="no 'colour', known are poisson_ratio"):
        identify([pressed()], NODES, PHYSICS, IdentificationConfig(unknowns=("colour",)), "cpu")
    with pytest.raises(ConfigError, match="relaxation of physics is 0"):
        identify([pressed()], NODES, PHYSICS, IdentificationConfig(unknowns=("relaxation",)), "cpu")
    with pytest.raises(ConfigError, match="needs regions of physics"):
        identify([pressed()], NODES, PHYSICS, IdentificationConfig(stiffness="regions"), "cpu")


@pytest.mark.thorough
def test_going_on_from_an_estimate_is_as_good_as_all_at_once(one):
    press, first = one
    both = [press, measured(1)]
    then = identify(both[1:], NODES, PHYSICS, EXACT, "cpu", start=first)["young_modulus"]
    once = identify(both, NODES, PHYSICS, EXACT, "cpu")["young_modulus"]
    assert then.estimate == pytest.approx(once.estimate, rel=0.02)
    assert np.log(then.high / then.low) == pytest.approx(np.log(once.high / once.low), rel=0.15)


@pytest.mark.thorough
def test_a_press_elsewhere_is_expected_to_tell_more():
    config = replace(EXACT, stiffness="field", field_length=0.012)
    places = np.array([[-0.012, 0, 0.1], [0.012, 0, 0.1]])
    found = identify([measure(pressed(-0.012), NODES, PHYSICS, np.random.default_rng(0))], NODES, PHYSICS, config, "cpu", around=places)
    model = ForwardModel(NODES, PHYSICS, "cpu")
    here, there = expected_information(found, [pressed(-0.012), pressed(0.012)], model)
    assert there > 1.2 * here > 0
    # With all unknowns known there is no news, though where the tool stands is still to be told.
    asked = np.arange(len(found.mean)) < found.parameters.count
    sure = np.where(asked[:, None] & asked, 1e-8 * np.eye(len(asked)), np.where(asked[:, None] ^ asked, 0, found.covariance))
    assert expected_information(replace(found, covariance=sure), [pressed(0.012)], model)[0] < 1e-3


AT = (-0.01, 0.0, 0.01)  # m
ENOUGH = 5  # iterations, after which chi-square falls by less than 3 %


def hidden(seed: int, radius: float, depth: tuple[float, float] = (0.004, 0.008), steps: int = 16, physics: PhysicsConfig = PHYSICS):
    """Place of an inclusion below the nine presses of a raster, what is felt of it, and the true moduli."""
    rng = np.random.default_rng(seed)
    centre = np.array([*rng.uniform(-0.01, 0.01, 2), 0.1 + rng.uniform(*depth)])
    inside = inside_sphere(NODES.rest, centre, radius)
    factors, centre = np.where(inside, 8.0, 1.0), NODES.rest[inside].mean(0)  # as far as these nodes can tell
    return centre, [measure(pressed(x, y, steps=steps), NODES, physics, rng, factors) for x in AT for y in AT], 4e3 * factors


@pytest.mark.thorough
def test_an_inclusion_is_found_in_a_map():
    centre, experiments, truth = hidden(0, 0.007, physics=HEAVY)
    found = identify(experiments, NODES, HEAVY, IdentificationConfig(stiffness="field", field_length=0.012, iterations=ENOUGH), "cpu")
    inclusion = find_inclusion(found)
    # How deep it lies presses from above hardly tell.
    assert np.linalg.norm((inclusion.centre - centre)[:2]) < 0.004 and inclusion.ratio > 2 and inclusion.sure > 0.9
    x, y, z = inclusion.centre
    (said,) = [each for each in found.findings if each.startswith("the stiffest place")]
    assert f"is at {x:.4f} {y:.4f} {z:.4f} m" in said and "times as stiff as most tissue" in said and inclusion.low < 8 < inclusion.high
    assert seen_from(found, Camera(np.eye(3), 9, 9))[0].endswith(f"and {1e3 * z:.0f} mm ahead of the camera of the picture")
    # What is called known holds the truth; how stiff the middle of the ball is forces hardly tell.
    held, ball = (found.low <= truth) & (truth <= found.high), truth > 4e3
    assert 0.05 < found.known.mean() < 0.5 and held[found.known].mean() > 0.8
    assert not found.known[ball & ~NODES.is_skin].any()
    skin = NODES.is_skin & ~NODES.pinned
    assert found.removed[skin].mean() > found.removed[NODES.pinned & ~NODES.is_skin].mean()  # what is felt is known best
    painted = paint_regions(TissueProperties.uniform(len(NODES), 4e3, 0.3, 1000.0), NODES.rest, found.regions(step=0.2))
    assert np.abs(np.log(painted.young_modulus / found.young_modulus)).max() < 0.2


@pytest.mark.thorough
def test_a_field_of_even_tissue_has_no_places():
    """Though it explains noise by a stiffest or a softest one."""
    rng = np.random.default_rng([1, 6])
    heavier = replace(HEAVY, density=8000.0)
    stiff = replace(heavier, young_modulus=12e3)
    felt = [measure(pressed(x, y, steps=24), NODES, stiff, rng) for x, y in ((-0.006, 0), (0.006, 0), (0, 0.008))]
    found = identify(felt, NODES, heavier, IdentificationConfig(stiffness="field", field_length=0.012, iterations=ENOUGH), "cpu")
    assert not any("place is at" in text for text in found.findings) and not seen_from(found, Camera(np.eye(3), 9, 9))
    assert not found.doubts and found["young_modulus"].low < 12e3 < found["young_modulus"].high


@pytest.mark.thorough
def test_an_inclusion_is_found_as_a_ball():
    physics = replace(PHYSICS, density=2000.0)  # fewer substeps, as in `HEAVY`, where forces are not exact enough for this
    centre, experiments, truth = hidden(1, 0.007, physics=physics)
    found = identify(experiments, NODES, physics, IdentificationConfig(stiffness="inclusion", iterations=ENOUGH), "cpu")
    inclusion = find_inclusion(found)
    off = inclusion.centre - centre
    assert np.linalg.norm(off) < 0.004 and np.linalg.norm(off[:2]) < 0.003
    assert (np.abs(off) < 3 * inclusion.deviation + 0.001).all() and inclusion.sure > 0.9
    assert found["young_modulus of the rest"].low < 4e3 < found["young_modulus of the rest"].high
    assert found.tells_inclusion and "the middle of the inclusion is at" in found.findings[0]
    held = (found.low <= truth) & (truth <= found.high)
    about = np.linalg.norm(NODES.rest - centre, axis=1)
    felt = found.parameters.residual == 0
    assert held[about < 0.01].mean() > 0.8 and held[found.known].mean() > 0.9
    assert found.known[(about > 0.02) & felt].all() and not found.known[~felt].any() and 0.5 < felt.mean() < 1
    told = found["inclusion_ratio"]
    assert told.low < 8 < told.high and found.young_modulus.max() == pytest.approx(4e3 * 8, rel=0.6)


def test_places_that_no_tool_felt_are_not_known_with_an_inclusion():
    config = IdentificationConfig(stiffness="inclusion")
    near, far = (NODES.rest[:, 0] < 0 if side else NODES.rest[:, 0] > 0.02 for side in (True, False))
    unknowns = Unknowns(NODES, PHYSICS, config, np.array([[-0.012, 0.0, 0.1]]))
    theta = np.zeros(unknowns.count + solving.NUISANCES)
    theta[1:3] = unknowns.ball.numbers(np.array([-0.012, 0.0, 0.106]))[:2]
    painted = estimate._paint(theta, 1e-6 * np.eye(len(theta)), unknowns, True)
    assert np.median(painted.removed[near]) > config.known and not painted.removed[far].any()
    assert (painted.variance[far] >= config.field_spread**2).all()


def test_presses_to_one_side_of_an_inclusion_are_told_apart_from_those_around_it():
    touched = np.array([[x, y, 0.099] for x in AT for y in AT])
    ball = Ball(NODES, IdentificationConfig(), touched)
    assert ball.aside(np.array([0.007, -0.002, 0.106]), touched) == 0
    assert ball.aside(np.array([0.022, 0.001, 0.106]), touched) == pytest.approx(np.hypot(0.012, 0.001), abs=1e-4)
    assert ball.aside(np.array([0.003, 0.0, 0.106]), touched[:1]) == pytest.approx(np.hypot(0.013, 0.01), abs=1e-4)


@pytest.mark.thorough
def test_a_place_that_rests_on_where_the_skin_is_is_told():
    rng = np.random.default_rng([2, 20])
    centre = np.array([*rng.uniform(-0.012, 0.012, 2), 0.112])  # deep, under presses farther apart than the tool is wide
    factors, offset = np.where(inside_sphere(NODES.rest, centre, 0.007), 6.0, 1.0), 0.0005 * rng.standard_normal(3)
    places = [(x, y) for x in (-0.015, 0.0, 0.015) for y in (-0.0075, 0.0075)]
    experiments = [measure(pressed(x, y, 0.005, 20), NODES, HEAVY, rng, factors, offset) for x, y in places]
    config = IdentificationConfig(stiffness="inclusion")
    data = [Observations(each, config.tip_smoothing) for each in experiments]
    touched = [estimate.touched_places([each.experiment], NODES, HEAVY) for each in data]
    unknowns = Unknowns(NODES, HEAVY, config, np.concatenate(touched))
    parts = [solving.Data(each, *unknowns.directions(at)) for each, at in zip(data, touched)]
    size = unknowns.count + solving.NUISANCES
    prior = solving.Prior(np.zeros(size), np.eye(size))
    _, sure, said = estimate._locate(np.zeros(size), prior, parts, ForwardModel(NODES, HEAVY, "cpu"), unknowns)
    assert sure > 0.5 and "surface_error 0" in said[0]
    there = np.array(said[0].split(" m:")[0].split(" be at ")[1].split(), float)
    assert np.linalg.norm((there - centre)[:2]) < 0.006  # about as far as places are apart


@pytest.mark.thorough
def test_without_an_inclusion_none_is_sure():
    rng = np.random.default_rng(0)
    experiments = [measure(pressed(x, 0.0, steps=16), NODES, HEAVY, rng) for x in AT]
    field = identify(experiments, NODES, HEAVY, IdentificationConfig(stiffness="field", field_length=0.012, iterations=ENOUGH), "cpu")
    assert not any("place is at" in each for each in field.findings) and field.any_known
    found = identify(experiments, NODES, HEAVY, IdentificationConfig(stiffness="inclusion", iterations=ENOUGH), "cpu")
    assert find_inclusion(found).sure < 0.5 and not found.tells_inclusion and found.findings[0].startswith("no inclusion is told")
    assert all(f"its {name} is {found[f'inclusion_{name}'].told}" in found.findings[0] for name in ("radius", "ratio"))
    whole = identify(experiments, NODES, HEAVY, IdentificationConfig(iterations=ENOUGH), "cpu")
    assert found.findings[1:] == whole.findings and found.chi_square == pytest.approx(whole.chi_square)
    assert np.ptp(found.young_modulus) == 0 and not seen_from(found, Camera(np.eye(3), 9, 9))
    assert found.young_modulus[0] == pytest.approx(found["young_modulus of the rest"].estimate)


@pytest.mark.thorough
def test_a_search_presses_where_it_learns_and_finds_what_it_looks_for():
    presses = [pressed(x, y, steps=12) for x in AT for y in AT]
    search = Search(presses, ForwardModel(NODES, PHYSICS, "cpu"))
    centre, felt, _ = hidden(1, 0.007, steps=12)
    assert search.probable[-1] == pytest.approx(0.5) and search.deviation > 0.01
    expected = search.expected()
    assert (expected > 0.1).all()
    for _ in range(4):
        number = int(search.expected().argmax())
        search.feel(number, felt[number].forces)
    assert (search.expected() < expected).all()  # there is less to be learnt
    assert search.probable[-1] < 0.1 and search.deviation < 0.006
    assert np.linalg.norm((search.centre - centre)[:2]) < 0.006


def test_derivatives_steeper_than_forces_can_be_are_not_believed():
    told, forces = np.array([0.5, -1.0, 2.0, 7.0]), np.array([True, True, True, False])
    assert solving._believed(1.2 * told, told, forces) == 1.0
    assert solving._believed(6.0 * told, told, forces) == pytest.approx(1 / 6)
    assert solving._believed(np.array([0.5, -1.0, 2.0, 700.0]), told, forces) == 1.0  # a displacement, which is no force
    assert solving._believed(told, 0 * told, forces) == 0.0  # what is not felt tells nothing


def test_intervals_count_with_all_explanations_that_are_as_likely():
    config = IdentificationConfig()
    press = measure(pressed(steps=12), NODES, HEAVY, np.random.default_rng(0))
    unknowns, model = Unknowns(NODES, HEAVY, config, np.zeros((0, 3))), ForwardModel(NODES, HEAVY, "cpu")
    data = [solving.Data(Observations(press, config.tip_smoothing), *unknowns.directions(np.zeros((0, 3))))]
    theta = np.zeros(unknowns.count + solving.NUISANCES)
    point = solving.look(theta, solving.Prior(theta, np.eye(len(theta))), data, model, unknowns)
    apart = 0.3 * np.eye(len(theta))[0]  # in the modulus
    (one, own), (mean, covariance) = (
        estimate._mixed(maybe, 1.0) for maybe in ([(0.0, point)], [(0.0, point), (-2 * np.log(3), replace(point, theta=theta + apart))])
    )
    np.testing.assert_allclose([one, mean], [theta, 0.25 * apart])
    np.testing.assert_allclose(covariance - own, 0.75 * 0.25 * np.outer(apart, apart), atol=1e-9)
