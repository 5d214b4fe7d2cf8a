"""Spectra: spectral reflectance coefficients of every pixel from its diffuse reflectance in the camera's channels."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.maps import Maps, MapWriter, TiledStage
from nishiki.artifacts.stage import Context
from nishiki.capture.tables import read_curves
from nishiki.colour import estimate
from nishiki.colour.sampling import channel_weights
from nishiki.colour.training import measured_reflectances, synthetic_reflectances
from nishiki.model_selection.decision import Decision, economy
from nishiki.model_selection.sufficient import Bases, decide_bases, output_bases, principal_bases
from nishiki.stages.spectra import OUTPUTS


def map_tiles(context: Context) -> dict:
    """Fit the estimator once, then apply it band by band."""
    settings = context.settings
    if settings.training == "synthetic":
        training = synthetic_reflectances()
    else:
        curves = read_curves(Path(settings.training), label=settings.training)
        training = measured_reflectances(curves.wavelengths_nm, curves.values, name=settings.training)
    estimator, decision = fit(context, training)
    if decision:
        context.progress.tell(str(decision))
    arrays: dict[str, Any] = estimator.as_arrays()
    np.savez(context.output.path("estimator.npz"), **arrays)
    maps = Maps(context.inputs["normals"].folder)
    reflectance = maps.group["reflectance"]
    rows, columns, _ = reflectance.shape
    band_rows = reflectance.chunks[0]
    out = MapWriter.of(context, OUTPUTS, (rows, columns), band_rows)
    basis = np.asarray(estimator.basis).tolist()
    coefficients = out.create("coefficients", (len(basis),), basis=basis, first_nm=400, step_nm=5)
    profile = np.round(estimator.profile, 4).tolist()
    sigma = out.create("sigma", profile=profile)
    flags = out.create("flags")
    counts: Counter[str] = Counter()
    sampled = [np.zeros((0, reflectance.shape[2]))]
    some_rows, some_columns = estimate.sample_rows(rows, columns)
    for start in context.progress.over(context.share(range(0, rows, band_rows)), "band"):
        band = slice(start, min(rows, start + band_rows))
        observed = reflectance[band]
        field = estimate.estimate_spectra(observed, estimator)
        inside = some_rows[(some_rows >= band.start) & (some_rows < band.stop)] - band.start
        sampled.append(observed[np.ix_(inside, some_columns)].reshape(-1, observed.shape[-1]))
        coefficients[band], sigma[band], flags[band] = field.coefficients, field.sigma, field.flags
        counts.update(field.counts)
    same = {
        "method": estimator.method,
        "bases": len(basis),
        "condition": float(estimator.condition),
        "training_rmse": float(estimator.training_rmse),
        "training_spectra": len(training),
        "economy": economy(decision),
    }
    responses = np.concatenate(sampled)
    responses = responses[np.isfinite(responses).all(axis=1) & (responses > 0).any(axis=1)]
    curves = np.load(context.inputs["ingest"].path("curves.npz"))
    errors = estimate.expected_colour_error(
        responses, training, channel_weights(curves["illuminant"], curves["sensitivities"]), estimator
    )
    return {
        "same": same,
        "counts": {name: int(count) for name, count in counts.items()},
        "sampled": len(responses),
        "colour_error": {light: float(values.sum()) for light, values in errors.items()},
    }


def merge(context: Context, tallies: list[dict]) -> dict:
    """Return the estimator, the pixels with each flag, and the expected colour error of the sampled pixels by light."""
    counts: Counter[str] = Counter()
    errors: Counter[str] = Counter()
    for tally in tallies:
        counts.update(tally["counts"])
        errors.update(tally["colour_error"])
    sampled = sum(tally["sampled"] for tally in tallies)
    return {
        **tallies[0]["same"],
        "expected_de00": {light: total / sampled for light, total in errors.items()} if sampled else None,
        **{f"flagged_{name}": count for name, count in counts.items()},
    }


def fit(context: Context, training: np.ndarray) -> tuple[estimate.SpectralEstimator, Decision | None]:
    """Fit the estimator for this capture's lamp and camera; return the decision on its bases too."""
    curves = np.load(context.inputs["ingest"].path("curves.npz"))
    settings = context.settings
    lamp, camera = curves["illuminant"], curves["sensitivities"]
    numbers: list[Bases] = []

    def enough(estimates: np.ndarray, mean_square: float) -> int:
        numbers.append(output_bases(estimates, mean_square))
        return numbers[-1].count

    bases = settings.bases if settings.bases != "auto" else enough
    if settings.bases == "auto" and settings.method == "paper":
        numbers.append(principal_bases(training, channel_weights(lamp, camera), noise=settings.noise))
        bases = numbers[-1].count
    estimator = estimate.fit_estimator(
        training, lamp, camera, method=settings.method, bases=bases, noise=settings.noise
    )
    return estimator, decide_bases(numbers[-1], method=settings.method) if numbers else None


run = TiledStage(map_tiles, merge)
