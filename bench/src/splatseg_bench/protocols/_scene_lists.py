"""Lists of scenes that publications name, by data set, each with where it stands."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from splatseg.core.boundary import convert_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneList:
    """Scenes of a data set."""

    scenes: tuple[str, ...]
    """As the data set's folders are called."""

    source: str
    """Where they are named."""

    def __post_init__(self) -> None:
        convert_fields(self)


_GAGA_SCANNET = (
    "scene0010_00", "scene0012_00", "scene0033_00", "scene0038_00", "scene0088_00",
    "scene0113_00", "scene0192_00",
)  # fmt: skip

SCENE_LISTS: Mapping[str, Mapping[str, SceneList]] = MappingProxyType(
    {
        "replica": MappingProxyType(
            {
                "dm-nerf": SceneList(
                    scenes=(
                        "office_0", "office_2", "office_3", "office_4", "room_0", "room_1",
                        "room_2",
                    ),
                    source="the README and configs/replica of vLAR-group/DM-NeRF",
                )
            }
        ),
        "scannet": MappingProxyType(
            {
                "dm-nerf": SceneList(
                    scenes=tuple(sorted((*_GAGA_SCANNET, "scene0024_00"))),
                    source="the README and configs/scannet of vLAR-group/DM-NeRF",
                ),
                "gaga": SceneList(scenes=_GAGA_SCANNET, source="Gaga (Lyu et al. 2024)"),
            }
        ),
    }
)  # fmt: skip
"""By layout of the data set, then by the name that a protocol's ``scene_list`` has."""
