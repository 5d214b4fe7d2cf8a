"""The adjustment against a slow one, and what it does with wrong overlaps and gaps."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.cut_mosaic import picture_places, place_fields
from scipy.optimize import least_squares

from nishiki.errors import UserError
from nishiki.mosaic.adjustment import LENSES, FieldPlacement, adjust, solve
from nishiki.mosaic.registration import Field, Overlap


def fields_of(truth: list[dict]) -> list[Field]:
    return [
        Field(f["name"], tuple(f["shape"]), None, (np.array(f["shape"][::-1]) - 1) / 2)  # nothing is read
        for f in truth
    ]


def matches(truth: list[dict], *, error: float = 0.02, seed: int = 0) -> list[Overlap]:
    """Matches of all fields that overlap, at random places of the picture."""
    rng, overlaps = np.random.default_rng(seed), []
    for i in range(len(truth)):
        for j in range(i + 1, len(truth)):
            rows, columns = truth[i]["shape"]
            points = rng.uniform(0, 1, (500, 2)) * (columns, rows)
            places = picture_places(truth[i], points)
            there = points.copy()
            for _ in range(30):  # invert by fixed-point steps
                there = there + places - picture_places(truth[j], there)
            inside = ((there > 0) & (there < truth[j]["shape"][::-1])).all(axis=1)
            ends = np.stack([points[inside], there[inside]])[:, :40]
            if ends.shape[1] >= 8:
                ends[1] += error * rng.standard_normal(ends[1].shape)
                overlaps.append(Overlap(i, j, ends, np.tile(error**2 * np.eye(2), (ends.shape[1], 1, 1))))
    return overlaps


@pytest.fixture(scope="module")
def truth():
    return place_fields((1500, 2000), (3, 3), 0.25, 5)


@pytest.fixture(scope="module")
def adjusted(truth):
    return adjust(fields_of(truth), matches(truth))


def aligned_error(placement: FieldPlacement, truth: list[dict]) -> np.ndarray:
    """Distance from the truth in pixels over all fields, after the best shift, turn and scale of the whole."""
    got, expected = [], []
    for i, field in enumerate(truth):
        rows, columns = field["shape"]
        points = np.stack(np.meshgrid(np.linspace(0, columns - 1, 9), np.linspace(0, rows - 1, 9)), -1).reshape(-1, 2)
        got.append(placement.to_mosaic(i, points) @ (1, 1j))
        expected.append(picture_places(field, points) @ (1, 1j))
    one, two = (np.concatenate(part) - np.concatenate(part).mean() for part in (got, expected))
    return np.abs(one * (np.vdot(one, two) / np.vdot(one, one)) - two)


def test_fields_are_placed_to_hundredths_of_a_pixel_with_the_lens_that_matches_need(truth, adjusted):
    placement, found = adjusted
    assert aligned_error(placement, truth).max() < 0.1
    assert "k1" in found["lens"]["terms"]
    assert found["rms_px"] < 0.05
    assert all(each["used"] for each in found["overlaps"])
    assert placement.sigma.max() < 0.1


@pytest.mark.slow
def test_no_lens_is_fitted_where_none_distorts(truth):
    straight = [{**field, "barrel": 1e-6} for field in truth]
    placement, found = adjust(fields_of(straight), matches(straight))
    assert found["lens"]["terms"] == "none"
    assert aligned_error(placement, straight).max() < 0.05


def test_places_in_field_and_mosaic_are_inverse(adjusted):
    placement, _ = adjusted
    points = np.random.default_rng(1).uniform(0, 400, (50, 2))
    assert np.abs(placement.to_field(4, placement.to_mosaic(4, points)) - points).max() < 1e-6
    low, high = placement.box(4)
    inside = placement.to_mosaic(4, points)
    assert (inside >= low).all()
    assert (inside < high).all()


def test_adjustment_is_that_of_a_general_solver(truth):
    fields, overlaps = fields_of(truth)[:3], [o for o in matches(truth, error=0.05) if o.second < 3]
    placement, _ = solve(fields, overlaps, LENSES["k1"])  # its weights hardly differ, as no match is wrong

    def differences(state: np.ndarray) -> np.ndarray:
        own, lens = np.r_[0, 0, state[:10]].reshape(3, 4), np.array([state[10], 0, 0, 0])
        trial = FieldPlacement(tuple(fields), own[:, :2], own[:, 2], np.exp(own[:, 3]), lens, np.zeros(3))
        apart = [trial.to_mosaic(o.first, o.points[0]) - trial.to_mosaic(o.second, o.points[1]) for o in overlaps]
        return np.r_[np.concatenate(apart).ravel() / 0.05, 1e4 * own[:, 2:].sum(axis=0), own[:, 2:].ravel() / 0.01,
                     lens[0] / 0.05]  # fmt: skip

    start = np.r_[0, 0, np.array([[*p, 0, 0] for p in placement.position[1:]]).ravel(), 0]
    slow = least_squares(differences, start, x_scale="jac")
    assert np.abs(slow.x[[2, 3, 6, 7]] - placement.position[1:].ravel()).max() < 0.05
    assert abs(slow.x[10] - placement.lens[0]) < 5e-4


@pytest.mark.slow
def test_wrong_overlap_in_a_net_is_left_out(truth):
    overlaps = matches(truth)
    wrong = next(k for k, o in enumerate(overlaps) if (o.first, o.second) == (4, 5))
    overlaps[wrong] = replace(overlaps[wrong], points=overlaps[wrong].points + np.array([[[0, 0]], [[90, 5]]]))
    placement, found = adjust(fields_of(truth), overlaps)
    assert [each["fields"] for each in found["overlaps"] if each["why"]] == [["b2", "b3"]]
    assert aligned_error(placement, truth).max() < 0.1


@pytest.mark.parametrize("wrong_by", [15, 60, 400])
def test_wrong_overlap_in_a_single_loop_is_refused(wrong_by):
    square = place_fields((1000, 1000), (2, 2), 0.25, 3)
    overlaps = [o for o in matches(square) if (o.first, o.second) in {(0, 1), (0, 2), (1, 3), (2, 3)}]
    overlaps[0] = replace(overlaps[0], points=overlaps[0].points + np.array([[[0, 0]], [[wrong_by, 0]]]))
    with pytest.raises(UserError, match="contradict"):
        adjust(fields_of(square), overlaps)


def test_gap_is_refused_with_the_names_of_the_fields(truth):
    overlaps = [o for o in matches(truth) if 8 not in (o.first, o.second)]
    with pytest.raises(UserError, match="c3"):
        adjust(fields_of(truth), overlaps)


def test_one_field_is_a_mosaic():
    placement, found = adjust(fields_of(place_fields((300, 400), (1, 1), 0.2, 1)), [])
    assert placement.shape == tuple(placement.fields[0].shape)
    assert found["rms_px"] == 0
