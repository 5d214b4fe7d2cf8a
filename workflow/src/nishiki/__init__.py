"""Photographs under controlled light to normals, spectra, reflection models and renders.

The functions below are what people call from Python; the workflow calls the same ones. Arrays go in and out, with the
last axis for channels or directions. The coordinate frame of pictures is x right, y up, z towards the camera.

Each function is imported when it is first used, so `import nishiki` costs nothing.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from nishiki.api import (
        Observed,
        find_lights,
        fit_cloth,
        fit_gloss,
        read_object,
        read_observations,
        read_photographs,
        render_view,
        save_picture,
        shade,
    )
    from nishiki.brdf.cloth.store import load_brdf as read_cloth
    from nishiki.brdf.cloth.store import save_brdf as write_cloth
    from nishiki.brdf.torrance_sparrow import fresnel
    from nishiki.brdf.torrance_sparrow import specular as torrance_sparrow
    from nishiki.capture.folder import load_capture as read_capture
    from nishiki.colour.estimate import estimate_spectra, fit_estimator
    from nishiki.colour.training import synthetic_reflectances
    from nishiki.photometric.height import integrate_normals as integrate_height
    from nishiki.photometric.light_selection import select_diffuse as select_lights
    from nishiki.photometric.solve import estimate_normals

__all__ = [
    "Observed", "estimate_normals", "estimate_spectra", "find_lights", "fit_cloth", "fit_estimator", "fit_gloss",
    "fresnel", "integrate_height", "read_capture", "read_cloth", "read_object", "read_observations", "read_photographs",
    "render_view", "save_picture", "select_lights", "shade", "synthetic_reflectances", "torrance_sparrow",
    "write_cloth",
]  # fmt: skip

_PLACES = {
    "estimate_normals": "photometric.solve:estimate_normals",
    "estimate_spectra": "colour.estimate:estimate_spectra",
    "fit_estimator": "colour.estimate:fit_estimator",
    "fresnel": "brdf.torrance_sparrow:fresnel",
    "integrate_height": "photometric.height:integrate_normals",
    "read_capture": "capture.folder:load_capture",
    "read_cloth": "brdf.cloth.store:load_brdf",
    "select_lights": "photometric.light_selection:select_diffuse",
    "synthetic_reflectances": "colour.training:synthetic_reflectances",
    "torrance_sparrow": "brdf.torrance_sparrow:specular",
    "write_cloth": "brdf.cloth.store:save_brdf",
}
"""Module and name, below this package, of public names that are not defined in `api`."""


def __getattr__(name: str):
    if name not in __all__:
        raise AttributeError(f"module 'nishiki' has no attribute {name!r}; public are {', '.join(__all__)}")
    import importlib
    import sys

    if "numba" not in sys.modules:
        importlib.import_module("nishiki.installation").use_kernel_cache()
    module, _, inner = _PLACES.get(name, f"api:{name}").partition(":")
    value = getattr(importlib.import_module(f"nishiki.{module}"), inner)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
