"""Normals of one parcel: from the selected lights, together with a gloss where there is one.

What the joint fit of normals and gloss needs is imported where it is used: it takes 50 ms.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from nishiki.brdf.torrance_sparrow import LAMBERT
from nishiki.observations.plane import Parcel
from nishiki.photometric.body import body_intensity, diffuse_reflectance, mean_of_channels
from nishiki.photometric.flags import FEW_LIGHTS, NO_ESTIMATE, NormalFlag
from nishiki.photometric.relighting import fit_relighting
from nishiki.photometric.solve import estimate_normals
from nishiki.stages.normals import OUTPUTS, NormalsSettings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from nishiki.brdf.gloss_profile import GlossProfile


WEIGHTED = 0.01  # mean change of the samples, relative, from which the shading is fitted to the mean of the channels


def solve(
    observations: np.ndarray, usable: np.ndarray, valid: np.ndarray, parcel: Parcel, settings: NormalsSettings
) -> dict:
    """Solve the maps of one parcel by name, from the selected lights."""
    observations = parcel.scale_to_centre(observations)
    if observations.shape[-1] == 1:
        intensity = observations[..., 0]
    elif settings.solver == "least_squares":  # as published: the mean of the channels
        intensity = mean_of_channels(observations)
    else:
        intensity = body_intensity(observations, valid)
    field = estimate_normals(
        intensity,
        parcel.directions,
        usable=usable,
        valid=valid,
        solver=settings.solver,
        max_condition=settings.max_condition,
    )
    if field.shading is not None and observations.shape[-1] > 1:
        # gloss was weighted down for the normals; light is predicted with all of it
        from nishiki.photometric.body import shading_of_mean

        mean, lit = mean_of_channels(observations), {"usable": usable, "valid": valid}
        shading = shading_of_mean(intensity, mean, parcel.directions, field, **lit, least_change=WEIGHTED)
        field = replace(field, shading=shading)
    maps = {name: getattr(field, name) for name, *_ in OUTPUTS if hasattr(field, name)}
    if observations.shape[-1] == 1 and field.shading is None:
        maps["reflectance"] = field.albedo[..., None]
    else:
        maps["reflectance"] = diffuse_reflectance(
            observations,
            parcel.directions,
            field.normals,
            usable=usable,
            method=settings.reflectance,
            shading=field.shading,
        ).reflectance
    if field.shading is None:
        del maps["shading"]
    return maps


def fitted_together(maps: dict, observations, valid, parcel: Parcel, settings: NormalsSettings, gloss) -> dict:
    """Return the maps of `solve`, fitted again together with a gloss; observations are scaled."""
    from nishiki.photometric.gloss import JointSettings, refine_normals

    fit = refine_normals(
        observations,
        parcel.directions,
        normals=maps["normals"],
        gloss=gloss,
        valid=valid,
        flags=maps["flags"],
        reflectance=maps["reflectance"],
        settings=JointSettings(max_condition=float(settings.max_condition)),
    )
    kept = (fit.flags & (NO_ESTIMATE | NormalFlag.FALLBACK)) != 0
    lambert = {"shading": np.array(LAMBERT, np.float32)}  # the joint fit has a body of its own
    return {
        name: fit.flags
        if name == "flags"
        else np.where(align(kept, values), values, lambert[name] if name in lambert else getattr(fit, name))
        for name, values in maps.items()
    }


def fit_finishes(
    maps: dict,
    observations: np.ndarray,
    valid: np.ndarray,
    parcel: Parcel,
    settings: NormalsSettings,
    glosses: Sequence[GlossProfile | None],
    labels: np.ndarray,
) -> None:
    """Fit the pixels of each finish again together with its gloss, in place; labels (rows, columns): their finishes."""
    observations = parcel.scale_to_centre(observations)
    for number, gloss in enumerate(glosses):
        here = labels == number
        if gloss is not None and here.any():
            start = {name: values[here][None] for name, values in maps.items()}
            of_finish = observations[:, here][:, None], valid[:, here][:, None]
            for name, values in fitted_together(start, *of_finish, parcel, settings, gloss).items():
                maps[name][here] = values[0]


def relit(
    observations: np.ndarray,
    valid: np.ndarray,
    parcel: Parcel,
    maps: dict,
    model: str,
    kept: np.ndarray | bool = False,
    always: bool = False,
) -> dict:
    """Fit the maps for predicting lamps again to the samples of a parcel; with many lights `plain` keeps its own.

    kept : (rows, columns) bool, pixels that keep their maps; always : with many lights too.
    """
    if model == "plain" and len(parcel.directions) > FEW_LIGHTS and not always:
        return {}
    known = ((maps["flags"] & NO_ESTIMATE) == 0) & ~np.asarray(kept)
    return fit_relighting(
        parcel.scale_to_centre(observations),
        parcel.directions,
        maps["normals"],
        valid=valid & known,
        scatter=maps["residual"] / np.maximum(maps["albedo"], 1e-9),
        reflectance=maps["reflectance"],
        shading=maps["shading"],
        model=model,
    )


def align(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Reshape the mask (rows, columns) to as many axes as the map."""
    return mask.reshape(mask.shape + (1,) * (values.ndim - 2))
