"""What a move costs in the viewer: pictures of it while a handle is dragged, and clicks after it.

    python benchmarks/viewer_moved.py SCENE [--view 6] [--repeats 9]

In a picture of 720 x 600 from the place of a view the thing in the middle is clicked, and pictures
are drawn of a camera that moves, and of the thing while it is moved and turned, at half the size
and at the whole. Then it is moved, and the middle clicked again. Milliseconds of the wall, medians
of the repeats, in one thread of torch as in the viewer's worker.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

from splatseg.core import View
from splatseg.core.threads import one_torch_thread
from splatseg.io.scene import load_scene
from splatseg.prompting.prompts import ViewPrompt
from splatseg.viewer import _messages as messages
from splatseg.viewer import open_session
from splatseg.viewer._draw import Drawer
from splatseg.viewer._pictures import Pictures
from splatseg.viewer.commands import Apply, Edit

WIDTH, HEIGHT = 720, 600
Quaternion = tuple[float, float, float, float]
STRAIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
TURN: Quaternion = (0.9, 0.1, 0.2, 0.3)


def median(work: Callable[[int], object], repeats: int) -> float:
    """Milliseconds of what is done again and again."""
    spent: list[float] = []
    for turn in range(repeats):
        began = time.perf_counter()
        work(turn)
        spent.append(1e3 * (time.perf_counter() - began))
    return statistics.median(spent)


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("scene", type=Path, help="with views")
    parser.add_argument("--view", type=int, default=6)
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    scene = load_scene(args.scene)
    pose = scene.views[args.view].camera.world_from_cam.numpy()

    def seen(aside: float = 0.0) -> messages.DrawRequest:
        matrix = pose.copy()
        matrix[0, 3] += aside
        return messages.DrawRequest(
            id=1, width=WIDTH, height=HEIGHT, focal=600, matrix=matrix.ravel().tolist()
        )

    with (
        one_torch_thread(),
        tempfile.TemporaryDirectory() as folder,
        open_session(scene, folder=folder) as session,
    ):
        session.prepare()
        pictures = Pictures(session, Drawer(scene, views=session.views))
        middle = torch.tensor([[WIDTH / 2, HEIGHT / 2]])
        eye = View(name="page", camera=seen().camera())

        def click(turn: int) -> None:
            session.select(ViewPrompt(view=eye, points=middle + turn))

        click(0)
        thing = session.document.selection
        if thing is None:
            parser.error("nothing is in the middle of this view")

        def move(turn: int, *, rotation: Quaternion) -> Edit:
            return Edit(kind="move", mask=thing, translation=(0.01 * turn, 0, 0), rotation=rotation)

        def draw(asked: messages.DrawRequest, scale: float, preview: Edit | None = None) -> None:
            pictures.picture(
                asked, asked.camera(), selection=pictures.selection, scale=scale, preview=preview
            )

        count = len(scene.gaussians)
        print(f"{count:,} Gaussians, {thing.count:,} of them move; clicks by {session.source}")
        for scale in (0.5, 1.0):

            def preview(turn: int, scale: float = scale, by: Quaternion = STRAIGHT) -> None:
                draw(seen(), scale, move(turn, rotation=by))

            def turned(turn: int) -> None:
                preview(turn, by=TURN)

            def travelled(turn: int, scale: float = scale) -> None:
                draw(seen(1e-3 * turn), scale)

            spent = [median(work, args.repeats) for work in (travelled, preview, turned)]
            print("scale {}: camera {:.0f}, moved {:.0f}, turned {:.0f} ms".format(scale, *spent))
        before = median(click, args.repeats)
        session.do(Apply(move(1, rotation=TURN)))
        first = median(lambda _: draw(seen(), 1.0), 1)
        print(f"first picture after the move {first:.0f} ms")
        print(f"click before {before:.0f}, after {median(click, args.repeats):.0f} ms")


if __name__ == "__main__":
    main()
