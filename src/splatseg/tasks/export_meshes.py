"""Meshes of the objects of a layer: views rendered once, fused and textured object by object."""

from collections.abc import Generator, Sequence

import torch

from splatseg.core import Labels, View
from splatseg.errors import InputError, import_package
from splatseg.io.export import (
    ImageTexture,
    NoMesh,
    ObjectMesh,
    ObjectRow,
    TriangleMesh,
    VertexColours,
    write_object_meshes,
)
from splatseg.mesh import (
    Grid,
    MapStore,
    ViewMaps,
    bake_texture,
    convex_hulls,
    fuse_object,
    map_store,
    pixel_size,
    render_maps,
    seen_colours,
    vertex_normals,
)
from splatseg.prompting.next_click import choose_cameras, choose_views
from splatseg.tasks.export_labels import ExportJob

_MAX_VIEWS = 200
"""Most views that are rendered, those that show most of the objects, spread apart."""

_VIEWS_OF_OBJECT = 24
"""Most views that an object is made from, of the rendered ones."""

_MIN_GAUSSIANS = 10
_MIN_PIXELS = 16
"""Fewest pixels of an object in a view that counts."""

_TEXELS = 2.0
"""Texels along a voxel: a voxel is at least as large as a pixel, so that no more is seen."""

_HULL_RESOLUTION = 40
"""Voxels along the longest side of the surface that is decomposed into hulls: of ten thousand
triangles CoACD takes 6 s, of a hundred thousand minutes."""

_NOTED = 5


def export_meshes(job: ExportJob) -> dict[int, str]:
    """Write the folder of meshes; gives the files by object id.

    Raises:
        InputError: If the scene has no views, or no object has a mesh.
        MissingPackageError: If a package of the extra `mesh` is not installed.
    """
    options, work = job.options, job.work
    _check_packages(job)
    objects, rows = job.objects, job.rows()
    without: list[NoMesh] = []

    def noting(made: Generator[ObjectMesh | NoMesh]) -> Generator[ObjectMesh | NoMesh]:
        for one in made:
            if isinstance(one, NoMesh):
                without.append(one)
            yield one

    with map_store() as store:
        _render(job, objects, store)
        files = write_object_meshes(
            noting(_meshes(job, rows, store)),
            job.output,
            format=options.mesh_format or "glb",
            about=job.about,
            up=work.scene.up,
            metres_per_unit=work.scene.metres_per_unit,
        )
    if without:
        named = ", ".join(
            f"{f'{one.row.id} {one.row.name}'.strip()} ({one.reason})" for one in without[:_NOTED]
        )
        more = f" and {len(without) - _NOTED} more" if len(without) > _NOTED else ""
        work.observer.note(f"without a mesh: {named}{more}")
    return files


def _check_packages(job: ExportJob) -> None:
    """Refuse before the work what would fail after it."""
    for name, needed in (
        ("trimesh", True),
        ("skimage", True),
        ("xatlas", job.options.mesh_format != "ply"),
        ("coacd", job.options.hulls),
    ):
        if needed:
            import_package(name, "an export of meshes", "mesh")


def _render(job: ExportJob, objects: Labels, store: MapStore) -> None:
    """Render the views that show most of the objects."""
    work = job.work
    among = work.scene.train_views or work.scene.views
    if not among:
        raise InputError("meshes: expected a scene with views that see its surfaces, got none.")
    weights = torch.where(objects.ids.cpu() >= 0, work.gaussians.opacities.detach().cpu(), 0.0)
    views: Sequence[View] = choose_views(work.gaussians, among, weights, most=_MAX_VIEWS)
    with work.observer.stage("render") as step:
        for done, view in enumerate(views, start=1):
            store.add(render_maps(work.gaussians, objects, view, backend=work.backend))
            step(done, len(views))


def _meshes(
    job: ExportJob, rows: Sequence[ObjectRow], store: MapStore
) -> Generator[ObjectMesh | NoMesh]:
    """One object after another."""
    with job.work.observer.stage("meshes") as step:
        for done, row in enumerate(rows, start=1):
            yield _mesh_of(job, row, store)
            step(done, len(rows))


def _mesh_of(job: ExportJob, row: ObjectRow, store: MapStore) -> ObjectMesh | NoMesh:
    if row.gaussians < _MIN_GAUSSIANS:
        reason = f"{row.gaussians} Gaussians where {_MIN_GAUSSIANS} are needed"
        return NoMesh(row=row, reason=reason)
    pixels = torch.tensor(store.pixels_of(row.id), dtype=torch.float64)
    worth = torch.where(pixels >= _MIN_PIXELS, pixels, 0.0)
    maps = [store[i] for i in choose_cameras(store.cameras, worth, most=_VIEWS_OF_OBJECT)]
    size = pixel_size(maps, row.id)
    if not maps or not size > 0:
        return NoMesh(row=row, reason="no view sees its surface")
    if not bool(row.box.size.max() > 0):
        return NoMesh(row=row, reason="its Gaussians have no extent")
    grid = _grid(row, resolution=job.options.resolution, min_voxel=size)
    surface = fuse_object(maps, row.id, grid)
    if surface is None:
        return NoMesh(row=row, reason="thinner than a voxel")
    return _coloured(job, row, maps, surface, grid)


def _grid(row: ObjectRow, *, resolution: int, min_voxel: float) -> Grid:
    box = row.box
    return Grid.about(
        box.centre, box.size, box.rotation, resolution=resolution, min_voxel=min_voxel
    )


def _coloured(
    job: ExportJob, row: ObjectRow, maps: Sequence[ViewMaps], surface: TriangleMesh, grid: Grid
) -> ObjectMesh:
    normals = vertex_normals(surface)
    tolerance = grid.truncation
    hulls: Sequence[TriangleMesh] = ()
    if job.options.hulls:
        coarse = _grid(row, resolution=_HULL_RESOLUTION, min_voxel=grid.voxel)
        rough = fuse_object(maps, row.id, coarse)
        hulls = convex_hulls(surface, coarse=rough)
    if job.options.mesh_format == "ply":
        found = seen_colours(surface.vertices, normals, maps, row.id, tolerance=tolerance)
        mesh, colour = surface, VertexColours(colours=found.colours, seen=found.seen)
        seen = float(found.seen.double().mean())
    else:
        texture = bake_texture(
            surface, maps, row.id, tolerance=tolerance, texel=grid.voxel / _TEXELS
        )
        # The charts' vertices are the surface's, doubled.
        mesh = TriangleMesh(vertices=surface.vertices[texture.source], faces=texture.faces)
        normals = normals[texture.source]
        colour, seen = ImageTexture(uv=texture.uv, image=texture.image), texture.seen
    return ObjectMesh(
        row=row,
        mesh=mesh,
        normals=normals,
        colour=colour,
        facts={
            "vertices": len(surface.vertices),
            "triangles": len(surface.faces),
            "watertight": surface.is_watertight,
            "volume": _figure(surface.volume),
            "seen": _figure(seen),
            "views": len(maps),
            "voxel": _figure(grid.voxel),
            "hulls": len(hulls),
        },
        hulls=hulls,
    )


def _figure(value: float) -> float:
    """Six significant digits, as the tables of objects have."""
    return float(f"{value:.6g}")
