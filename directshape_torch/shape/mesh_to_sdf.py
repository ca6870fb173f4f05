"""This module makes signed distance grids of CAD files' meshes, which are open, have gaps and loose sheets of glass.

The surface is voxelised finely, gaps are closed, what the outside cannot reach is solid, and the distance transform of
that solid is sampled at the nodes of a coarser grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError, MeshError, UnlikelyMeshError
from directshape_torch.files.mesh_files import read_mesh
from directshape_torch.numerics.checks import check_positive
from directshape_torch.shape.car_looks import check_looks
from directshape_torch.shape.outlines import AXES, Outlines, surface_points

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]
Voxels = NDArray[np.bool_]

# A solid car fills 60 to 85 percent of its convex hull; a shell that the flood fill entered fills a few percent.
_LEAST_SHARE_OF_HULL = 0.4
# Distance transforms need some twenty bytes for each voxel.
_MOST_VOXELS = 2**27
# Rounding may move corners by at most this share of the size of a mesh, which is 8 mm for a car.
_LARGEST_STEP = 0.002


@dataclass(frozen=True)
class GridSpec:
    """A `GridSpec` says where the nodes of a signed distance grid lie, in the object frame, in metres."""

    origin: tuple[float, float, float]
    spacing_m: float
    shape: tuple[int, int, int]

    def nodes(self) -> Array:
        """Positions of all nodes, (nx, ny, nz, 3), metres."""
        axes = [o + self.spacing_m * np.arange(n) for o, n in zip(self.origin, self.shape, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    @classmethod
    def for_cars(cls, spacing_m: float = 0.1) -> GridSpec:
        """A grid for cars up to 5.2 m long, 2 m high and 2 m wide, with 0.2 m or more around them and below the ground.

        Examples:
            >>> GridSpec.for_cars().shape
            (59, 26, 27)
        """
        half_length, half_width = (int(np.ceil(size / spacing_m - 1e-9)) for size in (2.9, 1.3))
        above, below = (int(np.ceil(size / spacing_m - 1e-9)) for size in (2.2, 0.3))
        origin = (-half_length * spacing_m, -above * spacing_m, -half_width * spacing_m)
        return cls(origin, spacing_m, (2 * half_length + 1, above + below + 1, 2 * half_width + 1))

    @classmethod
    def around(cls, low: Array, high: Array, spacing_m: float = 0.1) -> GridSpec:
        """A grid for shapes of any class between two corners (3,) in the object frame, with 0.3 m around them.

        Examples:
            >>> GridSpec.around(np.array([-0.3, -1.8, -0.3]), np.array([0.3, 0.0, 0.3])).shape
            (13, 25, 13)
        """
        first, last = np.floor((low - 0.3) / spacing_m + 1e-9), np.ceil((high + 0.3) / spacing_m - 1e-9)
        # The grid is symmetric about the middle plane.
        last[2] = max(last[2], -first[2])
        first[2] = -last[2]
        nx, ny, nz = (int(count) + 1 for count in last - first)
        x, y, z = (spacing_m * first).tolist()
        return cls((x, y, z), spacing_m, (nx, ny, nz))


@dataclass(frozen=True)
class MeshOptions:
    """`MeshOptions` say how a mesh file is to be read and made solid."""

    forward_axis: str = "+x"  # the file's axes that point to the car's front and up, as "-y"
    up_axis: str = "+z"
    scale: float = 1.0  # metres per unit of the file
    length_m: float | None = None  # scale the car to this length (after `scale`); None keeps it
    symmetrise: bool = True  # average the field with its left-right mirror image
    voxel_m: float = 0.025  # fine voxel size
    closing_m: float = 0.2  # gaps up to twice this wide are closed. Narrower closings are tried first
    are_cars: bool = True  # refuse meshes that do not look like passenger cars; False for any other class

    def __post_init__(self) -> None:
        for name, axis in (("forward_axis", self.forward_axis), ("up_axis", self.up_axis)):
            if axis not in AXES:
                raise InputError(name, f"one of {', '.join(AXES)}", repr(axis))
        if AXES[self.forward_axis] == AXES[self.up_axis]:
            raise InputError("up_axis", "another axis than forward_axis", repr(self.up_axis))
        lengths = [("scale", self.scale), ("voxel_m", self.voxel_m), ("closing_m", self.closing_m)]
        for name, value in lengths + ([("length_m", self.length_m)] if self.length_m is not None else []):
            check_positive(name, value)


def load_mesh_obj(path: Path | str, options: MeshOptions | None = None) -> trimesh.Trimesh:
    """Read a mesh file and place it in the object frame: x forward, y down, centred in x and z, lowest point at y = 0.

    Raises:
        DataFormatError: the file cannot be read or holds no triangles.
        UnlikelyMeshError: the mesh does not look like a passenger car by the axes and scale of the options; the message
            says by which ones it would. `are_cars=False` switches this check off.
    """
    import trimesh

    return place_mesh(trimesh.Trimesh(*read_mesh(path), process=False), options or MeshOptions(), str(path))


def place_mesh(mesh: trimesh.Trimesh, options: MeshOptions, name: str = "mesh") -> trimesh.Trimesh:
    """A copy of a mesh in the object frame, by the axes, scale and length of the options.

    Raises:
        MeshError: the corners are so far from the origin that single precision has rounded them.
        UnlikelyMeshError: the mesh does not look like a passenger car; see `load_mesh_obj`.
    """
    import trimesh

    mesh = mesh.copy()
    # Vertices without a triangle are invisible and would move the mesh.
    mesh.remove_unreferenced_vertices()
    _check_steps(np.asarray(mesh.vertices), name)
    if options.are_cars:
        axes, size = (options.forward_axis, options.up_axis), (options.scale, options.length_m)
        check_looks(Outlines.of_triangles(np.asarray(mesh.triangles, dtype=np.float64)), *axes, *size, name=name)
    forward, up = _unit(options.forward_axis), _unit(options.up_axis)
    R_obj_file = np.stack([forward, -up, np.cross(forward, -up)])
    vertices = options.scale * np.asarray(mesh.vertices, dtype=np.float64) @ R_obj_file.T
    if options.length_m is not None:
        vertices *= options.length_m / max(np.ptp(vertices[:, 0]), 1e-9)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices -= [0.5 * (low[0] + high[0]), high[1], 0.5 * (low[2] + high[2])]
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def _check_steps(vertices: Array, name: str) -> None:
    """Refuse a mesh so far from its origin that single precision rounds its corners to visible steps."""
    with np.errstate(all="ignore"):
        step = float(np.spacing(np.float32(np.abs(vertices).max())))
        is_single = bool((vertices == vertices.astype(np.float32)).all())
        size = float(np.ptp(vertices, axis=0).max())
    if is_single and step > _LARGEST_STEP * size:
        raise MeshError(
            f"{name}: corners as far as {np.abs(vertices).max():.4g} from the origin of a mesh of size {size:.4g} are "
            f"rounded to steps of {step:.2g}; move the mesh to its origin before it is written"
        )


def _unit(axis: str) -> Array:
    return np.asarray(np.eye(3)[AXES[axis]] * (1.0 if axis[0] == "+" else -1.0))


def mesh_to_sdf(
    mesh_obj: trimesh.Trimesh,
    grid: GridSpec,
    options: MeshOptions | None = None,
    name: str = "mesh",
) -> NDArray[np.float32]:
    """Signed distance of a mesh at the nodes of a grid, metres, negative inside, not truncated.

    Args:
        mesh_obj: mesh in the object frame, metres; it need not be watertight.
        grid: where to sample; the mesh should lie inside.
        options: voxel size, closing, symmetry and class (only `load_mesh_obj` uses axes and scale).
        name: name of the mesh, for messages.

    Returns:
        Signed distances (nx, ny, nz), exact to about half a fine voxel.

    Raises:
        MeshError: the mesh cannot be made solid, or does not fit into the grid.
        UnlikelyMeshError: the mesh does not look like a passenger car in the object frame. `are_cars=False` switches
            this check off.

    Examples:
        >>> import trimesh
        >>> box = trimesh.creation.box((4.0, 1.5, 1.6))
        >>> sdf = mesh_to_sdf(box.apply_translation((0, -0.75, 0)), GridSpec.for_cars(0.2), MeshOptions(voxel_m=0.05))
        >>> sdf.shape, bool(abs(sdf.min() + 0.75) < 0.06)
        ((31, 14, 15), True)
    """
    from scipy.ndimage import map_coordinates

    options = options or MeshOptions()
    if options.are_cars:
        _check_placed(mesh_obj, name)
    _check_fits(mesh_obj, grid, name)
    surface, origin = _voxelise(mesh_obj, grid, options)
    solid = _solid(surface, mesh_obj, options, name)
    distance = _signed_distance(solid, options.voxel_m)
    nodes = grid.nodes()

    def sample(points: Array) -> Array:
        index = (points - origin) / options.voxel_m
        return np.asarray(map_coordinates(distance, index.reshape(-1, 3).T, order=1, mode="nearest")).reshape(
            points.shape[:-1]
        )

    sdf = sample(nodes)
    if options.symmetrise:
        sdf = 0.5 * (sdf + sample(nodes * [1.0, 1.0, -1.0]))
    return sdf.astype(np.float32)


def _check_placed(mesh_obj: trimesh.Trimesh, name: str) -> None:
    try:
        check_looks(Outlines.of_triangles(np.asarray(mesh_obj.triangles, dtype=np.float64)), "+x", "-y", name=name)
    except UnlikelyMeshError as problem:
        found = f"{problem.found}; bring it to the object frame (x forward, y down, metres) by place_mesh"
        raise UnlikelyMeshError(found, problem.cure) from problem


def _check_fits(mesh_obj: trimesh.Trimesh, grid: GridSpec, name: str) -> None:
    low = np.array(grid.origin)
    high = low + grid.spacing_m * (np.array(grid.shape) - 1)
    # Infinite sizes fail these comparisons, too.
    if not ((mesh_obj.bounds[0] >= low).all() and (mesh_obj.bounds[1] <= high).all()):
        raise MeshError(
            f"{name}: extents {np.round(mesh_obj.bounds, 2).tolist()} m leave the grid {low.round(2).tolist()} to "
            f"{high.round(2).tolist()} m; check axes and scale, normalise the length, or fit the grid to the mesh "
            "(GridSpec.around, build-prior --not-cars)"
        )


def _voxelise(mesh_obj: trimesh.Trimesh, grid: GridSpec, options: MeshOptions) -> tuple[Voxels, Array]:
    """Fine voxels that the surface passes through, with room for the closing, and the centre of the first voxel."""
    room = options.closing_m + 3 * options.voxel_m
    half_cell = 0.5 * options.voxel_m
    high = np.array(grid.origin) + grid.spacing_m * (np.array(grid.shape) - 1) + room
    # The voxels are symmetric about the middle plane and cover the grid, so that both halves are sampled alike.
    high[2] = max(high[2], -grid.origin[2] + room)
    low = np.minimum(np.array(grid.origin) - room, [np.inf, np.inf, -high[2]])
    shape = [math.ceil(size) + 1 for size in (high - low) / options.voxel_m]
    if math.prod(shape) > _MOST_VOXELS:
        got = f"{math.prod(shape)} by {options.voxel_m:g} m"
        raise InputError("voxel_m", f"at most {_MOST_VOXELS} voxels", got, "raise it, or lower closing_m")
    voxels = np.zeros(shape, dtype=bool)
    for points in surface_points(mesh_obj.triangles, half_cell):
        index = np.floor((points - low) / options.voxel_m + 0.5).astype(int)
        voxels[index[:, 0], index[:, 1], index[:, 2]] = True
    return voxels, low


def _solid(surface: Voxels, mesh_obj: trimesh.Trimesh, options: MeshOptions, name: str) -> Voxels:
    """The voxels that the outside cannot reach, with the narrowest closing that makes the mesh solid."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull_m3 = float(ConvexHull(mesh_obj.vertices).volume)
    except QhullError as problem:
        raise MeshError(f"{name}: is flat, or has fewer than four corners") from problem
    share = 0.0
    for closing_m in (0.25 * options.closing_m, 0.5 * options.closing_m, options.closing_m):
        solid = _fill(surface, closing_m / options.voxel_m)
        share = float(solid.sum()) * options.voxel_m**3 / max(hull_m3, 1e-9)
        if share >= _LEAST_SHARE_OF_HULL:
            return solid
    raise MeshError(
        f"{name}: cannot be made solid: only {100 * share:.0f} percent of its convex hull is enclosed, so "
        f"it has a hole wider than {2 * options.closing_m:.2f} m; close the hole or raise the closing"
    )


def _fill(surface: Voxels, radius: float) -> Voxels:
    """Close gaps of the surface up to twice the radius wide, flood from outside and return the other voxels."""
    from scipy.ndimage import distance_transform_edt, label

    thick = distance_transform_edt(~surface) <= radius
    regions, _ = label(~thick)
    outside = regions == regions[0, 0, 0]
    # The outside grows back by what the closing took from it.
    reached = distance_transform_edt(~outside) <= radius
    return np.asarray(surface | ~reached)


def _signed_distance(solid: Voxels, voxel_m: float) -> Array:
    """Signed distance to the outermost voxel centres of a solid, through which its surface passes on average."""
    from scipy.ndimage import distance_transform_edt

    outside = distance_transform_edt(~solid)
    inside = np.maximum(distance_transform_edt(solid) - 1.0, 0.0)
    return np.asarray(voxel_m * (outside - inside))
