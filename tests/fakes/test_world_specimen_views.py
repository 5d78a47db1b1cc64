"""What cameras see of specimen and tools: exact places, rigid cap, and nothing where nothing should be."""

from __future__ import annotations

import math

import numpy as np
import pytest

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.units import NS_PER_S
from microdrivers.estimators.vision.template import take_template
from microdrivers.fakes.world.embryo import TAIL_UM, Embryo
from microdrivers.fakes.world.normal import normal_cdf
from microdrivers.fakes.world.painting import Overlay, Rod
from microdrivers.fakes.world.settings import SpecimenWorld
from microdrivers.rig import build_rig
from tests.fakes.specimen_bench import build, go, picture, probe_rig, ready, seen_px

HALF = (15, 15)
QUIET = {"noise_levels": 0.0, "blur_px": (1.4, 1.4)}
"""Blurred enough for the tracker's interpolation not to matter."""

CAP_DEPTH_UM, BEHIND_TIP_UM = 105.0, 115.0


def track(world, template, true_px, t_ns):
    """How far off the template says that it is, px."""
    match = template.refine(picture(world, t_ns).astype(np.float32), np.round(true_px))
    assert match is not None
    return match.shift - true_px


@pytest.mark.parametrize(("seed", "preset"), [(0, "single"), (1, "slip_corrected"), (2, "single")])
def test_cap_and_tip_are_where_the_truth_says(seed, preset):
    world = build(seed=seed, target=QUIET, specimen={"preset": preset})
    start_ns = ready(world)
    own = world.specimen
    away_um = own.touch_at(start_ns).tip_um
    begins = [seen_px(world, start_ns, place) for place in (CAP_DEPTH_UM, away_um - BEHIND_TIP_UM)]
    first = picture(world, start_ns).astype(np.float32)
    templates = [take_template(first, centre=tuple(np.round(px).astype(int)), half=HALF) for px in begins]
    assert None not in templates
    end_ns = go(world, start_ns, x=-590.0, speed=25.0)
    errors, contacts = [], set()
    for t_ns in np.linspace(start_ns, end_ns, 9)[1:].astype(int).tolist():
        touch = own.touch_at(t_ns)
        places = (CAP_DEPTH_UM + touch.deformation_um, touch.tip_um - BEHIND_TIP_UM)
        truths = [seen_px(world, t_ns, place) - begin for place, begin in zip(places, begins, strict=True)]
        errors.append([track(world, *pair, t_ns) for pair in zip(templates, truths, strict=True)])
        contacts.add(touch.in_contact)
    assert contacts == {False, True}
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 0.005


def test_noise_leaves_a_hundredth_of_a_pixel():
    world = build()
    start_ns = ready(world)
    begin = seen_px(world, start_ns, CAP_DEPTH_UM)
    frames = [picture(world, start_ns + k, frame_id=k).astype(np.float32) for k in range(16)]
    template = take_template(frames[0], centre=tuple(np.round(begin).astype(int)), half=HALF)
    shifts = np.array([template.refine(frame, np.zeros(2)).shift for frame in frames[1:]])
    assert shifts.std(axis=0).max() < 0.012


def embryo(**settings):
    return Embryo(SpecimenWorld(**settings), np.random.default_rng(1))


def test_the_cap_moves_as_one_piece_and_the_rest_with_the_slip():
    own = embryo()
    at_rest, _, _ = own.grains(0.0, 0.0, 0.0)
    moved = own.grains(80.0, 20.0, 0.0)[0] - at_rest
    assert not moved[:, 1].any()
    distance = np.hypot(at_rest[:, 0], at_rest[:, 1])
    assert moved[distance <= 200.0, 0] == pytest.approx(80.0, abs=1e-12)
    assert (distance <= 200.0).sum() > 100
    assert moved[distance > 200.0 + 6.0 * TAIL_UM, 0] == pytest.approx(20.0, abs=1e-5)
    order = np.argsort(distance)
    assert np.all(np.diff(moved[order, 0]) <= 1e-12)
    assert np.abs(np.diff(moved[order, 0]) / np.maximum(np.diff(distance[order]), 0.05)).max() < 0.4


def test_the_tissue_does_not_fold_at_full_depth():
    line = embryo(grain_distance_um=8.0)
    places = np.column_stack([np.linspace(20.0, 1200.0, 2000), np.zeros(2000)])
    moved = line._moved(places, 175.0, 0.0, 0.0)
    assert np.diff(moved[:, 0]).min() > 0.0


def test_grains_lie_inside_and_as_far_apart_as_stated():
    own = embryo()
    places, sigmas_um, depths = own.grains(0.0, 0.0, 0.0)
    assert np.hypot(places[:, 0] - 650.0, places[:, 1]).max() < 640.0
    assert math.sqrt(math.pi * 628.0**2 / len(places)) == pytest.approx(18.0, rel=0.03)
    assert 3.9 < sigmas_um.min() < sigmas_um.max() < 6.1
    assert 19.0 < np.abs(depths).min() < np.abs(depths).max() < 60.1


def test_a_membrane_is_even():
    own = embryo()
    places, sigmas, depths = own.membrane(0.0, 0.0, 0.0, px_per_um=0.25, blur_px=1.2)
    image = np.zeros((400, 400), dtype=np.float32)
    Overlay(np.column_stack([0.25 * places + [20.0, 200.0], 0.25 * sigmas, depths])).paint(image, blur_px=1.2)
    turns = np.linspace(0.0, 2.0 * math.pi, 720, endpoint=False)
    ring = np.round(np.column_stack([20 + 162.5 - 160.5 * np.cos(turns), 200 + 160.5 * np.sin(turns)])).astype(int)
    line = image[ring[:, 1], ring[:, 0]]
    assert line.max() < 0.0
    assert line.min() == pytest.approx(-own._rim_depth, rel=0.01)


def test_many_blobs_are_the_sum_of_each():
    random = np.random.default_rng(2)
    blobs = np.column_stack([
        random.uniform(-20, 180, 700), random.uniform(-20, 120, 700), random.uniform(0.5, 3.0, 700),
        random.uniform(-50, 50, 700),
    ])  # fmt: skip
    image = np.zeros((100, 160), dtype=np.float32)
    Overlay(blobs).paint(image, blur_px=1.2)
    v, u = np.mgrid[0:100, 0:160]
    plain = np.zeros((100, 160))
    for at_u, at_v, radius, depth in blobs:
        plain -= depth * np.exp(-0.5 * ((u - at_u) ** 2 + (v - at_v) ** 2) / (radius**2 + 1.2**2))
    np.testing.assert_allclose(image, plain, rtol=0.0, atol=0.05, equal_nan=False)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0, 180.0, -50.0])
@pytest.mark.parametrize("smear_px", [0.0, 4.0])
def test_a_rod_is_two_edges_and_an_end(angle_deg, smear_px):
    along = (math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg)))
    rod = Rod((80.3, 50.7), along, 7.25, 60.0, smear_px)
    image = np.zeros((100, 160), dtype=np.float32)
    Overlay(np.empty((0, 4)), (rod,)).paint(image, blur_px=1.2)
    v, u = np.mgrid[0:100, 0:160] - np.array([50.7, 80.3])[:, None, None]
    inwards, sideways = u * along[0] + v * along[1], v * along[0] - u * along[1]
    cover = normal_cdf((sideways + 7.25) / 1.2) - normal_cdf((sideways - 7.25) / 1.2)
    cover *= normal_cdf(inwards / math.hypot(1.2, smear_px / math.sqrt(12.0)))
    np.testing.assert_allclose(image, -60.0 * cover, rtol=0.0, atol=1e-3, equal_nan=False)


@pytest.mark.parametrize("place", [(-500.0, 50.0), (80.0, 1e5), (900.0, -40.0)])
def test_what_lies_outside_is_not_painted(place):
    image = np.zeros((100, 160), dtype=np.float32)
    away = Rod(place, (math.copysign(1.0, place[0] - 80), 0.0), 7.0, 60.0)
    Overlay(np.array([[*place, 2.0, 50.0]]), (away,)).paint(image, blur_px=1.2)
    assert not image.any()


def test_the_same_seed_gives_the_same_bits_and_another_one_another_picture():
    def shot(seed, camera):
        world = build(seed=seed)
        return picture(world, go(world, ready(world), x=-560.0, speed=50.0), camera)

    for camera in ("camera", "camera_lateral"):
        assert np.array_equal(shot(4, camera), shot(4, camera))
        assert not np.array_equal(shot(4, camera), shot(5, camera))


def test_from_the_side_the_rod_comes_from_the_right_and_the_gripper_from_the_left():
    world = build(target=QUIET)
    background = world.look.background_levels
    image = picture(world, go(world, ready(world), x=-480.0), "camera_lateral").astype(float)
    row = image[240]
    assert np.median(row[340:600]) < background - 30.0
    assert np.median(row[:40]) < background - 30.0
    assert np.median(row[100:250]) > background - 10.0
    raised = picture(world, go(world, 20 * NS_PER_S, z=300.0), "camera_lateral").astype(float)
    assert np.median(raised[240 - 60, 340:600]) < background - 30.0


def frame(rig, camera="camera_fine", t_ns=NS_PER_S):
    return picture(rig.simulation.world, t_ns, camera)


def emulated(**options):
    return build_rig(shipped_rig(), fake=True, seed=0, clock=SimulatedClock(), **options)


def test_a_microscope_alone_sees_what_it_saw_without_specimens():
    complete = emulated()
    without = emulated(world_overrides={"specimen": {"preset": "none"}})
    for camera in ("camera_fine", "camera_coarse"):
        assert np.array_equal(frame(complete, camera), frame(without, camera))
    assert np.array_equal(frame(emulated(devices="microscope")), frame(without))


def test_a_complete_rig_shows_what_was_moved_last():
    world = emulated().simulation.world
    slide = picture(world, 9 * NS_PER_S, "camera_fine")
    go(world, 1 * NS_PER_S, x=0.0)
    assert world.specimen_in_view(2 * NS_PER_S)
    assert not world.specimen_in_view(NS_PER_S - 1)
    specimen = picture(world, 9 * NS_PER_S, "camera_fine")
    world.stage_axes["x"].move(10 * NS_PER_S, 7500.0, speed=1000.0, acceleration=1e4)
    assert not world.specimen_in_view(11 * NS_PER_S)
    assert np.array_equal(picture(world, 9 * NS_PER_S, "camera_fine"), specimen)
    assert np.mean(slide != specimen) > 0.05
    assert build(probe_rig()).specimen_in_view(0)
