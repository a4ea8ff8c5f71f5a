"""Progress of a fit and of the search for poses on stderr: bars, or lines in a log."""

from collections.abc import Callable, Generator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from splatseg.cli._progress import lines_on_stderr
from splatseg.fit import FitProgress
from splatseg.pose import PoseProgress

# Weight of the newest view in the figures of the progress line; views differ much.
_SMOOTHING = 0.02


class _Smoothed:
    """Loss and PSNR of single views, smoothed over many of them."""

    def __init__(self) -> None:
        self._values: tuple[float, float] | None = None

    def text(self, now: FitProgress) -> str:
        """What a line of progress says of a step."""
        loss, psnr = self._values or (now.loss, now.psnr)
        loss += _SMOOTHING * (now.loss - loss)
        psnr += _SMOOTHING * (now.psnr - psnr)
        self._values = loss, psnr
        speed = now.step / max(now.seconds, 1e-9)
        return (
            f"step {now.step}, loss {loss:.4f}, PSNR {psnr:.2f}, {now.count} Gaussians, "
            f"{speed:.1f} it/s"
        )


@contextmanager
def fit_progress() -> Generator[Callable[[FitProgress], None]]:
    """Share done, smoothed loss and PSNR, count, speed, estimate."""
    smoothed = _Smoothed()
    lines = lines_on_stderr("fit")
    if lines is not None:

        def write(now: FitProgress) -> None:
            text = smoothed.text(now)
            lines.show(now.progress, 1.0, text=text, seconds_left=now.seconds_left)

        yield write
        return
    columns = (
        TextColumn("fit"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f}%"),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0, left="")
        shown = 0.0

        def show(now: FitProgress) -> None:
            nonlocal shown
            text = smoothed.text(now)
            if now.seconds - shown < 0.25:
                return
            shown = now.seconds
            left = f"{now.seconds_left / 60:.1f} min left"
            bar.update(task, completed=now.progress, description=text, left=left)

        yield show


@contextmanager
def pose_progress() -> Generator[Callable[[PoseProgress], None]]:
    """The stage and how much of it is done."""
    lines = lines_on_stderr("poses")
    if lines is not None:

        def write(now: PoseProgress) -> None:
            # Stages take differently long: there is no estimate of the whole.
            lines.show(now.done, None, text=_stage(now))

        yield write
        return
    columns = (
        TextColumn("poses"),
        BarColumn(bar_width=24),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)

        def show(now: PoseProgress) -> None:
            bar.update(task, description=_stage(now), completed=now.done, total=now.total or None)

        yield show


def _stage(now: PoseProgress) -> str:
    return f"{now.stage} {now.done}/{now.total}" if now.total else now.stage
