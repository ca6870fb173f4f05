"""Results are indexed, moved, converted, stored and printed as users of tensors expect."""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from functools import lru_cache
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.synthetic_scene import cached_street, disturbed
from safetensors.torch import load, save

from directshape_torch import (
    Detections,
    DirectShapeRefiner,
    InputError,
    MissingDependencyError,
    RefinementResult,
)
from directshape_torch.status import Status

PRIOR, STREET = cached_street()


@lru_cache(maxsize=1)
def refined() -> RefinementResult:
    return DirectShapeRefiner(PRIOR)(STREET.frames, disturbed(STREET.detections))


def test_results_are_indexed_like_tensors() -> None:
    result = refined()
    assert len(result) == 2
    turned, nothing = (slice(None, None, -1), [1, 0]), (slice(0, 0), [])
    for index, rows in ((1, [1]), (-1, [1]), (slice(None), [0, 1]), turned, nothing, ([1, 0], [1, 0])):
        part = result[index]
        torch.testing.assert_close(part.T_cam_obj, result.T_cam_obj[rows])
        torch.testing.assert_close(part.quality.mask_iou_left, result.quality.mask_iou_left[rows])
        assert part.profile.offsets_px.equal(result.profile.offsets_px)
        assert len(part.ground_source) == len(part.status) == len(rows)
        assert part.term_names == result.term_names
    good = torch.tensor([False, True])
    assert result[good].code.equal(result.code[1:])
    assert result[good.numpy()].code.equal(result.code[1:])
    assert [one.status[0] for one in result] == result.status
    for wrong in (2, -3, [2], good[:1], torch.tensor([0.5])):
        with pytest.raises(InputError, match="index: expected"):
            result[wrong]


def test_boxes_in_conventions_and_frames() -> None:
    result, boxes = refined(), refined().boxes()
    kitti = result.to_boxes("kitti", frame="ref")
    torch.testing.assert_close(kitti[:, :3], boxes.location_ref)
    torch.testing.assert_close(kitti[:, 3:6], boxes.dimensions_hwl)
    torch.testing.assert_close(kitti[:, 6], boxes.rotation_y)
    in_cam = result.to_boxes("kitti")
    torch.testing.assert_close(in_cam[:, :3] - kitti[:, :3], result.t_cam_ref)
    # A car that was refined has its axes within a tilt of upright: the corners enclose its middle.
    corners = result.corners()
    torch.testing.assert_close(corners.mean(dim=1), result.to_boxes("opencv")[:, :3], atol=1e-6, rtol=0)
    torch.testing.assert_close(corners - result.corners("ref"), result.t_cam_ref[:, None].expand(-1, 8, -1))
    again = Detections.from_boxes(result.to_boxes("mmdet3d_camera"), "mmdet3d_camera", mask_left=torch.ones(2, 9, 9))
    torch.testing.assert_close(again.dimensions_hwl, boxes.dimensions_hwl)
    from_corners = Detections.from_boxes(corners, "kitti", mask_left=torch.ones(2, 9, 9))
    torch.testing.assert_close(from_corners.T_cam_obj[:, :3, :3], result.T_cam_obj[:, :3, :3], atol=1e-5, rtol=0)
    torch.testing.assert_close(from_corners.dimensions_hwl, boxes.dimensions_hwl)
    with pytest.raises(InputError, match="T_cam_boxes: expected the rigid motion"):
        result.to_boxes("nuscenes")
    with pytest.raises(InputError, match="frame: expected 'cam' or 'ref', got 'world'"):
        result.to_boxes("kitti", frame="world")  # type: ignore[arg-type]


def test_results_move_and_give_arrays() -> None:
    result = refined()
    single = result.to(dtype=torch.float32)
    assert single.T_cam_obj.dtype == single.boxes().location_ref.dtype == torch.float32
    assert single.covariance.dtype == single.quality.mask_iou_left.dtype == torch.float64
    assert single.prior.origin.dtype == torch.float32
    assert result.prior.origin.dtype == torch.float64  # the refiner's own shapes stay
    assert result.cpu().prior is result.prior
    assert result.to(torch.float32).code.dtype == result.to("cpu", torch.float32).code.dtype == torch.float32
    attached = replace(result, T_cam_obj=result.T_cam_obj.clone().requires_grad_())
    assert not attached.detach().T_cam_obj.requires_grad
    arrays = attached.numpy()
    assert arrays["status"].tolist() == [status.name for status in result.status]
    assert arrays["boxes.rotation_y"].shape == (2,)
    assert arrays["term_names"].tolist() == list(result.term_names)
    np.testing.assert_array_equal(arrays["T_cam_obj"], result.T_cam_obj.numpy())


def test_results_are_stored_without_pickles() -> None:
    result = refined()
    state = result.state_dict()
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    for read in (torch.load(buffer, weights_only=True), load(save(state))):
        again = RefinementResult.from_state_dict(read, PRIOR)
        assert again.state_dict().keys() == state.keys()
        assert all(again.state_dict()[name].equal(value) or value.isnan().any() for name, value in state.items())
        assert again.status == result.status
        assert (again.term_names, again.ground_source) == (result.term_names, result.ground_source)
        torch.testing.assert_close(again.boxes().location_ref, result.boxes().location_ref)
    assert RefinementResult.from_state_dict(result[:0].state_dict(), PRIOR).ground_source == ()
    with pytest.raises(InputError, match=r"state: expected the tensor 'quality\.evidence'"):
        RefinementResult.from_state_dict({k: v for k, v in state.items() if k != "quality.evidence"}, PRIOR)
    with pytest.raises(InputError, match=r"prior: expected the prior of the result, with \d codes"):
        RefinementResult.from_state_dict(replace(result, code=result.code[:, :1]).state_dict(), PRIOR)
    covariance = torch.eye(4, dtype=torch.float64).expand(len(result), 4, 4).clone()
    covariance[1, 0, 0] = -1.0  # of nothing
    for wrong in ({"code": 0 * result.code + 1e9}, {"covariance_xyz_yaw": covariance}):
        with pytest.raises(InputError, match=r"state: expected finite boxes .*, got none of cars \[.*1"):
            RefinementResult.from_state_dict(state | wrong, PRIOR)


def test_meshes_of_all_cars(monkeypatch: pytest.MonkeyPatch) -> None:
    result = refined()
    surfaces = result.meshes()
    assert [mesh.is_watertight for mesh in surfaces] == [True, True]
    monkeypatch.setitem(sys.modules, "pytorch3d", None)
    with pytest.raises(MissingDependencyError, match="needs the package 'pytorch3d'"):
        result.meshes("pytorch3d")
    structures = ModuleType("pytorch3d.structures")
    structures.Meshes = lambda verts, faces: SimpleNamespace(verts=verts, faces=faces)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pytorch3d", ModuleType("pytorch3d"))
    monkeypatch.setitem(sys.modules, "pytorch3d.structures", structures)
    batch = result.meshes("pytorch3d")
    assert [len(vertices) for vertices in batch.verts] == [len(mesh.vertices) for mesh in surfaces]
    assert batch.verts[0].dtype == torch.float64
    assert batch.faces[0].dtype == torch.int64
    with pytest.raises(InputError, match="kind: expected 'trimesh' or 'pytorch3d'"):
        result.meshes("blender")  # type: ignore[arg-type]


def test_a_result_prints_its_cars_and_of_many_those_that_need_a_look() -> None:
    """Car 90 has no mask, car 70 is doubtful, the front of car 1 is unknown; 38 of the others fill the table."""
    result = refined()[[0, 1] * 50]
    result.status_code[90] = Status.no_mask.code
    result.quality.probability_better[:] = 0.9
    result.quality.probability_better[70] = 0.4
    result.quality.probability_heading[1] = 0.5
    lines = repr(result).splitlines()
    assert lines[0] == "RefinementResult of 100 cars (torch.float64, cpu)"
    assert lines[1] == "  99 refined (converged 50, max_iterations 49), 1 as before (no_mask 1)"
    assert lines[2] == f"  no_mask: {Status.no_mask.value}"
    assert [int(line.split()[0]) for line in lines[4:-2]] == [*range(38), 70, 90]
    assert [number for number, line in enumerate(lines[4:-2]) if "?" in line] == [1]
    assert f"{float(result.to_boxes('kitti')[1, 6]):.2f}?" in lines[5]
    assert lines[-1].startswith("  60 more cars are not shown, all refined, none doubtful (better below 0.5)")
    assert lines[-2] == "  ? either end may be the front (quality.probability_heading)"
    result.quality.probability_better[:] = 0.4
    assert "60 more cars are not shown, 60 of them not refined or doubtful" in repr(result)
    assert repr(result[:0]).splitlines()[1:] == ["  no cars"]


def test_a_refiner_and_a_result_in_half_precision_are_refused() -> None:
    with pytest.raises(InputError, match=r"^refiner: expected shapes in float32 or float64, got torch.bfloat16"):
        DirectShapeRefiner(ellipsoid_prior()).bfloat16()(STREET.frames, STREET.detections)
    with pytest.raises(
        InputError, match=r"^dtype: expected float32 or float64, got torch.float16; convert what to_boxes"
    ):
        refined().to(torch.float16)
    with pytest.raises(
        InputError, match=r"^code: expected the dtype of the prior \(torch.float64\), got torch.float32"
    ):
        PRIOR.values(torch.zeros(1, 3))
