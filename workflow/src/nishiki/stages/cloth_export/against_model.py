"""How far the reflection of an exported cloth is from its model, in pictures of the cloth."""

import numpy as np

from nishiki.colour.colour import delta_e_2000, srgb_encode, srgb_matrix, xyz_to_lab
from nishiki.colour.encoding import decode
from nishiki.render.cloth.frame import RenderVariant, render
from nishiki.render.cloth.scene import Brdf, ClothScene
from nishiki.render.cloth.studio import Lighting, framed
from nishiki.stages.cloth_export.scene import ExportedCloth

VIEWS = ((21, 12), (21, 132), (21, 252), (60, 12))
"""Elevation and azimuth in degrees of the views on which the loss is measured,"""
LAMPS = ((38, -50), (24, 68), (60, 180))
"""and of the lamps, from the view: beside, low at the other side, behind."""
SIDE = 128
"""Pixels along a side of these pictures."""


def errors(cloth: ExportedCloth, material: Brdf) -> dict:
    """Pictures of the cloth with the material against pictures with the model, under one lamp each, without shadows:
    PSNR of the sRGB codes, dB, peak 1, of all and of the worst; CIEDE2000, mean and 95th percentile."""
    scene = ClothScene.of([cloth.draped.surface])
    squares, differences = [], []
    for elevation, azimuth in np.radians(VIEWS):
        points = cloth.draped.surface.mesh.vertices
        camera = framed(
            points, elevation=elevation, azimuth=azimuth, rows=SIDE, columns=SIDE, distance=cloth.shown.view.distance
        )
        lamps = [Lighting(*np.radians(place), (1.0, 1.0, 1.0), 0.0).lamp(azimuth) for place in LAMPS]
        takes = [
            RenderVariant((brdf,), tuple(np.eye(len(lamps))[k]))
            for k in range(len(lamps))
            for brdf in (cloth.brdf, material)
        ]
        made = render(scene, takes, lamps, camera, supersampling=1, shadows=False)
        for true, shown in zip(made[::2], made[1::2], strict=True):
            codes = [srgb_encode(picture.linear[picture.coverage > 0]) for picture in (true, shown)]
            squares.append(np.mean((codes[0] - codes[1]) ** 2))
            differences.append(colour_differences(*codes))
    together = np.concatenate(differences)
    decibels = -10 * np.log10(np.maximum([np.mean(squares), np.max(squares)], 1e-12))
    return {
        "pictures": len(squares),
        "psnr_db": {"all": float(decibels[0]), "worst": float(decibels[1])},
        "delta_e": {"mean": float(together.mean()), "percentile_95": float(np.percentile(together, 95))},
    }


def colour_differences(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """CIEDE2000 (n,) of sRGB codes (n, 3)."""
    to_xyz = np.linalg.inv(srgb_matrix())
    labs = (
        xyz_to_lab(decode(codes.astype(np.float64), "srgb") @ to_xyz.T, to_xyz @ np.ones(3))
        for codes in (first, second)
    )
    return delta_e_2000(*labs)
