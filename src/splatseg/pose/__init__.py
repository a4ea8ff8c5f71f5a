"""From photographs or a video to cameras and start points; see ``docs/poses.md``.

The names below load at first use: the process that does the work with pycolmap imports this
package too, and needs none of torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatseg.pose._options import CameraSharing as CameraSharing
    from splatseg.pose._options import Mapper as Mapper
    from splatseg.pose._options import Matching as Matching
    from splatseg.pose._options import PoseOptions as PoseOptions
    from splatseg.pose._photographs import holds_photographs as holds_photographs
    from splatseg.pose._recover import PoseProgress as PoseProgress
    from splatseg.pose._recover import PoseResult as PoseResult
    from splatseg.pose._recover import recover_poses as recover_poses
    from splatseg.pose._report import LeftOut as LeftOut
    from splatseg.pose._report import MapperTry as MapperTry
    from splatseg.pose._report import PoseReport as PoseReport
    from splatseg.pose._saved import load_pose_report as load_pose_report
    from splatseg.pose._video import is_video as is_video

_HOMES = {
    "splatseg.pose._options": "CameraSharing Mapper Matching PoseOptions",
    "splatseg.pose._photographs": "holds_photographs",
    "splatseg.pose._recover": "PoseProgress PoseResult recover_poses",
    "splatseg.pose._report": "LeftOut MapperTry PoseReport",
    "splatseg.pose._saved": "load_pose_report",
    "splatseg.pose._video": "is_video",
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Load a public name at its first use."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted(_HOME_OF)
