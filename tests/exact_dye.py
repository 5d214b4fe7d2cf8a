"""Dyes whose gloss' directional albedo is integrated at every node of its table, not read from light around it."""

import numpy as np

from nishiki.brdf.cloth.interface import PHIS, THETAS, Dyed, directional_albedo


def exact_dye(gloss, albedo) -> Dyed:
    """A dye of albedo (channels,) under a gloss, whose own light from within it keeps: give a black one."""
    theta = (np.arange(THETAS) + 0.5) * (np.pi / 2 / THETAS)
    t, p = np.meshgrid(theta, np.arange(PHIS) * (2 * np.pi / PHIS), indexing="ij")
    incident = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)
    table = np.clip(directional_albedo(gloss, incident).mean(axis=-1), 0, 1)
    weight = (np.sin(theta) * np.cos(theta))[:, None]
    mean = float(np.sum(weight * table) / np.sum(weight) / PHIS)
    return Dyed(gloss, np.atleast_1d(np.asarray(albedo, float)), table, mean)
