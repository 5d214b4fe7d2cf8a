"""A camera from an exposure series of an even surface: linearity, dark level, noise, shading, defective pixels.

Every exposure is photographed twice with nothing changed. Half the variance of the difference of two equal frames is
the noise alone, whatever the surface looks like, and for a camera that counts electrons it rises with the signal m,

    variance = read_noise^2 + m / gain,

with gain in electrons a code (photon transfer: Janesick, Photon Transfer, 2007; EMVA Standard 1288).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.calibrate.result import Calibration, finite, list_photographs
from nishiki.capture.taking import channel_names, full_scale_of, read_channels
from nishiki.errors import UserError
from nishiki.formats.images import read_header
from nishiki.formats.text_tables import number_of, table_rows
from nishiki.observations.linearise import check_linearity
from nishiki.report.page import Figure, Figures, Section, Table
from nishiki.report.pictures import heat, scalar_picture
from nishiki.report.svg import PALETTE, Curve, chart

SATURATION = 0.98  # of full scale: a channel with a pixel in a thousand above is not used
SATURATED_SHARE = 1e-3  # of the pixels of a level that is used
LEAST_LEVELS = 3  # exposures
WINDOW = 0.5  # share of each side, in the middle, from which means and variances are taken
HOT_SIGMAS = 8.0  # of the dark frame's own scatter
DEAD_SHARE = 0.5  # of the light of its neighbours
NONLINEAR = 0.01  # largest deviation from the line, of the largest value, that is not warned about
RESPONSE = 0.5  # of white: the response at which the noise for the stage spectra is stated


@dataclass(frozen=True)
class PhotonTransfer:
    """Noise of a channel: gain in electrons a code, read noise in codes; each with its standard deviation."""

    gain: float
    gain_sigma: float
    read_noise: float
    read_noise_sigma: float


def fit_photon_transfer(signals: np.ndarray, variances: np.ndarray, samples: int) -> PhotonTransfer:
    """Line variance = read_noise^2 + signal / gain, weighted by the scatter of a variance of so many samples.

    signals, variances (levels,) in codes, the dark level subtracted from the signals. A variance v of n samples has
    the standard deviation v sqrt(2 / n); where the levels scatter more, the uncertainties grow with it.
    ValueError where the variance does not rise with the signal.
    """
    signals, variances = np.asarray(signals, float), np.asarray(variances, float)
    sigma = np.maximum(variances, 1e-9) * np.sqrt(2 / samples)
    for _ in range(3):  # the weights are those of the fitted variances, which no single low one pulls
        design = np.column_stack([np.ones_like(signals), signals]) / sigma[:, None]
        covariance = np.linalg.inv(design.T @ design)
        floor, slope = covariance @ design.T @ (variances / sigma)
        sigma = np.maximum(floor + slope * signals, 1e-3 * variances.max()) * np.sqrt(2 / samples)
    if not slope > 0:
        raise ValueError("the noise does not rise with the signal")
    residual = (variances - floor - slope * signals) / sigma
    freedom = len(signals) - 2
    covariance = covariance * max(1.0, float(residual @ residual) / freedom if freedom > 0 else 1.0)
    floor_sigma, slope_sigma = np.sqrt(np.diag(covariance))
    read = float(np.sqrt(max(floor, 0.0)))
    read_sigma = float(floor_sigma / (2 * read)) if floor > floor_sigma else float(np.sqrt(floor_sigma))
    return PhotonTransfer(float(1 / slope), float(slope_sigma / slope**2), read, read_sigma)


def read_series(table: Path) -> dict[float, list[Path]]:
    """Photographs by exposure time from a table `file,exposure_s`; 0 stands for the closed lens."""
    if not table.is_file():
        raise UserError(f"{table}: no such file. Remedy: write a table with the columns file,exposure_s")
    columns, *rows = [cells for _, cells in table_rows(table, table.name)] or [[]]
    if not {"file", "exposure_s"} <= set(columns):
        raise UserError(f"{table}: expected the columns file,exposure_s, found {','.join(columns)[:80]}")
    series: dict[float, list[Path]] = {}
    for cells in rows:
        row = dict(zip(columns, cells, strict=False))
        exposure = number_of(row.get("exposure_s", ""))
        if not (0 <= exposure < 1e6) or not row.get("file"):
            raise UserError(f"{table}: expected a file and an exposure time in seconds, found {cells}")
        series.setdefault(exposure, []).append(table.parent / row["file"])
    list_photographs([str(path) for paths in series.values() for path in paths])
    return dict(sorted(series.items()))


def calibrate_camera(table: Path, *, bits: int | None = None) -> Calibration:
    """Linearity, dark level, noise, shading and defective pixels from a series. UserError where it tells too little."""
    series = read_series(table)
    pairs = {exposure: paths for exposure, paths in series.items() if len(paths) >= 2 and exposure > 0}
    if 0 not in series or len(series[0]) < 2 or len(pairs) < LEAST_LEVELS:
        raise UserError(
            f"{table}: expected two frames or more with the lens closed (exposure_s 0) and two for each of at least "
            f"{LEAST_LEVELS} exposures, found {len(series.get(0, []))} and {len(pairs)} such exposures"
        )
    first = series[0][0]
    full = float(2**bits - 1) if bits else full_scale_of(first)
    channels = channel_names(read_header(first))
    dark = np.mean([read_channels(path) for path in series[0]], axis=0)
    middle = tuple(slice(int(n * (1 - WINDOW) / 2), int(n * (1 + WINDOW) / 2)) for n in dark.shape[:2])
    samples = dark[middle].shape[0] * dark[middle].shape[1]
    black = np.median(dark, axis=(0, 1))
    listed: tuple[list, ...] = ([], [], [], [])
    brightest: np.ndarray | None = None
    for exposure, paths in {0.0: series[0], **pairs}.items():
        one, two = read_channels(paths[0]), read_channels(paths[1])
        a, b = one[middle], two[middle]
        difference = a - b
        difference -= difference.mean(axis=(0, 1))
        usable = ((a > SATURATION * full) | (b > SATURATION * full)).mean(axis=(0, 1)) < SATURATED_SHARE
        level = (a + b).mean(axis=(0, 1)) / 2 - dark[middle].mean(axis=(0, 1))
        for values, value in zip(listed, (exposure, level, (difference**2).mean(axis=(0, 1)) / 2, usable), strict=True):
            values.append(value)
        if usable.all():
            brightest = (one + two) / 2 - dark
    exposures, levels, variances, usable = (np.array(each) for each in listed)
    results, warnings, rows, noise_of_white = {}, [], [], []
    for c, channel in enumerate(channels):
        good = usable[:, c]
        if good.sum() < LEAST_LEVELS + 1:
            raise UserError(
                f"channel {channel}: expected {LEAST_LEVELS} unsaturated exposures, found {good.sum() - 1}. Remedy: "
                "add shorter ones"
            )
        lit = good & (exposures > 0)
        line = check_linearity(levels[lit, c], exposures[lit])
        try:
            noise = fit_photon_transfer(levels[good, c], variances[good, c], samples)
        except ValueError as e:
            raise UserError(f"channel {channel}: {e}. Remedy: give raw frames without noise reduction") from e
        if line.worst_deviation > NONLINEAR:
            at = exposures[lit][line.worst_patch]
            warnings.append(
                f"{channel}: not linear: {100 * line.worst_deviation:.1f} % of the largest value off the line at "
                f"{at:g} s"
            )
        # White just below saturation, and a surface half as bright: the noise of its response relative to white.
        white = SATURATION * full - black[c]
        response = np.sqrt(noise.read_noise**2 + RESPONSE * white / noise.gain) / white
        noise_of_white.append(float(response))
        results[channel] = {
            "dark_level": finite(black[c]),
            "slope_codes_per_s": finite(line.slope),
            "intercept_codes": finite(line.intercept),
            "r_squared": finite(line.r_squared, 9),
            "worst_deviation": finite(line.worst_deviation),
            "gain_e_per_code": finite(noise.gain),
            "gain_sigma": finite(noise.gain_sigma),
            "read_noise_codes": finite(noise.read_noise),
            "read_noise_sigma": finite(noise.read_noise_sigma),
            "full_well_e": finite(noise.gain * white),
        }
        read = noise.read_noise
        deviation = 100 * line.worst_deviation
        numbers = (black[c], deviation, noise.gain, noise.gain_sigma, read, noise.read_noise_sigma, read * noise.gain)
        rows.append((channel, *(float(v) for v in numbers)))
    hot, dead, shading = _defects(dark, brightest)
    if hot.sum() + dead.sum() > 1e-3 * hot.size:
        warnings.append(f"{int(hot.sum())} hot and {int(dead.sum())} dead samples: more than one in a thousand")
    lines: dict = {"camera": {"black_level": finite(float(np.mean(black)))}}
    if bits:
        lines["camera"]["bits"] = bits
    spectra_noise = finite(max(noise_of_white), 3)
    content = {
        "channels": results,
        "exposures_s": exposures.tolist(),
        "levels": np.round(levels, 4).tolist(),
        "variances": np.round(variances, 5).tolist(),
        "used": usable.tolist(),
        "spectra_noise": spectra_noise,
        "hot_samples": int(hot.sum()),
        "dead_samples": int(dead.sum()),
        "defects_row_column_channel": np.argwhere(hot | dead)[:1000].tolist(),
        "darkest_corner": finite(float(np.nanmin(shading))),
    }
    sections = _sections(rows, channels, exposures, levels, variances, usable, shading, content)
    inputs = [table, *(path for paths in series.values() for path in paths)]
    subtitle = f"{len(pairs)} exposures, {len(channels)} channels."
    files = {"config-lines.yaml": f"spectra: {{noise: {spectra_noise:g}}}\n"}
    return Calibration("camera", content, inputs, lines, sections, subtitle, files, warnings)


def _defects(dark: np.ndarray, light: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Hot and dead samples (rows, columns, channels) bool, and the shading (rows, columns), 1 where brightest."""
    import cv2

    away = dark - np.median(dark, axis=(0, 1))
    scatter = np.maximum(1.4826 * np.median(np.abs(away), axis=(0, 1)), 0.5)
    hot = away > HOT_SIGMAS * scatter
    if light is None:
        return hot, np.zeros_like(hot), np.full(dark.shape[:2], np.nan)
    around = np.stack([cv2.medianBlur(np.ascontiguousarray(light[..., c]), 5) for c in range(light.shape[2])], axis=-1)
    dead = light < DEAD_SHARE * around
    smooth = cv2.GaussianBlur(around.mean(axis=2), (0, 0), max(1.0, max(dark.shape[:2]) / 50))
    return hot, dead, smooth / smooth.max()


def _sections(rows, channels, exposures, levels, variances, usable, shading, content) -> list[Section]:
    head = ("channel", "dark level", "off the line %", "gain e/code", "±", "read noise codes", "±", "read noise e")
    linear = _plot(exposures, levels, usable, channels, "exposure, s", "code above dark", "linearity")
    transfer = _plot(levels, variances, usable, channels, "code above dark", "variance, codes²", "photon transfer")
    picture = scalar_picture(shading, heat(), unit="of the brightest", low=0.0, high=1.0)
    figures = [
        Figure(
            "Linearity", "Mean code against exposure time. The points of a linear camera lie on a line.", svg=linear
        ),
        Figure("Noise", "Variance of equal frames against their level: a line, if the camera counts.", svg=transfer),
        Figure("Shading", "Lens and light together; white boards of a capture correct both.", picture),
    ]
    text = (
        f"Hot samples: {content['hot_samples']}, dead: {content['dead_samples']}. Noise of a response of {RESPONSE:g} "
        f"relative to white: {content['spectra_noise']:g}; config-lines.yaml has it for the stage spectra."
    )
    return [Section("camera", "Camera", [Table(head, rows, "lrrrrrrr"), text, Figures(figures, 2)])]


def _plot(x, y, usable, channels, x_label, y_label, title) -> str:
    """Draw the points of every channel that are used, and lines between these."""
    x = np.broadcast_to(x[:, None] if x.ndim == 1 else x, y.shape)
    curves = [
        Curve(channel, x[usable[:, c], c], y[usable[:, c], c], PALETTE[c % len(PALETTE)], dots=dots)
        for dots in (False, True)
        for c, channel in enumerate(["" if dots else name for name in channels])
    ]
    return chart(curves, x_label=x_label, y_label=y_label, title=title, size=(460, 300))
