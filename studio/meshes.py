"""Meshes for the page and for exports, from a MuJoCo model: what can be seen, as binary glTF."""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import scipy.sparse
import trimesh
from trimesh.visual.material import PBRMaterial

from controller.types import Array, Pose

CREASE = np.cos(np.radians(35.0))  # faces that meet at less than this angle are shaded as one smooth surface
LAST_VISIBLE_GROUP = 2  # MuJoCo's convention: what only collides is in group 3 and above
ROUNDNESS = 24  # sides of a tessellated cylinder
GHOST_SWELL = 0.0015  # [m] a hull stands off the surface that it covers, against z-fighting

Material = tuple[float, ...]  # red, green, blue, opacity (sRGB), roughness


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh in some body's frame."""

    vertices: Array  # (n, 3) [m]
    faces: Array  # (m, 3) indices

    def moved(self, pose: Pose) -> Mesh:
        return Mesh(pose.apply(self.vertices), self.faces)


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """All in one, vertices kept apart."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]),
    )


def visible_geoms(model: mujoco.MjModel, bodies: Iterable[int]) -> list[int]:
    """Ids of the geoms of `bodies` that one can see; planes, which the stage draws, are not among them."""
    wanted = set(bodies)
    return [
        geom
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] in wanted
        and model.geom_group[geom] <= LAST_VISIBLE_GROUP
        and model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE
        and _material(model, geom)[3] > 0.0
    ]


def glb_of(model: mujoco.MjModel, geoms: Iterable[int], frame_from_body: Callable[[int], Pose]) -> bytes:
    """Geoms as one binary glTF with one mesh per material, in the frame that `frame_from_body` maps to."""
    by_material: dict[Material, list[Mesh]] = defaultdict(list)
    for geom in geoms:
        placed = geom_mesh(model, geom).moved(frame_from_body(int(model.geom_bodyid[geom])))
        by_material[_material(model, geom)].append(creased(placed))
    scene = trimesh.Scene()
    for material, meshes in by_material.items():
        scene.add_geometry(_shaded(merged(meshes), material))
    with io.BytesIO() as file:
        scene.export(file, file_type="glb", include_normals=True)
        return file.getvalue()


def geom_mesh(model: mujoco.MjModel, geom: int) -> Mesh:
    """One geom's mesh in its body's frame; primitives are tessellated."""
    size = model.geom_size[geom]
    match mujoco.mjtGeom(model.geom_type[geom]):
        case mujoco.mjtGeom.mjGEOM_MESH:
            mesh = _asset(model, int(model.geom_dataid[geom]))
        case mujoco.mjtGeom.mjGEOM_BOX:
            mesh = _from_trimesh(trimesh.creation.box(extents=2.0 * size))
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            mesh = _from_trimesh(trimesh.creation.cylinder(size[0], 2.0 * size[1], sections=ROUNDNESS))
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            mesh = _from_trimesh(
                trimesh.creation.capsule(2.0 * size[1], size[0], count=(ROUNDNESS, ROUNDNESS // 2))
            )
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            mesh = _ellipsoid(np.repeat(size[0], 3))
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            mesh = _ellipsoid(size)
        case other:
            raise ValueError(f"Geom {model.geom(geom).name!r} is a {other.name}; the page cannot draw that.")
    return mesh.moved(Pose(model.geom_pos[geom].copy(), model.geom_quat[geom].copy()))


def creased(mesh: Mesh) -> Mesh:
    """The same surface with a vertex of its own for each smooth face around it.

    The corners of one smooth patch share a vertex, so that shading is continuous across it, and edges
    sharper than the crease angle stay sharp.
    """
    corners = mesh.faces.ravel()
    _, patch = np.unique(
        np.column_stack((corners, np.round(_corner_normals(mesh) * 50.0))), axis=0, return_inverse=True
    )
    _, first, patch = np.unique(patch.ravel(), return_index=True, return_inverse=True)
    return Mesh(mesh.vertices[corners[first]], patch.reshape(-1, 3))


def hull(meshes: Sequence[Mesh]) -> Mesh:
    """The convex hull around some meshes, slightly swollen, with few faces: the shape of a ghost."""
    points = np.concatenate([mesh.vertices for mesh in meshes])
    shape = trimesh.convex.convex_hull(np.unique(np.round(points, 3), axis=0))
    return _from_trimesh(trimesh.Trimesh(shape.vertices + GHOST_SWELL * shape.vertex_normals, shape.faces))


def linear(srgb: Array) -> Array:
    """Linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _asset(model: mujoco.MjModel, mesh: int) -> Mesh:
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    return Mesh(
        np.array(model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]], dtype=float),
        np.array(model.mesh_face[face : face + model.mesh_facenum[mesh]], dtype=int),
    )


def _ellipsoid(radii: Array) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=2)
    return Mesh(np.asarray(ball.vertices) * radii, np.asarray(ball.faces))


def _from_trimesh(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.array(mesh.vertices), np.array(mesh.faces))


def _face_normals(mesh: Mesh) -> Array:
    """(m, 3), as long as twice the face's area [m²]."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def _corner_normals(mesh: Mesh) -> Array:
    """(3 m, 3) unit normal at each face's corners: the mean over the faces around it that go on smoothly."""
    weighted = np.repeat(_face_normals(mesh), 3, axis=0)
    normals = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-18)
    corners = mesh.faces.ravel()
    n = len(corners)
    touches = scipy.sparse.csr_array((np.ones(n), (np.arange(n), corners)))
    corner, other = (touches @ touches.T).nonzero()  # pairs of corners at one vertex
    smooth = np.einsum("ij,ij->i", normals[corner], normals[other]) > CREASE
    total = normals * 1e-12
    np.add.at(total, corner[smooth], weighted[other[smooth]])
    unit: Array = total / np.linalg.norm(total, axis=1, keepdims=True).clip(1e-30)
    return unit


def _shaded(mesh: Mesh, material: Material) -> trimesh.Trimesh:
    *color, opacity, roughness = material
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    shape.visual = trimesh.visual.TextureVisuals(
        material=PBRMaterial(
            baseColorFactor=[*(linear(np.array(color))), opacity],  # glTF's factors are linear
            metallicFactor=0.0,
            roughnessFactor=roughness,
            alphaMode="OPAQUE" if opacity == 1.0 else "BLEND",
        )
    )
    return shape


def _material(model: mujoco.MjModel, geom: int) -> Material:
    material = int(model.geom_matid[geom])
    if material < 0:
        return (*model.geom_rgba[geom].tolist(), 0.8)
    # A matte surface has no highlights; nothing here is a mirror.
    roughness = 0.85 - 0.7 * float(model.mat_specular[material])
    return (*model.mat_rgba[material].tolist(), roughness)
