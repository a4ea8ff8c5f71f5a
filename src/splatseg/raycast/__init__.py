"""Where rays meet triangles first: Embree's search, and its readable twin.

`RayCaster` needs the package ``embreex`` (``pip install 'splatseg[mesh]'``);
`splatseg.raycast.reference` compares every ray with every triangle.
"""

from splatseg.raycast._caster import RayCaster as RayCaster
from splatseg.raycast._hits import RayHits as RayHits
from splatseg.raycast._hits import through_triangles as through_triangles
