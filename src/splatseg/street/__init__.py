"""Street scenes as deformable neural mesh primitives, with labels for any point.

A drive's points become a sparse grid of small watertight meshes (`street.shapes`), whose shapes are
fitted to depth (`street.geometry`), and which carry colour, opacity and classes for rays that hit
them (`street.radiance`). The whole is a `core.Renderable`, `MeshField`.
"""
