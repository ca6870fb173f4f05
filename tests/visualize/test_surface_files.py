"""GLB and PLY files, read back by libraries that did not write them, hold the shapes of the run and its image."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.finished_run import FinishedRun
from numpy.typing import NDArray
from plyfile import PlyData

from directshape_torch.io.result_files import read_shapes, write_shapes
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.visualize.export_run import export_run
from directshape_torch.visualize.painted_cars import MIRRORED, NEUTRAL, NEUTRAL_RGB, SEEN

Floats = NDArray[np.float64]
LINES = (1, 3)


@pytest.fixture(scope="module")
def exported(finished: FinishedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("surfaces")
    export_run(finished.inputs(), folder, ["glb", "ply"])
    return folder


class Glb:
    """A `Glb` is a binary glTF file as pygltflib reads it."""

    def __init__(self, path: Path) -> None:
        from pygltflib import GLTF2

        self.gltf = GLTF2().load(str(path))
        self.nodes = {node.name: node for node in self.gltf.nodes if node.mesh is not None}

    def attribute(self, name: str, attribute: str) -> NDArray[np.generic]:
        primitive = self.gltf.meshes[self.nodes[name].mesh].primitives[0]
        accessors = {**vars(primitive.attributes), "indices": primitive.indices}
        assert self.gltf.accessors[accessors[attribute]].normalized == (attribute == "COLOR_0")
        return self.numbers(accessors[attribute])

    def numbers(self, place: int) -> NDArray[np.generic]:
        accessor = self.gltf.accessors[place]
        view = self.gltf.bufferViews[accessor.bufferView]
        kind = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor.componentType]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor.type]
        content = self.gltf.binary_blob()[view.byteOffset + (accessor.byteOffset or 0) :]
        assert accessor.count * width * np.dtype(kind).itemsize <= view.byteLength
        return np.frombuffer(content, kind, accessor.count * width).reshape(-1, width)

    def matrix(self, name: str) -> Floats:
        """The transform from a node to the world; glTF stores columns first."""
        return np.array(self.nodes[name].matrix).reshape(4, 4).T

    def extras(self, name: str) -> dict[str, object]:
        return dict(self.gltf.meshes[self.nodes[name].mesh].extras)


@functools.cache
def glb(path: Path) -> Glb:
    return Glb(path)


def distances(run: FinishedRun, frame_id: str, car: int, points_cam: Floats) -> Floats:
    """Distances of points from the surface that the npz describes, by the signed distance field itself."""
    arrays = run.state(frame_id)
    T = arrays["T_cam_obj"][car].astype(np.float64)
    points_obj = (points_cam - T[:3, 3]) @ T[:3, :3]
    shape = run.prior.bind(torch.from_numpy(arrays["codes"][car : car + 1]).to(run.prior.origin))
    points = torch.from_numpy(points_obj).to(run.prior.origin)
    return shape.value(points, torch.zeros(len(points), dtype=torch.int64)).numpy()


def extents(run: FinishedRun, frame_id: str, car: int, points_cam: Floats) -> Floats:
    """Height, width and length of points along the axes of the car."""
    R = run.state(frame_id)["T_cam_obj"][car][:3, :3].astype(np.float64)
    length, height, width = np.ptp(points_cam @ R, axis=0)
    return np.array([height, width, length])


def srgb(linear: NDArray[np.generic]) -> Floats:
    """Bytes of an image for 16-bit linear colours of glTF."""
    c = linear.astype(np.float64) / 65535
    return 255 * np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.maximum(c, 1e-9) ** (1 / 2.4) - 0.055)


def image_at(run: FinishedRun, frame_id: str, points_cam: Floats) -> Floats:
    """The left image at the projections of points, by OpenCV's interpolation."""
    uv = points_cam @ run.P_left(frame_id)[:, :3].T
    uv = (uv[:, :2] / uv[:, 2:]).astype(np.float32)[:, None]
    bgr = cv2.imread(str(run.root / f"training/image_2/{frame_id}.png"))
    return cv2.remap(bgr, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)[:, 0, ::-1].astype(np.float64)


@pytest.mark.parametrize("car", [0, 1])
def test_glb_surface_is_the_zero_level_of_the_npz(finished: FinishedRun, exported: Path, car: int) -> None:
    file, name = glb(exported / "glb" / "000000.glb"), f"car_{LINES[car]}"
    points = file.attribute(name, "POSITION").astype(np.float64)
    assert np.abs(distances(finished, "000000", car, points)).max() < 0.02
    np.testing.assert_allclose(
        extents(finished, "000000", car, points), finished.state("000000")["boxes_hwl"][car], atol=1e-3
    )
    faces = file.attribute(name, "indices").reshape(-1, 3).astype(np.int64)
    # Each edge of a closed surface belongs to two triangles, once in each direction.
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert set(map(tuple, edges)) == set(map(tuple, edges[:, ::-1]))
    a, b, c = points[faces].transpose(1, 0, 2)
    volume = (np.cross(a, b) * c).sum() / 6
    height, width, length = finished.state("000000")["boxes_hwl"][car]
    assert volume == pytest.approx(np.pi / 6 * height * width * length, rel=0.1)


def test_glb_stands_upright_and_looks_along_minus_z(exported: Path) -> None:
    file = glb(exported / "glb" / "000000.glb")
    for name in ("car_1", "car_3", "ground"):
        np.testing.assert_array_equal(file.matrix(name), np.diag([1.0, -1.0, -1.0, 1.0]))
    points = file.attribute("car_1", "POSITION") @ file.matrix("car_1")[:3, :3].T
    normals = file.attribute("ground", "NORMAL").astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert normals[:, 1].max() < -0.9
    ground = file.attribute("ground", "POSITION") @ file.matrix("ground")[:3, :3].T
    assert points[:, 1].min() > ground[:, 1].max() - 0.3
    assert points[:, 2].max() < 0


def test_glb_shows_the_image_where_it_is_seen(finished: FinishedRun, exported: Path) -> None:
    file = glb(exported / "glb" / "000000.glb")
    colours = file.attribute("car_1", "COLOR_0")
    source = file.attribute("car_1", "_COLOR_SOURCE")[:, 0]
    points = file.attribute("car_1", "POSITION").astype(np.float64)
    assert set(np.unique(source)) == {NEUTRAL, MIRRORED, SEEN}
    seen = source == SEEN
    np.testing.assert_allclose(srgb(colours[seen, :3]), image_at(finished, "000000", points[seen]), atol=1.01)
    np.testing.assert_allclose(srgb(colours[source == NEUTRAL, :3]) - NEUTRAL_RGB, 0, atol=0.01)
    assert (colours[:, 3] == 65535).all()
    # What is seen is turned towards the camera; what is mirrored is not.
    normals = file.attribute("car_1", "NORMAL").astype(np.float64)
    towards = -(points * normals).sum(1) > 0
    assert towards[seen].all()
    assert towards[source == MIRRORED].mean() < 0.4


def test_mirrored_colours_are_those_of_the_other_side(finished: FinishedRun, exported: Path) -> None:
    file = glb(exported / "glb" / "000000.glb")
    colours = file.attribute("car_1", "COLOR_0")[:, :3].astype(np.int64)
    source = file.attribute("car_1", "_COLOR_SOURCE")[:, 0]
    T = finished.state("000000")["T_cam_obj"][0].astype(np.float64)
    points_obj = (file.attribute("car_1", "POSITION") - T[:3, 3]) @ T[:3, :3]
    seen, mirrored = np.flatnonzero(source == SEEN), np.flatnonzero(source == MIRRORED)[::23]
    assert len(mirrored) > 20
    for vertex in mirrored:
        x, y, z = points_obj[vertex]
        way = np.linalg.norm(points_obj[seen] - [x, y, -z], axis=1)
        # By the distance, not the vertex: the two sides of a symmetric mesh have vertices that are equally far.
        nearest = seen[way < way.min() + 1e-4]
        assert way.min() <= 0.12
        assert (colours[nearest] == colours[vertex]).all(axis=1).any()


def test_glb_carries_what_is_known_of_a_car(finished: FinishedRun, exported: Path) -> None:
    extras = glb(exported / "glb" / "000001.glb").extras("car_3")
    arrays = finished.state("000001")
    assert extras["line"] == 3
    assert extras["status"] == arrays["statuses"][1]
    np.testing.assert_allclose(extras["dimensions_hwl_m"], arrays["boxes_hwl"][1])


def ply(path: Path, columns: Sequence[str] = "xyz") -> Floats:
    """Columns of a PLY file's vertices."""
    vertex = PlyData.read(str(path))["vertex"]
    return np.stack([vertex[name] for name in columns], 1).astype(float)


RGB, NORMAL = ("red", "green", "blue"), ("nx", "ny", "nz")


def test_ply_has_the_surface_and_the_colours_of_glb(exported: Path) -> None:
    file, path = glb(exported / "glb" / "000001.glb"), exported / "ply" / "000001_3.ply"
    np.testing.assert_allclose(ply(path), file.attribute("car_3", "POSITION"), atol=1e-5)
    np.testing.assert_allclose(ply(path, NORMAL), file.attribute("car_3", "NORMAL"), atol=1e-5)
    np.testing.assert_allclose(ply(path, RGB), srgb(file.attribute("car_3", "COLOR_0")[:, :3]), atol=0.01)
    np.testing.assert_array_equal(ply(path, ["color_source"]), file.attribute("car_3", "_COLOR_SOURCE"))
    faces = np.stack(PlyData.read(str(path))["face"]["vertex_indices"])
    np.testing.assert_array_equal(faces, file.attribute("car_3", "indices").reshape(-1, 3))


def test_without_images_everything_is_grey(finished: FinishedRun, tmp_path: Path) -> None:
    export_run(finished.inputs(with_images=False), tmp_path, ["glb", "ply"])
    file = glb(tmp_path / "glb" / "000000.glb")
    assert set(file.nodes) == {"car_1", "car_3"}
    assert (file.attribute("car_1", "_COLOR_SOURCE") == NEUTRAL).all()
    assert len(np.unique(file.attribute("car_1", "COLOR_0"), axis=0)) == 1
    assert sorted(path.name for path in (tmp_path / "ply").iterdir()) == [
        f"{frame}_{line}.ply" for frame in ("000000", "000001") for line in LINES
    ]


def test_equal_runs_give_equal_bytes(finished: FinishedRun, exported: Path, tmp_path: Path) -> None:
    export_run(finished.inputs(), tmp_path, ["glb", "ply"])
    names = sorted(path.relative_to(exported) for path in exported.rglob("*.*"))
    assert len(names) == 6
    for name in names:
        assert (exported / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_a_frame_without_refined_cars_has_no_surfaces(finished: FinishedRun, tmp_path: Path) -> None:
    out = Path(shutil.copytree(finished.out, tmp_path / "out"))
    path = out / "shapes" / "000000.npz"
    write_shapes(path, replace(read_shapes(path), statuses=("no_mask", "singular")))
    run = RunFolder(out, [0])
    export_run(finished.inputs(run), tmp_path / "images", ["glb", "ply"])
    assert set(glb(tmp_path / "images" / "glb" / "000000.glb").nodes) == {"ground"}
    export_run(finished.inputs(run, with_images=False), tmp_path / "plain", ["glb", "ply"])
    assert glb(tmp_path / "plain" / "glb" / "000000.glb").nodes == {}
    assert not list(tmp_path.rglob("*.ply"))
