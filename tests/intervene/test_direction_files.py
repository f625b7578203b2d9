"""Directions from outside: read from safetensors, npz and sparse autoencoders, and patched or added."""

import json
import os
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.hooks import Site
from probe_kit.intervene import Interchange, Steering
from probe_kit.intervene.directions import Directions
from probe_kit.intervene.patching import run_with_hooks
from probe_kit.intervene.patching.patch import Cell
from probe_kit.intervene.places import resolve_sites
from probe_kit.intervene.replay import ConditionContext, replay
from probe_kit.intervene.scene_session import SceneSession
from probe_kit.runs import export_run
from probe_kit.runs.direction_files import about_direction, names_file, read_direction, write_directions
from probe_kit.train.results.probe_results import Direction, write_direction_file

SITE, WIDTH = "backbone.02", 96


def written(path: Path, vectors: dict[str, Any], **about: str) -> Path:
    write_directions(path, vectors, dict.fromkeys(vectors, about))
    return path


@pytest.mark.parametrize("ending", ["safetensors", "npz"])
def test_a_written_direction_is_read_again_with_what_is_said_of_it(tmp_path: Path, ending: str) -> None:
    vector = np.arange(1, 5)
    path = written(tmp_path / f"some.{ending}", {"a": vector, "b": 2 * vector}, site=SITE, weights="0f" * 32)
    assert names_file(f"{path}#a")
    a, b = read_direction(f"{path}#a"), read_direction(f"{path}#b")
    assert (a.site, a.weights) == (SITE, "0f" * 32)
    assert a.name.startswith("a-")
    assert a.name != b.name
    np.testing.assert_array_equal(a.vectors, [vector])
    np.testing.assert_allclose(np.abs(a.basis), [vector / np.linalg.norm(vector)], rtol=1e-6)


def test_a_standardised_direction_is_scaled_to_the_raw_space(tmp_path: Path) -> None:
    arrays = {"w": np.ones(3), "w.scale": np.array([1.0, 2.0, 4.0])}
    path = tmp_path / "probe.npz"
    write_directions(path, arrays, {"w": {"space": "standardised"}})
    np.testing.assert_array_equal(read_direction(str(path)).vectors, [[1, 2, 4]])


def test_a_feature_of_an_autoencoder_is_its_row_of_the_decoder(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    decoder = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    save_file({"W_dec": decoder, "b_dec": np.zeros(3, np.float32)}, tmp_path / "sae_weights.safetensors")
    (tmp_path / "cfg.json").write_text(json.dumps({"metadata": {"hook_name": SITE}}), encoding="utf-8")
    feature = read_direction(f"{tmp_path}#3")
    np.testing.assert_array_equal(feature.vectors, decoder[3:4])
    assert feature.site == SITE
    with pytest.raises(UsageError, match="has 5 features"):
        read_direction(f"{tmp_path}#9")


def test_a_decoder_in_bfloat16_is_read(tmp_path: Path) -> None:
    """numpy has no such numbers; large models have no others."""
    import torch
    from safetensors.torch import save_file

    decoder = torch.arange(15, dtype=torch.bfloat16).reshape(5, 3) + 1
    save_file({"W_dec": decoder}, tmp_path / "sae_weights.safetensors")
    np.testing.assert_array_equal(read_direction(f"{tmp_path}#2").vectors, [[7, 8, 9]])


@pytest.mark.slow
def test_probes_directions_are_written_for_the_sites_and_weights_that_they_are_of(
    session: SceneSession, tmp_path: Path
) -> None:
    weights = np.random.default_rng(0).normal(size=(3, WIDTH)).astype(np.float32)
    direction_key = ("color", "mean:image", Site("backbone", 2))
    probes = {direction_key: Direction(weights, np.zeros(3), np.array([1.0, 2.0, 3.0]))}
    path = tmp_path / "probes.safetensors"
    assert write_direction_file(probes, path, session.run.weights_sha256) == 1
    direction = read_direction(f"{path}#color.mean:image.backbone.02")
    assert (direction.site, direction.role, direction.weights) == (SITE, "image", session.run.weights_sha256)
    np.testing.assert_allclose(direction.vectors[0], 2 * probes[direction_key].unit, rtol=1e-5)
    assert Interchange(sites=(SITE,), direction=str(path)).conditions(session)
    for view, role in (("mean", "all"), ("last", "")):
        assert about_direction("color", view, Site("backbone", 2), None)[1]["role"] == role
    write_direction_file(probes, path, "0" * 64)
    with pytest.raises(UsageError, match="was found in the weights"):
        Interchange(sites=(SITE,), direction=str(path)).conditions(session)


@pytest.mark.slow
def test_a_file_has_the_directions_of_one_captured_inference(labelled_run: Path, tmp_path: Path) -> None:
    file = tmp_path / "probes.npz"
    options = ["--call", "all", "--directions", str(file)]
    refused = CliRunner().invoke(app, ["train", str(labelled_run), *options])
    assert refused.exit_code == 2
    assert "--call 'all' with --directions; expected one number" in " ".join(refused.stderr.split())
    assert not file.exists()


def test_an_export_has_half_the_difference_of_the_class_means_and_steers_by_it(
    session: SceneSession, tmp_path: Path
) -> None:
    run, file = session.run, tmp_path / "means.npz"
    export_run(run.location, "directions", file, sites=[SITE], view="mean:image")
    rows = (run.episodes["category"] == "color").to_numpy()
    is_left = (run.episodes["side_correct"] == "left").to_numpy()
    features = run.column(Site("backbone", 2), "mean:image").astype(np.float64)
    half = (features[rows & is_left].mean(axis=0) - features[rows & ~is_left].mean(axis=0)) / 2
    name = f"{file}#color.mean:image.base.{SITE}"
    np.testing.assert_allclose(read_direction(name).vectors[0], half, rtol=1e-5, atol=1e-7)
    steering = Steering(sites=(SITE,), role="image", direction=name, coefficients=(1.0,), controls=0)
    (bases,) = directions_of(session, steering).values()
    np.testing.assert_allclose(bases.shift(steering.direction, "", 1.0), half, rtol=1e-5, atol=1e-7)
    with pytest.raises(UsageError, match=r"ending \.safetensors or \.npz"):
        export_run(run.location, "directions", tmp_path / "means.txt")


@pytest.mark.parametrize(
    ("vectors", "name", "mention"),
    [
        ({"a": np.ones(3), "b": np.ones(3)}, "", "directions a, b"),
        ({"a": np.ones(3)}, "#c", "directions a"),
        ({"a": np.zeros(3)}, "", "a row of zeros"),
        ({"a": np.array([1.0, np.nan])}, "", "NaN"),
        ({"a": np.ones((0, 3))}, "", "shape"),
        ({"a": np.ones((2, 2, 2))}, "", "shape"),
    ],
)
def test_a_file_without_the_direction_is_refused(
    tmp_path: Path, vectors: dict[str, Any], name: str, mention: str
) -> None:
    path = written(tmp_path / "some.npz", vectors)
    with pytest.raises(UsageError, match=mention):
        read_direction(f"{path}{name}")


@pytest.mark.parametrize("values", [np.ones(3, complex), np.array(["1", "2"]), np.ones(3, bool)])
def test_a_direction_of_other_than_real_numbers_is_refused(tmp_path: Path, values: Any) -> None:
    np.savez(tmp_path / "some.npz", a=values)
    with pytest.raises(UsageError, match="expected real numbers"):
        read_direction(str(tmp_path / "some.npz"))


@pytest.mark.parametrize("length", [1e300, 1e39, 1e-60])
def test_a_direction_that_float32_cannot_hold_is_refused(tmp_path: Path, length: float) -> None:
    """Added to an activation it would be infinite, or nothing."""
    np.savez(tmp_path / "some.npz", a=np.array([length, 0.0]))
    with pytest.raises(UsageError, match="activations are float32"):
        read_direction(str(tmp_path / "some.npz"))


@pytest.mark.parametrize(("scale", "mention"), [([0.0, 1.0], "a row of zeros"), ([np.inf, 1.0], "infinity")])
def test_a_scale_that_leaves_no_direction_is_refused(tmp_path: Path, scale: list[float], mention: str) -> None:
    path = tmp_path / "some.npz"
    values = {"a": np.array([1.0, 0.0]), "a.scale": np.array(scale)}
    write_directions(path, values, {"a": {"space": "standardised"}})
    with pytest.raises(UsageError, match=mention):
        read_direction(str(path))


@pytest.mark.parametrize("shape", [(), (3,), (2, 2, 3), (0, 3)])
def test_a_decoder_that_is_no_matrix_has_no_features(tmp_path: Path, shape: tuple[int, ...]) -> None:
    from safetensors.numpy import save_file

    save_file({"W_dec": np.ones(shape, np.float32)}, tmp_path / "sae_weights.safetensors")
    with pytest.raises(UsageError, match="has 0 features; expected"):
        read_direction(f"{tmp_path}#0")


def test_a_scale_of_another_shape_than_the_direction_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "some.npz"
    write_directions(path, {"a": np.ones(4), "a.scale": np.ones((5, 4))}, {"a": {"space": "standardised"}})
    with pytest.raises(UsageError, match=r"a\.scale has the shape \(5, 4\); expected \(4,\)"):
        read_direction(str(path))


@given(
    rank=st.integers(1, 4),
    extra=st.integers(0, 3),
    dtype=st.sampled_from(["float16", "bfloat16", "float32", "float64"]),
    seed=st.integers(0, 2**16),
)
@settings(deadline=None, max_examples=40)
def test_rows_that_depend_on_each_other_span_no_further_direction(
    rank: int, extra: int, dtype: str, seed: int
) -> None:
    import torch
    from safetensors.torch import save_file

    draw = np.random.default_rng(seed)
    independent = draw.normal(size=(rank, 64))
    # Stored numbers are rounded: a sum of rows, a multiple and a negative are dependent up to that rounding.
    dependent = draw.normal(size=(extra, rank)) @ independent
    stored = torch.tensor(np.concatenate([independent, dependent])).to(getattr(torch, dtype))
    with TemporaryDirectory() as folder:
        save_file({"a": stored}, Path(folder) / "some.safetensors")
        direction = read_direction(f"{folder}/some.safetensors")
    basis = direction.basis.astype(np.float64)
    assert len(basis) == rank
    np.testing.assert_allclose(basis @ basis.T, np.eye(rank), atol=1e-5)
    projected = direction.vectors @ basis.T @ basis
    np.testing.assert_allclose(projected, direction.vectors, atol=0.1 if "16" in dtype else 1e-5)
    assert bool(direction.note) == bool(extra)


def test_a_file_that_holds_no_directions_is_refused(tmp_path: Path) -> None:
    for ending in ("npz", "safetensors"):
        path = tmp_path / f"broken.{ending}"
        path.write_bytes(b"no such format")
        with pytest.raises(UsageError, match="broken"):
            read_direction(str(path))
    with pytest.raises(UsageError, match="there is no file"):
        read_direction(str(tmp_path / "absent.npz"))


@pytest.mark.parametrize("entry", ["[]", '{"a": 1}', '{"a": {}, "a": {}}', "{"])
def test_descriptions_of_directions_must_be_an_object_with_their_names(tmp_path: Path, entry: str) -> None:
    np.savez(tmp_path / "some.npz", allow_pickle=False, a=np.ones(3), directions=np.array(entry))
    with pytest.raises(UsageError, match="holds no directions"):
        read_direction(str(tmp_path / "some.npz"))


@pytest.mark.parametrize("settings", ["[]", '{"metadata": "here"}', "{", "pipe"])
def test_settings_of_an_autoencoder_that_are_none_are_refused_and_never_waited_for(
    tmp_path: Path, settings: str
) -> None:
    from safetensors.numpy import save_file

    save_file({"W_dec": np.ones((1, 3), np.float32)}, tmp_path / "sae_weights.safetensors")
    if settings == "pipe":
        os.mkfifo(tmp_path / "cfg.json")
    else:
        (tmp_path / "cfg.json").write_text(settings, encoding="utf-8")
    with pytest.raises(UsageError, match="Save the autoencoder again"):
        read_direction(f"{tmp_path}#0")


@pytest.mark.parametrize(
    ("width", "about", "mention"),
    [
        (WIDTH - 1, {}, "has 95 numbers; backbone.02 has 96"),
        (WIDTH, {"weights": "0" * 64}, "was found in the weights"),
        (WIDTH, {"site": "backbone.01"}, "not of backbone.02|is a direction of backbone.01"),
    ],
)
def test_another_width_model_or_site_is_refused(
    session: SceneSession, tmp_path: Path, width: int, about: dict[str, str], mention: str
) -> None:
    path = written(tmp_path / "some.npz", {"a": np.ones(width)}, **about)
    interchange = Interchange(sites=(SITE,), roles=("image",), direction=str(path), controls=0)
    with pytest.raises(UsageError, match=mention):
        interchange.conditions(session)


@pytest.mark.slow
def test_patching_within_the_whole_space_is_patching_in_full(session: SceneSession, tmp_path: Path) -> None:
    path = written(tmp_path / "all.npz", {"all": np.eye(WIDTH)})
    within = Interchange(sites=(SITE,), roles=("image",), direction=str(path))
    full = Interchange(sites=(SITE,), roles=("image",))
    pairs = session.pairs(str(session.run.episodes["item_id"][0]))
    (*_, a), (*_, b) = (
        replay(session, pairs, intervention.conditions(session)).displacement for intervention in (within, full)
    )
    np.testing.assert_allclose(a, b, atol=1e-5)
    assert within.parameters()["direction"].startswith("all-")
    assert "vector" not in within.parameters()


def test_steering_adds_so_many_vectors_of_the_file(session: SceneSession, tmp_path: Path) -> None:
    """By hand: a hook that adds the vector to the picture's tokens."""
    vector = np.random.default_rng(0).normal(size=WIDTH)
    path = written(tmp_path / "one.safetensors", {"one": vector}, site=SITE)
    steering = Steering(sites=(SITE,), role="image", direction=f"{path}#one", coefficients=(2.0,), controls=1)
    conditions = steering.conditions(session)
    steered = next(condition for condition in conditions if condition.name.endswith(f"|{steering.direction}|2"))
    pair = replace(session.pairs(str(session.run.episodes["item_id"][0]))[0], side=None)
    chunk = steered.play(ConditionContext(session, pair)).chunk

    def add(activation: Any, point: Any) -> Any:
        activation[0, point.roles.mask("image")] += 2 * activation.new_tensor(vector)
        return activation

    np.testing.assert_allclose(
        chunk, run_with_hooks(session.policy, pair.clean, {SITE: add}, pair.seed), atol=1e-5
    )
    (bases,) = directions_of(session, steering).values()
    control = bases.shift("control-1", pair.episode, 1.0)
    assert np.linalg.norm(control) == pytest.approx(np.linalg.norm(vector), rel=1e-5)
    assert abs(float(control @ vector)) < 1e-3 * np.linalg.norm(vector) ** 2


def directions_of(session: SceneSession, steering: Steering) -> dict[Cell, Directions]:
    cells = [Cell(site_group, steering.role) for site_group in resolve_sites(SITE, session.policy)]
    return steering.fit_directions(session, cells, steering.sites)
