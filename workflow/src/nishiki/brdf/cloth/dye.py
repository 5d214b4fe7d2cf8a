"""Any dye on a measured gloss: the dichromatic model (Shafer, Using color to separate reflection components, 1985).

Light that a fibre's surface reflects has the lamp's colour; light that comes from within has the dye's.  A black cloth
shows the first alone (Takeda et al., section 2).  For another dye the light from within is added: that of a diffuser
under the gloss, which gets only what the gloss lets through on the way in and out,

    f = f_gloss + albedo / pi (1 - a(i)) (1 - a(o)) / (1 - a_mean),

with a(w) the directional albedo of the gloss and a_mean its cosine-weighted mean: reciprocal, and its albedo is
a(i) + albedo (1 - a(i)), at most 1 if the gloss' is (Kelemen and Szirmay-Kalos, A microfacet based coupled
specular-matte BRDF model with importance sampling, 2001).
"""

from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np

from nishiki.brdf.cloth.interface import azimuth, halves, only_above, polar
from nishiki.brdf.cloth.measures import directional_albedo

THETAS, PHIS = 16, 24  # grid of the stored directional albedo


WITHIN = ("diffuse", "body", "lambert")  # fields that hold the light from within


def gloss_of(brdf):
    """The model without its light from within: a black cloth of the same yarns; itself where it has none."""
    inner = {field.name: getattr(brdf, field.name) for field in fields(brdf) if field.name in WITHIN}
    return replace(brdf, **{name: np.zeros_like(value) for name, value in inner.items()}) if inner else brdf


@dataclass(frozen=True)
class Dyed:
    """A gloss over a dye; channels are the dye's."""

    KIND: ClassVar[str] = "dyed"
    gloss: object  # a BRDF of one channel, or of the dye's channels
    albedo: np.ndarray  # (channels,) of the dye under a gloss that takes nothing, 0 .. 1
    gloss_albedo: np.ndarray  # (THETAS, PHIS) share of the light that the gloss reflects, mean over its channels
    mean_albedo: float  # cosine-weighted mean of gloss_albedo

    @classmethod
    def of(cls, gloss, albedo) -> "Dyed":
        """A dye of albedo (channels,) under a gloss, which keeps any light from within of its own: give a black one."""
        albedo = np.atleast_1d(np.asarray(albedo, float))
        theta = (np.arange(THETAS) + 0.5) * (np.pi / 2 / THETAS)
        phi = np.arange(PHIS) * (2 * np.pi / PHIS)
        t, p = np.meshgrid(theta, phi, indexing="ij")
        incident = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)
        table = np.clip(directional_albedo(gloss, incident).mean(axis=-1), 0, 1)
        weight = (np.sin(theta) * np.cos(theta))[:, None]
        return cls(gloss, albedo, table, float(np.sum(weight * table) / np.sum(weight) / PHIS))

    @property
    def channels(self) -> int:
        """Number of channels."""
        return max(self.albedo.size, self.gloss.channels)

    def gloss_albedo_at(self, directions: np.ndarray) -> np.ndarray:
        """Directional albedo of the gloss (...,), linear in theta, periodic and linear in phi."""
        t = np.clip(polar(directions) / (np.pi / 2) * THETAS - 0.5, 0, THETAS - 1)
        p = azimuth(directions) / (2 * np.pi) * PHIS
        t0, p0 = np.minimum(t.astype(int), THETAS - 2), p.astype(int)
        u, v = t - t0, p - p0
        rows = [
            (1 - v) * self.gloss_albedo[t0 + k, p0 % PHIS] + v * self.gloss_albedo[t0 + k, (p0 + 1) % PHIS]
            for k in (0, 1)
        ]
        return (1 - u) * rows[0] + u * rows[1]

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """BRDF, 1 / sr."""
        g = halves(incident, outgoing)
        through = (
            (1 - self.gloss_albedo_at(incident))
            * (1 - self.gloss_albedo_at(outgoing))
            / max(1 - self.mean_albedo, 1e-3)
        )
        return self.gloss.evaluate(incident, outgoing) + only_above(g.above, through[..., None] * (self.albedo / np.pi))

    def as_arrays(self) -> dict[str, np.ndarray]:
        """The dye's numbers, and the gloss' under the prefix `gloss_of_`."""
        albedos = {n: np.asarray(getattr(self, n)) for n in ("albedo", "gloss_albedo", "mean_albedo")}
        inner = {f"gloss_of_{name}": value for name, value in self.gloss.as_arrays().items()}
        return {**albedos, **inner, "gloss_of": np.array(self.gloss.KIND)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> "Dyed":
        """The model of `as_arrays`."""
        from nishiki.brdf.cloth.store import class_of  # the store knows the kinds; this kind is one of them

        prefix = "gloss_of_"
        inner = {name[len(prefix) :]: value for name, value in arrays.items() if name.startswith(prefix)}
        gloss = class_of(str(arrays["gloss_of"])).from_arrays(inner)
        return cls(gloss, arrays["albedo"], arrays["gloss_albedo"], float(arrays["mean_albedo"]))
