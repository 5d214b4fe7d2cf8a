"""The stage from views to components: boards, pictures, several lights, and what is missing."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from refusals import refused

from nishiki.artifacts.declaration import limit_checks, limit_warnings
from nishiki.capture.folder import load_capture
from nishiki.errors import UserError
from nishiki.observations.check import check_capture
from nishiki.observations.views_store import geometry_sources, write_views
from nishiki.polarisation.polarisation import Components
from nishiki.progress import Progress
from nishiki.stages.ingest import IngestSettings
from nishiki.stages.polarise import LIMITS, PolariseSettings
from nishiki.stages.polarise import run as stage

ROWS, COLUMNS = 48, 64
BETA = np.array([0.42, 0.36, 0.3])
FULL = 65535


def scene(view: int) -> tuple[np.ndarray, np.ndarray]:
    """Diffuse and specular reflectance (rows, columns, 3) of a view."""
    row, column = np.mgrid[:ROWS, :COLUMNS]
    diffuse = (0.2 + 0.2 * np.sin((row + 5 * view) / 9))[..., None] * [1.0, 0.8, 0.6] + 0.05
    gloss = 0.4 * np.exp(-((row - 20) ** 2 + (column - 20 - 8 * view) ** 2) / 40)
    return diffuse, np.repeat(gloss[..., None], 3, axis=-1)


def lamp() -> np.ndarray:
    row, column = np.mgrid[:ROWS, :COLUMNS]
    return (0.9 - 0.004 * row - 0.003 * column)[..., None]


def seen(state: str, diffuse, specular) -> np.ndarray:
    if state in ("", "off"):
        return diffuse + specular
    if state == "on":
        return BETA * diffuse
    generator, analyser = (0.0, float(state)) if "/" not in state else map(float, state.split("/"))
    return 0.8 * (diffuse / 2 + specular * np.cos(np.radians(analyser - generator)) ** 2)


def make(
    folder, states, *, boards=None, views=("a", "b"), block=None, files=None, noise=0.0, plain_board=False, labels=None
):
    """A capture of a simulated lamp and scene, ingested; boards: states of the white boards photographed; noise:
    variance of full scale; plain_board: one without polariser, too; labels: names that photographs of the object get in
    place of those of their states."""
    capture, artifact = folder / "capture", folder / "ingest"
    (artifact / "geometry").mkdir(parents=True)
    capture.mkdir()
    rows = ["file,role,view,polariser"]

    random = np.random.default_rng(0)

    def save(name, values):
        values = values + random.normal(size=values.shape) * np.sqrt(noise * np.maximum(values, 0))
        cv2.imwrite(str(capture / name), np.rint(FULL * np.clip(values, 0, 1))[..., ::-1].astype(np.uint16))

    for number, view in enumerate(views):
        for k, state in enumerate(states):
            save(f"{view}{k}.png", lamp() * seen(state, *scene(number)))
            rows.append(f"{view}{k}.png,sample,{view},{(labels or {}).get(state, state)}")
    white = np.ones((ROWS, COLUMNS, 3))
    for k, state in enumerate(states if boards is None else boards):
        save(f"white{k}.png", lamp() * seen(state, white, 0 * white))
        rows.append(f"white{k}.png,white,,{state}")
    if plain_board:
        save("white.png", 0.7 * lamp() * white)
        rows.append("white.png,white,,")
    (capture / "frames.csv").write_text("\n".join(rows) + "\n")
    for name, text in (files or {}).items():
        (capture / name).write_text(text)
    settings = {
        "format": 1,
        "title": "polarised",
        "geometry": "turntable",
        "camera": {"channels": ["red", "green", "blue"], "encoding": "linear"},
        "turntable": block or {},
    }
    (capture / "capture.yaml").write_text(yaml.safe_dump(settings))
    loaded = load_capture(capture)
    write_views(loaded, artifact, settings=IngestSettings())
    for source, name in geometry_sources(loaded):
        (artifact / name).write_bytes(source.read_bytes())
    return artifact


def run(artifact, folder, **settings):
    out = folder / "out"
    out.mkdir()

    def path(name):
        (out / name).parent.mkdir(exist_ok=True)
        return out / name

    context = SimpleNamespace(
        inputs={"ingest": SimpleNamespace(folder=artifact)},
        settings=PolariseSettings(**settings),
        output=SimpleNamespace(folder=out, path=path),
        progress=Progress("test"),
        stamp={"scene": "test", "key": "0"},
    )
    told = stage.run(context)
    json.dumps(told, allow_nan=False)
    return told, Components(out), out


def test_circular_states_with_boards(tmp_path):
    told, found, out = run(make(tmp_path, ("on", "off")), tmp_path)
    assert told["method"] == "circular"
    np.testing.assert_allclose(told["boards"][""]["channel"], BETA, rtol=1e-3)
    for view in range(2):
        diffuse, specular, valid = found.read(view)
        assert valid.all()
        true = scene(view)
        np.testing.assert_allclose(diffuse, lamp() * true[0], atol=2e-4)
        np.testing.assert_allclose(specular, lamp() * true[1], atol=3e-4)
    names = sorted(file.name for file in (out / "pictures").iterdir())
    assert names == sorted(f"00{k}_{v}_{p}.png" for k, v in enumerate("ab")
                           for p in ("whole", "diffuse", "specular", "side_by_side"))  # fmt: skip
    wide = cv2.imread(str(out / "pictures/000_a_side_by_side.png"))
    assert wide.shape == (ROWS, 3 * COLUMNS, 3)
    assert wide[20, 20].min() > 150 > wide[20, 2 * COLUMNS + 60].max()


@pytest.mark.parametrize("states", [("off", "on"), ("0", "45", "90", "135"), ("0/0", "0/90")])
def test_smoothing_brings_both_parts_closer(states, tmp_path):
    artifact = make(tmp_path, states, noise=1e-4)
    errors = []
    for smoothing in (False, True):
        told, components_read, out = run(artifact, tmp_path, smoothing=smoothing, pictures=0)
        true = [part * (1 if told["unit"] == "white board" else lamp()) for part in scene(0)]
        found = components_read.read(0)[:2]
        errors.append([float(np.sqrt(np.mean((a - b)[8:-8, 8:-8] ** 2))) for a, b in zip(found, true, strict=True)])
        out.rename(tmp_path / f"smoothing-{smoothing}")
    assert errors[1][0] < 0.85 * errors[0][0]
    assert errors[1][1] < 0.6 * errors[0][1]
    facts = told["by_view"][0]
    noise = np.sqrt(errors[0][1] ** 2 - errors[1][1] ** 2)  # what is left is independent of what was removed
    assert facts["changed"]["specular"] == pytest.approx(noise, rel=0.25)
    assert facts["doubtful"] < 0.01
    np.testing.assert_allclose(facts["photograph_noise"]["slope"], 1e-4, rtol=0.6)


@pytest.mark.parametrize(
    ("states", "boards", "plain", "unit"),
    [
        (("off", "on"), None, False, "full scale"),
        (("off", "on"), None, True, "white board"),
        (("0", "90"), None, False, "white board"),
        (("0", "90"), (), False, "full scale"),
    ],
)
def test_the_unit_of_the_components_is_stated(states, boards, plain, unit, tmp_path):
    told, found, _ = run(make(tmp_path, states, boards=boards, plain_board=plain), tmp_path)
    assert told["unit"] == unit
    if unit == "white board":
        np.testing.assert_allclose(np.median(found.read(0)[0] / scene(0)[0]), 1 / 0.7 if plain else 1, rtol=0.01)
    assert list(told["pictures"].values()) == ["a", "b"]


def test_circular_states_need_boards_or_a_given_beta(tmp_path):
    artifact = make(tmp_path, ("off", "on"), boards=())
    with refused(UserError, "polarise.beta"):
        run(artifact, tmp_path)
    (tmp_path / "out").rename(tmp_path / "first")
    told, found, _ = run(artifact, tmp_path, beta=tuple(BETA), pictures=0)
    np.testing.assert_allclose(found.read(1)[1], lamp() * scene(1)[1], atol=3e-4)
    assert told["boards"] == {"": None}
    (tmp_path / "out").rename(tmp_path / "second")
    with pytest.raises(UserError, match="expected 1 or 3 values"):
        run(artifact, tmp_path, beta=(0.3, 0.4))


@pytest.mark.parametrize("states", [("0", "45", "90", "135"), ("0", "90"), ("0/0", "0/90", "30/30", "30/120")])
def test_linear_states_with_boards_give_parts_relative_to_white(states, tmp_path):
    told, found, _ = run(make(tmp_path, states, block=None), tmp_path, pictures=1)
    assert told["method"] in ("linear", "crossed", "pairs")
    inner = np.s_[8:-8, 8:-8]
    for view in range(2):
        diffuse, specular, valid = found.read(view)
        assert valid.all()
        true = scene(view)
        np.testing.assert_allclose(diffuse[inner], true[0][inner], atol=2e-3)
        np.testing.assert_allclose(specular[inner], true[1][inner], atol=2e-3)


def test_given_arms_and_a_series_without_pairs(tmp_path):
    states = tuple(f"{g}/{a}" for g in (0, 60, 120) for a in (20, 80, 140))
    arms = yaml.safe_dump({"generator": {"polariser_deg": 0.0}, "analyser": {}})
    artifact = make(tmp_path, states, boards=(), block={"calibration": "arms.yaml"}, files={"arms.yaml": arms})
    told, found, _ = run(artifact, tmp_path, pictures=0)
    assert told["method"] == "mueller"
    assert told["by_view"][0]["residual"] < 1e-4
    np.testing.assert_allclose(found.read(0)[1], 0.8 * lamp() * scene(0)[1], atol=3e-4)


def test_one_state(tmp_path):
    told, found, _ = run(make(tmp_path, ("",), boards=()), tmp_path)
    assert told["method"] == "none"
    assert told["specular_share"] == 0
    np.testing.assert_allclose(found.read(0)[0], lamp() * sum(scene(0)), atol=1e-4)


def test_a_dispersion_needs_the_wavelength(tmp_path):
    states = tuple(f"{g}/{a}" for g in range(0, 180, 30) for a in range(0, 180, 30))
    arms = yaml.safe_dump({"generator": {"dispersion": [702.0, 3.7e7]}, "analyser": {"dispersion": [702.0, 3.7e7]}})
    artifact = make(tmp_path, states, boards=(), views=("a",), block={"calibration": "arms.yaml"},
                    files={"arms.yaml": arms})  # fmt: skip
    with pytest.raises(UserError, match="wavelength_nm"):
        run(artifact, tmp_path)


def beyond(told):
    """Names of the limits of the stage that a result is beyond."""
    return {each.limit.name for each in limit_checks(LIMITS, told) if each.beyond}


SWAPS = [("off", "on"), ("0", "90"), ("0/0", "0/90")]


@pytest.mark.parametrize("states", SWAPS)
def test_sound_states_are_within_every_limit(states, tmp_path):
    told, _, _ = run(make(tmp_path, states, noise=1e-4), tmp_path, pictures=0)
    assert not beyond(told)
    assert not limit_warnings("polarise", LIMITS, told)
    assert "polarisers-exchanged" not in {p.kind for p in check_capture(tmp_path / "capture", level="full")}


@pytest.mark.parametrize("states", SWAPS)
def test_exchanged_states_are_found_by_check_and_by_the_stage(states, tmp_path):
    first, second = states
    artifact = make(tmp_path, states, noise=1e-4, labels={first: second, second: first})
    problems = {p.kind: p for p in check_capture(tmp_path / "capture", level="full")}
    assert problems["polarisers-exchanged"].severity == "error"
    assert "white board" not in problems["polarisers-exchanged"].remedy
    told, _, _ = run(artifact, tmp_path, pictures=0)
    assert "specular_share" in beyond(told)


def test_boards_that_are_exchanged_too_give_a_beta_above_one(tmp_path):
    artifact = make(tmp_path, ("on", "off"), labels={"on": "off", "off": "on"}, boards=("off", "on"))
    table = (tmp_path / "capture" / "frames.csv").read_text()
    table = table.replace("white,,off", "white,,x").replace("white,,on", "white,,off").replace("white,,x", "white,,on")
    (tmp_path / "capture" / "frames.csv").write_text(table)
    write_views(load_capture(tmp_path / "capture"), tmp_path / "second", settings=IngestSettings())
    told, _, _ = run(tmp_path / "second", tmp_path, pictures=0)
    assert {"specular_share", "beta"} <= beyond(told)
    assert artifact.is_dir()


def test_angles_that_do_not_explain_the_photographs(tmp_path):
    states = ("0", "30", "60", "90", "120", "150")
    for number, labels in enumerate(({}, {"30": "90", "90": "30"})):
        folder = tmp_path / str(number)
        folder.mkdir()
        told, _, _ = run(make(folder, states, noise=1e-4, labels=labels), folder, pictures=0)
        assert ("unexplained" in beyond(told)) == ("exchanged" in beyond(told)) == bool(labels)
        found = [p for p in check_capture(folder / "capture", level="full") if p.kind == "states-exchanged"]
        assert len(found) == bool(labels)
        assert all("90 and 30" in problem.remedy or "30 and 90" in problem.remedy for problem in found)
