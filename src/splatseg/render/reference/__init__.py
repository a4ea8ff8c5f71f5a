"""The readable backend: what the others are held to. See `_composite` for the model."""

from splatseg.render.reference._backend import ReferenceBackend as ReferenceBackend
