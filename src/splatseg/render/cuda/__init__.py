"""The CUDA backend: gsplat's kernels behind the same interface. Loaded only when asked for."""

from splatseg.render.cuda._backend import CudaBackend as CudaBackend
from splatseg.render.cuda._view import GSPLAT_ALPHA_MAX as GSPLAT_ALPHA_MAX
