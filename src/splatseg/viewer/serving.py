"""What the command line serves a scene with."""

from splatseg.viewer._answers import opener as opener
from splatseg.viewer._fitting import FittingScene as FittingScene
from splatseg.viewer._fitting import FittingWatch as FittingWatch
from splatseg.viewer._server import ViewServer as ViewServer
from splatseg.viewer._worker import Worker as Worker
