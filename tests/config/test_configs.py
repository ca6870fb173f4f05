"""The configuration files say what the code does."""

from __future__ import annotations

import runpy
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml

import directshape_torch
from directshape_torch.config import RefinerConfig
from directshape_torch.errors import ConfigError
from directshape_torch.io.config_files import BUNDLED_CONFIGS, config_to_mapping, load_config

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
