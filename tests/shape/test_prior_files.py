"""Files of priors of every kind are read back by their content, and wrong or truncated files are named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from helpers.kitti_folder import write_data_set
from helpers.priors import KINDS, prior_of
from safetensors.torch import load_file, save_file
from torch import nn

from directshape_torch.cli.main import main
from directshape_torch.errors import DataFormatError
from directshape_torch.io.result_files import read_shapes
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.status import Status


def write(kind: str, folder: Path) -> Path:
    path = folder / "prior.safetensors"
    prior = prior_of(kind)
    assert isinstance(prior, nn.Module)
    prior.save(path)
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_says_of_which_kind_it_is(kind: str, tmp_path: Path) -> None:
    path, prior = write(kind, tmp_path), prior_of(kind)
    read = load_prior(path)
    assert type(read) is type(prior)
    assert read.origin.dtype == torch.float32
    assert not [p for p in read.named_parameters() if p[1].requires_grad]
    code = torch.linspace(-1, 1, prior.num_codes)[None]
    torch.testing.assert_close(read.values(code).double(), prior.values(code.double()), atol=1e-5, rtol=0)
    first = path.read_bytes()
    prior.save(path)
    assert path.read_bytes() == first
    assert list(tmp_path.iterdir()) == [path]


def test_names_are_bundled_priors_and_paths_are_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(load_prior("pca"), PCAShapePrior)
    assert isinstance(load_prior("neural"), NeuralShapePrior)
    monkeypatch.chdir(tmp_path)
    for file in ("./neural", Path("neural")):
        with pytest.raises(DataFormatError, match=r"cannot be read.*bundled ones are pca and neural"):
            load_prior(file)


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_files_say_what_is_wrong(kind: str, tmp_path: Path) -> None:
    good, bad = write(kind, tmp_path), tmp_path / "bad.safetensors"
    content = good.read_bytes()
    for damaged in (content[:5], content[:200], content[:-4], b"", b"no tensors at all" * 100):
        bad.write_bytes(damaged)
        with pytest.raises(DataFormatError, match=r"bad\.safetensors: not a whole safetensors file .*make one with"):
            load_prior(bad)
    tensors, description = load_file(good), json.loads(_metadata(good)["description"])
    name = sorted(tensors)[0]

    def changed(**changes: object) -> Path:
        save_file(tensors, bad, {"description": json.dumps({**description, **changes})})
        return bad

    with pytest.raises(DataFormatError, match="schema 'other/9' is none of directshape_torch"):
        load_prior(changed(schema="other/9"))
    with pytest.raises(DataFormatError, match=r"prior.*; make one with: (python scripts/|directshape build-prior)"):
        load_prior(changed(provenance={"made_at": "home"}))
    save_file(tensors, bad)
    with pytest.raises(DataFormatError, match="schema 'none' is none of"):
        load_prior(bad)
    kept = tensors.pop(name)
    with pytest.raises(DataFormatError, match=name.split(".")[-1]):
        load_prior(changed())
    tensors[name] = torch.full_like(kept, torch.nan)
    with pytest.raises(DataFormatError, match=f"{name} holds values that are no finite"):
        load_prior(changed())
    tensors[name] = kept.flatten()[:1]
    with pytest.raises(DataFormatError, match=r"expected|size mismatch"):
        load_prior(changed())
    wrong_kind = PCAShapePrior.load if kind == "neural" else NeuralShapePrior.load
    with pytest.raises(DataFormatError, match=r"prior\.safetensors"):
        wrong_kind(good)


def _metadata(path: Path) -> dict[str, str]:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        return dict(file.metadata())


def test_the_refine_command_takes_another_kind_than_pca(tmp_path: Path) -> None:
    root, out = tmp_path / "kitti", tmp_path / "out"
    root.mkdir()
    write_data_set(root, ("000000",))
    words = ["refine", "--data", root, "--detections", root / "detections", "--masks", root / "masks", "--out", out]
    options = ["--prior", write("neural", tmp_path), "--device", "cpu"]
    trusting = ["acceptance.min_probability_better=0", "acceptance.min_probability_not_worse=0"]
    settings = [
        "--set",
        "stages=[{max_iterations: 2}]",
        "check=off",
        "search=off",
        "sampling.max_pixels=200",
        *trusting,
    ]
    assert main([str(word) for word in (*words, *options, *settings, "sampling.min_pixels=100")]) == 0
    shapes = read_shapes(out / "shapes" / "000000.npz")
    assert shapes.codes.shape == (2, prior_of("neural").num_codes)
    refined = [Status[status].is_refined for status in shapes.statuses]
    assert any(refined)
