"""Mistakes in settings name the key and the nearest one, and the configuration files say what the code does."""

from __future__ import annotations

import dataclasses
import re
import runpy
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml

import directshape_torch
from directshape_torch.config import (
    BackwardConfig,
    RefinerConfig,
    SamplingConfig,
    Settings,
    StageConfig,
)
from directshape_torch.errors import ConfigError, DirectShapeError
from directshape_torch.io.config_files import BUNDLED_CONFIGS, config_from_mapping, config_to_mapping, load_config


@pytest.mark.parametrize(
    ("mapping", "nearest"),
    [
        ({"silhouete": {}}, "silhouette"),
        ({"silhouette": {"wieght": 3}}, "silhouette.weight"),
        ({"solver": {"step_toleranse": 1}}, "solver.step_tolerance"),
        ({"stages": [{"contour_px": 1.0}]}, "stages[0].contour_width_px"),
        ({"solver": {"max_iteration": 3}}, "stages.max_iterations"),  # a setting of another group
        ({"max_code": 2}, "solver.max_code"),
        ({"silhouette": {"huber_grey_level": 2}}, "photometric.huber_grey_levels"),
        ({"photometric": {"wieght": 3}}, "photometric.weight"),  # of equal names the one of the same group
        ({"stages": [{"max_iteration": 3}]}, "stages[0].max_iterations"),
    ],
)
def test_an_unknown_key_names_the_nearest(mapping: dict[str, Any], nearest: str) -> None:
    with pytest.raises(ConfigError) as error:
        config_from_mapping(RefinerConfig, mapping)
    assert "unknown key" in str(error.value)
    assert str(error.value).endswith(f"the nearest known one is {nearest}")


def test_where_none_is_near_an_unknown_key_names_all_of_its_group() -> None:
    with pytest.raises(ConfigError, match=r"unknown key solver\.qqq; known are initial_damping, .*, max_code"):
        config_from_mapping(RefinerConfig, {"solver": {"qqq": 1}})


@pytest.mark.parametrize(
    ("mapping", "text"),
    [
        ({"silhouette": 3}, "silhouette: expected keys and values, got 3"),
        ({"silhouette": {"weight": "heavy"}}, "silhouette.weight: expected a number, got 'heavy'"),
        ({"silhouette": {"weight": True}}, "silhouette.weight: expected a number, got True"),
        ({"silhouette": {"samples_per_ray": 3.5}}, "silhouette.samples_per_ray: expected a whole number, got 3.5"),
        ({"silhouette": {"form": "sum"}}, "silhouette.form: expected one of closest_approach, product, got 'sum'"),
        ({"sampling": {"occlusion": 1}}, "sampling.occlusion: expected true or false, got 1"),
        ({"stages": {"a": 1}}, "stages: expected a list, got {'a': 1}"),
        ({"priors": {"dimensions_sigma_m": [0.1, 0.2]}}, "priors.dimensions_sigma_m: expected 3 entries"),
        ({"priors": {"dimensions_sigma_m": ["x", 1, 1]}}, "priors.dimensions_sigma_m[0]: expected a number"),
        ({"silhouette": {"weight": None}}, "silhouette.weight: expected a number, got None"),
    ],
)
def test_a_value_of_the_wrong_kind_is_named(mapping: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as error:
        config_from_mapping(RefinerConfig, mapping)
    assert text in str(error.value)


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("stages=[]", "stages: expected at least one stage"),
        ("stages=[{contour_width_px: 0}]", "stages[0].contour_width_px: expected a finite number, above 0, got 0.0"),
        (
            "silhouette.samples_per_ray=0",
            "silhouette.samples_per_ray: expected a finite number, at least 1 and at most 4096, got 0",
        ),
        ("silhouette.probability_floor=0.5", "silhouette.probability_floor: expected"),
        ("silhouette.weight=-1", "silhouette.weight: expected a finite number, at least 0, got -1.0"),
        (
            "photometric.huber_grey_levels=.nan",
            "photometric.huber_grey_levels: expected a finite number, above 0, got nan",
        ),
        ("solver.max_code=.inf", "solver.max_code: expected a finite number, above 0, got inf"),
        (
            "priors.dimensions_sigma_m=[0.1, 0, 0.1]",
            "priors.dimensions_sigma_m: expected a finite number, above 0, got (0.1, 0.0, 0.1)",
        ),
        ("sampling.max_pixels=50", "sampling.max_pixels: expected a finite number, at least min_pixels = 400, got 50"),
        ("point_cloud.huber_m=0", "point_cloud.huber_m: expected a finite number, above 0, got 0.0"),
        ("sampling.density=1.5", "sampling.density: expected a finite number, above 0 and at most 1, got 1.5"),
    ],
)
def test_a_value_out_of_range_is_named(override: str, text: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_config(None, [override])
    assert text in str(error.value)


def test_groups_made_in_python_are_checked_too() -> None:
    with pytest.raises(ConfigError, match=r"^compile: expected one of on, off, got True$"):
        RefinerConfig(compile=True)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"^density: expected a finite number, above 0 and at most 1, got '5 %'$"):
        SamplingConfig(density="5 %")  # type: ignore[arg-type]


def test_every_setting_is_described_and_every_number_has_limits() -> None:
    config = RefinerConfig()
    groups = [x for x in vars(config).values() if isinstance(x, Settings)] + [config.stages[0]]
    assert len(groups) == 11
    settings = [(group, field) for group in groups for field in dataclasses.fields(group)]
    assert len(settings) > 50
    for group, field in settings:
        default = getattr(group, field.name)
        assert field.metadata["description"]
        if isinstance(default, (int, float, tuple)) and not isinstance(default, bool):
            assert field.metadata["limits"], field.name


def test_implicit_gradients_need_a_last_stage_at_rest() -> None:
    text = "^stages\\[-1\\].unknowns: backward.mode implicit needs both, got pose$"
    with pytest.raises(ConfigError, match=text):
        RefinerConfig(stages=(StageConfig(unknowns="pose"),), backward=BackwardConfig(mode="implicit"))


def test_round_trip() -> None:
    config = load_config(
        None, ["silhouette.form=product", "priors.dimensions_sigma_m=[0.2, 1, 3]", "solver.max_code=2"]
    )
    assert config.priors.dimensions_sigma_m == (0.2, 1.0, 3.0)
    assert config.solver.max_code == 2.0
    assert config_from_mapping(RefinerConfig, config_to_mapping(config)) == config


def test_on_and_off_are_words_though_yaml_reads_truth_values(tmp_path: Path) -> None:
    file = tmp_path / "off.yaml"
    file.write_text("compile: off\n")
    assert load_config(file).compile == "off"
    assert load_config(None, ["compile=on"]).compile == "on"
    assert config_from_mapping(RefinerConfig, config_to_mapping(RefinerConfig(compile="off"))).compile == "off"


def test_files_and_overrides(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("silhouette: {weight: 5}\nphotometric: {brightness: none}\n", encoding="utf-8")
    config = load_config(path, ["silhouette.weight=6"])
    assert config.silhouette.weight == 6
    assert config.photometric.brightness == "none"
    path.write_text("", encoding="utf-8")
    assert load_config(path) == RefinerConfig()


@pytest.mark.parametrize(
    ("content", "overrides", "text"),
    [
        ("- 1\n", [], "expected keys and values"),
        ("a: [1\n", [], "cannot be read as a YAML configuration"),
        ("solver: 3\n", ["solver.max_code=2"], "solver holds no keys of its own"),
        ("", ["solver.max_code"], "expected key=value"),
        ("", ["solver.max_code=[1"], "the value is not YAML"),
    ],
)
def test_unreadable_files_and_overrides(tmp_path: Path, content: str, overrides: list[str], text: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_config(path, overrides)
    assert text in str(error.value)
    with pytest.raises(DirectShapeError, match=r"none\.yaml: cannot be read"):
        load_config(tmp_path / "none.yaml")


def test_errors_name_file_and_overrides(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("stages: [{unknowns: pose}, {unknowns: all}]\n", encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_config(path)
    assert str(error.value) == f"{path}: stages[1].unknowns: expected one of both, pose, shape, got 'all'"
    with pytest.raises(ConfigError) as error:
        load_config("fast", ["sampling.density=0.1", "sampling.max_pixels=100"])
    assert str(error.value) == (
        "fast --set sampling.density=0.1 --set sampling.max_pixels=100: "
        "sampling.max_pixels: expected a finite number, at least min_pixels = 200, got 100"
    )
    with pytest.raises(ConfigError, match=r"^refiner\.solver\.max_code: expected a finite number, above 0, got 0\.0$"):
        config_from_mapping(RefinerConfig, {"solver": {"max_code": 0}}, "refiner.")


ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs"


def keys(mapping: Any, prefix: str = "") -> set[str]:
    if not isinstance(mapping, dict):
        return {prefix}
    return {key for name, value in mapping.items() for key in keys(value, f"{prefix}.{name}")}


@pytest.mark.parametrize("name", BUNDLED_CONFIGS)
def test_names_stand_for_the_files_of_the_package(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    in_repository = load_config(CONFIGS / f"{name}.yaml")
    monkeypatch.chdir(tmp_path)
    assert load_config(name) == load_config(Path(name)) == in_repository
    (tmp_path / name).write_text("solver: {max_code: 1.5}")
    assert load_config(f"./{name}").solver.max_code == 1.5


def test_every_file_has_a_name_and_is_part_of_the_package() -> None:
    folder = Path(directshape_torch.__file__).parent / "assets" / "configs"
    assert sorted(path.stem for path in folder.glob("*.yaml")) == sorted(BUNDLED_CONFIGS)
    # One place only: the folder at the top is a link.
    assert CONFIGS.resolve() == folder.resolve()
    with pytest.raises(
        ConfigError, match=r"papr: cannot be read .* bundled ones are default, paper, fast, geom.*, combined"
    ):
        load_config("papr")


def test_default_is_what_its_script_writes() -> None:
    text = runpy.run_path(str(ROOT / "scripts" / "write_default_config.py"))["default_yaml"]()
    assert (CONFIGS / "default.yaml").read_text(encoding="utf-8") == text, "run scripts/write_default_config.py"


@pytest.mark.parametrize("name", ["default", "paper"])
def test_no_key_is_left_to_the_defaults(name: str) -> None:
    written = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))
    assert keys(written) == keys(config_to_mapping(RefinerConfig()))


def test_paper_has_the_weights_and_forms_of_the_paper() -> None:
    config = load_config(CONFIGS / "paper.yaml")
    # Paper, section on the energy: lambda_silh = 12, lambda_1 = 10, lambda_2 = 10, lambda_3 = 1e7.
    assert config.silhouette.weight == 12
    assert (config.priors.shape_weight, config.priors.height_weight, config.priors.tilt_weight) == (10, 10, 1e7)
    assert (config.silhouette.form, config.priors.tilt_form) == ("product", "cosine")
    assert (config.photometric.pixel_set, config.sampling.occlusion_order) == ("hit", "box_bottom")
    assert config.solver.initial_damping == 0
    assert config.solver.accept_every_step
    # What the paper does not have.
    assert config.photometric.brightness == "none"
    assert config.priors.dimensions_weight == 0


def test_paper_anneals_the_contour_by_a_factor_of_07() -> None:
    widths = [stage.contour_width_px for stage in load_config(CONFIGS / "paper.yaml").stages]
    assert widths[0] == 4 * widths[-1] == 1.0
    for softer, sharper in pairwise(widths[:-1]):
        assert sharper == pytest.approx(0.7 * softer, abs=1e-3)


def test_paper_names_an_option_that_exists_for_each_deviation() -> None:
    text = (CONFIGS / "paper.yaml").read_text(encoding="utf-8")
    header = text[: text.index("\ncompile:")]
    known = keys(config_to_mapping(RefinerConfig()))
    named = set(re.findall(r"\b(?:photometric|silhouette|sampling|solver|priors)\.(?!md)[a-z_]+(?:\*)?", header))
    assert len(named) >= 6
    for name in named:
        assert any(key == f".{name}" or (name.endswith("*") and key.startswith(f".{name[:-1]}")) for key in known), name


@pytest.mark.parametrize("name", ["geometric", "paper"])
def test_baselines_take_plain_steps(name: str) -> None:
    assert {stage.over_relaxation for stage in load_config(name).stages} == {1.0}
