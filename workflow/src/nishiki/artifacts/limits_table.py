"""The limits of every stage, with the reason of each. docs/stability.md shows this table."""

from collections.abc import Mapping
from typing import Any

from nishiki.artifacts.limits import Limit, at, extreme, share


def _regions(told: Mapping[str, Any], name: str) -> list[Any]:
    """One entry of every region of a cloth."""
    return [region.get(name) for region in (told.get("regions") or {}).values() if isinstance(region, Mapping)]


def _weave_error(told: Mapping[str, Any]) -> float | None:
    return extreme("all")({"all": _regions(told, "rms_rel")})


def _fabric_error(told: Mapping[str, Any]) -> float | None:
    """At the incidences that the default model was fitted to."""
    chosen = told.get("default")
    models = [region.get(chosen) or {} for region in (told.get("regions") or {}).values()]
    return extreme("all")({"all": [(model.get("rms_rel_used") or {}) for model in models]})


def _residual_loss(told: Mapping[str, Any]) -> float | None:
    psnr, model = at("psnr_db")(told), at("model_psnr_db")(told)
    return None if psnr is None or model is None else model - psnr


def _pose_outliers(told: Mapping[str, Any]) -> float | None:
    kept, lost = told.get("points") or {}, told.get("outliers") or {}
    shares = [lost[view] / (lost[view] + kept[view]) for view in lost if lost[view] + kept.get(view, 0)]
    return max(shares) if shares else None


def _scan_residual(told: Mapping[str, Any]) -> float | None:
    """Of the registration, relative to the size of the surface."""
    worst, area = extreme("scans.residual")(told), at("area")(told)
    return None if worst is None or not area else worst / area**0.5


def _flag(name: str, meaning: str, whole: str, **rest: Any) -> Limit:
    return Limit(f"{name}_share", meaning, share(f"flagged_{name}", whole), **rest)


INGEST = (
    Limit(
        "object_pixels",
        "pixels inside the mask",
        at("mask_pixels"),
        least=1,
        remedy="give a mask or a region of interest that shows the object",
        why="an empty mask leaves nothing to compute",
    ),
    Limit("defect_pixels", "hot or dead pixels", at("defects")),
)
SEPARATE = (
    Limit(
        "valid_share",
        "share of the samples that are neither saturated, dark nor outside the mask",
        at("valid_fraction"),
        least=1e-4,
        remedy="expose differently, or check the mask and the black level of the capture",
        why="a small object in a large picture may be one in a thousand; less means photographs that show nothing",
    ),
    Limit(
        "usable_share",
        "share of the valid samples that were taken as diffuse",
        share("usable_fraction", "valid_fraction"),
        least=0.05,
        remedy="set separate.method to none or trimmed, or change separate.w1 and w2",
        why="captures gave 0.40 to 0.88; below a twentieth most pixels keep fewer than three lights",
    ),
    Limit("highlight_share", "share of the samples taken as highlight", at("highlight_fraction")),
    Limit("shadow_share", "share of the samples taken as shadow", at("shadow_fraction")),
)
NORMALS = (
    Limit(
        "estimated_share",
        "share of the object's pixels that have a normal",
        share("valid_pixels", "object_pixels"),
        least=0.5,
        remedy="more lights, other exposures, separate.method none, or normals.max_condition for lights in a plane",
        why="captures gave 0.9997 and more; where half is missing, height and reflectance are mostly interpolation",
    ),
    Limit(
        "sigma",
        "median expected error of a normal, degrees",
        at("sigma_median_deg"),
        most=45,
        remedy="more lights, from other sides; check that the light directions belong to these photographs",
        why="captures gave 0.4 to 13; a random normal is wrong by 57 degrees on average",
    ),
    *(
        _flag(name, f"share of the object's pixels flagged {words}", "object_pixels")
        for name, words in (
            ("too_few_lights", "too few lights"),
            ("coplanar_lights", "lights in one plane"),
            ("ill_conditioned", "badly conditioned"),
            ("no_redundancy", "no redundancy"),
            ("no_signal", "no signal"),
            ("faces_away", "faces away"),
            ("filled", "filled"),
            ("fallback", "without the joint fit"),
        )
    ),
)
HEIGHT = (
    Limit(
        "convergence",
        "relative residual of the linear system of the height",
        at("residual"),
        most=1e-2,
        remedy="set height.method to another solver, or more iterations; check the normals' maps for islands",
        why="captures gave 1e-5 and less; a hundredth bends a surface by about its own relief",
    ),
    Limit("integrability", "rms curl of the gradients", at("integrability_rms")),
    Limit("parts", "separate parts of the object, each with its own zero", at("parts")),
)
SPECTRA = (
    Limit(
        "condition",
        "condition of camera, lamp and bases",
        at("condition"),
        most=1e4,
        remedy="set spectra.bases to fewer, use a lamp with a broader spectrum, or take the stage from the products",
        why="captures gave 3 to 4; at 1e4 noise of 0.1 % in a pixel is an error ten times the reflectance",
    ),
    *(
        Limit(f"{name}_pixels", f"pixels flagged {words}", at(f"flagged_{name}"))
        for name, words in (
            ("ill_conditioned", "badly conditioned"),
            ("negative_response", "negative response"),
            ("not_finite", "not finite"),
            ("outside_training", "unlike all training spectra"),
            ("outside_unit", "reflectance outside 0 to 1"),
        )
    ),
)
BRDF = (
    Limit("samples", "samples of the gloss, least region", extreme("samples", min)),
    Limit("residual", "rms residual of the gloss, worst region", extreme("residual")),
)
POLARISE = (
    Limit(
        "condition",
        "condition of the least squares over the polariser states",
        at("condition"),
        most=1e3,
        remedy="photograph states that are spread more evenly",
        why="simulated and measured series gave 1 to 35; 1000 turns noise of 0.1 % into the whole signal",
    ),
    Limit(
        "valid_share",
        "share of the pixels with both components",
        at("valid"),
        least=0.1,
        remedy="expose differently, or give polarise.beta where the board does not fill the picture",
        why="captures gave 0.9998 and more",
    ),
    Limit(
        "negative_share",
        "share of specular values further below 0 than noise reaches",
        at("doubtful"),
        most=0.5,
        remedy="check that the states in the column polariser of frames.csv are not exchanged, and polarise.beta",
        why="captures gave 0.017 and less; exchanged states make most specular values negative",
    ),
    Limit("low_beta_pixels", "pixels whose beta is below polarise.beta_least", extreme("low_beta")),
)
CAMERAS = (
    Limit(
        "reprojection",
        "reprojection error of the worst view, px",
        at("reprojection_worst_px"),
        most=20,
        remedy="check the correspondences and the board of that view, and that cameras and points are of one world",
        why="at 20 pixels every texel is smeared over its neighbours; sound boards and points stay far below",
    ),
    Limit(
        "calibration",
        "rms error of the lens calibration, px",
        at("calibration.rms_px"),
        most=5,
        remedy="photograph the board again, flat, sharp and without gloss; or cameras.distortion with more terms",
        why="at 5 pixels the board or the lens is not the one that is described",
    ),
    Limit(
        "outlier_share",
        "share of the points that no pose explains, worst view",
        _pose_outliers,
        most=0.5,
        remedy="pick the points of that view again",
        why="with half of the points wrong another half could be as right",
    ),
)
MESH = (
    Limit(
        "silhouette_overlap",
        "mean intersection over union of the mesh's outline and the silhouettes",
        at("fit.iou_mean"),
        least=0.5,
        remedy="check that mesh and cameras are of one world and unit; mesh.overlap (scans), mesh.background",
        why="captures gave 0.985 and more; scans that were registered wrongly gave 0.26",
    ),
    Limit(
        "registration",
        "residual of the scans' registration over the size of the surface",
        _scan_residual,
        most=0.05,
        remedy="scans that overlap more, or mesh.overlap",
        why="scans gave 5e-5; a twentieth of the object is no registration",
    ),
    Limit("open_edges", "edges of one triangle only", at("open_edges")),
    Limit("crowded_edges", "edges of more than two triangles", at("crowded_edges")),
    Limit("degenerate_triangles", "triangles without area that were left out", at("cleaned.degenerate")),
)
TEXELS = (
    Limit(
        "object_pixels",
        "pixels of all views that show the mesh",
        at("object_pixels"),
        least=1,
        remedy="mesh and cameras must be of one world; look at the mesh stage's preview",
        why="no pixel: nothing to fit",
    ),
    Limit(
        "visible_share",
        "share of the texels that a view shows, mean over the views",
        at("visible_share"),
        least=0.01,
        remedy="check mesh and cameras; texels.depth_tolerance and grazing_deg",
        why="captures gave 0.32 to 0.38; a mesh that stood wrong gave 0.003",
    ),
    Limit(
        "uncovered_share",
        "share of the silhouettes that the mesh does not cover",
        at("silhouette_uncovered_share"),
        most=0.5,
        remedy="check mesh and cameras, and the silhouettes of the capture",
        why="captures gave 0.0015 to 0.013; scans that were registered wrongly gave 0.74",
    ),
    Limit("degenerate_triangles", "triangles without area that get no texels", at("degenerate_triangles")),
)
REFLECTION = (
    Limit(
        "unseen_share",
        "share of the texels that no view shows",
        at("unseen_share"),
        most=0.9,
        remedy="views from more sides, or a mesh without inner surfaces",
        why="captures gave 0.02 to 0.07; a mesh that stood wrong gave 0.98",
    ),
    Limit(
        "psnr",
        "PSNR of the model over the samples, dB",
        at("psnr_db"),
        least=6,
        remedy="check reflection.lighting and the capture's lamp; cameras and mesh",
        why="captures gave 22 to 41; 6 dB is an error of half of full scale",
    ),
    Limit("once_share", "share of the texels that one observation shows", at("once_share")),
    Limit("filled_share", "share of the texels whose gloss is their neighbours'", at("filled_share")),
    Limit("highlight_share", "share of the texels with a highlight of their own", at("highlight_share")),
)
RESIDUAL = (
    Limit(
        "loss",
        "how much worse the stored result is than the model that it refines, dB",
        _residual_loss,
        most=3,
        remedy="a finer residual.amount, or leave the stage out",
        why="a residual adds 0.4 to 17 dB; a step so coarse that it costs 3 is worse than none",
    ),
    Limit("empty_tiles", "tiles for which the model suffices", at("empty_tiles")),
)
REFLECTANCE = (
    Limit(
        "unusable_share",
        "share of the measurements that cannot be used, worst region",
        lambda told: share("worst", "directions")({**told, "worst": extreme("unusable")(told)}),
        most=0.9,
        remedy="expose differently, or check the window of the photographs",
        why="captures gave 0; with a tenth left most incidences are empty",
    ),
    Limit(
        "noise",
        "relative noise of a reflectance",
        at("noise_relative"),
        most=0.5,
        remedy="a larger window, longer exposures, or more photographs",
        why="captures gave 0.001 to 0.01",
    ),
    Limit(
        "symmetry",
        "relative departure from the symmetry that was assumed",
        extreme("symmetry_departure"),
        most=1,
        remedy="set reflectance.symmetry, and check the directions of warp and camera",
        why="captures gave 0.0006 to 0.14; at 1 the quarters do not show the same cloth",
    ),
    Limit(
        "interpolation",
        "relative error at left-out views of normal incidence",
        extreme("left_out_error"),
        most=1,
        remedy="more views at normal incidence",
        why="captures gave 0.0009 to 0.085; at 1 the table of the hemisphere holds nothing",
    ),
    Limit("saturated_measurements", "measurements with saturated pixels", at("saturated")),
)
WEAVE = (
    Limit(
        "misfit",
        "relative rms error of the cross-section's fit, worst yarn and region",
        _weave_error,
        most=0.5,
        remedy="set weave.harness, or take the stage from the products",
        why="cloths gave 0.009 to 0.06; at a half the section explains nothing",
    ),
)
FABRIC = (
    Limit(
        "misfit",
        "relative rms error of the default model at the incidences that it was fitted to, worst region",
        _fabric_error,
        most=2,
        remedy="set fabric.model, and check directions and regions of the capture",
        why="models gave 0.0003 to 0.95 where they were fitted; at 2 the errors are twice the light",
    ),
)
LIMITS: dict[str, tuple[Limit, ...]] = {
    "ingest": INGEST,
    "separate": SEPARATE,
    "normals": NORMALS,
    "height": HEIGHT,
    "spectra": SPECTRA,
    "brdf": BRDF,
    "polarise": POLARISE,
    "cameras": CAMERAS,
    "mesh": MESH,
    "texels": TEXELS,
    "reflection": REFLECTION,
    "residual": RESIDUAL,
    "reflectance": REFLECTANCE,
    "weave": WEAVE,
    "fabric": FABRIC,
}
"""By stage. Those that judge and show (render, evaluate, report) have none: a bad result must be shown as well."""
