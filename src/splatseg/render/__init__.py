"""W of a view and its adjoint: one rasteriser with one signal argument of any width."""

from splatseg.render._backend import Backend as Backend
from splatseg.render._backend import BackendName as BackendName
from splatseg.render._backend import default_options as default_options
from splatseg.render._backend import get_backend as get_backend
from splatseg.render._backend import options_for as options_for
from splatseg.render._rows import CompactRows as CompactRows
from splatseg.render._rows import SparseWeights as SparseWeights
from splatseg.render._values import BackProjected as BackProjected
from splatseg.render._values import Contributors as Contributors
from splatseg.render._values import Rendered as Rendered
from splatseg.render._values import RenderOptions as RenderOptions
from splatseg.render._values import SparseBackProjected as SparseBackProjected
from splatseg.render._values import SparseImage as SparseImage
from splatseg.render._values import SparseSignal as SparseSignal
from splatseg.render._values import StrongestChannels as StrongestChannels
from splatseg.render.once import back_project as back_project
from splatseg.render.once import contributors as contributors
from splatseg.render.once import render as render
from splatseg.render.once import weights as weights
from splatseg.render.prepared import PreparedView as PreparedView
from splatseg.render.prepared import prepare as prepare
