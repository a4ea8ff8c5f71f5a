"""The CPU backend: the C++ kernels of ``native/`` behind torch tensors."""

from splatseg.render.cpu._backend import CpuBackend as CpuBackend
from splatseg.render.cpu._threads import isa as isa
from splatseg.render.cpu._threads import set_isa as set_isa
from splatseg.render.cpu._threads import set_threads as set_threads
from splatseg.render.cpu._threads import threads as threads
from splatseg.render.cpu._view import CpuView as CpuView
from splatseg.render.cpu._view import SceneGradients as SceneGradients
