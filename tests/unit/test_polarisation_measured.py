"""A measured polarimetric series: metal badges are specular, a finger is diffuse."""

import cv2
import numpy as np
import pytest

from nishiki.polarisation.polarisation import components, reflected_sense, sum_planes
from nishiki.polarisation.polariser_states import arms_of, read_instrument, sums_of
from nishiki.polarisation.series import Thinned, diagnose, statistics_of

pytestmark = pytest.mark.data
NAMES = (0, 23, 45, 68, 90, 113, 135, 158)


@pytest.fixture(scope="module")
def series(data):
    folder = data / "mueller_badges"
    states = [f"{g}/{a}" for g in NAMES for a in NAMES]
    images = [cv2.imread(str(folder / f"{state.replace('/', '_')}.png"), -1) for state in states]
    stack = np.stack(images)[..., None].astype(np.float32) / 255
    return states, stack, folder / "calibration_reflexion.mat"


@pytest.fixture(scope="module")
def separated(series):
    states, stack, calibration = series
    generator, analyser = arms_of(read_instrument(calibration), wavelength_nm=630.0)
    sums = sums_of(states, generator=generator, analyser=analyser)
    good = np.ones(stack.shape[1:3], bool)
    thinned = Thinned(sums, stack.shape[1:3], 1)

    def photographs():
        for values in stack:
            thinned.add(values, good)
            yield values, good

    planes, valid = sum_planes(photographs(), sums.weights)
    sense = reflected_sense(planes[1], planes[2])
    return components(planes, valid, sums, sense=sense), sense, diagnose(sums, thinned), sums


def largest(mask: np.ndarray, disc: int) -> np.ndarray:
    """The largest connected part of what remains where a disc of this diameter fits."""
    opened = cv2.morphologyEx(
        mask.astype(np.uint8), cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (disc, disc))
    )
    _, labels, table, _ = cv2.connectedComponentsWithStats(opened)
    return labels == 1 + np.argmax(table[1:, 4])


def regions(stack: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Brushed metal and finger without polarimetry, from the mean of all photographs: brighter than half of the bright
    end, then by fine texture relative to brightness, split by Otsu's threshold: rough is metal; smooth, where a disc of
    a quarter of the picture's height fits, is the finger. Also the level of the unlit corners."""
    mean = stack.mean(axis=0)[..., 0].astype(np.float64)
    black = np.percentile(mean, 1)
    light = mean - black
    fine = mean - cv2.GaussianBlur(mean, (0, 0), 4)
    texture = np.sqrt(cv2.GaussianBlur(fine**2, (0, 0), 8)) / cv2.GaussianBlur(np.maximum(light, 1e-3), (0, 0), 8)
    bright = light > 0.5 * np.percentile(light, 99)
    codes = np.log(texture[bright])
    scaled = np.rint(255 * (codes - codes.min()) / np.ptp(codes)).astype(np.uint8)
    threshold, _ = cv2.threshold(scaled.reshape(-1, 1), 0, 255, cv2.THRESH_OTSU)
    rough = np.log(texture) > codes.min() + threshold / 255 * np.ptp(codes)
    rows = mean.shape[0]
    return largest(bright & rough, 5), largest(bright & ~rough, rows // 4 + 1), float(black)


@pytest.mark.slow
def test_the_whole_mueller_matrix_fits_as_published(separated):
    _, sense, told, sums = separated
    assert len(sums.elements) == 16
    assert sense == -1, "a reflection, seen along the light"
    assert told["residual"] == pytest.approx(0.0053, abs=0.0001)
    matrix = np.array(told["mueller"])
    assert abs(matrix[3, :3]).max() < 0.01, "no circular light from linear light"
    assert matrix[1, 1] > 0 > matrix[2, 2]


def test_metal_is_specular_and_the_finger_diffuse(separated, series):
    view = separated[0]
    metal, finger, black = regions(series[1])
    assert min(metal.sum(), finger.sum()) > 10_000
    share = [float(view.specular[m].sum() / (view.specular + view.diffuse)[m].sum()) for m in (metal, finger)]
    assert share[0] > 0.33
    assert share[1] < 0.16
    # The camera's black level counts as diffuse; twice its code, because an analyser passes half.
    lit = [
        float(view.specular[m].sum() / ((view.specular + view.diffuse)[m] - 2 * black).sum()) for m in (metal, finger)
    ]
    assert lit[0] > 0.6
    assert lit[1] < 0.28
    # Pixel by pixel: how often a metal pixel has the larger specular share than one of the finger.
    shares = (view.specular / (view.specular + view.diffuse))[..., 0]
    ranks = np.argsort(np.argsort(np.concatenate([shares[metal], shares[finger]])))
    n, m = metal.sum(), finger.sum()
    above = (ranks[:n].sum() - n * (n - 1) / 2) / (n * m)
    assert above > 0.99


def test_noise_and_negative_values(separated):
    told = statistics_of(separated[0])
    assert told.valid == 1
    assert 0 < told.negative < 0.06
    assert told.noise < 0.006
    assert told.doubtful < 0.001
