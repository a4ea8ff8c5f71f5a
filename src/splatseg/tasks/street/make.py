"""The mesh field that a person asks for, in the folder of its scene: whole, or in blocks."""

from splatseg.core import Renderable, Scene
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.scene import FOLDER, scene_field_names, scene_field_path
from splatseg.io.scene_folder import work_on_scene
from splatseg.render import BackendName
from splatseg.street.build import DnmpOptions
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks.scene_parts import scene_field
from splatseg.tasks.street._build import chosen_options
from splatseg.tasks.street._names import check_field_name, is_stopped
from splatseg.tasks.street.drive import StreetDrive, street_drive
from splatseg.tasks.street.field import StreetField, save_street_field, street_field
from splatseg.tasks.street.options import StreetOptions


@boundary
def make_street_field(
    scene: Scene,
    *,
    options: StreetOptions | None = None,
    field_options: DnmpOptions | None = None,
    overwrite: bool = False,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> StreetField | StreetDrive:
    """Make a mesh field of a drive and write it into the folder of its scene.

    Args:
        scene: The scene. It may have no Gaussians.
        options: What the field is made from; with a length of blocks it is a drive in blocks,
            which goes on where it was stopped.
        field_options: How; None is the default, or the published setting where `options` ask
            for it.
        overwrite: Replace a field of the same name, of whatever form.
        backend: Who renders Gaussians for their depth.
        observer: Is told of the progress.

    Raises:
        InputError: If there is a field of this name, or something asked for cannot be used.
        FileFormatError: If a file is damaged.
    """
    options = options or StreetOptions()
    root = scene.root
    if root is None:
        raise InputError("scene: expected one with a folder to write a field to, got none.")
    if options.block_length is not None:
        return street_drive(
            scene,
            options=options,
            field_options=field_options,
            overwrite=overwrite,
            backend=backend,
            observer=observer,
        )
    if not overwrite:
        check_field_name(root, options.field, in_blocks=False)
    with work_on_scene(root, "street", writes=[FOLDER]):
        made = street_field(
            scene,
            options=options,
            field_options=field_options,
            backend=backend,
            observer=observer,
        )
        save_street_field(made, root)
    return made


@boundary
def made_street_field(
    scene: Scene,
    *,
    options: StreetOptions | None = None,
    field_options: DnmpOptions | None = None,
) -> Renderable | None:
    """The field of this name that a scene has.

    Args:
        scene: The scene.
        options: Of which field, whether it is made in blocks, and whether as published.
        field_options: Of these the rule by which points ask vertices, where one is asked for, is
            that of the field that is there, too.

    Returns:
        None where `make_street_field` is to be asked: where there is none, or where blocks that
        were stopped are gone on with.

    Raises:
        FileFormatError: If its file is damaged.
        MissingFileError: If it was stopped, and is not asked for in blocks.
        InputError: If the field does not know what the rule needs.
    """
    options = options or StreetOptions()
    if scene.root is None or options.field not in scene_field_names(scene.root):
        return None
    in_blocks = options.block_length is not None
    if in_blocks and is_stopped(scene_field_path(scene.root, options.field)):
        return None
    chosen = chosen_options(options, field_options)
    default = chosen.vertex_rule is None and chosen.setting == "fast"
    rule = None if default else chosen.effective_vertex_rule
    return scene_field(scene, options.field, vertex_rule=rule)
