"""What is drawn over a rendered scene: seeded, a function of time, and marked as without rigid truth."""

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.synth.sequence import make_sequence
from dvo.synth.surroundings import SURROUNDINGS, Canvas, Style, drawings

SIZE = {"frames": 4, "height": 60, "width": 80, "fps": 15.0, "sensor": False, "family": "street", "kind": "forward"}
CENTRE = np.array([0.0, 0.0, 2.0])
CAMERA = Camera(80.0, 80.0, 39.5, 29.5, 80, 60)


def sequence(surroundings, seed=3, **options):
    return make_sequence(seed, surroundings=surroundings, **{**SIZE, **options})


def level(height=2.0, time=0.0, depth=6.0):
    """Camera that looks along x, level, before a wall."""
    pose = np.array([0, 0, height, -0.5, 0.5, -0.5, 0.5])
    return Canvas(np.full((60, 80, 3), 0.5), np.full((60, 80), depth), pose, CAMERA, time)


@pytest.mark.long
@pytest.mark.parametrize("name", SURROUNDINGS)
def test_what_it_covers_is_marked_and_nothing_else_changes(name):
    plain, with_it = sequence(""), sequence(name)
    for index in (0, 3):
        changed = (plain.frame(index).image != with_it.frame(index).image).any(-1)
        covered = with_it.dynamic_mask(index)
        assert covered.any() and (
            name == "night" or not (changed & ~covered).any()
        )  # lamps light what they do not cover
        assert changed[covered].mean() > 0.5
        assert not plain.dynamic_mask(index).any()
    assert np.array_equal(with_it.frame(2).image, sequence(name).frame(2).image)
    assert not np.array_equal(with_it.frame(2).image, sequence(name, seed=4).frame(2).image)


@pytest.mark.long
@pytest.mark.parametrize("name", SURROUNDINGS)
def test_it_moves_before_a_camera_that_stands_still(name):
    """All but a bonnet, whose reflections alone do, and a border, of which a propeller does."""
    moved = []
    for seed, later in [(seed, later) for seed in range(6 if name == "border" else 1) for later in (0.8, 2.0)]:
        (draw,) = drawings(name, seed, CENTRE)
        one, other = level(time=0.0), level(time=later)
        draw(one), draw(other)
        moved.append((np.abs(one.image - other.image) > 0.02).mean())
    assert max(moved) > 0.02
    if name == "bonnet":
        assert np.array_equal(draw(level(time=0.0)), draw(level(time=2.0)))


def test_water_lies_below_the_camera_and_the_sky_above():
    (sea,), (clouds,) = drawings("water", 0, CENTRE), drawings("sky", 0, CENTRE)
    assert not sea(level())[:29].any() and sea(level(depth=1e3))[35:].all()
    assert not clouds(level())[31:].any() and clouds(level())[:20].all()
    assert not clouds(level(depth=1.0)).any(), "what is near hides the sky"
    assert not drawings("crowd", 0, CENTRE)[0](level(depth=0.3)).any(), "and people"


def test_several_are_drawn_in_order():
    both = sequence("sky+water").dynamic_mask(0)
    assert both.sum() >= max(sequence(name).dynamic_mask(0).sum() for name in ("sky", "water"))
    assert drawings("", 0, CENTRE) == ()


@pytest.mark.parametrize("names", ["hail", "water+", "water, sky", "Water", None, 3])
def test_names_that_are_not_known_are_refused(names):
    with pytest.raises(DvoError, match="surroundings"):
        sequence(names)


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in SURROUNDINGS if name != "snow"])  # flakes have neither
def test_training_clips_show_other_pictures_than_sequences(name):
    """No suite shows a texture or an outline that a network was trained on."""
    differ = False
    for seed in range(4):  # of lamps at night some are not in view
        (one,), (other,) = (drawings(name, seed, CENTRE, style) for style in (Style(), Style(training=True)))
        shown, trained = level(), level()
        one(shown), other(trained)
        differ |= not np.allclose(shown.image, trained.image, atol=0.02)
    assert differ


def test_at_night_surfaces_keep_their_place():
    """Lamps change how bright a surface is, and cover a small part of the picture themselves."""
    shown = []
    for seed in range(6):
        canvas = level(depth=6.0)
        canvas.image[:, ::2] = 0.1
        before = canvas.image.copy()
        covered = drawings("night", seed, CENTRE)[0](canvas)
        shown.append(covered.mean())
        assert (canvas.image <= 1.5 * before + 0.03)[~covered].all()
        assert canvas.image[~covered].mean() < 0.6 * before.mean()
        pairs = ~covered[:, ::2] & ~covered[:, 1::2]
        assert canvas.image[:, ::2][pairs].mean() / canvas.image[:, 1::2][pairs].mean() == pytest.approx(0.2, abs=0.05)
    assert 0 < max(shown) < 0.4
